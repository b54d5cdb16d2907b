"""Pages with the viewer in a real browser, in real time: the picture, and its controls."""

import dataclasses
import io
import os
import time

import numpy as np
import pytest

import nanogs
from browsers import CHROMIUM, SOFTWARE
from builders import random_splats, solid
from conftest import scene_path
from nanogs.metrics import psnr
from nanogs.raster.rendering import render
from nanogs.scoring.run import compare_files
from nanogs.scoring.viewing import view_files
from nanogs.splats import RenderMode
from viewer_bundle import require_bundle
from views_and_scores import opening_camera

pytestmark = [
    pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed"),
    pytest.mark.filterwarnings("default"),  # the driver's own warnings are not ours
]
VIEW = "#nanogs-view"
BARE = f"{VIEW} > :not(canvas) {{ opacity: 0 !important; }} canvas {{ outline: none !important; }}"
TIMEOUT = 60_000  # milliseconds


@pytest.fixture(scope="module")
def driver():
    require_bundle()
    from playwright.sync_api import sync_playwright

    with sync_playwright() as started:
        yield started


@pytest.fixture(scope="module")
def chromium(driver):
    browser = driver.chromium.launch(executable_path=CHROMIUM, args=SOFTWARE)
    yield browser
    browser.close()


class OpenedPage:
    """A page in the browser, with the requests it made and the errors it had."""

    def __init__(self, browser, path, width=200, height=160, **options):
        size = {"width": width, "height": height}
        self.context = browser.new_context(viewport=size, **options)
        self.page = self.context.new_page()
        self.requests, self.errors = [], []
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on(
            "console",
            lambda message: self.errors.append(message.text) if message.type == "error" else None,
        )
        self.page.goto(path.as_uri())

    def settle(self):
        self.page.wait_for_selector(f"{VIEW}[data-state=still]", timeout=TIMEOUT)

    def pixels(self):
        """Return the pixels of the models once nothing moves, (H, W, 3) float32 in [0, 1]."""
        from PIL import Image

        self.settle()
        picture = self.page.locator(f"{VIEW} canvas").screenshot(style=BARE)
        image = Image.open(io.BytesIO(picture)).convert("RGB")
        return np.asarray(image, dtype=np.float32) / 255

    def sees(self, condition):
        """Return the pixels once they meet the condition; an input takes time to arrive."""
        end = time.monotonic() + TIMEOUT / 2000
        while not condition(pixels := self.pixels()):
            assert time.monotonic() < end, "the picture did not become what it should be"
            self.page.wait_for_timeout(50)
        return pixels

    def close(self):
        foreign = [url for url in self.requests if not url.startswith(("file:", "data:", "blob:"))]
        self.context.close()
        assert foreign == []
        assert self.errors == []


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A red model and a blue one, and pages of both and of the red one."""
    require_bundle()
    folder = tmp_path_factory.mktemp("pages")
    nanogs.save(solid((1, 0, 0)), folder / "red.ply")
    nanogs.save(solid((0, 0, 1)), folder / "blue.ply")
    inputs = [
        ("red", folder / "red.ply"),
        ("a blue one with quite a long name", folder / "blue.ply"),
    ]
    view_files(inputs, folder / "two.html", views=1, width=32, height=32, background=(0, 0.5, 0))
    view_files(inputs[:1], folder / "one.html")
    return folder


@pytest.fixture
def two(chromium, files):
    opened = OpenedPage(chromium, files / "two.html")
    opened.settle()
    yield opened
    opened.close()


def is_red(pixels):
    return (pixels[..., 0] > 0.5) & (pixels[..., 2] < 0.2)


def is_blue(pixels):
    return (pixels[..., 2] > 0.5) & (pixels[..., 0] < 0.2)


def is_background(pixels):
    return np.abs(pixels - (0, 128 / 255, 0)).max(axis=-1) < 0.02


def edge(pixels):
    """Return the column where red ends and blue begins, as a share of the width."""
    columns = np.arange(pixels.shape[1])
    red, blue = columns[is_red(pixels).any(axis=0)], columns[is_blue(pixels).any(axis=0)]
    assert red.max() < blue.min()
    return blue.min() / pixels.shape[1]


def edge_at(share):
    return lambda pixels: edge(pixels) == pytest.approx(share, abs=0.015)


def same_as(picture):
    return lambda pixels: np.array_equal(pixels, picture)


def changed(pixels, picture, share=0.01):
    """Whether more than this share of the picture has changed."""
    return (np.abs(pixels - picture).max(axis=-1) > 0.1).mean() > share


def test_each_side_shows_its_model_in_front_of_the_background(two):
    pixels = two.pixels()
    half = pixels.shape[1] // 2
    left, right = pixels[:, :half], pixels[:, half:]
    assert is_red(left).mean() > 0.1
    assert is_blue(right).mean() > 0.1
    assert not is_blue(left).any()
    assert not is_red(right).any()
    assert is_background(left).mean() > 0.3
    assert is_background(right).mean() > 0.3


def test_the_divider_moves_by_mouse_and_by_keys(two):
    slider = two.page.get_by_role("slider")
    assert slider.get_attribute("aria-valuenow") == "50"
    two.sees(edge_at(0.5))
    mouse = two.page.mouse
    mouse.move(100, 40)
    mouse.down()
    mouse.move(120, 60)
    mouse.up()
    two.sees(edge_at(0.6))
    mouse.move(80, 40)  # after the release: the divider stays
    two.page.keyboard.press("ArrowLeft")  # the divider has the focus now
    two.sees(edge_at(0.58))
    for key, share in ((",", "56"), (".", "58"), ("PageDown", "48"), ("End", "100"), ("Home", "0")):
        two.page.keyboard.press(key)
        assert slider.get_attribute("aria-valuenow") == share
    two.sees(lambda pixels: is_blue(pixels).any() and not is_red(pixels).any())


def test_mouse_and_keys_move_the_camera_of_both_sides(two):
    first = two.pixels()
    page = two.page

    def both_changed(pixels):
        half = pixels.shape[1] // 2
        sides = (np.s_[:, :half], np.s_[:, half:])
        return all(changed(pixels[side], first[side]) for side in sides)

    def moved(action):
        """Return the picture after the action, and go back to the first view."""
        for _ in range(3):
            action()
        pixels = two.sees(both_changed)
        page.keyboard.press("0")
        two.sees(same_as(first))
        return pixels

    def drag(button="left"):
        page.mouse.move(40, 80)
        page.mouse.down(button=button)
        page.mouse.move(60, 95, steps=3)
        page.mouse.up(button=button)

    moved(lambda: page.keyboard.press("ArrowRight"))
    moved(lambda: page.keyboard.press("ArrowUp"))
    moved(lambda: page.keyboard.press("Shift+ArrowDown"))
    nearer = moved(lambda: page.keyboard.press("+"))
    farther = moved(lambda: page.keyboard.press("-"))
    assert (
        is_background(nearer).mean() < is_background(first).mean() < is_background(farther).mean()
    )
    moved(drag)
    moved(lambda: drag("right"))
    moved(lambda: page.mouse.wheel(0, 300))


def test_touches_move_divider_and_camera_on_a_phone(chromium, files):
    opened = OpenedPage(chromium, files / "two.html", 240, 400, has_touch=True, is_mobile=True)
    opened.settle()
    first = opened.pixels()
    session = opened.context.new_cdp_session(opened.page)

    def swipe(*fingers):
        """Move each finger in a straight line from one point to another."""
        for share, kind in ((0, "touchStart"), (0.5, "touchMove"), (1, "touchMove")):
            points = [
                {"x": a[0] + share * (b[0] - a[0]), "y": a[1] + share * (b[1] - a[1]), "id": i}
                for i, (a, b) in enumerate(fingers)
            ]
            session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
        session.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})

    swipe(((120, 200), (150, 210)))
    opened.sees(edge_at(150 / 240))
    swipe(((150, 200), (120, 200)))
    swipe(((40, 260), (80, 280)))
    turned = opened.sees(lambda pixels: edge_at(0.5)(pixels) and changed(pixels, first, 0.003))
    swipe(((40, 200), (20, 200)), ((80, 200), (100, 200)))
    opened.sees(lambda pixels: is_background(pixels).mean() < is_background(turned).mean() - 0.05)
    opened.page.get_by_role("button", name="First view").tap()
    opened.sees(same_as(first))
    opened.close()


@pytest.fixture(scope="module")
def helping(chromium, files):
    """A page on a phone, with its help shown."""
    opened = OpenedPage(chromium, files / "two.html", 390, 844)
    opened.settle()
    opened.page.get_by_role("button", name="Help").click()
    yield opened
    opened.close()


@pytest.mark.parametrize(("width", "height"), [(390, 844), (844, 390), (1200, 800)])
def test_labels_and_help_fit_any_screen(helping, width, height):
    page = helping.page
    page.set_viewport_size({"width": width, "height": height})
    helping.settle()
    boxes = {
        name: page.locator(name).bounding_box()
        for name in (".nv-left", ".nv-right", ".nv-help", ".nv-bar")
    }
    for box in boxes.values():
        assert min(box["x"], box["y"]) >= 0
        assert box["x"] + box["width"] <= width
        assert box["y"] + box["height"] <= height
    left, right = boxes[".nv-left"], boxes[".nv-right"]
    assert left["x"] + left["width"] <= width / 2 <= right["x"]
    assert boxes[".nv-help"]["y"] + boxes[".nv-help"]["height"] <= boxes[".nv-bar"]["y"]
    text = page.locator(".nv-right").inner_text()
    assert "a blue one" in text
    assert "300 splats" in text
    assert "PSNR" in text
    assert "kB" in text
    if folder := os.environ.get("NANOGS_SCREENSHOTS"):
        page.screenshot(path=f"{folder}/view_{width}.png")


def test_a_model_written_as_a_page_is_named_after_its_file(chromium, files, tmp_path):
    nanogs.save(nanogs.load(files / "red.ply"), tmp_path / "first.html")
    page = (tmp_path / "first.html").rename(tmp_path / "a b\u00fc%.html")
    opened = OpenedPage(chromium, page)
    opened.settle()
    assert opened.page.title() == "a b\u00fc%"
    assert "a b\u00fc%" in opened.page.inner_text(VIEW)
    opened.close()


def test_a_long_name_leaves_the_models_visible(chromium, files):
    opened = OpenedPage(chromium, files / "two.html", 360, 640)
    opened.settle()
    names = opened.page.locator(".nv-label strong").all()
    assert len(names) == 2
    for name in names:
        name.evaluate("name => { name.textContent = 'a_very_long_name_'.repeat(12) }")
        assert name.bounding_box()["height"] < 640 / 8
    status = opened.page.locator(".nv-status")
    status.evaluate("it => { it.textContent = 'a sentence '.repeat(9); it.hidden = false }")
    assert status.bounding_box()["width"] > 0.8 * 360
    opened.close()


def test_a_page_of_one_model_has_no_divider(chromium, files):
    opened = OpenedPage(chromium, files / "one.html")
    opened.settle()
    assert opened.page.get_by_role("slider").count() == 0
    assert is_red(opened.pixels()).mean() > 0.1
    opened.close()


@pytest.mark.parametrize(
    ("degree", "mode", "min_psnr"),
    [(0, RenderMode.DEFAULT, 46), (3, RenderMode.DEFAULT, 40), (0, RenderMode.MIP, 46)],
)
def test_the_page_shows_what_nanogs_renders(chromium, tmp_path, degree, mode, min_psnr):
    """`min_psnr` is their PSNR in dB; colours and sizes are those of a trained model."""
    require_bundle()
    splats = random_splats(400, degree=degree)
    splats = dataclasses.replace(
        splats, sh=splats.sh * np.float32(0.4), log_scales=splats.log_scales - 1, render_mode=mode
    )
    nanogs.save(splats, tmp_path / "model.npz")
    rendered, shown = rendered_and_shown(chromium, tmp_path / "model.npz", tmp_path)
    assert rendered.max() > 0.5
    assert psnr(rendered, shown) > min_psnr


@pytest.mark.slow
def test_the_page_shows_a_real_room_as_nanogs_renders_it(chromium, tmp_path):
    """From inside, and trained with antialiasing."""
    rendered, shown = rendered_and_shown(chromium, scene_path("kitchen.spz"), tmp_path)
    assert rendered.mean() > 0.3
    assert psnr(rendered, shown) > 44


def rendered_and_shown(chromium, model, folder):
    """Return the first view as nanogs and as the page draw it, each (200, 200, 3)."""
    require_bundle()
    view_files([("model", model)], folder / "page.html")
    opened = OpenedPage(chromium, folder / "page.html", 200, 200)
    opened.settle()
    shown = opened.pixels()
    opened.close()
    splats = nanogs.load(model)
    camera = opening_camera(splats, 200, 200)
    return render(splats, camera).shown(), shown


def test_a_report_loads_its_models_on_request(chromium, files, tmp_path):
    nanogs.save(solid((0, 0, 1), count=200), tmp_path / "fewer.ply")
    tests = [("blue", files / "blue.ply"), ("blue", tmp_path / "fewer.ply")]
    compare_files(
        ("red", files / "red.ply"), tests, views=1, sizes=[(32, 32)],
        report=tmp_path / "report.html", interactive=True,
    )  # fmt: skip
    opened = OpenedPage(chromium, tmp_path / "report.html", 400, 700)
    page = opened.page
    assert page.locator("canvas").count() == 0
    assert page.evaluate("typeof nanogsViewer") == "undefined"
    page.get_by_role("button", name="Show in 3D").dblclick()
    opened.settle()
    assert page.locator("head > script").count() == 1  # the program is started once
    many = opened.pixels()
    assert is_red(many).any()
    assert is_blue(many).any()
    panel = page.locator(VIEW).bounding_box()
    for name in (".nv-left", ".nv-right"):  # their facts are in the table above
        label = page.locator(name).bounding_box()
        assert label["width"] * label["height"] < 0.06 * panel["width"] * panel["height"]
    chooser = page.get_by_label("Model on the right")
    assert chooser.evaluate("chooser => getComputedStyle(chooser).textOverflow") == "ellipsis"
    chooser.select_option(label="blue: 200 splats (66.67\N{NO-BREAK SPACE}%)")
    assert "200" not in page.locator(".nv-left").inner_text()
    half = many.shape[1] // 2
    fewer = opened.sees(lambda pixels: not np.array_equal(pixels[:, half:], many[:, half:]))
    assert np.array_equal(fewer[:, :half], many[:, :half])
    chooser.select_option(index=0)
    opened.sees(same_as(many))
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
    opened.close()


def test_a_model_chosen_while_the_first_is_read_is_the_one_that_is_shown(chromium, files, tmp_path):
    nanogs.save(solid((0, 0, 1), count=200), tmp_path / "fewer.ply")
    nanogs.save(solid((0, 1, 0)), tmp_path / "green.ply")
    tests = [(name, tmp_path / f"{name}.ply") for name in ("fewer", "green")]
    compare_files(
        ("red", files / "red.ply"), [("blue", files / "blue.ply"), *tests], views=1,
        sizes=[(32, 32)], report=tmp_path / "report.html", interactive=True,
    )  # fmt: skip
    opened = OpenedPage(chromium, tmp_path / "report.html", 400, 700)
    # As soon as the chooser is there: the first model takes some milliseconds to read.
    opened.page.evaluate("""() => new Promise((done) => {
        new MutationObserver((_, observer) => {
            const chooser = document.querySelector("#nanogs-view select");
            if (!chooser) return;
            observer.disconnect();
            for (const index of [1, 2]) {
                chooser.selectedIndex = index;
                chooser.dispatchEvent(new Event("change"));
            }
            done();
        }).observe(document.body, { childList: true, subtree: true });
        document.getElementById("nanogs-load").click();
    })""")
    opened.page.locator(".nv-status").wait_for(state="hidden")
    pixels = opened.pixels()
    green = (pixels[..., 1] > 0.5) & (pixels[..., 0] < 0.2)
    assert green.any()
    assert is_red(pixels).any()
    assert not is_blue(pixels).any()
    assert "green" in opened.page.locator(".nv-right option:checked").inner_text()
    opened.close()


def test_without_webgl_the_page_says_so(driver, files):
    require_bundle()
    browser = driver.chromium.launch(
        executable_path=CHROMIUM, args=["--no-sandbox", "--disable-3d-apis"]
    )
    page = browser.new_page()
    page.goto((files / "one.html").as_uri())
    page.wait_for_selector(f"{VIEW}[data-state=failed]", timeout=TIMEOUT)
    message = page.get_by_role("status").inner_text()
    browser.close()
    assert "WebGL" in message

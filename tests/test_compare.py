"""`compare` and `render`: scores, skipped views, and the report page in a real browser."""

import base64
import io
import json
import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import nanogs
from browsers import CHROMIUM
from builders import random_splats
from launch import run
from nanogs.cli.parsing import parse_background, parse_direction, parse_pixels
from nanogs.errors import ExistsError, ModelError, OptionError
from nanogs.metrics import depth_error
from nanogs.protocol import PackingLoss, Protocol
from nanogs.raster.camera import Camera
from nanogs.raster.images import color_image, depth_image, to_bytes
from nanogs.raster.rendering import Rendering, prepare, render
from nanogs.scoring.comparison import NamedModel, Scoring, compare_models
from nanogs.scoring.page import rate_distortion_plot, render_page
from nanogs.scoring.pictures import data_uri, error_map
from nanogs.scoring.run import compare_files
from nanogs.scoring.scores import mean_psnr
from nanogs.views.pictures import file_names, render_images
from test_cli import assert_refused


def camera(name="front", *, size=48, away=False):
    """Return a camera outside the cube of `random_splats`, facing it or facing away from it."""
    pose = np.eye(4)
    pose[2, 3] = -6.0 if away else 6.0
    return Camera(size, size, size, size, size / 2, size / 2, pose, name)


def simplified(splats, ratio):
    """Return some smaller model; the tests do not depend on the method."""
    return nanogs.simplify(splats, ratio=ratio, preset="fast")[0]


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A model, and two simplifications of it."""
    folder = tmp_path_factory.mktemp("models")
    splats = random_splats(2000, degree=1)
    nanogs.save(splats, folder / "scene.ply")
    for ratio in (0.1, 0.5):
        nanogs.save(simplified(splats, ratio), folder / f"small_{ratio}.ply")
    return folder


def test_a_model_equals_itself_and_a_smaller_one_does_not():
    splats = random_splats(500)
    small = simplified(splats, 0.2)
    models = [NamedModel("same", splats), NamedModel("small", small)]
    comparison, _ = compare_models(NamedModel("ref", splats), models, [camera()])
    same, smaller = comparison.models
    assert math.isinf(same.psnr)
    assert same.ssim == pytest.approx(1)
    assert same.depth == 0
    assert 10 < smaller.psnr < 60
    assert smaller.ssim < 1
    ref, shown = (render(prepare(model), camera(), depth=True) for model in (splats, small))
    error = depth_error(shown.depth, shown.alpha, ref.depth, ref.alpha)
    assert smaller.depth == pytest.approx(error)
    assert error > 0


def test_the_psnr_of_a_model_is_the_mean_over_the_views():
    splats = random_splats(500)
    small = simplified(splats, 0.2)
    cameras = [camera("a"), camera("b", size=64)]
    comparison, _ = compare_models(NamedModel("r", splats), [NamedModel("s", small)], cameras)
    model = comparison.models[0]
    assert [view.view for view in model.views] == ["a", "b"]
    assert model.psnr == pytest.approx(np.mean([view.psnr for view in model.views]))
    assert model.views[0].psnr != model.views[1].psnr


def test_a_view_of_infinite_psnr_does_not_make_the_mean_infinite():
    assert mean_psnr([math.inf, 30.0, 50.0]) == 60
    assert mean_psnr([30.0, 50.0]) == 40
    assert mean_psnr([math.inf, math.inf]) == math.inf


def test_the_worst_view_is_not_better_than_the_mean_of_all():
    """The model differs by rounding only, and the mean counts no view as more than 100 dB."""
    splats = random_splats(500)
    almost_equal = splats.take(np.arange(500))
    almost_equal.sh[...] += np.float32(1e-6)
    scored, _ = compare_models(
        NamedModel("r", splats), [NamedModel("s", almost_equal)], [camera("a")]
    )
    assert scored.models[0].views[0].psnr > 100
    assert scored.models[0].least_psnr == scored.models[0].psnr == 100


def test_an_empty_view_is_left_out_of_the_mean_and_named():
    splats = random_splats(300)
    small = simplified(splats, 0.2)
    with_empty, _ = compare_models(
        NamedModel("r", splats), [NamedModel("s", small)], [camera(), camera("back", away=True)]
    )
    without, _ = compare_models(NamedModel("r", splats), [NamedModel("s", small)], [camera()])
    assert with_empty.skipped_views == ("back",)
    assert any("back" in note for note in with_empty.notes)
    assert with_empty.models == without.models


@pytest.mark.parametrize("empty_views", [3, 4, 9])
def test_many_empty_views_share_one_note(tmp_path, empty_views):
    splats = random_splats(300)
    away = [camera(f"back{number}", away=True) for number in range(empty_views)]
    comparison, _ = compare_models(
        NamedModel("r", splats), [NamedModel("s", splats)], [camera(), *away]
    )
    assert len(comparison.skipped_views) == empty_views
    _, render_notes = render_images(splats, [camera(), *away], tmp_path / "pictures")
    assert len(comparison.notes) == len(render_notes) == (3 if empty_views == 3 else 1)
    more = {4: "1 more view: ", 9: "6 more views: "}.get(empty_views)
    for [note, *_], model in (
        (comparison.notes, "of the reference"),
        (render_notes, "of the model"),
    ):
        assert note.startswith(f"back0, back1, back2 and {more}" if more else "back0: ")
        assert f"nothing {model} is visible" in note


def test_a_comparison_without_a_visible_view_is_refused():
    splats = random_splats(300)
    with pytest.raises(ModelError, match="none of the views"):
        compare_models(NamedModel("r", splats), [NamedModel("s", splats)], [camera(away=True)])


def test_different_sh_degrees_and_nonfinite_rows_are_noted():
    splats = random_splats(300, degree=2)
    flat = random_splats(300, degree=0)
    flat.means[5] = np.nan
    comparison, _ = compare_models(NamedModel("r", splats), [NamedModel("s", flat)], [camera()])
    assert any("SH degree 0" in note for note in comparison.notes)
    assert any("1 splat with" in note for note in comparison.models[0].notes)
    assert math.isfinite(comparison.models[0].psnr)


def test_a_comparison_without_models_or_with_an_unknown_metric_is_refused():
    splats = random_splats(100)
    with pytest.raises(OptionError, match="at least one model"):
        compare_models(NamedModel("r", splats), [], [camera()])
    with pytest.raises(OptionError, match="vmaf"):
        compare_models(
            NamedModel("r", splats),
            [NamedModel("s", splats)],
            [camera()],
            scoring=Scoring(extras=["vmaf"]),
        )


@pytest.mark.parametrize(("side", "kind"), [(16_383, "webp"), (16_384, "jpeg")])
def test_pictures_of_any_side_that_a_view_may_have_are_encoded(side, kind):
    image = np.full((2, side, 3), 0.5, np.float32)
    start, data = data_uri(image).split(",")
    assert start == f"data:image/{kind};base64"
    with Image.open(io.BytesIO(base64.b64decode(data))) as decoded:
        assert decoded.size == (side, 2)


def test_the_error_map_is_black_where_images_are_equal_and_bright_elsewhere():
    a = np.zeros((2, 2, 3), np.float32)
    b = a.copy()
    b[0, 0] = 1
    heat = error_map(a, b)
    assert heat[1, 1].max() < 0.02
    assert heat[0, 0].min() > 0.5
    b[0, 1], b[1, 0] = 0.25, (0.125, 0, 0.25)
    full, half = (
        (0xFC, 0xFF, 0xA4),
        (187, 55, 84),
    )  # half: between the middle two colours of the map
    heat = np.rint(255 * error_map(b, a))
    assert (heat[0, 0] == full).all()
    assert (heat[0, 1] == full).all()
    assert (heat[1, 0] == half).all()


def test_the_plot_has_a_line_for_each_name_and_omits_infinite_psnr():
    splats = random_splats(400)
    models = [NamedModel("ours", simplified(splats, ratio)) for ratio in (0.5, 0.2, 0.1)]
    models.append(NamedModel("all", splats))
    comparison, _ = compare_models(NamedModel("r", splats), models, [camera()])
    svg = rate_distortion_plot(comparison.models)
    assert svg.startswith("<svg")
    assert "ours" in svg
    assert svg.count("<polyline") == 1
    assert rate_distortion_plot(comparison.models[-1:]) == ""
    packed = replace(
        comparison.models[0], name="packed", packed=PackingLoss(".sog", 0.1, 0.001, 60.0, 0.999)
    )
    assert rate_distortion_plot([*comparison.models, packed]) == svg


@pytest.mark.parametrize(("text", "size"), [("512", (512, 512)), ("1280x720", (1280, 720))])
def test_a_picture_size_is_one_number_or_width_x_height(text, size):
    assert parse_pixels(text) == size


@pytest.mark.parametrize(
    "text", ["", "0", "12x", "x12", "0x9", "9x0", "-5", "99999", "9x16385", "16385x9", "1.5", "a"]
)
def test_invalid_picture_sizes_are_refused(text):
    with pytest.raises(OptionError):
        parse_pixels(text)


def test_backgrounds_and_directions_are_parsed_or_refused():
    assert parse_background("white") == (1, 1, 1)
    assert parse_background("#ff8000") == (1, 128 / 255, 0)
    assert parse_direction("0,-1,0.5") == (0, -1, 0.5)
    for bad in ("whit", "#12", "#gggggg"):
        with pytest.raises(OptionError):
            parse_background(bad)
    for bad in ("1,2", "a,b,c", "0,0,0", "0,inf,0", "nan,0,1", "inf,-inf,0"):
        with pytest.raises(OptionError):
            parse_direction(bad)


def test_cameras_whose_pictures_would_have_the_same_file_name_are_refused():
    assert file_names([camera("a/b"), camera("")]) == ["a_b", "view_001"]
    with pytest.raises(OptionError, match="a_b"):
        file_names([camera("a/b"), camera("a?b")])


def test_the_suffix_of_a_photograph_is_dropped_from_file_names():
    """Unless two cameras differ in nothing else."""
    assert file_names([camera("images/v0.png"), camera("v1.JPG")]) == ["images_v0", "v1"]
    assert file_names([camera("a.png"), camera("a.jpg")]) == ["a.png", "a.jpg"]
    assert file_names([camera("v1.5")]) == ["v1.5"]


def test_near_is_bright_in_depth_images_and_no_splat_is_black():
    depth = np.array([[2, 4, 3, np.inf]], np.float32)
    alpha = np.array([[1, 1, 1, 0]], np.float32)
    shown = Rendering(np.zeros((1, 4, 3), np.float32), alpha, depth, None, None, 3, 0, ())
    assert depth_image(shown).tolist() == [[65535, 1, 32768, 0]]


def test_bytes_are_rounded_to_nearest():
    values = np.array([-1, 0.4 / 255, 0.6 / 255, 254.6 / 255, 2, np.nan], np.float32)
    assert to_bytes(values).tolist() == [0, 0, 1, 255, 255, 0]


def test_a_transparent_image_blended_over_white_equals_the_rendering_over_white():
    splats = random_splats(200)
    over_black = render(splats, camera())
    rgba = color_image(over_black, transparent=True) / 255.0
    composed = rgba[..., :3] * rgba[..., 3:] + (1 - rgba[..., 3:]) * (1, 1, 1)
    over_white = np.clip(render(splats, camera(), background=(1, 1, 1)).color, 0, 1)
    inside = over_black.color.max(axis=2) <= over_black.alpha  # elsewhere straight colour exceeds 1
    assert np.abs(composed - over_white)[inside].max() < 0.01


def test_render_writes_pictures_and_replaces_them_only_with_its_flag(files, tmp_path):
    from PIL import Image

    arguments = ("render", files / "scene.ply", tmp_path / "out", "--views", "3")
    result = run(*arguments, "--pixels", "64x48", "--depth", "--json")
    assert result.returncode == 0, result.stderr
    written = json.loads(result.stdout)["images"]
    assert len(written) == 6
    picture = Image.open(written[0])
    assert picture.size == (64, 48)
    assert np.asarray(picture).max() > 0
    again = run(
        "render", files / "scene.ply", tmp_path / "out", "--views", "3", "--pixels", "64x48"
    )
    assert_refused(again, "-w")
    fewer = run(*arguments[:-1], "1", "--pixels", "64x48", "-w")
    assert f"5 older pictures were left in {tmp_path / 'out'}: " in fewer.stderr
    assert len([*(tmp_path / "out").iterdir()]) == 6
    assert "older" not in run(*arguments, "--pixels", "64x48", "--depth", "-w").stderr


def test_compare_prints_json_or_a_table(files):
    models = (files / "scene.ply", files / "small_0.1.ply", f"half={files}/small_0.5.ply")
    arguments = ("compare", *models, "--views", "2", "--pixels", "64")
    report = json.loads(run(*arguments, "--json").stdout)
    assert [model["name"] for model in report["models"]] == ["small_0.1.ply", "half"]
    assert report["models"][0]["psnr"] < report["models"][1]["psnr"]
    assert len(report["models"][0]["views"]) == 2
    table = run(*arguments)
    assert table.returncode == 0
    assert "PSNR" in table.stdout
    assert "half" in table.stdout
    assert "means over 2 held-out views of 64 pixels" in table.stderr
    assert "held-out" not in run(*arguments, "-q").stderr


def test_every_comparison_describes_its_views():
    splats = random_splats(300)
    models = [NamedModel("s", splats)]
    with_cameras, _ = compare_models(NamedModel("r", splats), models, [camera()])
    assert with_cameras.protocol == Protocol(1, (48, 48), "given", None)
    assert with_cameras.judged(0).text == "∞ dB on 1 given view of 48 pixels"
    assert Protocol().text == "8 held-out views of 512 pixels"
    wide = Protocol(3, (64, 48), "inside", "test", (1.0, 1.0, 1.0))
    assert wide.text == "3 held-out views of 64 x 48 pixels over white"
    photographs = Protocol(14, (800, 800), "photographs", "train", (1.0, 0.0, 0.0))
    assert photographs.text == "14 train photographs of 800 pixels over #ff0000"


def test_compare_refuses_invalid_arguments(files, tmp_path):
    scene, small = files / "scene.ply", files / "small_0.1.ply"
    assert_refused(run("compare", scene, tmp_path / "no.ply"), "no.ply")
    assert_refused(run("compare", scene, small, "--cameras", "orbitt"), "orbitt")
    assert_refused(run("compare", scene, small, "--pixels", "big"), "big")
    mistyped = run("compare", scene, small, "--sizes", "512,abc")
    assert_refused(mistyped, "Sizes of views are like 512,1280x720", "'abc'")
    assert_refused(run("compare", scene, small, "--metrics", "vmaf"), "vmaf")
    (tmp_path / "page.html").write_text("mine")
    assert_refused(run("compare", scene, small, "--report", tmp_path / "page.html"), "-w")
    assert (tmp_path / "page.html").read_text() == "mine"


@pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed")
@pytest.mark.filterwarnings("default")  # warnings of the browser's driver
@pytest.mark.parametrize("width", [1200, 390])
def test_the_report_page_is_complete_and_makes_no_requests(browser, files, tmp_path, width):
    """The page makes no request, all its pictures decode, and it fits the window."""
    page_file = Path(tmp_path / "page.html")
    tests = [("ours", files / "small_0.1.ply"), ("ours", files / "small_0.5.ply")]
    compare_files(
        ("<b>ref</b>", files / "scene.ply"), tests, views=2, sizes=[(64, 64)], report=page_file
    )
    page = browser.new_page(viewport={"width": width, "height": 800})
    requests = []
    page.on("request", lambda request: requests.append(request.url))
    page.goto(page_file.as_uri())
    pictures = page.evaluate(
        "Promise.all([...document.images].map(i => i.decode().then(() => i.naturalWidth)))"
    )
    heading, fits = page.evaluate(
        "[document.querySelector('h1').textContent,"
        " document.documentElement.scrollWidth <= window.innerWidth]"
    )
    plots = page.evaluate("document.querySelectorAll('svg').length")
    if folder := os.environ.get("NANOGS_SCREENSHOTS"):
        page.screenshot(path=f"{folder}/compare_{width}.png", full_page=True)
    page.close()
    assert [url for url in requests if not url.startswith(("file:", "data:"))] == []
    assert pictures == [64] * (2 + 2 * (1 + 2 + 2))  # two side by side above, and all below
    assert "<b>ref</b>" in heading  # a name is text, never markup
    assert fits
    assert plots == 1


@pytest.fixture(scope="module")
def browser():
    """Chromium."""
    if not CHROMIUM:
        pytest.skip("Chromium is not installed")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def report(files, tmp_path_factory):
    """A report of two views and two models."""
    report = tmp_path_factory.mktemp("report") / "page.html"
    tests = [("tenth", files / "small_0.1.ply"), ("half", files / "small_0.5.ply")]
    compare_files(("all", files / "scene.ply"), tests, views=2, sizes=[(64, 64)], report=report)
    return report


@pytest.fixture
def opened(browser, report):
    """A function that opens the report in a new window, with options such as its size."""
    contexts = []

    def open_page(**options):
        contexts.append(browser.new_context(**options))
        page = contexts[-1].new_page()
        page.goto(report.as_uri())
        return page

    yield open_page
    for context in contexts:
        context.close()


@pytest.mark.filterwarnings("default")  # warnings of the browser's driver
def test_many_rows_are_a_table_below_the_picture_and_lists_on_a_phone(browser, files, tmp_path):
    tests = [(f"model {number}", files / "small_0.1.ply") for number in range(5)]
    page = tmp_path / "many.html"
    compare_files(
        ("all", files / "scene.ply"), tests, views=1, sizes=[(64, 64)], report=page,
        interactive=False,
    )  # fmt: skip
    opened = browser.new_page()
    opened.goto(page.as_uri())
    for width, rows in ((390, "grid"), (768, "grid"), (1024, "table-row"), (1920, "table-row")):
        opened.set_viewport_size({"width": width, "height": 800})
        style = "getComputedStyle(document.querySelector('tbody tr')).display"
        assert opened.evaluate(style) == rows
        assert opened.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
        assert opened.locator("td").evaluate_all(
            "cells => cells.every((cell) => cell.scrollWidth <= cell.clientWidth)"
        )
        picture, table = (opened.locator(name).bounding_box() for name in (".look", "table"))
        assert table["y"] > picture["y"] + picture["height"]
    opened.close()


@pytest.mark.filterwarnings("default")  # warnings of the browser's driver
def test_pictures_of_any_shape_are_seen_whole(browser, tmp_path):
    splats = random_splats(300)
    views = [
        replace(camera(name), width=width, height=height, cx=width / 2, cy=height / 2)
        for name, width, height in (("wide", 160, 80), ("high", 60, 120))
    ]
    found, sheets = compare_models(
        NamedModel("all", splats), [NamedModel("small", simplified(splats, 0.5))], views,
        scoring=Scoring(pictures=True),
    )  # fmt: skip
    (tmp_path / "page.html").write_text(render_page(found, sheets, "Shapes"), encoding="utf-8")
    page = browser.new_page(viewport={"width": 1000, "height": 600})
    page.goto((tmp_path / "page.html").as_uri())
    stage = page.locator("#stage")
    for shape in (2, 0.5, 2):
        page.evaluate(
            "document.querySelector('#stage img').decode()"
            ".then(() => new Promise(requestAnimationFrame))"
        )
        box = stage.bounding_box()
        assert box["width"] / box["height"] == pytest.approx(shape, rel=0.01)
        assert 300 < box["height"] < 0.79 * 600
        page.click("#after")
    page.close()


PHONE = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}
driver_may_warn = pytest.mark.filterwarnings("default")  # warnings of the browser's driver


def divider_position(page):
    """Return the position of the dividing line, as a fraction of the width."""
    stage = page.locator("#stage").bounding_box()
    edge = page.locator(".edge").bounding_box()
    return (edge["x"] + edge["width"] / 2 - stage["x"]) / stage["width"]


@driver_may_warn
def test_the_report_opens_with_two_pictures_and_a_divider(opened):
    page = opened(viewport={"width": 1280, "height": 800})
    stage = page.locator("#stage").bounding_box()
    assert stage["y"] + stage["height"] < 800
    assert page.locator("#left").inner_text() == "original"
    assert page.locator("#right").inner_text() == "tenth"
    assert page.locator("#place").inner_text() == "View 1 of 2"
    assert "test_0" not in page.content()
    assert page.locator("#nanogs-view").count() == 0
    assert divider_position(page) == pytest.approx(0.5, abs=0.01)
    assert "dB" in page.locator("#caption").inner_text()


@driver_may_warn
def test_the_divider_moves_by_mouse_and_by_keys(opened):
    page = opened(viewport={"width": 1280, "height": 800})
    box = page.locator("#stage").bounding_box()
    middle = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + box["width"] / 2, middle)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.8 * box["width"], middle, steps=4)
    page.mouse.up()
    moved = divider_position(page)
    assert moved == pytest.approx(0.8, abs=0.03)
    clip = page.evaluate("getComputedStyle(document.querySelectorAll('.stage img')[1]).clipPath")
    assert float(clip.split()[-1].rstrip("%)")) == pytest.approx(100 * moved, abs=0.5)
    page.get_by_role("slider").press("ArrowLeft")
    assert divider_position(page) < moved
    page.get_by_role("slider").press("Home")
    assert divider_position(page) == pytest.approx(0, abs=0.01)


@driver_may_warn
def test_views_models_and_differences_can_be_chosen(opened):
    page = opened(viewport={"width": 1280, "height": 800})
    sources = "[...document.querySelectorAll('.stage img')].map(image => image.src)"
    first = page.evaluate(sources)
    page.get_by_role("button", name="Next view").click()
    assert page.locator("#place").inner_text() == "View 2 of 2"
    second = page.evaluate(sources)
    assert first[0] != second[0]
    assert first[1] != second[1]
    page.get_by_label("Compared model").select_option(index=1)
    assert page.locator("#right").inner_text() == "half"
    other = page.evaluate(sources)
    assert (other[0], other[1] != second[1]) == (second[0], True)
    page.get_by_label("Difference").check()
    assert page.evaluate(sources)[1] not in (other[1], second[1])
    page.get_by_role("button", name="Next view").click()
    assert page.locator("#place").inner_text() == "View 1 of 2"


@driver_may_warn
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_nothing_in_the_report_is_cut_off_on_a_phone(opened, scheme):
    page = opened(**PHONE, color_scheme=scheme)
    page.locator("summary").tap()
    for selector in ("td", "#stage", "button", "select", "label", "figure"):
        parts = page.locator(selector).all()
        assert parts, selector
        for part in parts:
            box = part.bounding_box()
            assert box["x"] >= 0
            assert box["x"] + box["width"] <= 390
    assert page.evaluate("document.documentElement.scrollWidth") == 390
    light = page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    assert light == (scheme == "light")
    page.evaluate("scrollTo(0, 0)")
    box = page.locator("#stage").bounding_box()
    page.touchscreen.tap(box["x"] + 0.25 * box["width"], box["y"] + box["height"] / 2)
    assert divider_position(page) == pytest.approx(0.25, abs=0.04)


@driver_may_warn
def test_two_numbers_in_a_cell_of_the_table_stay_in_one_line(opened):
    """Two numbers in two lines would look like one of this row and one of the next."""
    page = opened(viewport={"width": 1200, "height": 800})
    cell = page.locator("td[data-is='splats a pixel']").first
    cell.evaluate("cell => cell.textContent = '137.6, 1,152'")
    lines = """cell => {
        const range = document.createRange();
        range.selectNodeContents(cell);
        return range.getClientRects().length;
    }"""
    assert cell.evaluate(lines) == 1
    assert cell.evaluate("cell => getComputedStyle(cell, '::before').textAlign") == "left"


@driver_may_warn
@pytest.mark.parametrize("width", [360, 390, 768, 1024, 1280, 1440])
def test_each_number_is_in_one_line_with_its_label(opened, width):
    page = opened(viewport={"width": width, "height": 800})
    page.locator("td[data-is='splats a pixel']").evaluate_all(
        "cells => cells.forEach((cell) => { cell.textContent = '137.6, 1,152' })"
    )
    heights = page.locator("td[data-is]").evaluate_all(
        "cells => cells.map((cell) => cell.getBoundingClientRect().height)"
    )
    assert max(heights) < 30  # pixels; a line has 24


@driver_may_warn
def test_the_plot_can_be_read_on_a_phone(opened):
    page = opened(**PHONE)
    heights = page.locator(".plot text").evaluate_all(
        """texts => texts.map((text) => {
            const { b, d } = text.getScreenCTM();
            return text.getBBox().height * Math.hypot(b, d);
        })"""
    )
    assert min(heights) > 10  # pixels
    plot = page.locator(".plot")
    plot.focus()
    plot.evaluate("plot => new Promise((moved) => { plot.onscroll = moved; plot.scrollBy(50, 0) })")
    assert page.get_by_role("img", name="PSNR over splats").count() == 1


@driver_may_warn
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_plot_has_the_colours_of_the_page(opened, scheme):
    page = opened(color_scheme=scheme)
    colour = "part => getComputedStyle(part).color"
    page_colour = page.locator("body").evaluate(colour)
    assert page.locator(".plot text").first.evaluate(colour) == page_colour
    fill = page.locator(".plot svg > rect").evaluate("part => getComputedStyle(part).fill")
    assert fill == "none"


@driver_may_warn
def test_a_long_name_leaves_the_picture_visible(opened):
    page = opened(**PHONE)
    right = page.locator("#right")
    right.evaluate("label => { label.textContent = 'a_very_long_name_'.repeat(12) }")
    assert right.bounding_box()["height"] < page.locator("#stage").bounding_box()["height"] / 4


@driver_may_warn
def test_without_javascript_nothing_is_shown_that_needs_it(browser, files, tmp_path):
    page_file = tmp_path / "page.html"
    compare_files(
        ("all", files / "scene.ply"), [("tenth", files / "small_0.1.ply")], views=1,
        sizes=[(64, 64)], report=page_file, interactive=True,
    )  # fmt: skip
    page = browser.new_page(java_script_enabled=False)
    page.goto(page_file.as_uri())
    assert page.locator("table").is_visible()
    assert not page.locator("#stage").is_visible()
    assert not page.locator("#nanogs-load").is_visible()
    page.locator("summary").click()
    assert page.locator("figure img").first.is_visible()
    page.close()


@pytest.mark.parametrize("kept", ["b.png", "b_depth.png"])
def test_no_picture_is_written_if_one_of_them_exists(tmp_path, kept):
    (tmp_path / kept).write_text("mine")
    cameras = [replace(camera(), name=name) for name in "ab"]
    with pytest.raises(ExistsError, match=kept):
        render_images(random_splats(20), cameras, tmp_path, depth=True)
    assert [path.name for path in tmp_path.iterdir()] == [kept]
    if kept == "b_depth.png":
        with pytest.raises(ExistsError, match=kept):
            render_images(random_splats(20), cameras[1:], tmp_path / "b.png", depth=True)
        assert [path.name for path in tmp_path.iterdir()] == [kept]


@pytest.mark.parametrize("overwrite", [False, True])
def test_pictures_of_one_name_are_refused(tmp_path, overwrite):
    cameras = [replace(camera(), name=name) for name in ("a", "a_depth")]
    files, _ = render_images(random_splats(20), cameras, tmp_path / "images")
    assert len(files) == 2
    with pytest.raises(OptionError, match=r"Two images would be called a_depth\.png"):
        render_images(
            random_splats(20), cameras, tmp_path / "both", depth=True, overwrite=overwrite
        )
    assert [path.name for path in tmp_path.iterdir()] == ["images"]


def test_transparent_pictures_do_not_depend_on_the_background(tmp_path):
    splats = random_splats(20)
    images = []
    for background in ((0.0, 0.0, 0.0), (1.0, 0.5, 0.0)):
        [path], _ = render_images(
            splats, [camera()], tmp_path, background=background, transparent=True, overwrite=True
        )
        images.append(np.array(Image.open(path)))
    assert np.array_equal(*images)


@pytest.mark.parametrize(
    ("name", "kind"), [("a.jpg", "JPEG"), ("a.JPEG", "JPEG"), ("a.webp", "WEBP")]
)
def test_one_picture_is_written_in_the_format_of_its_name(tmp_path, name, kind):
    splats = random_splats(200)
    [path], _ = render_images(splats, camera(), tmp_path / "exact.png")
    files, _ = render_images(splats, camera(), tmp_path / name, depth=True)
    assert files == [str(tmp_path / each) for each in (name, "a_depth.png")]
    with Image.open(files[0]) as found, Image.open(path) as exact:
        assert (found.format, found.size) == (kind, exact.size)
        off = np.asarray(found.convert("RGB"), float) - np.asarray(exact, float)
    assert 0 < np.sqrt(np.mean(off**2)) < 8


def test_what_a_picture_cannot_hold_is_refused(tmp_path):
    splats, wide = random_splats(20), replace(camera(), width=16384, height=1)
    with pytest.raises(OptionError, match=r"JPEG has no alpha; name .*a\.png or .*a\.webp"):
        render_images(splats, camera(), tmp_path / "a.jpg", transparent=True)
    with pytest.raises(OptionError, match=r"at most 16383 pixels along a side; name .*a\.png"):
        render_images(splats, wide, tmp_path / "a.webp")
    [path], _ = render_images(splats, camera(), tmp_path / "a.webp", transparent=True)
    with Image.open(path) as found:
        assert found.mode == "RGBA"


def test_pictures_need_a_model_and_cameras(tmp_path):
    splats = random_splats(20)
    [path], _ = render_images(splats, camera(), str(tmp_path / "a.png"))
    assert path == str(tmp_path / "a.png")
    with pytest.raises(OptionError, match=r"must be a nanogs\.Camera, not str"):
        render_images(splats, "auto", tmp_path / "images")
    with pytest.raises(OptionError, match="no view to render"):
        render_images(splats, [], tmp_path / "images")
    with pytest.raises(ModelError, match=r"not the path 'a\.ply'"):
        render_images("a.ply", camera(), tmp_path / "images")
    assert [each.name for each in tmp_path.iterdir()] == ["a.png"]


def test_pictures_are_written_into_the_current_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    named = replace(camera(), name="front")
    assert render_images(random_splats(20), named, ".")[0] == ["front.png"]
    assert [each.name for each in tmp_path.iterdir()] == ["front.png"]


def test_a_model_for_another_rasteriser_is_noted():
    splats = random_splats(50)
    other = replace(splats, render_mode="mip")
    found = nanogs.compare(splats, splats, other, names=["same", "other"], views=2, pixels=16)
    modes = [note for note in found.notes if "render mode" in note]
    assert modes == [
        "other: render mode mip, the reference has default, and each is drawn in its own"
    ]

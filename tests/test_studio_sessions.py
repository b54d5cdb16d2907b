"""Whole sessions of `nanogs studio` in a real browser: from a scene to files for other programs."""

import contextlib
import os
import shlex
import shutil
import signal
import time

import numpy as np
import pytest

import nanogs
from browsers import CHROMIUM, browser, pixels_of
from conftest import scene_path
from launch import contents, run
from nanogs.datasets.synthetic import make_scene
from npm_packages import splat_transform
from studio import running
from studio_page import StudioPage
from viewer_bundle import require_bundle

pytestmark = [
    pytest.mark.story,
    pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed"),
    pytest.mark.filterwarnings("default"),  # the driver's own warnings are not ours
]
SPLATS = 2_500
BARE = "#view > :not(canvas), #picture > :not(#view) { opacity: 0 !important; }"
SIZES = {1280: 640, 390: 844}  # pixels, width and height
PHONE = {"has_touch": True, "is_mobile": True}


@pytest.fixture(scope="module")
def chromium():
    require_bundle()
    with browser() as found:
        yield found


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The folder that the studio is started in, with nothing but a small synthetic scene."""
    folder = tmp_path_factory.mktemp("work")
    nanogs.save(make_scene(SPLATS, sh_degree=1), folder / "scene.ply")
    return folder


@pytest.fixture(scope="module")
def studio(folder):
    with running("scene.ply", "--preset", "fast", "--idle", "0", cwd=folder) as started:
        yield started


@pytest.fixture
def open_studio(chromium, studio):
    """A function that opens a page of the studio and waits for its first answer."""
    with contextlib.ExitStack() as stack:

        def open_page(width=1280, **options):
            phone = PHONE if width < 600 else {}
            opened = StudioPage(chromium, studio.url, width, SIZES[width], **phone, **options)
            stack.callback(opened.close)
            opened.settle()
            choose_fast_preset(opened)
            return opened

        yield open_page


def choose_fast_preset(opened):
    """Choose the preset `fast`, which renders nothing and is quick enough for tests."""
    fast = opened.at("preset").get_by_text("fast", exact=True)
    if fast.get_attribute("aria-pressed") != "true":
        opened.measured(fast.click)


def slider_values(opened):
    """Return splats, megabytes and PSNR as the page shows them."""
    return np.array([opened.value(name) for name in ("splats", "bytes", "psnr")])


def canvas_pixels(opened, name):
    """Return the pixels of the canvas without its overlays, (H, W, 3) in [0, 1]."""
    opened.still()
    return pixels_of(opened.page.locator("#view canvas"), name, style=BARE)


def differing_share(one, other):
    """Return the share of pixels that differ."""
    return (np.abs(one - other).max(axis=-1) > 0.06).mean()


def magenta_share(pixels):
    """Return the share of magenta pixels, the colour of splats that a filter would remove."""
    red, green, blue = np.moveaxis(pixels, -1, 0)
    return ((red > 0.45) & (blue > 0.45) & (green < 0.3)).mean()


def shown_arguments(opened):
    """Return the arguments of the command that the page shows."""
    first, *words = shlex.split(opened.text("save-command"))
    assert first == "nanogs"
    return words


def open_dialogue(opened, name, suffix=None):
    """Open the save dialogue and enter a format and a name."""
    opened.at("save-open").click()
    if suffix:
        opened.at("save-format").select_option(suffix)
    opened.at("save-name").fill(name)
    opened.until(
        "(name) => document.getElementById('save-command').textContent.includes(name)", name
    )


def save(opened, name, suffix):
    """Save a file or levels, and return the arguments of the equivalent command."""
    open_dialogue(opened, name, suffix)
    opened.at("save-go").click()
    opened.until("() => /^Saved|stopped/.test(document.getElementById('save-said').textContent)")
    assert name in opened.text("save-said")
    words = shown_arguments(opened)
    opened.at("save-close").click()
    assert opened.state == "measured"
    return words


def files_of_command(scene, words, folder):
    """Run the command in a new folder with only the scene; return the written files by name."""
    folder.mkdir()
    shutil.copy(scene, folder)
    result = run(*words, cwd=folder)
    assert result.returncode == 0, result.stderr
    (folder / scene.name).unlink()
    return contents(folder)


def read_elsewhere(path, out):
    """Return a model as splat-transform reads it; skip the test if that is not installed."""
    splat_transform(path, out)
    return nanogs.load(out)


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (390, "dark")])
def test_a_whole_session(open_studio, folder, tmp_path, width, scheme):
    opened = open_studio(width, color_scheme=scheme)
    assert "2,500 splats" in opened.text("scene-facts")

    # Each slider moves the other two.
    first = slider_values(opened)
    opened.measured(lambda: opened.slide("splats", 850))
    more = slider_values(opened)
    assert (more > first).all()
    opened.measured(lambda: opened.slide("bytes", 250))
    less = slider_values(opened)
    assert (less < more).all()
    opened.measured(lambda: opened.type("psnr", "29"))
    assert slider_values(opened)[2] == 29
    assert slider_values(opened)[0] > less[0]
    assert "--psnr 29" in opened.text("command")
    opened.measured(lambda: opened.type("splats", "400"))
    assert slider_values(opened)[0] == 400
    assert opened.text("how") == "measured"
    assert len(opened.page.locator("#plot svg circle").all()) > 2

    # The scene on the left, the result on the right, and the error map.
    divider = opened.page.locator("#view [role=slider]")
    divider.focus()
    opened.page.keyboard.press("End")
    assert divider.get_attribute("aria-valuenow") == "100"
    whole = canvas_pixels(opened, f"studio-scene-{width}")
    divider.focus()
    opened.page.keyboard.press("Home")
    small = canvas_pixels(opened, f"studio-small-{width}")
    assert 0.001 < differing_share(whole, small) < 0.9
    opened.at("heat").click()
    assert opened.at("legend").is_visible()
    assert differing_share(small, canvas_pixels(opened, f"studio-error-{width}")) > 0.2
    opened.at("heat").click()
    assert not opened.at("legend").is_visible()
    assert differing_share(small, canvas_pixels(opened, f"studio-small-again-{width}")) < 0.001

    # A crop box is previewed before it is applied, and can be undone.
    divider.focus()
    opened.page.keyboard.press("End")
    opened.unfold("sift")
    opened.at("crop").check()
    opened.until("() => document.body.dataset.preview !== 'none'")
    opened.at("x-high-range").fill("480")
    opened.until("() => document.body.dataset.preview === 'shown'")
    assert "magenta" in opened.text("takes")
    assert magenta_share(canvas_pixels(opened, f"studio-preview-{width}")) > 0.02
    assert "--crop" not in opened.text("command")
    opened.measured(opened.at("take").click)
    assert "--crop box:" in opened.text("command")
    assert "removed" in opened.text("taken")
    assert magenta_share(canvas_pixels(opened, f"studio-taken-{width}")) < 0.005
    opened.measured(opened.at("undo").click)
    assert "--crop" not in opened.text("command")
    assert opened.text("taken") == ""
    opened.measured(opened.at("redo").click)

    # Render mode and up can be changed by a click.
    opened.unfold("scene")
    opened.measured(opened.at("mode").get_by_text("mip").click)
    opened.measured(opened.at("up").get_by_text("+z").click)
    assert "--render-mode mip" in opened.text("command")
    assert "--frame rfu:" in opened.text("command")

    # Saved files equal those of the shown command, and another program opens them.
    scene = folder / "scene.ply"
    for suffix in ("sog", "spz"):
        name = f"small-{width}.{suffix}"
        words = save(opened, name, f"file .{suffix}")
        assert {"--crop", "--render-mode", "--frame"} < set(words)
        written = files_of_command(scene, words, tmp_path / suffix)
        assert written == {name: (folder / name).read_bytes()}
    name = f"levels-{width}/lod-meta.json"
    words = save(opened, name, "levels lod-meta.json")
    assert words[0] == "lod"
    written = files_of_command(scene, words, tmp_path / "levels")
    saved = contents(folder / f"levels-{width}")
    assert written == {f"levels-{width}/{path}": data for path, data in saved.items()}
    for path in (f"small-{width}.sog", f"small-{width}.spz"):
        saved_model = nanogs.load(folder / path)
        theirs = read_elsewhere(folder / path, tmp_path / "theirs.ply")
        assert len(theirs) == len(saved_model) == 400
    assert len(read_elsewhere(folder / name, tmp_path / "theirs.ply")) > 400


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", SIZES)
def test_the_page_fits_its_window_and_follows_the_system_colours(open_studio, width, scheme):
    opened = open_studio(width, color_scheme=scheme)
    assert opened.page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    outside = """() => [...document.querySelectorAll('button, input, select, summary, p, h1, h2')]
        .filter((element) => element.checkVisibility() && !element.closest('dialog'))
        .map((element) => [element.id || element.textContent, element.getBoundingClientRect()])
        .filter(([, {left, right, width}]) => width && (left < -1 || right > innerWidth + 1))
        .map(([name]) => name)"""
    assert opened.page.evaluate(outside) == []
    for name in ("sift", "scene"):
        opened.unfold(name)
    opened.at("crop").check()
    assert opened.page.evaluate(outside) == []
    opened.at("crop").uncheck()
    shot = pixels_of(opened.page, f"studio-{width}-{scheme}")
    panel = opened.at("panel").bounding_box()
    corner = shot[int(max(panel["y"], 0)) + 2, int(panel["x"]) + 2]
    assert (corner.mean() > 0.5) == (scheme == "light")
    opened.at("save-open").click()
    box = opened.at("save").bounding_box()
    assert box["x"] >= 0
    assert box["x"] + box["width"] <= width
    pixels_of(opened.page, f"studio-save-{width}-{scheme}")


def test_an_existing_file_is_replaced_only_after_confirmation(open_studio, folder):
    opened = open_studio()
    opened.measured(lambda: opened.type("splats", "100"))
    save(opened, "again.spz", "file .spz")
    before = (folder / "again.spz").read_bytes()
    opened.measured(lambda: opened.type("splats", "200"))
    open_dialogue(opened, "again.spz", "file .spz")
    opened.at("save-go").click()
    opened.until("() => document.getElementById('save-go').textContent === 'Replace it'")
    assert "exists" in opened.text("save-said")
    assert (folder / "again.spz").read_bytes() == before
    opened.at("save-go").click()
    opened.until("() => document.getElementById('save-said').textContent.startsWith('Saved')")
    assert len(nanogs.load(folder / "again.spz")) == 200
    assert {"-w", "--overwrite"} & set(shown_arguments(opened))


def begin_long_save(opened, name):
    """Start saving ten levels with a preset that renders, and wait for the first progress."""
    opened.at("preset").get_by_text("default", exact=True).click()
    open_dialogue(opened, f"{name}/lod-meta.json", "levels lod-meta.json")
    opened.at("ratios").fill("1,0.9,0.8,0.7,0.6,0.5,0.4,0.3,0.2,0.1")
    opened.until("() => document.getElementById('save-command').textContent.includes('0.9')")
    opened.at("save-go").click()
    opened.until("() => document.getElementById('save-said').textContent.startsWith('Saving:')")


def test_a_cancelled_save_leaves_no_file(open_studio, folder):
    opened = open_studio()
    before = sorted(contents(folder))
    begin_long_save(opened, "cancelled")
    assert opened.state == "saving"
    opened.at("save-cancel").click()
    opened.until("() => document.getElementById('save-said').textContent.startsWith('Cancelled')")
    assert sorted(contents(folder)) == before
    assert not (folder / "cancelled").exists()
    assert list(folder.glob(".nanogs*")) == []
    opened.at("save-close").click()
    choose_fast_preset(opened)  # the studio still answers
    opened.measured(lambda: opened.type("splats", "150"))


def test_cancelled_work_stops(open_studio):
    opened = open_studio()
    before = opened.number
    opened.at("preset").get_by_text("best", exact=True).click()
    opened.until("() => !document.getElementById('cancel').hidden")
    assert opened.number > before
    opened.at("cancel").click()
    opened.until("() => document.getElementById('said').textContent === 'Cancelled'")
    assert opened.state == "coarse"
    choose_fast_preset(opened)


def test_two_pages_do_not_disturb_each_other(open_studio):
    one, other = open_studio(), open_studio()
    one.measured(lambda: one.type("splats", "300"))
    shown = [one.text("result"), one.text("command"), one.number]
    other.measured(lambda: other.type("splats", "120"))
    other.measured(lambda: other.at("format").select_option(".spz"))
    assert [one.text("result"), one.text("command"), one.number] == shown
    before = [one.number, other.number]
    one.type("splats", "310")
    other.type("splats", "130")
    for opened, number, count in zip((one, other), before, (310, 130), strict=True):
        opened.settle(number)
        assert opened.state == "measured"
        assert opened.value("splats") == count
        assert f"--count {count}" in opened.text("command")
    assert "out.spz" in other.text("command")
    assert "out.sog" in one.text("command")


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
@pytest.mark.parametrize("number", ["SIGTERM", "SIGKILL"])
def test_a_studio_killed_during_a_save_leaves_no_file(chromium, tmp_path, number):
    nanogs.save(make_scene(SPLATS, sh_degree=1), tmp_path / "scene.ply")
    with running("scene.ply", "--preset", "fast", cwd=tmp_path) as started:
        opened = StudioPage(chromium, started.url)
        opened.settle()
        begin_long_save(opened, "out")
        started.process.send_signal(getattr(signal, number))
        started.process.wait(timeout=30)
        opened.until("() => document.body.dataset.lost")
        assert opened.alert
        opened.context.close()
    end = time.monotonic() + 30
    while (left := sorted(each.name for each in tmp_path.iterdir())) != ["scene.ply"]:
        assert time.monotonic() < end, left
        time.sleep(0.05)


def test_a_real_scene_is_saved_at_a_given_size(chromium, tmp_path):
    shutil.copy(scene_path("biker.spz"), tmp_path)
    with running("biker.spz", "--preset", "fast", cwd=tmp_path) as started:
        opened = StudioPage(chromium, started.url)
        opened.settle()
        choose_fast_preset(opened)
        opened.measured(lambda: opened.type("bytes", "0.2"))
        assert "--size 200000" in opened.text("command")
        save(opened, "small.sog", "file .sog")
        opened.close()
    small = tmp_path / "small.sog"
    assert 190_000 < small.stat().st_size <= 200_000
    assert len(read_elsewhere(small, tmp_path / "theirs.ply")) == len(nanogs.load(small))

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
import studio_page
from browsers import CHROMIUM, pixels_of
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
    with studio_page.browser() as found:
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
            seen = StudioPage(chromium, studio.url, width, SIZES[width], **phone, **options)
            stack.callback(seen.close)
            seen.settle()
            quick(seen)
            return seen

        yield open_page


def quick(seen):
    """Choose the preset `fast`, which renders nothing and is quick enough for tests."""
    fast = seen.at("preset").get_by_text("fast", exact=True)
    if fast.get_attribute("aria-pressed") != "true":
        seen.measured(fast.click)


def sliders(seen):
    """Return splats, megabytes and PSNR as the page shows them."""
    return np.array([seen.value(name) for name in ("splats", "bytes", "psnr")])


def picture(seen, name):
    """Return the pixels of the canvas without its overlays, (H, W, 3) in [0, 1]."""
    seen.still()
    return pixels_of(seen.page.locator("#view canvas"), name, style=BARE)


def differ(one, other):
    """Return the share of pixels that differ."""
    return (np.abs(one - other).max(axis=-1) > 0.06).mean()


def magenta(pixels):
    """Return the share of magenta pixels, the colour of splats that a filter would remove."""
    red, green, blue = np.moveaxis(pixels, -1, 0)
    return ((red > 0.45) & (blue > 0.45) & (green < 0.3)).mean()


def command_of(seen):
    """Return the arguments of the command that the page shows."""
    first, *words = shlex.split(seen.text("save-command"))
    assert first == "nanogs"
    return words


def open_dialogue(seen, name, suffix=None):
    """Open the save dialogue and enter a format and a name."""
    seen.at("save-open").click()
    if suffix:
        seen.at("save-format").select_option(suffix)
    seen.at("save-name").fill(name)
    seen.until("(name) => document.getElementById('save-command').textContent.includes(name)", name)


def save(seen, name, suffix):
    """Save a file or levels, and return the arguments of the equivalent command."""
    open_dialogue(seen, name, suffix)
    seen.at("save-go").click()
    seen.until("() => /^Saved|stopped/.test(document.getElementById('save-said').textContent)")
    assert name in seen.text("save-said")
    words = command_of(seen)
    seen.at("save-close").click()
    assert seen.state == "measured"
    return words


def files_of_command(scene, words, folder):
    """Run the command in a new folder with only the scene; return the written files by name."""
    folder.mkdir()
    shutil.copy(scene, folder)
    done = run(*words, cwd=folder)
    assert done.returncode == 0, done.stderr
    (folder / scene.name).unlink()
    return contents(folder)


def read_elsewhere(path, out):
    """Return a model as splat-transform reads it; skip the test if that is not installed."""
    splat_transform(path, out)
    return nanogs.load(out)


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (390, "dark")])
def test_a_whole_session(open_studio, folder, tmp_path, width, scheme):
    seen = open_studio(width, color_scheme=scheme)
    assert "2,500 splats" in seen.text("scene-facts")

    # Each slider moves the other two.
    first = sliders(seen)
    seen.measured(lambda: seen.slide("splats", 850))
    more = sliders(seen)
    assert (more > first).all()
    seen.measured(lambda: seen.slide("bytes", 250))
    less = sliders(seen)
    assert (less < more).all()
    seen.measured(lambda: seen.type("psnr", "29"))
    assert sliders(seen)[2] == 29
    assert sliders(seen)[0] > less[0]
    assert "--psnr 29" in seen.text("command")
    seen.measured(lambda: seen.type("splats", "400"))
    assert sliders(seen)[0] == 400
    assert seen.text("how") == "measured"
    assert len(seen.page.locator("#plot svg circle").all()) > 2

    # The scene on the left, the result on the right, and the error map.
    divider = seen.page.locator("#view [role=slider]")
    divider.focus()
    seen.page.keyboard.press("End")
    assert divider.get_attribute("aria-valuenow") == "100"
    whole = picture(seen, f"studio-scene-{width}")
    divider.focus()
    seen.page.keyboard.press("Home")
    small = picture(seen, f"studio-small-{width}")
    assert 0.001 < differ(whole, small) < 0.9
    seen.at("heat").click()
    assert seen.at("legend").is_visible()
    assert differ(small, picture(seen, f"studio-error-{width}")) > 0.2
    seen.at("heat").click()
    assert not seen.at("legend").is_visible()
    assert differ(small, picture(seen, f"studio-small-again-{width}")) < 0.001

    # A crop box is previewed before it is applied, and can be undone.
    divider.focus()
    seen.page.keyboard.press("End")
    seen.unfold("sift")
    seen.at("crop").check()
    seen.until("() => document.body.dataset.preview !== 'none'")
    seen.at("x-high-range").fill("480")
    seen.until("() => document.body.dataset.preview === 'shown'")
    assert "magenta" in seen.text("takes")
    assert magenta(picture(seen, f"studio-preview-{width}")) > 0.02
    assert "--crop" not in seen.text("command")
    seen.measured(seen.at("take").click)
    assert "--crop box:" in seen.text("command")
    assert "removed" in seen.text("taken")
    assert magenta(picture(seen, f"studio-taken-{width}")) < 0.005
    seen.measured(seen.at("undo").click)
    assert "--crop" not in seen.text("command")
    assert seen.text("taken") == ""
    seen.measured(seen.at("redo").click)

    # Render mode and up can be changed by a click.
    seen.unfold("scene")
    seen.measured(seen.at("mode").get_by_text("mip").click)
    seen.measured(seen.at("up").get_by_text("+z").click)
    assert "--render-mode mip" in seen.text("command")
    assert "--frame rfu:" in seen.text("command")

    # Saved files equal those of the shown command, and another program opens them.
    scene = folder / "scene.ply"
    for suffix in ("sog", "spz"):
        name = f"small-{width}.{suffix}"
        words = save(seen, name, f"file .{suffix}")
        assert {"--crop", "--render-mode", "--frame"} < set(words)
        written = files_of_command(scene, words, tmp_path / suffix)
        assert written == {name: (folder / name).read_bytes()}
    name = f"levels-{width}/lod-meta.json"
    words = save(seen, name, "levels lod-meta.json")
    assert words[0] == "lod"
    written = files_of_command(scene, words, tmp_path / "levels")
    saved = contents(folder / f"levels-{width}")
    assert written == {f"levels-{width}/{path}": data for path, data in saved.items()}
    for path in (f"small-{width}.sog", f"small-{width}.spz"):
        own = nanogs.load(folder / path)
        theirs = read_elsewhere(folder / path, tmp_path / "theirs.ply")
        assert len(theirs) == len(own) == 400
    assert len(read_elsewhere(folder / name, tmp_path / "theirs.ply")) > 400


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", SIZES)
def test_the_page_fits_its_window_and_follows_the_system_colours(open_studio, width, scheme):
    seen = open_studio(width, color_scheme=scheme)
    assert seen.page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    outside = """() => [...document.querySelectorAll('button, input, select, summary, p, h1, h2')]
        .filter((element) => element.checkVisibility() && !element.closest('dialog'))
        .map((element) => [element.id || element.textContent, element.getBoundingClientRect()])
        .filter(([, {left, right, width}]) => width && (left < -1 || right > innerWidth + 1))
        .map(([name]) => name)"""
    assert seen.page.evaluate(outside) == []
    for name in ("sift", "scene"):
        seen.unfold(name)
    seen.at("crop").check()
    assert seen.page.evaluate(outside) == []
    seen.at("crop").uncheck()
    shot = pixels_of(seen.page, f"studio-{width}-{scheme}")
    panel = seen.at("panel").bounding_box()
    corner = shot[int(max(panel["y"], 0)) + 2, int(panel["x"]) + 2]
    assert (corner.mean() > 0.5) == (scheme == "light")
    seen.at("save-open").click()
    box = seen.at("save").bounding_box()
    assert box["x"] >= 0
    assert box["x"] + box["width"] <= width
    pixels_of(seen.page, f"studio-save-{width}-{scheme}")


def test_an_existing_file_is_replaced_only_after_confirmation(open_studio, folder):
    seen = open_studio()
    seen.measured(lambda: seen.type("splats", "100"))
    save(seen, "again.spz", "file .spz")
    before = (folder / "again.spz").read_bytes()
    seen.measured(lambda: seen.type("splats", "200"))
    open_dialogue(seen, "again.spz", "file .spz")
    seen.at("save-go").click()
    seen.until("() => document.getElementById('save-go').textContent === 'Replace it'")
    assert "exists" in seen.text("save-said")
    assert (folder / "again.spz").read_bytes() == before
    seen.at("save-go").click()
    seen.until("() => document.getElementById('save-said').textContent.startsWith('Saved')")
    assert len(nanogs.load(folder / "again.spz")) == 200
    assert {"-w", "--overwrite"} & set(command_of(seen))


def begin_long_save(seen, name):
    """Start saving ten levels with a preset that renders, and wait for the first progress."""
    seen.at("preset").get_by_text("default", exact=True).click()
    open_dialogue(seen, f"{name}/lod-meta.json", "levels lod-meta.json")
    seen.at("ratios").fill("1,0.9,0.8,0.7,0.6,0.5,0.4,0.3,0.2,0.1")
    seen.until("() => document.getElementById('save-command').textContent.includes('0.9')")
    seen.at("save-go").click()
    seen.until("() => document.getElementById('save-said').textContent.startsWith('Saving:')")


def test_a_cancelled_save_leaves_no_file(open_studio, folder):
    seen = open_studio()
    before = sorted(contents(folder))
    begin_long_save(seen, "cancelled")
    assert seen.state == "saving"
    seen.at("save-cancel").click()
    seen.until("() => document.getElementById('save-said').textContent.startsWith('Cancelled')")
    assert sorted(contents(folder)) == before
    assert not (folder / "cancelled").exists()
    assert list(folder.glob(".nanogs*")) == []
    seen.at("save-close").click()
    quick(seen)  # the studio still answers
    seen.measured(lambda: seen.type("splats", "150"))


def test_cancelled_work_stops(open_studio):
    seen = open_studio()
    before = seen.number
    seen.at("preset").get_by_text("best", exact=True).click()
    seen.until("() => !document.getElementById('cancel').hidden")
    assert seen.number > before
    seen.at("cancel").click()
    seen.until("() => document.getElementById('said').textContent === 'Cancelled'")
    assert seen.state == "coarse"
    quick(seen)


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
    for seen, number, count in zip((one, other), before, (310, 130), strict=True):
        seen.settle(number)
        assert seen.state == "measured"
        assert seen.value("splats") == count
        assert f"--count {count}" in seen.text("command")
    assert "out.spz" in other.text("command")
    assert "out.sog" in one.text("command")


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
@pytest.mark.parametrize("number", ["SIGTERM", "SIGKILL"])
def test_a_studio_killed_during_a_save_leaves_no_file(chromium, tmp_path, number):
    nanogs.save(make_scene(SPLATS, sh_degree=1), tmp_path / "scene.ply")
    with running("scene.ply", "--preset", "fast", cwd=tmp_path) as started:
        seen = StudioPage(chromium, started.url)
        seen.settle()
        begin_long_save(seen, "out")
        started.process.send_signal(getattr(signal, number))
        started.process.wait(timeout=30)
        seen.until("() => document.body.dataset.lost")
        assert seen.alert
        seen.context.close()
    end = time.monotonic() + 30
    while (left := sorted(each.name for each in tmp_path.iterdir())) != ["scene.ply"]:
        assert time.monotonic() < end, left
        time.sleep(0.05)


def test_a_real_scene_is_saved_at_a_given_size(chromium, tmp_path):
    shutil.copy(scene_path("biker.spz"), tmp_path)
    with running("biker.spz", "--preset", "fast", cwd=tmp_path) as started:
        seen = StudioPage(chromium, started.url)
        seen.settle()
        quick(seen)
        seen.measured(lambda: seen.type("bytes", "0.2"))
        assert "--size 200000" in seen.text("command")
        save(seen, "small.sog", "file .sog")
        seen.close()
    small = tmp_path / "small.sog"
    assert 190_000 < small.stat().st_size <= 200_000
    assert len(read_elsewhere(small, tmp_path / "theirs.ply")) == len(nanogs.load(small))

"""Settings and helpers shared by all tests."""

import gc
import importlib
import os
import shutil
import signal
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import hypothesis
import psutil
import pytest

import nanogs
from nanogs.card.device import CUDA, WARP_CPU, has_driver

# No deadline, because the first example of a test compiles kernels. `derandomize` gives the same
# examples on every machine.
hypothesis.settings.register_profile("nanogs", deadline=None, derandomize=True, max_examples=60)
hypothesis.settings.load_profile("nanogs")

# Processes that a shell starts in the background ignore Ctrl-C, and commands under test inherit it.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Where it has room, temporary files are in memory: a run writes two gigabytes, in so many files
# that a disk can make it a third longer. Commands under test and other test processes inherit this.
MEMORY, ROOM = Path("/dev/shm"), 4_000_000_000
if (
    "TMPDIR" not in os.environ
    and os.access(MEMORY, os.W_OK)
    and min(shutil.disk_usage(MEMORY).free, psutil.virtual_memory().available / 2) > ROOM
):
    os.environ["TMPDIR"], tempfile.tempdir = str(MEMORY), None

CARD = CUDA if has_driver() else WARP_CPU  # the device that runs the kernels for graphics cards
SHARED = Path(__file__).resolve().parents[2] / "shared"


def pytest_collection_modifyitems(items):
    """Run files with slow tests first, so that at the end no worker waits long for another."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)


def pytest_collection_finish():
    """Let garbage collections pass over the tests and their modules, which stay until the end."""
    gc.collect()
    gc.freeze()


def scene_path(name: str) -> Path:
    """Return the path of a file or folder of the real scenes; skip the test if it is absent."""
    path = Path(os.environ.get("NANOGS_SCENES", SHARED / "scenes")) / name
    if not path.exists():
        pytest.skip(f"the real scene {name} is absent: set NANOGS_SCENES to the folder of scenes")
    return path


def peer_path(name: str) -> Path:
    """Return a file that another tool made of a real scene; skip the test if it is absent."""
    path = Path(os.environ.get("NANOGS_PEERS", SHARED / "peers")) / name
    if not path.exists():
        pytest.skip(f"the file {name} is absent: set NANOGS_PEERS to the folder of peers' results")
    return path


def made_on_the_device(notes):
    """Return whether one of a report's notes says that `CARD` was used."""
    return any(note.startswith(f"Pictures were made on {CARD}") for note in notes)


@pytest.fixture(scope="module")
def scene(splats, tmp_path_factory):
    """A file with the splats of the module's own fixture `splats`."""
    import nanogs

    path = tmp_path_factory.mktemp("scene") / "scene.ply"
    nanogs.save(splats, path)
    return path


@pytest.fixture
def small_pictures(monkeypatch):
    """Score results on pictures of 128 instead of 512 pixels: searches render hundreds of them."""
    from nanogs.protocol import Judged, Protocol

    def usual(psnr, ssim, views):
        return Judged(psnr, ssim, Protocol(views, pixels=(128, 128)))

    monkeypatch.setattr("nanogs.scoring.held_out.PIXELS", 128)
    monkeypatch.setattr(Judged, "usual", usual)


@pytest.fixture(scope="module")
def benchmark_module():
    """A function that imports a benchmark by its name; the test is skipped if these are absent."""
    folder = Path(__file__).resolve().parents[1] / "benchmarks"
    if not folder.exists():
        pytest.skip("benchmarks are only in the repository")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "path", [str(folder), *sys.path])
        yield importlib.import_module


@pytest.fixture(scope="module")
def small_views():
    """Let all presets that render use few and small views and few steps."""
    from nanogs.pipeline.options import presets

    small_presets = {
        name: replace(
            preset,
            views=2,
            further=2,
            around=min(preset.around, 1),
            view_size=32,
            steps=min(preset.steps, 2),
        )
        if isinstance(preset, presets.ForestParameters)
        else preset
        for name, preset in presets.PRESETS.items()
    }
    with pytest.MonkeyPatch.context() as patch:
        # First, because monkeypatch imports the lazy attribute now and restores it at the end.
        patch.setattr(nanogs, "presets", small_presets)
        patch.setattr(presets, "PRESETS", small_presets)
        yield


@pytest.fixture(scope="module")
def one_tab():
    """Let the pages of a module's tests be opened in one tab."""
    import browsers

    with browsers.one_tab():
        yield


@pytest.fixture
def outcomes():
    """The number of files that were read and refused; at the end, there must be both."""
    found = {"read": 0, "refused": 0}
    yield found
    assert min(found.values()) > 0, found


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    """An own folder for temporary files, which must be empty at the end of the test."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(folder))
    monkeypatch.setattr(tempfile, "tempdir", None)
    yield folder
    assert list(folder.iterdir()) == []


@pytest.fixture(autouse=True)
def no_terminal_width(monkeypatch):
    """Let tables be as wide as necessary: some test of a whole run sets COLUMNS."""
    monkeypatch.delenv("COLUMNS", raising=False)

"""Settings and helpers shared by all tests."""

import importlib
import os
import signal
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import hypothesis
import pytest

import nanogs

# No deadline: the first example of a test compiles kernels. The same examples on every machine.
hypothesis.settings.register_profile("nanogs", deadline=None, derandomize=True, max_examples=60)
hypothesis.settings.load_profile("nanogs")

# A shell has what it starts in the background ignore Ctrl-C, and commands under test inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

SHARED = Path(__file__).resolve().parents[2] / "shared"


def pytest_collection_modifyitems(items):
    """Files with slow tests go first: what is left when others have ended is soon done."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)


def scene_path(name: str) -> Path:
    """A file or folder of the real scenes; skips the test where they are absent."""
    path = Path(os.environ.get("NANOGS_SCENES", SHARED / "scenes")) / name
    if not path.exists():
        pytest.skip(f"the real scene {name} is absent: set NANOGS_SCENES to the folder of scenes")
    return path


def peer_path(name: str) -> Path:
    """A file that another tool made of a real scene; skips the test where they are absent."""
    path = Path(os.environ.get("NANOGS_PEERS", SHARED / "peers")) / name
    if not path.exists():
        pytest.skip(f"the file {name} is absent: set NANOGS_PEERS to the folder of peers' results")
    return path


@pytest.fixture(scope="module")
def scene(splats, tmp_path_factory):
    """A file of the splats of a module's own fixture."""
    import nanogs

    path = tmp_path_factory.mktemp("scene") / "scene.ply"
    nanogs.save(splats, path)
    return path


@pytest.fixture
def small_pictures(monkeypatch):
    """Results are judged on pictures of a quarter of the edge: searches make hundreds of them."""
    from nanogs.protocol import Judged, Protocol

    def usual(psnr, ssim, views):
        return Judged(psnr, ssim, Protocol(views, pixels=(128, 128)))

    monkeypatch.setattr("nanogs.scoring.held_out.PIXELS", 128)
    monkeypatch.setattr(Judged, "usual", usual)


@pytest.fixture(scope="module")
def benchmark_module():
    """Imports a module of the benchmarks by its name; skips the test where they are absent."""
    folder = Path(__file__).resolve().parents[1] / "benchmarks"
    if not folder.exists():
        pytest.skip("benchmarks are only in the repository")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "path", [str(folder), *sys.path])
        yield importlib.import_module


@pytest.fixture(scope="module")
def small_views():
    """Presets that render and fit do so with few and small views."""
    from nanogs.pipeline.options import presets

    few = {
        name: replace(
            chosen,
            views=2,
            further=2,
            roaming=min(chosen.roaming, 1),
            view_size=32,
            steps=min(chosen.steps, 2),
        )
        if isinstance(chosen, presets.ForestParameters)
        else chosen
        for name, chosen in presets.PRESETS.items()
    }
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(nanogs, "presets", few)  # first: it keeps what it was when first asked for
        patch.setattr(presets, "PRESETS", few)
        yield


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    """The folder of temporary files, which is empty after every test."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(folder))
    monkeypatch.setattr(tempfile, "tempdir", None)
    yield folder
    assert list(folder.iterdir()) == []


@pytest.fixture(autouse=True)
def no_width_of_a_terminal(monkeypatch):
    """Tables are as wide as they need: something in a whole run sets the width of a terminal."""
    monkeypatch.delenv("COLUMNS", raising=False)

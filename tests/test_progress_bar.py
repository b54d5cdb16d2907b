"""`progress=True`: a bar on terminals and in notebooks, and nowhere else."""

import importlib.util
import io
import os
import re
import subprocess
import sys
from functools import partial

import pytest
import rich.console

import nanogs
from builders import cloud_pair
from nanogs.bar import show_progress
from nanogs.kernels import compiling
from nanogs.progress import Stage, Tracker

CALLS = {
    "simplify": lambda large, small, progress: nanogs.simplify(large, ratio=0.1, progress=progress),
    "levels": lambda large, small, progress: [*nanogs.levels(large, [0.5, 0.1], progress=progress)],
    "refit": lambda large, small, progress: nanogs.refit(
        large,
        small,
        parameters=nanogs.RefitParameters(views=2, steps=2, size=32),
        progress=progress,
    ),
    "compare": lambda large, small, progress: nanogs.compare(
        large, small, views=2, pixels=32, progress=progress
    ),
    "render": lambda large, small, progress: nanogs.render(
        large, views=2, pixels=32, progress=progress
    ),
}


@pytest.fixture(scope="module")
def pair():
    return cloud_pair()


@pytest.fixture
def screen(monkeypatch):
    """The text that is written to a simulated terminal."""
    file = io.StringIO()
    console = partial(rich.console.Console, file=file, force_terminal=True, width=100)
    monkeypatch.setattr(rich.console, "Console", lambda **_options: console())
    return file


def last_line(screen):
    text = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", screen.getvalue())
    return text.replace("\r", "\n").rstrip().splitlines()[-1]


def bars_begun_and_ended(screen):
    """Count how often the cursor was hidden, as by a bar that begins, and shown again."""
    return screen.getvalue().count("\x1b[?25l"), screen.getvalue().count("\x1b[?25h")


@pytest.mark.parametrize("call", CALLS.values(), ids=CALLS)
def test_a_bar_is_drawn_only_on_request_and_is_full_at_the_end(
    call, pair, screen, capfd, small_views
):
    call(*pair, None)
    call(*pair, False)
    assert screen.getvalue() == ""
    call(*pair, True)
    assert re.fullmatch(r"(\d+)/\1 \w+ +━{40} 100% \d:\d\d:\d\d", last_line(screen))
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("call", CALLS.values(), ids=CALLS)
def test_a_callback_gets_steps_with_rising_fractions(call, pair):
    steps = []
    call(*pair, steps.append)
    fractions = [step.fraction for step in steps]
    assert fractions == sorted(fractions)
    assert (fractions[0], fractions[-1]) == (0, 1)
    assert fractions.count(1) == 1


def test_a_bar_shows_the_stage_and_ends_with_its_context(screen):
    with show_progress(True) as callback:
        tracker = Tracker(callback, [Stage("cut", 1), Stage("store", 3)])
        tracker.begin("store")
        tracker.part(1, 2)
        assert bars_begun_and_ended(screen) == (1, 0)
    assert "2/2 store" in last_line(screen)
    assert " 62%" in last_line(screen)
    assert bars_begun_and_ended(screen) == (1, 1)
    with pytest.raises(ZeroDivisionError), show_progress(True):
        raise ZeroDivisionError
    assert bars_begun_and_ended(screen) == (2, 2)


def test_a_bar_announces_that_kernels_are_compiled(screen):
    with show_progress(True):
        compiling.begin()
        compiling.end()
    assert "compiling for this processor" in last_line(screen)


def test_pipes_get_no_bar():
    code = (
        "import nanogs\n"
        "from nanogs.datasets.synthetic import make_scene\n"
        "nanogs.simplify(make_scene(300), ratio=0.5, preset='fast', progress=True)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")


NEEDED = ("nbclient", "ipykernel", "ipywidgets")
MISSING = [name for name in NEEDED if importlib.util.find_spec(name) is None]

CELLS = (
    "import nanogs\nfrom nanogs.datasets.synthetic import make_scene\nsplats = make_scene(500)",
    "small, _ = nanogs.simplify(splats, ratio=0.5, preset='fast', progress=True)",
    "small",
)


@pytest.mark.skipif(bool(MISSING), reason=f"not installed: {', '.join(MISSING)}")
@pytest.mark.filterwarnings("ignore")  # warnings of the notebook's kernel
def test_a_notebook_shows_the_bar_and_the_picture(monkeypatch):
    import nbclient
    import nbformat

    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, sys.path)))
    notebook = nbformat.v4.new_notebook(cells=[*map(nbformat.v4.new_code_cell, CELLS)])
    nbclient.NotebookClient(notebook, timeout=120, kernel_name="python3").execute()
    widgets = notebook.metadata.widgets["application/vnd.jupyter.widget-state+json"]["state"]
    [bar] = [w["state"] for w in widgets.values() if w["model_name"] == "OutputModel"]
    assert "100%" in bar["outputs"][0]["data"]["text/plain"]
    [shown] = notebook.cells[2].outputs
    assert {"image/png", "text/html", "text/plain"} <= set(shown.data)
    assert shown.data["text/plain"].startswith("Splats(250 splats; ")

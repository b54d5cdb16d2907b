"""The memory that `--dry-run` states, compared with what a separate process really takes."""

import sys
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import nanogs
from builders import random_splats
from launch import measured
from nanogs.errors import NotEnoughMemoryError
from nanogs.io import registry
from nanogs.lod.streamed_sog import StreamedSog
from nanogs.memory import LIBRARIES
from nanogs.method import match as matching
from nanogs.pipeline import in_memory
from nanogs.pipeline.estimates.memory import (
    plan_levels,
    plan_memory,
    plan_search,
    plan_writing,
)
from nanogs.pipeline.options.presets import parameters
from nanogs.pipeline.options.target import Goal
from nanogs.slices import SLICE_PAIRS

COUNT = 300_000
SOG = registry.writable(Path("a.sog"))
COLUMNS = 4 * 59  # bytes of a splat of SH degree 3
MOST = {"fast": 2.0, "paper": 2.0, "default": 2.5}  # times the columns, without libraries and views
# Pixels of a view while it is rendered and compared, and pictures kept; the same for any model.
VIEWS = {"fast": 0, "paper": 0, "default": 150_000_000}
# Prints the memory of a process with compiled kernels before a run, and its peak since then.
RUN = """
import re, sys
from pathlib import Path
import nanogs
from nanogs.datasets.synthetic import make_scene

def status(name):
    text = Path("/proc/self/status").read_text()
    return int(re.search(name + r":\\s+(\\d+)", text)[1]) * 1024

given = {"ratio": 0.1, "preset": sys.argv[1], "threads": 2}
if sys.argv[1] == "default":
    given["steps"] = 4  # each step of a fit takes the memory of the one before
nanogs.simplify(make_scene(500), **given)
Path("/proc/self/clear_refs").write_text("5")  # forget the peak
before = status("VmRSS")
nanogs.simplify(nanogs.load(sys.argv[2]), **given)
print(before, status("VmHWM"))
"""


@pytest.mark.parametrize("preset", MOST)
def test_stages_have_the_same_names_in_the_plan_and_in_the_report(preset):
    plan = plan_memory(300, 1, 0, parameters(preset, {}), 30)
    _, report = nanogs.simplify(random_splats(300), ratio=0.1, preset=preset)
    named = {
        name.partition("_")[0] for name in report.seconds
    }  # without the number of a correction
    assert {*plan.stages} - {"cut"} <= named  # cuts are a part of trials and of reassignment


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("preset", MOST)
def test_a_run_takes_the_planned_memory_and_stays_within_the_limits(preset, large_scene):
    before, peak = measured(RUN, preset, large_scene)
    planned = plan_memory(COUNT, 3, 0, parameters(preset, {}), COUNT // 10, judged=False)
    assert planned.input_columns == COUNT * COLUMNS
    assert 0.88 < (peak - before) / planned.peak < 1.05
    assert peak - before < MOST[preset] * COUNT * COLUMNS + VIEWS[preset]
    # The oldest Numba and NumPy that are allowed take three quarters of what the newest do.
    assert 0.55 * LIBRARIES < before < 1.05 * LIBRARIES


@pytest.mark.parametrize("preset", MOST)
@pytest.mark.parametrize("count", [COUNT, 5_000_000, 50_000_000])
def test_the_planned_memory_is_within_the_limits(preset, count):
    planned = plan_memory(count, 3, 0, parameters(preset, {}), count // 10, judged=False)
    assert planned.peak <= MOST[preset] * count * COLUMNS + VIEWS[preset]
    assert planned.peak == max(planned.stages.values())
    assert all(stage_bytes > planned.input_columns for stage_bytes in planned.stages.values())


def test_random_neighbours_take_the_planned_memory(monkeypatch):
    """The plan also has what NumPy's sorting takes unseen, a fifth of that of matching."""
    monkeypatch.setattr(matching, "STRETCH", 1 << 10)  # as many as a large model has
    model, given = random_splats(20_000, degree=0), {"graph": "random", "tau": 0}
    nanogs.simplify(model.take(np.arange(500)), ratio=0.1, preset="paper", **given)
    tracemalloc.start()
    try:
        nanogs.simplify(model, ratio=0.1, preset="paper", **given)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    planned = plan_memory(len(model), 0, 0, parameters("paper", given), 2000)
    assert 0.8 < peak / (planned.peak - planned.input_columns) < 1.05


def test_for_five_million_splats_the_limits_include_the_libraries():
    for preset in ("fast", "default"):
        planned = plan_memory(5_000_000, 3, 0, parameters(preset, {}), 500_000, judged=False)
        assert planned.peak + LIBRARIES <= MOST[preset] * 5_000_000 * COLUMNS


@pytest.mark.parametrize("preset", ["fast", "paper"])
def test_the_planned_memory_grows_only_with_very_many_threads(preset, monkeypatch):
    def memory_of_costs():
        return plan_memory(5_000_000, 3, 0, parameters(preset, {}), 500_000, judged=False).stages[
            "cost"
        ]

    monkeypatch.setenv("NUMBA_NUM_THREADS", "2")
    with_few = memory_of_costs()
    monkeypatch.setenv("NUMBA_NUM_THREADS", "16")
    assert memory_of_costs() == with_few, "so that a model is divided alike on most machines"
    monkeypatch.setenv("NUMBA_NUM_THREADS", "64")
    assert memory_of_costs() - with_few >= 48 * SLICE_PAIRS * 8


@pytest.fixture(scope="module")
def large_scene(tmp_path_factory):
    import nanogs
    from nanogs.datasets.synthetic import make_scene

    for preset in MOST:  # compiles kernels that are not cached, which also takes memory
        few = {"steps": 2, "views": 2, "view_size": 64} if preset == "default" else {}
        nanogs.simplify(make_scene(500), ratio=0.1, preset=preset, **few)
    path = tmp_path_factory.mktemp("memory") / "scene.ply"
    nanogs.save(make_scene(COUNT), path)
    return path


@pytest.fixture
def needed(monkeypatch):
    """The bytes that each run in memory is checked to have."""
    found = []
    monkeypatch.setattr(in_memory, "refuse_too_large", lambda _, needed, *__: found.append(needed))
    return found


def test_centres_in_double_precision_take_twelve_bytes_more(needed):
    model = random_splats(500, degree=1)
    for each in (model, replace(model, means=model.means.astype(np.float64))):
        nanogs.simplify(each, ratio=0.5, preset="fast", max_memory="4GB")
    plans = [plan_memory(500, 1, more, parameters("fast", {}), 250) for more in (0, 12)]
    assert needed == [plan.peak for plan in plans]


@pytest.mark.parametrize(
    "work",
    [
        lambda splats, most: nanogs.simplify(splats, ratio=0.5, preset="fast", max_memory=most),
        lambda splats, most: nanogs.render(splats, max_memory=most),
        lambda splats, most: nanogs.compare(splats, splats, max_memory=most),
    ],
    ids=["simplify", "render", "compare"],
)
def test_a_limit_of_0_counts_the_model_itself_as_any_other_limit_does(work):
    splats, messages = random_splats(20_000, degree=3), []
    for most in (0, 1):
        with pytest.raises(NotEnoughMemoryError) as refused:
            work(splats, most)
        messages.append(str(refused.value))
    assert messages[0] == messages[1]


def test_a_search_that_encodes_results_has_memory_for_it(needed):
    model = random_splats(2000, degree=3)
    for size in (90_000, 12_000):
        nanogs.simplify(model, size=size, format=".sog", preset="fast", max_memory="4GB")
    planned = plan_memory(2000, 3, 0, parameters("fast", {}), 2000, judged=True)
    sizes = [planned, *(plan_search(planned, 2000, Goal(size=n), SOG) for n in (90_000, 12_000))]
    assert needed == [each.peak for each in sizes[1:]]
    whole, half = (each.stages["encode"] - planned.stages["cut"] for each in sizes[1:])
    assert whole == 2000 * COLUMNS * 8  # a palette takes seven times the result
    assert half == 1500 * COLUMNS * 8  # no more splats fit
    assert plan_search(planned, 2000, Goal(psnr=30.0), registry.writable(Path("a.ply"))) == planned
    assert plan_search(planned, 2000, Goal(psnr=30.0), SOG) == sizes[1]


def test_stages_that_encode_results_raise_the_peak():
    planned = plan_memory(2000, 3, 0, parameters("fast", {}), 1000)
    row = planned.input_columns // 2000
    large = planned.with_stage("large", planned.peak + 1)
    assert large.peak == planned.peak + 1
    assert large.with_stage("small", 1).peak == large.peak
    written = plan_writing(planned, 2000, 1000, SOG).stages["write"]
    assert written == planned.input_columns + 1000 * row + SOG.extra_memory(1000 * row)
    chunks = (
        plan_levels(planned, 2000, 3, count, (0.5,), StreamedSog(1000)).stages["encode"]
        for count in (1000, 500)
    )
    assert next(chunks) - next(chunks) >= 500 * row  # the level that is encoded

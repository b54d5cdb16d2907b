"""Steps by which the library tells of its progress."""

import itertools

import numpy as np
import pytest

import nanogs
from builders import random_splats
from nanogs.fit.parameters import RefitParameters
from nanogs.levels_of_detail import write_levels
from nanogs.lod.layout import Layout
from nanogs.progress import Stage, Step, Tracker, each
from nanogs.scoring.comparison import NamedModel, compare_models
from nanogs.views.automatic import automatic_cameras
from nanogs.views.png import render_images

pytestmark = pytest.mark.usefixtures("small_views")
PLAN = [Stage("first", 1.0), Stage("second", 3.0)]


def told_by(stages=PLAN):
    told = []
    return told, Tracker(told.append, stages)


def fractions(told):
    return [step.fraction for step in told]


def assert_true(told):
    """The fraction never falls, is 1 in the last step alone, and stages come in their order."""
    assert fractions(told) == sorted(fractions(told))
    assert told[-1].fraction == 1
    assert all(step.fraction < 1 for step in told[:-1])
    assert [s.number for s in told] == sorted(s.number for s in told)
    assert all(1 <= s.number <= s.stages and 0 <= s.done <= s.parts for s in told)
    assert len({s.stages for s in told}) == 1


def test_weights_share_the_whole():
    told, tracker = told_by()
    tracker.begin("first")
    tracker.part(1, 2)
    tracker.begin("second")
    tracker.part(1, 3)
    tracker.finish()
    assert fractions(told) == [0, 0.125, 0.25, 0.5, 1]
    assert told[3] == Step("second", 2, 2, 1, 3, 0.5)


def test_nothing_is_full_before_the_end_and_nothing_falls():
    told, tracker = told_by()
    tracker.begin("second")
    tracker.part(3, 3)
    tracker.part(1, 3)
    tracker.part(7, 3)
    assert told[1].fraction < 1
    assert told[2].fraction == told[1].fraction == told[3].fraction
    tracker.finish()
    assert told[-1].fraction == 1


def test_a_stage_that_was_not_foreseen_is_told_where_the_last_one_is():
    told, tracker = told_by()
    tracker.begin("first")
    tracker.begin("other")
    tracker.begin("second")
    assert [(s.stage, s.number) for s in told] == [("first", 1), ("other", 1), ("second", 2)]


def test_stages_within_a_part():
    told, tracker = told_by([Stage("search", 1.0)])
    tracker.begin("search")
    probe = tracker.within(1, 4, PLAN)
    probe.begin("second")
    assert told[-1] == Step("search", 1, 1, 1.25, 4, 0.3125)
    tracker.within(9, 4, PLAN).finish()  # more probes than were expected
    assert told[-1].done == 4
    assert told[-1].fraction < 1


def test_steps_of_a_call_pass_into_those_of_its_caller():
    told, outer = told_by([Stage("read", 1.0), *PLAN, Stage("write", 5.0)])
    outer.begin("read")
    inner = Tracker(outer.passing(), PLAN)
    inner.begin("first")
    inner.begin("second")
    inner.part(1, 3)
    inner.finish()
    outer.begin("write")
    assert [s.number for s in told] == [1, 2, 3, 3, 3, 4]
    assert fractions(told) == [0, 0.1, 0.2, 0.3, 0.5, 0.5]


def test_each_tells_before_and_after():
    parts = []
    assert list(each("ab", lambda *part: parts.append(part))) == ["a", "b"]
    assert parts == [(0, 2), (1, 2), (2, 2)]


@pytest.mark.parametrize("preset", ["default", "fast", "best", "paper"])
@pytest.mark.parametrize("ratio", [0.1, 1.0])
def test_simplify(preset, ratio):
    told = []
    nanogs.simplify(random_splats(300), ratio=ratio, preset=preset, progress=told.append)
    assert_true(told)
    stages = {step.stage for step in told}
    build = {"paper": {"prune", "merge"}, "fast": {"frame", "grow"}}
    if ratio == 1 and preset != "paper":
        assert len(told) == 1  # nothing is to be done
        return
    assert stages >= build.get(preset, {"frame", "views", "look", "grow"})
    if ratio < 1:
        tried = {"trial", "pick", "settle", "judge", "choose", "part", "fit"}
        last = {"default": tried, "best": tried, "fast": {"settle", "part"}}
        assert stages >= last.get(preset, {"store"})


@pytest.mark.parametrize(
    ("goal", "first", "stages"),
    [
        ({"psnr": 20.0}, ["measure"], {"default": ["search", "deliver"], "fast": ["search"]}),
        ({"draw_cost": 0.5}, ["measure"], {"default": ["search", "deliver"], "fast": ["search"]}),
        (
            {"size": 9_000, "format": ".sog"},
            [],
            {"default": ["guess", "pack", "deliver"], "fast": ["guess", "search"]},
        ),
    ],
)
@pytest.mark.parametrize("preset", ["default", "fast"])
def test_searches(preset, goal, first, stages, small_pictures):
    told = []
    splats = random_splats(300)
    _, report = nanogs.simplify(splats, preset=preset, progress=told.append, **goal)
    assert_true(told)
    searching = ("search", "pack", "deliver")
    assert len({step.fraction for step in told if step.stage in searching}) > 3
    order = [stage for stage, _ in itertools.groupby(step.stage for step in told)]
    looking = ["views", "look"] if preset == "default" else []
    assert order[-len(stages[preset]) :] == stages[preset]
    assert order[: -len(stages[preset])] == [*first, "frame", *looking, "grow"]
    _, plain = nanogs.simplify(splats, preset=preset, ratio=0.3)
    timed = {"encode"} | {"measure" for _ in looking} if "size" in goal else {"measure"}
    assert {*report.seconds} - {*plain.seconds} == timed


def test_a_size_that_tells_the_count_but_not_the_harmonics_is_packed_first(small_pictures):
    told, splats = [], random_splats(300, degree=1)
    nanogs.simplify(splats, size=9_000, progress=lambda step: told.append(step.stage))
    first = ["frame", "views", "look", "grow"]
    assert [*dict.fromkeys(told)] == [*first, "guess", "pack", "deliver"]


def test_a_size_that_tells_the_count_has_the_stages_of_a_count(tmp_path):
    told = []
    nanogs.save(random_splats(300), tmp_path / "a.ply")
    given = {"preset": "fast", "progress": told.append}
    nanogs.simplify_blocks(tmp_path / "a.ply", tmp_path / "b.splat", size=3200, **given)
    assert_true(told)
    numbers = {step.stage: step.number for step in told}
    assert len(set(numbers.values())) == len(numbers) == told[0].stages


def test_long_stages_tell_their_parts():
    told = []
    nanogs.simplify(random_splats(400), ratio=0.2, preset="best", progress=told.append)
    for stage in ("look", "grow", "trial", "fit"):
        parts = [step.fraction for step in told if step.stage == stage]
        assert len(set(parts)) > 2, stage


def test_levels_and_their_folder(tmp_path):
    told = []
    list(nanogs.levels(random_splats(300), [0.5, 0.1], progress=told.append))
    assert_true(told)
    assert [s.stage for s in told if s.stage.startswith("level")][-1] == "level_1"
    told.clear()
    write_levels(
        random_splats(300), tmp_path / "levels", [0.5, 0.1], source="a", layout=Layout.SOG,
        chunk=50, preset="fast", progress=told.append,
    )  # fmt: skip
    assert_true(told)
    order = [stage for stage, _ in itertools.groupby(s.stage for s in told)]
    assert order == ["frame", "grow", "level_0", "write", "level_1", "write"]


def test_refit():
    told = []
    splats = random_splats(200)
    small, _ = nanogs.simplify(splats, ratio=0.3, preset="fast")
    chosen = RefitParameters(views=6, rounds=2, steps=3, size=32)
    nanogs.refit(splats, small, parameters=chosen, progress=told.append)
    assert_true(told)
    assert {s.stage for s in told} == {"render", "fit"}


@pytest.mark.parametrize("levels", [1, 2])
def test_blocks(tmp_path, levels):
    told = []
    nanogs.save(random_splats(600), tmp_path / "scene.ply")
    if levels == 1:
        nanogs.simplify_blocks(
            tmp_path / "scene.ply", tmp_path / "out.ply", ratio=0.2, block=200,
            progress=told.append,
        )  # fmt: skip
    else:
        write_levels(
            tmp_path / "scene.ply", tmp_path / "out", [0.5, 0.1], preset="default",
            block=200, progress=told.append,
        )  # fmt: skip
    assert_true(told)
    assert {"frame", "segment", "grow", "cut", "settle", "part", "write"} <= {s.stage for s in told}
    forest = [s.fraction for s in told if s.stage == "grow"]
    assert len(set(forest)) > 2


def test_renders_and_comparisons(tmp_path):
    told = []
    splats = random_splats(200)
    cameras = automatic_cameras(splats, 3, width=32, height=32)
    render_images(splats, cameras, tmp_path / "images", progress=told.append)
    assert_true(told)
    assert [s.done for s in told] == [0, 1, 2, 3, 1]
    told.clear()
    tracker = Tracker(told.append, [Stage("render", 1.0), Stage("score", 1.0)])
    models = [NamedModel("a", splats), NamedModel("b", splats.take(np.arange(100)))]
    compare_models(models[0], models, cameras, progress=tracker)
    assert max(s.done for s in told if s.stage == "score") == 6


def test_writing_sog_tells_how_far_its_palette_is(tmp_path):
    told = []
    splats = random_splats(3000)
    for name, steps in (("a.sog", 6), ("a.ply", 1)):
        told.clear()
        nanogs.save(splats, tmp_path / name, progress=told.append)
        assert_true(told)
        assert len(told) >= steps


def test_what_the_callback_raises_ends_the_call():
    def stop(step):
        if step.stage == "grow":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        nanogs.simplify(random_splats(50), ratio=0.5, preset="fast", progress=stop)

"""Progress steps that the library reports."""

import io
import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import nanogs
from builders import random_splats
from nanogs.errors import OptionError
from nanogs.fit.parameters import RefitParameters
from nanogs.io import registry
from nanogs.levels_of_detail import write_levels
from nanogs.lod.layout import LodLayout
from nanogs.pipeline.estimates.durations import count_stages, search_stages
from nanogs.progress import Stage, Step, Tracker, each
from nanogs.scoring.comparison import NamedModel, compare_models
from nanogs.views.automatic import automatic_cameras
from nanogs.views.pictures import render_images

pytestmark = pytest.mark.usefixtures("small_views")
PLAN = [Stage("first", 1.0), Stage("second", 3.0)]


def recording_tracker(stages=PLAN):
    reported = []
    return reported, Tracker(reported.append, stages)


def fractions(reported):
    return [step.fraction for step in reported]


def assert_consistent(reported):
    """Assert that the fraction never falls and is 1 only at the end, and stages are in order."""
    assert fractions(reported) == sorted(fractions(reported))
    assert reported[-1].fraction == 1
    assert all(step.fraction < 1 for step in reported[:-1])
    for step in reported:  # plain numbers, which JSON has
        assert {type(step.done), type(step.fraction)} <= {int, float}
        assert type(step.parts) is int
    assert [s.number for s in reported] == sorted(s.number for s in reported)
    assert all(1 <= s.number <= s.stages and 0 <= s.done <= s.parts for s in reported)
    assert len({s.stages for s in reported}) == 1


def test_stages_share_the_fraction_by_their_weights():
    reported, tracker = recording_tracker()
    tracker.begin("first")
    tracker.part(1, 2)
    tracker.begin("second")
    tracker.part(1, 3)
    tracker.finish()
    assert fractions(reported) == [0, 0.125, 0.25, 0.5, 1]
    assert reported[3] == Step("second", 2, 2, 1, 3, 0.5)


def test_the_fraction_never_falls_and_is_1_only_at_the_end():
    reported, tracker = recording_tracker()
    tracker.begin("second")
    tracker.part(3, 3)
    tracker.part(1, 3)
    tracker.part(7, 3)
    assert reported[1].fraction < 1
    assert reported[2].fraction == reported[1].fraction == reported[3].fraction
    tracker.finish()
    assert reported[-1].fraction == 1


def test_an_unplanned_stage_has_the_number_of_the_one_before():
    reported, tracker = recording_tracker()
    tracker.begin("first")
    tracker.begin("other")
    tracker.begin("second")
    assert [(s.stage, s.number) for s in reported] == [("first", 1), ("other", 1), ("second", 2)]


def test_stages_within_a_part_are_scaled_to_it():
    reported, tracker = recording_tracker([Stage("search", 1.0)])
    tracker.begin("search")
    probe = tracker.within(1, 4, PLAN)
    probe.begin("second")
    assert reported[-1] == Step("search", 1, 1, 1.25, 4, 0.3125)
    tracker.within(9, 4, PLAN).finish()  # more probes than were expected
    assert reported[-1].done == 4
    assert reported[-1].fraction < 1


def test_steps_of_an_inner_call_become_steps_of_its_caller():
    reported, outer = recording_tracker([Stage("read", 1.0), *PLAN, Stage("write", 5.0)])
    outer.begin("read")
    inner = Tracker(outer.passing(), PLAN)
    inner.begin("first")
    inner.begin("second")
    inner.part(1, 3)
    inner.finish()
    outer.begin("write")
    assert [s.number for s in reported] == [1, 2, 3, 3, 3, 4]
    assert fractions(reported) == [0, 0.1, 0.2, 0.3, 0.5, 0.5]


def test_each_reports_before_and_after_every_item():
    parts = []
    assert list(each("ab", lambda *part: parts.append(part))) == ["a", "b"]
    assert parts == [(0, 2), (1, 2), (2, 2)]


@pytest.mark.parametrize("preset", ["default", "fast", "best", "paper"])
@pytest.mark.parametrize("ratio", [0.1, 1.0])
def test_simplify_reports_the_stages_of_its_preset(preset, ratio):
    reported = []
    nanogs.simplify(random_splats(300), ratio=ratio, preset=preset, progress=reported.append)
    assert_consistent(reported)
    stages = {step.stage for step in reported}
    build = {"paper": {"prune", "merge"}, "fast": {"units", "grow"}}
    if ratio == 1 and preset != "paper":
        assert len(reported) == 1  # there is nothing to do
        return
    assert stages >= build.get(preset, {"units", "views", "look", "grow"})
    if ratio < 1:
        search_stages = {"trial", "pick", "reassign", "judge", "choose", "store", "fit"}
        last = {"default": search_stages, "best": search_stages, "fast": {"reassign", "store"}}
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
def test_searches_report_their_stages_in_order(preset, goal, first, stages, small_pictures):
    reported = []
    splats = random_splats(300)
    _, report = nanogs.simplify(splats, preset=preset, progress=reported.append, **goal)
    assert_consistent(reported)
    searching = ("search", "pack", "deliver")
    assert len({step.fraction for step in reported if step.stage in searching}) > 3
    order = [stage for stage, _ in itertools.groupby(step.stage for step in reported)]
    view_stages = ["views", "look"] if preset == "default" else []
    assert order[-len(stages[preset]) :] == stages[preset]
    assert order[: -len(stages[preset])] == [*first, "units", *view_stages, "grow"]
    _, plain = nanogs.simplify(splats, preset=preset, ratio=0.3)
    timed = {"encode"} | {"measure" for _ in view_stages} if "size" in goal else {"measure"}
    assert {*report.seconds} - {*plain.seconds} == timed


def test_stages_of_a_count_and_of_a_search_are_weighted_by_their_splats():
    presets, splats = nanogs.presets, 2_000_000
    fitted = replace(presets["best"], steps=20)
    known = registry.writable(Path("a.sog"))
    stages = {stage.name: stage.weight for stage in count_stages(fitted, splats, 500_000, known)}
    assert stages["encode"] == 2.0
    plain = count_stages(fitted, splats, 500_000, None)
    assert [stage.name for stage in plain] == [name for name in stages if name != "encode"]
    _, measured = search_stages(True, presets["fast"], splats, ".ply")
    assert measured == [Stage("search", pytest.approx(4 * 0.9))]
    _, sized = search_stages(False, presets["fast"], splats, ".ply")
    assert sized == [
        Stage("guess", pytest.approx(0.06 / 5)),
        Stage("search", pytest.approx(4 * 0.66)),
    ]


def test_a_size_that_leaves_the_sh_degree_open_is_packed_first(small_pictures):
    reported, splats = [], random_splats(300, degree=1)
    nanogs.simplify(splats, size=9_000, progress=lambda step: reported.append(step.stage))
    first = ["units", "views", "look", "grow"]
    assert [*dict.fromkeys(reported)] == [*first, "guess", "pack", "deliver"]


def test_a_size_that_determines_the_count_has_the_stages_of_a_count(tmp_path):
    reported = []
    nanogs.save(random_splats(300), tmp_path / "a.ply")
    options = {"preset": "fast", "progress": reported.append}
    nanogs.simplify_blocks(tmp_path / "a.ply", tmp_path / "b.splat", size=3200, **options)
    assert_consistent(reported)
    numbers = {step.stage: step.number for step in reported}
    assert len(set(numbers.values())) == len(numbers) == reported[0].stages


def test_long_stages_report_their_parts():
    reported = []
    nanogs.simplify(random_splats(400), ratio=0.2, preset="best", progress=reported.append)
    for stage in ("look", "grow", "trial", "fit"):
        parts = [step.fraction for step in reported if step.stage == stage]
        assert len(set(parts)) > 2, stage


def test_levels_report_their_stages(tmp_path):
    reported = []
    list(nanogs.levels(random_splats(300), [0.5, 0.1], progress=reported.append))
    assert_consistent(reported)
    assert [s.stage for s in reported if s.stage.startswith("level")][-1] == "level_1"
    reported.clear()
    write_levels(
        random_splats(300), tmp_path / "levels", [0.5, 0.1], source="a", layout=LodLayout.SOG,
        chunk=50, preset="fast", progress=reported.append,
    )  # fmt: skip
    assert_consistent(reported)
    order = [stage for stage, _ in itertools.groupby(s.stage for s in reported)]
    assert order == ["units", "grow", "level_0", "write", "level_1", "write"]
    reported.clear()
    nanogs.save(random_splats(300), tmp_path / "scene.ply")
    write_levels(
        tmp_path / "scene.ply", tmp_path / "of a file", [0.5, 0.1], preset="fast",
        progress=reported.append,
    )  # fmt: skip
    assert_consistent(reported)


def test_refit_reports_rendering_and_fitting():
    reported = []
    splats = random_splats(200)
    small, _ = nanogs.simplify(splats, ratio=0.3, preset="fast")
    chosen = RefitParameters(views=6, rounds=2, steps=3, size=32)
    nanogs.refit(splats, small, parameters=chosen, progress=reported.append)
    assert_consistent(reported)
    assert {s.stage for s in reported} == {"render", "fit"}


@pytest.mark.parametrize("levels", [1, 2])
def test_blocks_report_their_stages(tmp_path, levels):
    reported = []
    nanogs.save(random_splats(600), tmp_path / "scene.ply")
    if levels == 1:
        nanogs.simplify_blocks(
            tmp_path / "scene.ply", tmp_path / "out.ply", ratio=0.2, block=200,
            progress=reported.append,
        )  # fmt: skip
    else:
        write_levels(
            tmp_path / "scene.ply", tmp_path / "out", [0.5, 0.1], preset="default",
            block=200, progress=reported.append,
        )  # fmt: skip
    assert_consistent(reported)
    assert {"units", "segment", "grow", "cut", "reassign", "store", "write"} <= {
        s.stage for s in reported
    }
    forest = [s.fraction for s in reported if s.stage == "grow"]
    assert len(set(forest)) > 2


def test_renders_and_comparisons_report_their_parts(tmp_path):
    reported = []
    splats = random_splats(200)
    cameras = automatic_cameras(splats, 3, width=32, height=32)
    render_images(splats, cameras, tmp_path / "images", progress=reported.append)
    assert_consistent(reported)
    assert [s.done for s in reported] == [0, 1, 2, 3, 1]
    reported.clear()
    tracker = Tracker(reported.append, [Stage("render", 1.0), Stage("score", 1.0)])
    models = [NamedModel("a", splats), NamedModel("b", splats.take(np.arange(100)))]
    compare_models(models[0], models, cameras, progress=tracker)
    assert max(s.done for s in reported if s.stage == "score") == 6


def test_writing_sog_reports_the_progress_of_its_palette(tmp_path):
    reported = []
    splats = random_splats(3000)
    for name, steps in (("a.sog", 6), ("sog/meta.json", 6), ("a.ply", 1)):
        reported.clear()
        nanogs.save(splats, tmp_path / name, progress=reported.append)
        assert_consistent(reported)
        assert len(reported) >= steps
    reported.clear()
    nanogs.save(splats, io.BytesIO(), format=".sog", progress=reported.append)
    assert_consistent(reported)
    assert len(reported) >= 6
    with pytest.raises(OptionError, match="`progress` must be a function or None"):
        nanogs.save(splats, io.BytesIO(), format=".ply", progress="yes")


def test_an_exception_of_the_callback_ends_the_call():
    def stop(step):
        if step.stage == "grow":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        nanogs.simplify(random_splats(50), ratio=0.5, preset="fast", progress=stop)

"""Any choice on a studio page makes the same request through the library and the command."""

import dataclasses
import math
import re
import shlex
from contextlib import suppress
from functools import partial
from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

import nanogs
from builders import random_splats
from launch import run_here
from nanogs.datasets.synthetic import make_scene
from nanogs.errors import ExistsError, NotEnoughMemoryError, OptionError
from nanogs.frames import change_between, change_frame
from nanogs.pipeline.job.folder import MANIFEST, job_folder
from nanogs.pipeline.options.presets import FORESTS
from nanogs.studio import saving, turning
from nanogs.studio.cache import WorkerCache
from nanogs.studio.choice import UPS, choice_of
from nanogs.studio.opening import opened
from nanogs.studio.orders import LAYOUTS, SaveRequest, refuse_unfit, shown_path
from nanogs.studio.scene import StudioSettings, refuse_small_memory, scene_of
from nanogs.studio.worker import Cancelled

NUMBERS = st.floats(-1e6, 1e6, allow_nan=False) | st.integers(-1000, 1000)
BOXES = st.tuples(NUMBERS, NUMBERS, NUMBERS, NUMBERS, NUMBERS, NUMBERS).map(
    lambda v: [*map(min, v[:3], v[3:]), *map(max, v[:3], v[3:])]
)
WISHES = st.one_of(
    st.builds(lambda n: {"splats": n}, st.integers(1, 60)),
    st.builds(lambda n: {"bytes": n}, st.integers(1, 10**12)),
    st.builds(lambda n: {"psnr": n}, st.floats(1e-3, 100)),
)
FORMATS = [".ply", ".sog", ".spz", ".glb", ".splat", ".compressed.ply", ".npz", ".rad"]
FILTERS = st.fixed_dictionaries(
    {}, optional={
        "box": st.none() | BOXES,
        "min_opacity": st.none() | st.floats(0, 1),
        "floaters": st.booleans(),
    },
)  # fmt: skip
CHOICES = st.fixed_dictionaries(
    {"wish": WISHES}, optional={
        "format": st.sampled_from(FORMATS),
        "preset": st.sampled_from(FORESTS),
        "sh_degree": st.none() | st.integers(0, 4),
        "filters": st.none() | FILTERS,
        "render_mode": st.sampled_from([None, "default", "mip"]),
        "up": st.none() | st.sampled_from(UPS),
        "levels": st.none() | st.sampled_from(["1,0.5", "0.25", "1,0.1,0.03"]),
    },
)  # fmt: skip


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("scenes") / "a scene.ply"
    nanogs.save(random_splats(60, degree=1), path)
    return scene_of(path)


def caught(monkeypatch, where, call):
    """Return the request that `call` passes to the function named `where`."""
    taken = []

    def take(request, *_rest, **_more):
        taken.append(request)
        raise OptionError("caught")

    with monkeypatch.context() as patch, suppress(OptionError):
        patch.setattr(where, take)
        call()
    [request] = taken
    return request


def comparable(request):
    """Return the fields that decide the output, with equivalent defaults made equal."""
    plain = {field.name: getattr(request, field.name) for field in dataclasses.fields(request)}
    plain["filters"] = [each.plain for each in request.filters]
    plain["cameras"] = None if request.cameras == "auto" else request.cameras
    plain["device"] = request.device or "cpu"
    plain["up"] = request.up and tuple(request.up)
    plain["format_options"] = request.format_options or None
    plain["ratios"] = tuple(request.ratios)
    return plain


@settings(max_examples=60, deadline=None)
@given(data=CHOICES)
@example(data={"wish": {"psnr": 30.0}, "sh_degree": 4, "preset": "best"})
@example(data={"wish": {"splats": 9}, "format": ".rad"})
def test_the_shown_command_makes_the_same_request_as_the_studio(scene, data, monkeypatch_module):
    data = dict(data)
    if data.get("levels"):
        data["format"] = sorted(LAYOUTS)[len(str(data)) % len(LAYOUTS)]
    try:
        choice = choice_of(data)
        path = scene.path.parent / shown_path(scene, choice)
        order = SaveRequest(scene, StudioSettings(), choice, path)
    except OptionError:
        fast = data.get("preset") == "fast"
        assume(not (fast and "psnr" in data["wish"] and data.get("sh_degree") is not None))
        raise
    words = shlex.split(order.command())
    assert words == order.words()
    assert words[0] == "nanogs"
    if choice.levels is None:
        mine = caught(
            monkeypatch_module, "nanogs.pipeline.files.simplify_files",
            lambda: nanogs.simplify_blocks(**order.arguments()),
        )  # fmt: skip
        typed = "nanogs.cli.simplify_run.simplify_files"
    else:
        mine = caught(
            monkeypatch_module, "nanogs.levels_of_detail.write_levels_of_files",
            lambda: nanogs.write_levels(**order.arguments()),
        )  # fmt: skip
        typed = "nanogs.cli.lod_run.write_levels_of_files"
    theirs = caught(monkeypatch_module, typed, lambda: run_here(*words[1:]))
    assert comparable(mine) == comparable(theirs)


@pytest.fixture(scope="module")
def monkeypatch_module():
    with pytest.MonkeyPatch.context() as patch:
        yield patch


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (None, "must be an object"),
        ([], "must be an object"),
        ({}, "wish"),
        ({"wish": {}}, "exactly one"),
        ({"wish": {"splats": 1, "psnr": 3}}, "exactly one"),
        ({"wish": {"splat": 1}}, "did you mean 'splats'"),
        ({"wish": {"splats": True}}, "must be a number"),
        ({"wish": {"splats": 1.5}}, "whole number"),
        ({"wish": {"splats": 0}}, "at least 1"),
        ({"wish": {"splats": 10**400}}, "finite"),
        ({"wish": {"psnr": math.nan}}, "finite"),
        ({"wish": {"psnr": -1}}, "above 0"),
        ({"wish": {"splats": "5"}}, "must be a number"),
        ({"wish": {"splats": 5}, "presett": "fast"}, "did you mean 'preset'"),
        ({"wish": {"splats": 5}, "goal": 3}, "no entry"),
        ({"wish": {"splats": 5}, "preset": "paper"}, "one of fast, default, best"),
        ({"wish": {"splats": 5}, "sh_degree": 5}, "0 to 4"),
        ({"wish": {"splats": 5}, "sh_degree": False}, "0 to 4"),
        ({"wish": {"splats": 5}, "up": "z"}, "must be one of"),
        ({"wish": {"splats": 5}, "render_mode": "2dgs"}, "must be one of"),
        ({"wish": {"splats": 5}, "filters": {"box": [1, 2, 3]}}, "six numbers"),
        ({"wish": {"splats": 5}, "filters": {"box": [1, 0, 0, 0, 1, 1]}}, "lowest corner"),
        ({"wish": {"splats": 5}, "filters": {"box": [0, 0, 0, 1, 1, math.inf]}}, "finite"),
        ({"wish": {"splats": 5}, "filters": {"min_opacity": 2}}, "0 to 1"),
        ({"wish": {"splats": 5}, "filters": {"floaters": 1}}, "true or false"),
        ({"wish": {"splats": 5}, "levels": "1,2"}, "ratios"),
        ({"wish": {"splats": 5}, "levels": [1]}, "ratios"),
        ({"wish": {"splats": 5}, "levels": "0.1,0.5"}, "from fine to coarse"),
        ({"wish": {"splats": 5}, "levels": "0.5,0.5"}, "given twice"),
        ({"wish": {"splats": 5}, "format": 3}, "must be a text"),
    ],
)
def test_invalid_choices_are_refused(data, message):
    with pytest.raises(OptionError, match=message):
        choice_of(data)


def test_the_page_describes_the_presets_that_are_offered():
    script = files("nanogs.studio").joinpath("static", "method.js").read_text("utf-8")
    [described] = re.findall(r"^const PRESETS = \{$(.*?)^\};$", script, re.MULTILINE | re.DOTALL)
    assert re.findall(r"^  (\w+): \"\w", described, re.MULTILINE) == list(FORESTS)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"wish": {"splats": 61}}, "above the 60 splats"),
        ({"wish": {"splats": 5}, "format": ".xyz"}, "does not write"),
        ({"wish": {"splats": 5}, "format": ".ssog"}, "give their ratios"),
        ({"wish": {"splats": 5}, "levels": "1", "format": ".ply"}, "Levels are written as"),
        ({"wish": {"psnr": 30}, "preset": "fast", "sh_degree": 0}, "lower SH degree"),
        ({"wish": {"psnr": 30}, "format": "meta.json"}, "set the count, or choose .sog"),
        ({"wish": {"bytes": 9000}, "format": "meta.json"}, "set the count, or choose .sog"),
    ],
)
def test_choices_that_the_scene_cannot_meet_are_refused(scene, data, message):
    with pytest.raises(OptionError, match=message):
        refuse_unfit(scene, choice_of(data))


@pytest.mark.parametrize("path", ["out", "out.sog", "out.compressed.ply", "a/out.html"])
def test_file_names_that_do_not_match_the_format_are_refused(scene, path):
    with pytest.raises(OptionError, match="is no"):
        SaveRequest(scene, StudioSettings(), choice_of({"wish": {"splats": 5}}), Path(path))


def test_up_cannot_be_changed_if_the_file_states_its_frame(tmp_path):
    path = tmp_path / "a.glb"
    nanogs.save(random_splats(9, degree=0), path)
    choice = choice_of({"wish": {"splats": 5}, "up": "+z"})
    with pytest.raises(OptionError, match="states its frame"):
        refuse_unfit(scene_of(path), choice)
    refuse_unfit(scene_of(path), choice_of({"wish": {"splats": 5}, "up": "-y"}))


@pytest.mark.parametrize(
    ("frame", "up"), [("rub", "+y"), ("luf", "+y"), ("ruf", "+y"), ("rdf", "-y")]
)
def test_a_page_opens_with_the_up_that_the_file_states(tmp_path, frame, up):
    path = tmp_path / "without ground.spz"
    nanogs.save(random_splats(60), path, format_options={"spz_version": 4, "frame": frame})
    assert opening_of(path) == (up, turning.direction_of(up), False)


def test_a_page_opens_with_the_up_that_is_found_if_only_the_format_has_one(tmp_path):
    path = tmp_path / "scene.ply"
    nanogs.save(change_frame(make_scene(3000), "rdf", "rfu"), path)
    assert opening_of(path) == ("+z", (0, 0, 1), True)
    assert opening_of(path, up="-x") == ("-x", (-1, 0, 0), True)


def opening_of(path, **given):
    """Return the up axis, the camera's up and whether it can be changed, as a page is told."""
    event, start, _ = opened(scene_of(path), StudioSettings(**given), nanogs.load(path))
    assert event["camera"]["up"] == start.up.tolist()
    return event["up"], tuple(start.up), event["can_turn"]


def test_a_page_opens_with_what_it_needs_of_a_large_model_with_damaged_splats(
    tmp_path, monkeypatch
):
    monkeypatch.setattr("nanogs.studio.showing.MOST_SHOWN", 30)
    splats = random_splats(60, degree=0)
    splats.means[7, 1] = np.nan
    nanogs.save(splats, tmp_path / "a.ply")
    event, _, shown = opened(scene_of(tmp_path / "a.ply"), StudioSettings(), splats)
    assert (event["splats"], event["available"]) == (60, 59)
    assert (shown.entry["splats"], shown.entry["of"]) == (30, 60)
    whole = np.delete(splats.means, 7, axis=0)
    assert event["bounds"]["low"] == whole.min(axis=0).tolist()
    assert event["bounds"]["high"] == whole.max(axis=0).tolist()
    assert {"meta.json", ".ply"} <= {*event["formats"]}
    assert ".ksplat" not in event["formats"]


def test_up_of_a_studio_is_along_an_axis():
    assert turning.axis_of((0.0, 0.0, -2.0)) == "-z"
    for tilted in ((0.0, 1.0, 1.0), (0.0, 0.0, 0.0)):
        with pytest.raises(OptionError, match="must be an axis"):
            turning.axis_of(tilted)


@pytest.mark.parametrize("up", UPS)
def test_each_up_has_a_frame_that_rotates_it_upwards(up):
    change = change_between(turning.FRAMES[up], "rdf")
    assert np.linalg.det(change.matrix) == 1
    assert (change.matrix @ turning.direction_of(up) == turning.direction_of("-y")).all()
    assert turning.up_of(turning.direction_of(up)) == up


@pytest.mark.parametrize(
    "data",
    [
        {"wish": {"splats": 60}},
        {"wish": {"splats": 61}, "format": ".rad", "levels": "1"},  # of which levels take no count
        {"wish": {"splats": 5}, "preset": "fast", "sh_degree": 0},
        {"wish": {"psnr": 30}, "preset": "fast"},
    ],
)
def test_choices_that_the_scene_can_meet_are_allowed(scene, data):
    refuse_unfit(scene, choice_of(data))


@pytest.mark.parametrize(
    ("data", "path"),
    [
        ({}, "out.ply"),
        ({"format": "meta.json"}, "out/meta.json"),
        ({"format": "lod-meta.json", "levels": "1"}, "a scene-levels/lod-meta.json"),
    ],
)
def test_the_command_is_shown_with_a_name_that_fits_the_format(scene, data, path):
    assert shown_path(scene, choice_of({"wish": {"splats": 5}} | data)) == Path(path)


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("a.ply", {}),
        ("a.rad", {"format": ".rad", "levels": "1"}),
        ("a/lod-meta.json", {"format": "lod-meta.json", "levels": "1"}),
    ],
)
def test_an_existing_output_is_refused_before_anything_is_computed(scene, tmp_path, name, data):
    choice, path = choice_of({"wish": {"splats": 5}} | data), tmp_path / name
    order = SaveRequest(scene, StudioSettings(), choice, path)
    order.check_target()
    saved(order)
    with pytest.raises(ExistsError):
        order.check_target()
    dataclasses.replace(order, overwrite=True).check_target()


@pytest.mark.parametrize(("up", "frames"), [("-y", None), ("+z", ("rfu", "rdf"))])
def test_a_file_is_turned_only_if_another_up_is_chosen(scene, up, frames):
    choice = choice_of({"wish": {"splats": 5}, "up": up, "preset": "fast"})
    order = SaveRequest(scene, StudioSettings(), choice, Path("a.ply"))
    assert (scene.up, order.frames) == ("-y", frames)


def test_the_settings_of_the_studio_are_part_of_the_command(scene):
    studio = StudioSettings(device="cuda", max_memory=10**9, threads=3)
    order = SaveRequest(scene, studio, choice_of({"wish": {"splats": 5}}), Path("a.ply"), True)
    given = ["--device", "cuda", "--max-memory", "1000000000", "--overwrite"]
    assert order.words()[4:] == ["--count", "5", *given]
    expected = {"device": "cuda", "max_memory": 10**9, "threads": 3, "overwrite": True}
    assert expected.items() <= order.arguments().items()


def test_paths_that_look_like_options_are_written_as_paths(scene):
    order = SaveRequest(scene, StudioSettings(), choice_of({"wish": {"splats": 5}}), Path("-w.ply"))
    assert order.words()[3] == "./-w.ply"


def test_a_limit_on_memory_must_hold_the_model_but_not_all_of_its_forest(scene):
    large = dataclasses.replace(scene, splats=10**7)  # of 92 bytes each
    refuse_small_memory(large, StudioSettings(max_memory=1_130_000_000))
    refuse_small_memory(dataclasses.replace(scene, splats=10**12), StudioSettings())
    with pytest.raises(NotEnoughMemoryError, match=r"a scene\.ply takes about .* in the studio"):
        refuse_small_memory(large, StudioSettings(max_memory=1_129_000_000))


def test_the_studio_refuses_the_preset_paper():
    with pytest.raises(OptionError, match="fast, default, best"):
        StudioSettings(preset="paper")


@pytest.mark.parametrize(
    ("name", "choice"),
    [("a.ply", {}), ("web/lod-meta.json", {"format": "lod-meta.json", "levels": "0.5,0.1"})],
)
def test_a_save_in_blocks_that_is_cancelled_leaves_no_job(tmp_path, monkeypatch, name, choice):
    for function in ("simplify_blocks", "write_levels"):
        monkeypatch.setattr(nanogs, function, partial(getattr(nanogs, function), block=200))
    nanogs.save(random_splats(500), tmp_path / "scene.ply")
    scene, studio = scene_of(tmp_path / "scene.ply"), StudioSettings()
    asked = choice_of({"wish": {"splats": 100}, "preset": "fast", **choice})
    order = SaveRequest(scene, studio, asked, tmp_path / name)
    job = job_folder(order.target, None)

    def cancel(_step):
        if (job / MANIFEST).exists():
            raise Cancelled

    with pytest.raises(Cancelled):
        saving.save(order, WorkerCache(scene, studio), cancel)
    assert [path.name for path in tmp_path.iterdir()] == ["scene.ply"]
    assert saved(order)["type"] == "saved"
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
        [name.split("/")[0], "scene.ply"]
    )


def saved(order):
    """Do a save, and return the event that reports it."""
    cache = WorkerCache(order.scene, order.settings)
    return saving.save(order, cache, lambda _step: None)


def test_a_save_reports_what_it_wrote(tmp_path):
    nanogs.save(random_splats(500), tmp_path / "scene.ply")
    scene, filters = scene_of(tmp_path / "scene.ply"), {"box": [0, -9, -9, 9, 9, 9]}
    asked = choice_of({"wish": {"splats": 100}, "preset": "fast", "filters": filters})
    (tmp_path / "a.ply").write_bytes(b"before")
    order = SaveRequest(scene, StudioSettings(), asked, tmp_path / "a.ply", overwrite=True)
    event = saved(order)
    removed = 500 - event["report"]["input_count"]
    assert 0 < removed < 400
    assert event["bytes"] == (tmp_path / "a.ply").stat().st_size
    assert (event["replaced"], event["short"]) == (True, None)
    assert event["lines"][:2] == [("splats", "100 of 500"), ("crop", f"took {removed} splats")]
    assert event["lines"][-1][0] == "time"


def test_a_save_of_levels_reports_each_of_them(tmp_path):
    nanogs.save(random_splats(500), tmp_path / "scene.ply")
    scene, out = scene_of(tmp_path / "scene.ply"), tmp_path / "web" / "lod-meta.json"
    asked = {"wish": {"splats": 9}, "preset": "fast", "format": out.name, "levels": "1,0.1"}
    event = saved(SaveRequest(scene, StudioSettings(), choice_of(asked), out))
    files = [path for path in out.parent.rglob("*") if path.is_file()]
    assert event["bytes"] == sum(path.stat().st_size for path in files) > out.stat().st_size
    lines = [line for line in event["lines"] if line[0] == "splats"]
    assert lines == [("splats", "500 of 500"), ("splats", "50 of 500")]
    assert [level["achieved_count"] for level in event["report"]["levels"]] == [500, 50]
    assert not event["replaced"]


def test_a_save_as_a_folder_reports_the_bytes_of_all_files(scene, tmp_path):
    out = tmp_path / "sog" / "meta.json"
    asked = choice_of({"wish": {"splats": 9}, "preset": "fast", "format": out.name})
    event = saved(SaveRequest(scene, StudioSettings(), asked, out))
    sizes = [path.stat().st_size for path in out.parent.iterdir()]
    assert event["bytes"] == sum(sizes) > max(sizes)


def test_a_save_reports_a_psnr_that_was_not_reached(scene, tmp_path):
    asked = choice_of({"wish": {"psnr": 99}, "preset": "fast", "format": ".splat"})
    event = saved(SaveRequest(scene, StudioSettings(), asked, tmp_path / "a.splat"))
    assert event["short"].endswith("so the whole model was written (stop: unreached).")
    judged = event["report"]["judged"]
    quality = dict(event["lines"])["PSNR"]
    assert quality == f"{judged['psnr']:.2f} dB, SSIM {judged['ssim']:.4f}"


@pytest.mark.parametrize(("limit", "divided"), [(None, False), (10**9, False), (None, True)])
def test_a_save_that_needs_the_memory_frees_the_model_first(tmp_path, limit, divided, monkeypatch):
    nanogs.save(random_splats(500), tmp_path / "scene.ply")
    scene, studio = scene_of(tmp_path / "scene.ply"), StudioSettings(max_memory=limit)
    asked = choice_of({"wish": {"splats": 100}, "preset": "fast"})
    freed = []
    monkeypatch.setattr(WorkerCache, "forget", lambda _cache: freed.append(True))
    monkeypatch.setattr(saving, "plan_files", lambda _request: SimpleNamespace(divided=divided))
    saved(SaveRequest(scene, studio, asked, tmp_path / "a.ply"))
    assert len(freed) == (limit is not None or divided)


def test_a_save_leaves_the_job_of_a_command_alone(tmp_path):
    nanogs.save(random_splats(500), tmp_path / "scene.ply")
    output = tmp_path / "a.ply"
    kept = job_folder(output, None)

    def stop(_step):
        if (kept / MANIFEST).exists():
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        nanogs.simplify_blocks(
            tmp_path / "scene.ply", output, count=100, preset="fast", block=200, progress=stop
        )
    scene, studio = scene_of(tmp_path / "scene.ply"), StudioSettings()
    asked = choice_of({"wish": {"splats": 100}, "preset": "fast"})
    saved(SaveRequest(scene, studio, asked, output))
    assert (kept / MANIFEST).exists()

"""`bench`: its settings, its processes, its protocol, and the command as a user runs it."""

import contextlib
import importlib.util
import json
import math
import os
import shutil
import subprocess
import sys
import types
import typing
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import launch
import nanogs
from builders import model_bytes, random_splats
from crashes import CrashError
from dataset_files import write_capture
from kernel_copies import copy_kernels
from nanogs.bench import measuring, output
from nanogs.bench.baselines import MethodContext
from nanogs.bench.gsplat import gsplat_fps
from nanogs.bench.methods import ABLATIONS, find_method
from nanogs.bench.output import ResultFolder, only_run_in, run_of
from nanogs.bench.rows import ORIGINAL, Against, BenchRow, SetScore, Status
from nanogs.bench.run import row_count, row_keys, run_bench
from nanogs.bench.scenes import (
    BenchScene,
    fill,
    parse_dataset,
    parse_scene,
    scene_of_file,
    scene_views,
    scenes_of_files,
)
from nanogs.bench.settings import BenchSettings
from nanogs.bench.worker import Job, Outcome, peak_memory, run_job
from nanogs.cli.bench import bench
from nanogs.errors import OptionError, OutputError
from nanogs.io import load
from nanogs.io.atomic import atomic_write
from nanogs.method.graph import random_pairs
from nanogs.pipeline.options.presets import PRESETS, parameters
from nanogs.raster.camera import Camera
from nanogs.raster.rendering import render
from nanogs.report import StopReason
from nanogs.scoring.run import compare_files
from nanogs.scoring.scores import EXTRA_METRICS
from nanogs.views.automatic import automatic_cameras


def run(*arguments, **kwargs):
    return launch.run(*arguments, timeout=300, **kwargs)


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("bench") / "ball.ply"
    splats = random_splats(400, degree=1)
    splats.opacity_logits[:] = 2
    nanogs.save(splats, path)
    return path


# Names and patterns


def test_scenes_are_named_after_their_file_or_by_the_option():
    assert scene_of_file("x/biker.compressed.ply").name == "biker"
    assert parse_scene("g=a/b.ply").photos is None
    assert parse_scene("g=a/b.ply:data/g").photos.as_posix() == "data/g"
    drives = parse_scene("g=C:\\a.ply:D:\\photos")
    assert (str(drives.model), str(drives.photos)) == ("C:\\a.ply", "D:\\photos")
    assert str(parse_scene("g=C:\\a.ply").model) == "C:\\a.ply"
    for text in ("g", "=a.ply", "g="):
        with pytest.raises(OptionError, match="NAME=MODEL"):
            parse_scene(text)


def test_a_data_set_is_a_folder_with_a_folder_for_each_scene(tmp_path):
    for scene in ("bicycle", "room"):
        model = tmp_path / scene / "point_cloud" / "iteration_30000" / "point_cloud.ply"
        model.parent.mkdir(parents=True)
        model.touch()
    (tmp_path / "empty").mkdir()
    scenes = parse_dataset(f"mip-nerf-360={tmp_path}")
    assert [(scene.name, scene.images) for scene in scenes] == [
        ("bicycle", "images_4"),
        ("room", "images_2"),
    ]
    with pytest.raises(OptionError, match="holds no trained model"):
        parse_dataset(f"mip-nerf-360={tmp_path}", "{folder}/{scene}.ply")
    with pytest.raises(OptionError, match="nerf-synthetic"):
        parse_dataset(f"mine={tmp_path}")


def test_missing_scaled_photographs_of_a_data_set_are_asked_for(model, tmp_path):
    """Not a choice of `images`, which the command does not have."""
    write_capture(tmp_path / "room")
    shutil.copy(model, tmp_path / "room.ply")
    scenes = parse_dataset(f"mip-nerf-360={tmp_path}", "{folder}/{scene}.ply")
    row, *_ = run_bench(scenes, BenchSettings(ratios=(0.5,), methods=("random",)))
    assert row.reason.startswith(f"{tmp_path / 'room' / 'images_2'}: is no folder; copy the photo")
    assert "scaled to half of their width" in row.reason


def test_unknown_placeholders_are_refused():
    assert fill("{scene}_{ratio}.ply", scene="a", ratio="0.1") == "a_0.1.ply"
    assert fill("{scene}{{}}.ply", scene="a", ratio="0.1") == "a{}.ply"
    parts = ("{scene.name}", "{scene[a]}", "{scene[0]}", "{scene!r}", "{scene:{ratio.real}}")
    for pattern in ("{name}.ply", "{.ply", "{}", *parts):
        with pytest.raises(OptionError, match="no other braces"):
            fill(pattern, scene="a", ratio="0.1")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"ratios": (0.0,)}, "above 0"),
        ({"ratios": (0.1, 0.1)}, "The ratio .* occurs twice; leave one out"),
        ({"ratios": ()}, "at least one ratio"),
        ({"methods": ("nope",)}, "no method 'nope'"),
        ({"methods": ("random:seed=3",)}, "only presets take parameters; name random without"),
        ({"methods": ("paper:x=1",)}, "no parameter 'x'"),
        ({"methods": ("paper:k=many",)}, "k takes a whole number"),
        ({"methods": ("paper:tau=many",)}, "tau takes a number"),
        ({"methods": ("paper:graph=tree",)}, "knn or random"),
        ({"methods": ("random",), "externals": {"random": "a"}}, "The method .* occurs twice"),
        ({"externals": {ORIGINAL: "a"}}, "The method .* occurs twice"),
        (
            {"methods": ("them",), "externals": {"them": "a"}},
            "'them' .* out of the methods",
        ),
        (
            {"methods": ("them",), "externals": {"them": "a"}, "file_sizes": (1000,)},
            "leave it out of the methods",
        ),
        ({"views": 0}, "views"),
        ({"sizes": (2,)}, "16 pixels"),
        ({"sizes": (64, 64)}, "The size .* occurs twice"),
        ({"sizes": ()}, "one size"),
        ({"kinds": ("around",)}, "auto, orbit, inside, roam"),
    ],
)
def test_invalid_settings_are_refused(options, message):
    with pytest.raises(OptionError, match=message):
        BenchSettings(**options)


def test_every_ablation_is_a_method():
    assert len(set(ABLATIONS)) == len(ABLATIONS) == 18
    assert set(PRESETS) <= set(ABLATIONS)
    for name in ABLATIONS:
        assert callable(find_method(name))


def test_the_help_of_ablations_names_the_presets_that_are_taken_apart():
    hints = typing.get_type_hints(bench, include_extras=True)
    text = hints["ablations"].__metadata__[0].help
    taken_apart = {
        preset for preset, _, change in (name.partition(":") for name in ABLATIONS) if change
    }
    assert taken_apart == {"paper", "default", "fast"}
    assert [preset for preset in taken_apart if preset not in text] == []


def test_the_published_method_takes_the_seed_unless_its_name_states_one():
    splats, name = random_splats(60), "paper:graph=random"
    zero, one, stated = (
        model_bytes(find_method(chosen)(splats, 20, MethodContext(seed=seed)))
        for chosen, seed in ((name, 0), (name, 1), (f"{name}:seed=0", 1))
    )
    assert zero != one
    assert zero == stated


def test_results_are_replaced_only_with_overwrite_and_only_at_the_end(tmp_path):
    old = BenchRow("a", "x", 0.1, psnr=20.0)
    ResultFolder(tmp_path).add(old)
    ResultFolder(tmp_path, overwrite=True).finish([old])
    with pytest.raises(OutputError, match="overwrite=True to replace it"):
        ResultFolder(tmp_path)
    before = (tmp_path / "results.md").read_bytes()
    folder = ResultFolder(tmp_path, overwrite=True)
    assert (tmp_path / "results.md").read_bytes() == before
    rows = [BenchRow("b", "x", 0.1), BenchRow("c", "x", 0.1)]
    for row in rows:
        folder.add(row)
    folder.finish(rows)
    lines = (tmp_path / "results.jsonl").read_text().splitlines()
    assert [json.loads(line)["scene"] for line in lines] == ["b", "c"]
    assert {path.name for path in tmp_path.iterdir()} == {"results.md", "results.jsonl", "plot.svg"}


def test_an_unfinished_run_continues_where_it_ended(tmp_path):
    roam = SetScore("roam 64", 24, 20.0, -math.inf, 0.5, {"flip": math.inf})
    first = BenchRow(
        "a", "x", 0.1, label="auto 64", psnr=math.inf, extras={"flip": 0.5}, further=(roam,),
        notes=("a note",),
    )  # fmt: skip
    failed = BenchRow("a", "y", 0.1, status=Status.FAILED, reason="no memory")
    results = ResultFolder(tmp_path, run="this")
    results.add(first)
    results.add(failed)
    unfinished = tmp_path / "unfinished.jsonl"
    unfinished.write_text(unfinished.read_text() + '{"scene": "a", "me')  # cut off
    again = ResultFolder(tmp_path, run="this")
    assert again.done == [first]
    again.add(first)
    again.add(BenchRow("a", "y", 0.1, psnr=3.0))
    assert [row.psnr for row in ResultFolder(tmp_path, run="this").done] == [math.inf, 3.0]
    refused = r"other models, photographs or settings; .* to begin anew"
    with pytest.raises(OutputError, match=refused):
        ResultFolder(tmp_path, run="that")
    assert ResultFolder(tmp_path, run="that", overwrite=True).done == []


def test_a_run_that_cannot_write_its_results_continues(tmp_path, monkeypatch):
    """On a full disk nothing that was measured is lost, and the run needs no new measurement."""
    rows = [BenchRow("a", "x", 0.1, psnr=20.0), BenchRow("a", "y", 0.1, psnr=21.0)]
    results = ResultFolder(tmp_path, run="this")
    for row in rows:
        results.add(row)

    def full(path, **_):
        if path.name == "results.md":
            raise OutputError(f"{path}: the disk or quota is full.")
        return atomic_write(path, overwrite=True)

    with monkeypatch.context() as patched:
        patched.setattr(output, "atomic_write", full)
        with pytest.raises(OutputError, match="full"):
            results.finish(rows)
    assert (tmp_path / "results.jsonl").exists()
    again = ResultFolder(tmp_path, run="this")
    assert again.done == rows
    again.finish(rows)
    assert (tmp_path / "results.md").exists()
    assert not (tmp_path / "unfinished.jsonl").exists()


def test_results_of_which_no_plot_can_be_made_stay_those_of_a_finished_run(tmp_path, monkeypatch):
    row = BenchRow("a", "x", 0.1, psnr=20.0)
    ResultFolder(tmp_path, run="this").finish([row])
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    monkeypatch.setattr(output, "plot", lambda _: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        ResultFolder(tmp_path, run="this", overwrite=True).finish([row])
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def external(folder, name):
    """Return a pattern of files of another tool, and the path of the file for the ratio 0.5."""
    return str(folder / f"{{scene}}_{{ratio}}_{name}.ply"), folder / f"a_0.5_{name}.ply"


def finished_run(folder, model, settings):
    """Finish a run, without measuring anything, whose rows have 1 dB, 2 dB and so on."""
    scene = BenchScene("a", model)
    results = ResultFolder(folder, run=run_of([scene], settings))
    rows = [
        BenchRow("a", name, target.ratio, psnr=float(number))
        for number, (name, target) in enumerate(row_keys(settings))
    ]
    for row in rows:
        results.add(row)
    results.finish(rows)
    return [scene], rows


def test_a_finished_run_can_be_added_to(model, tmp_path):
    """Results of another tool that come later are scored alone; ours take hours."""
    first = BenchSettings(ratios=(0.5,), methods=("random",))
    scenes, rows = finished_run(tmp_path, model, first)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    pattern, _ = external(tmp_path, "them")
    more = replace(
        first, ratios=(0.5, 0.1), methods=("opacity", "random"), externals={"them": pattern}
    )
    scenes.append(BenchScene("b", model))
    results = ResultFolder(tmp_path, run=run_of(scenes, more))
    assert results.done == rows
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
    results.add(BenchRow("a", "opacity", 0.5, psnr=7.0))  # then the run is interrupted
    again = ResultFolder(tmp_path, run=run_of(scenes, more))
    assert [row.psnr for row in again.done] == [0.0, 1.0, 7.0]
    again.finish(again.done)
    assert not (tmp_path / "unfinished.jsonl").exists()
    assert [row.psnr for row in ResultFolder(tmp_path, run=run_of(scenes, more)).done] == [0, 1, 7]


@pytest.mark.parametrize(
    "change",
    [
        {},  # the same run, which would add nothing
        {"methods": ("random",)},  # fewer rows, the others of which would be lost
        {"methods": ("random", "opacity", "voxel"), "sizes": (32,)},
        {"methods": ("random", "opacity", "voxel"), "views": 3},
        {"methods": ("random", "opacity", "voxel"), "seed": 1},
    ],
)
def test_a_finished_run_of_other_settings_or_methods_is_refused(change, model, tmp_path):
    first = BenchSettings(ratios=(0.5,), methods=("random", "opacity"))
    scenes, _ = finished_run(tmp_path, model, first)
    other = run_of(scenes, replace(first, **change))
    way = ", or give all of its scenes, .* to add to it" if change else ""
    with pytest.raises(OutputError, match=rf"results\.md exists already.* to replace it{way}\.$"):
        ResultFolder(tmp_path, run=other)
    assert ResultFolder(tmp_path, run=other, overwrite=True).done == []


def test_a_finished_run_of_another_model_or_without_its_record_is_refused(model, tmp_path):
    first = BenchSettings(ratios=(0.5,), methods=("random",))
    copy, out = tmp_path / "copy.ply", tmp_path / "out"
    shutil.copy(model, copy)
    scenes, _ = finished_run(out, copy, first)
    more = replace(first, methods=("random", "opacity"))
    assert ResultFolder(out, run=run_of(scenes, more)).done
    os.utime(copy, (1, 1))
    with pytest.raises(OutputError, match="other models"):
        ResultFolder(out, run=run_of(scenes, more))
    for damage in ("{}", "[]", "run", '{"rows": 1}'):
        (out / "run.json").write_text(damage)
        with pytest.raises(OutputError, match="exists already"):
            ResultFolder(out, run=run_of(scenes, more))
    (out / "run.json").unlink()
    with pytest.raises(OutputError, match="exists already"):
        ResultFolder(out, run=run_of(scenes, more))


@pytest.mark.parametrize("layout", ["blender", "colmap"])
def test_a_run_of_other_photographs_or_cameras_is_refused(layout, model, tmp_path):
    if layout == "blender":
        write_photographs(tmp_path, model)
        photo, cameras = tmp_path / "test" / "near.png", tmp_path / "transforms_test.json"
    else:
        write_capture(tmp_path)
        photo, cameras = tmp_path / "images" / "img_0.png", tmp_path / "sparse" / "0" / "images.bin"
    scene = BenchScene("a", model, tmp_path)
    settings = BenchSettings(ratios=(0.5,), methods=("random",))
    row = BenchRow("a", ORIGINAL, 1.0, psnr=12.0)
    results = ResultFolder(tmp_path / "out", run=run_of([scene], settings))
    results.add(row)
    for file in (photo, cameras):
        before = file.stat()
        os.utime(file, (1, 1))
        with pytest.raises(OutputError, match="other models, photographs"):
            ResultFolder(tmp_path / "out", run=run_of([scene], settings))
        os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))
        file.rename(tmp_path / "away")  # counts as unchanged
        assert ResultFolder(tmp_path / "out", run=run_of([scene], settings)).done == [row]
        (tmp_path / "away").rename(file)
    assert ResultFolder(tmp_path / "out", run=run_of([scene], settings)).done == [row]


def test_a_run_of_other_sources_of_the_same_version_is_refused(model, tmp_path, monkeypatch):
    settings = BenchSettings(ratios=(0.5,), methods=("random",))
    scenes, _ = finished_run(tmp_path, model, settings)
    more = replace(settings, methods=("random", "opacity"))
    assert ResultFolder(tmp_path, run=run_of(scenes, more)).done
    monkeypatch.setattr(output, "digest_of_sources", lambda _apart: "other")
    with pytest.raises(OutputError, match="another version"):
        ResultFolder(tmp_path, run=run_of(scenes, more))


@pytest.mark.parametrize("finished", [True, False])
def test_files_of_other_tools_that_changed_are_scored_again(finished, model, tmp_path):
    files = {name: external(tmp_path, name) for name in ("old", "new", "noted")}
    files["old"][1].write_text("as before")
    files["noted"][1].write_text("as before")
    settings = BenchSettings(
        ratios=(0.5,), methods=("random",), externals={name: files[name][0] for name in files}
    )
    out = tmp_path / "out"
    scenes, rows = finished_run(out, model, settings)
    if not finished:
        shutil.rmtree(out)
        results = ResultFolder(out, run=run_of(scenes, settings))
        for row in rows:
            results.add(row)
    files["new"][1].write_text("now there is one")
    measuring.note_of(files["noted"][1]).write_text('{"seconds": 2}')
    kept = ResultFolder(out, run=run_of(scenes, settings)).done
    assert [row.method for row in kept] == [ORIGINAL, "random", "old"]


def test_files_that_are_missing_for_a_while_count_as_unchanged(model, tmp_path):
    """As on a drive that is not mounted: what was measured stays, also once they are back."""
    copy, out, away = tmp_path / "copy.ply", tmp_path / "out", tmp_path / "away"
    shutil.copy(model, copy)
    pattern, file = external(tmp_path, "them")
    file.write_text("as before")
    settings = BenchSettings(ratios=(0.5,), methods=("random",), externals={"them": pattern})
    scenes, rows = finished_run(out, copy, settings)
    more = replace(settings, methods=("random", "opacity"))
    away.mkdir()
    for path in (copy, file):
        path.rename(away / path.name)
    results = ResultFolder(out, run=run_of(scenes, more))
    assert results.done == rows
    results.add(rows[0])  # then the run is interrupted
    for path in (copy, file):
        (away / path.name).rename(path)
    assert ResultFolder(out, run=run_of(scenes, more)).done == rows
    os.utime(file, (1, 1))
    kept = ResultFolder(out, run=run_of(scenes, more)).done
    assert [row.method for row in kept] == [ORIGINAL, "random"]


def test_a_run_continues_once_files_are_there_that_were_missing(model, tmp_path):
    scenes = [BenchScene("a", model), BenchScene("b", tmp_path / "b.ply", tmp_path / "photos")]
    settings = BenchSettings(ratios=(0.5,), methods=("random",))
    row = BenchRow("a", ORIGINAL, 1.0)
    results = ResultFolder(tmp_path / "out", run=run_of(scenes, settings))
    results.add(row)
    results.add(BenchRow("b", ORIGINAL, 1.0, status=Status.SKIPPED, reason="There is none."))
    shutil.copy(model, tmp_path / "b.ply")
    write_capture(tmp_path / "photos")
    again = ResultFolder(tmp_path / "out", run=run_of(scenes, settings))
    assert again.done == [row]
    again.add(BenchRow("b", ORIGINAL, 1.0, psnr=20.0))
    os.utime(tmp_path / "b.ply", (1, 1))
    with pytest.raises(OutputError, match="other models"):
        ResultFolder(tmp_path / "out", run=run_of(scenes, settings))


def test_rows_of_a_scene_that_cannot_be_read_any_more_stay(model, tmp_path):
    known = [BenchRow("a", ORIGINAL, 1.0), BenchRow("a", "random", 0.5, psnr=12.0)]
    scene = BenchScene("a", model, tmp_path / "not_mounted")
    settings = BenchSettings(ratios=(0.5,), methods=("random", "opacity"))
    *kept, further = run_bench([scene], settings, done=known)
    assert kept == known
    assert further.status is Status.SKIPPED
    assert "not_mounted" in further.reason


def test_further_methods_leave_the_finished_rows_of_their_scene(model, monkeypatch):
    monkeypatch.setattr(measuring, "run_job", lambda job: Outcome(error=f"ran {job.method}"))
    known = [BenchRow("ball", ORIGINAL, 1.0, splats=1), BenchRow("ball", "fast", 0.5, psnr=12.0)]
    settings = BenchSettings(ratios=(0.5,), methods=("fast", "random"), views=1, sizes=(16,))
    *kept, further = run_bench([scene_of_file(model)], settings, done=known)
    assert kept == known
    assert further.reason == "ran random"


@pytest.mark.parametrize(
    ("file_bytes", "reason"),
    [
        (6000, "The whole model as .ply takes 6,000 B, which fits into this size."),
        (6001, "ran fast"),
        (None, "ran fast"),  # it could not be written
    ],
)
def test_the_size_of_the_whole_model_is_that_of_its_finished_row(
    file_bytes, reason, model, monkeypatch
):
    monkeypatch.setattr(measuring, "run_job", lambda job: Outcome(error=f"ran {job.method}"))
    known = [
        BenchRow("ball", ORIGINAL, 1.0),
        BenchRow("ball", ORIGINAL, 1.0, format=".ply", file_bytes=file_bytes),
    ]
    settings = BenchSettings(
        file_sizes=(6000,), formats=(".ply",), methods=("fast",), views=1, sizes=(16,)
    )
    rows = run_bench([scene_of_file(model)], settings, done=known)
    assert rows[:2] == known
    assert rows[2].reason == reason


def test_a_run_that_measured_nothing_keeps_the_rows_that_it_took_over(tmp_path):
    row = BenchRow("a", ORIGINAL, 1.0)
    ResultFolder(tmp_path, run="this").add(row)
    again = ResultFolder(tmp_path, run="this")
    again.add(row)
    again.abandon()
    assert ResultFolder(tmp_path, run="this").done == [row]


def test_finished_rows_are_not_measured_again(model, monkeypatch):
    scene = BenchScene("a", model)
    settings = BenchSettings(ratios=(0.5,), methods=("random",), views=1, sizes=(16,))
    known = [BenchRow("a", ORIGINAL, 1.0, splats=400), BenchRow("a", "random", 0.5, psnr=12.0)]
    monkeypatch.setattr("nanogs.bench.run.load", None)  # nothing is read
    assert run_bench([scene], settings, done=known) == known
    assert run_of([scene], settings) != run_of([scene], replace(settings, sizes=(32,)))
    assert run_of([scene], settings) == run_of([scene], replace(settings))


def test_a_folder_that_cannot_be_made_is_refused(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="cannot be written"):
        ResultFolder(tmp_path / "file")


# Random pairs in place of the neighbour graph, for the ablation


@pytest.mark.parametrize(("n", "k"), [(2, 1), (2, 5), (50, 1), (300, 16)])
def test_random_pairs_are_sorted_and_unique_and_cover_all_rows(n, k):
    pairs = random_pairs(n, k, 0)
    assert (pairs[:, 0] < pairs[:, 1]).all()
    assert pairs.min() == 0
    assert pairs.max() == n - 1
    assert set(pairs.ravel().tolist()) == set(range(n))
    packed = pairs[:, 0].astype(np.int64) << 32 | pairs[:, 1]
    assert (np.diff(packed) > 0).all()
    assert n * k / 2 * (n > 50) <= len(pairs) <= n * k


def test_random_pairs_depend_on_the_seed_and_are_spread_over_all_rows():
    assert np.array_equal(random_pairs(100, 4, 1), random_pairs(100, 4, 1))
    assert not np.array_equal(random_pairs(100, 4, 1), random_pairs(100, 4, 2))
    distances = np.diff(random_pairs(20_000, 8, 0).astype(np.int64), axis=1)
    assert distances.mean() == pytest.approx(20_000 / 3, rel=0.02)
    assert len(random_pairs(1, 4, 0)) == 0


def test_random_pairs_are_those_of_one_draw_for_all_rows():
    n, k = 5000, 20  # several slices, which begin within a row
    partners = np.random.default_rng(3).integers(0, n - 1, n * k)
    rows = np.repeat(np.arange(n), k)
    partners += partners >= rows
    expected = np.unique(np.sort([rows, partners], axis=0), axis=1)
    assert np.array_equal(random_pairs(n, k, 3), expected.T)


def test_the_random_graph_gives_the_exact_count_and_larger_splats():
    splats = random_splats(500)
    near, _ = nanogs.simplify(splats, ratio=0.1, preset="paper")
    far, report = nanogs.simplify(splats, ratio=0.1, preset="paper", graph="random")
    assert len(far) == 50
    assert report.stop == StopReason.TARGET
    assert report.parameters["graph"] == "random"
    assert far.log_scales.mean() > near.log_scales.mean() + 0.1


def test_an_unknown_graph_is_refused():
    with pytest.raises(OptionError, match="knn or random"):
        parameters("paper", {"graph": "tree"})


# Processes


def test_a_process_reports_its_own_seconds_and_memory(model, tmp_path):
    memory_of_the_parent = np.ones(1 << 27, dtype=np.uint8)
    outcome = run_job(Job(model, "opacity", 0.1, tmp_path / "small.ply"))
    assert outcome.error == ""
    assert outcome.splats == outcome.asked == 40 == len(nanogs.load(tmp_path / "small.ply"))
    assert 0 < outcome.seconds < 5
    assert outcome.read_seconds > 0
    assert outcome.peak_memory > 20e6
    assert peak_memory() > outcome.peak_memory
    assert memory_of_the_parent.sum() == 1 << 27


def test_a_method_that_raises_gives_an_outcome_with_the_error(model, tmp_path):
    outcome = run_job(Job(model, "significance", 0.1, tmp_path / "small.ply"))
    assert "at least one camera" in outcome.error
    missing = run_job(Job(model.with_name("none.ply"), "opacity", 0.1, tmp_path / "small.ply"))
    assert "none.ply" in missing.error


def test_a_process_that_compiles_kernels_prints_nothing(model, tmp_path, monkeypatch, capfd):
    """Otherwise `bench --quiet` would not be quiet."""
    job, cache = Job(model, "paper", 0.1, tmp_path / "small.ply"), tmp_path / "cache"
    run_job(job)  # so that there are kernels to copy
    missing = copy_kernels(cache, ("pairs.fill_firsts",))
    copied = {*cache.rglob("*.nbi")}
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(cache))
    capfd.readouterr()
    assert not run_job(job).error
    assert len({*cache.rglob("*.nbi")} - copied) == len(missing) > 0
    assert capfd.readouterr() == ("", "")


class ExitsWhenUnpickled:
    """An object that ends the process that unpickles it."""

    def __reduce__(self):
        return os._exit, (3,)


def test_a_process_that_dies_gives_an_outcome_with_the_error(tmp_path):
    outcome = run_job(Job(ExitsWhenUnpickled(), "opacity", 0.1, tmp_path / "small.ply"))
    assert outcome.error == "Its process ended without a result (exit code 3)."


# The protocol


def test_a_method_that_fails_gives_a_row_with_the_error(model, monkeypatch):
    monkeypatch.setattr(measuring, "run_job", lambda _job: Outcome(error="boom"))
    settings = BenchSettings(ratios=(0.1,), methods=("opacity",), views=1, sizes=(32,))
    failed = run_bench([scene_of_file(model)], settings)[1]
    assert (failed.status, failed.reason, failed.psnr) == (Status.FAILED, "boom", None)


def test_a_run_that_was_killed_leaves_nothing_in_the_way_of_the_next(model, monkeypatch):
    def run_in_blocks(job):
        begun = job.output.with_name(f"{job.output.name}.job")

        def kill(_step):
            if begun.exists() and job.method == "fast":
                raise CrashError

        try:
            report = nanogs.simplify_blocks(
                job.model, job.output, size=job.size, block=200, preset="fast", progress=kill
            )
        except CrashError:
            assert begun.exists()
            return Outcome(error="killed")
        return Outcome("", report.achieved_count, report.achieved_count)

    monkeypatch.setattr(measuring, "run_job", run_in_blocks)
    settings = BenchSettings(
        file_sizes=(6000,), formats=(".ply",), methods=("fast", "fast:k=4"), views=1, sizes=(32,)
    )
    rows = run_bench([scene_of_file(model)], settings)[2:]
    assert [row.status for row in rows] == [Status.FAILED, Status.OK]
    assert rows[0].reason == "killed"


def test_a_scene_that_cannot_be_read_is_skipped_and_the_next_is_measured(model, tmp_path):
    scenes = [BenchScene("gone", tmp_path / "gone.ply"), scene_of_file(model)]
    settings = BenchSettings(ratios=(0.1,), methods=("opacity",), views=1, sizes=(32,))
    reported = []
    rows = run_bench(scenes, settings, on_row=reported.append)
    assert rows == reported
    assert len(rows) == row_count(scenes, settings) == 4
    assert [entry.status for entry in rows] == [Status.SKIPPED] * 2 + [Status.OK] * 2
    assert "gone.ply" in rows[0].reason


def test_invalid_scenes_metrics_and_threads_are_refused(model):
    settings = BenchSettings(ratios=(0.1,), methods=("opacity",))
    with pytest.raises(OptionError, match="The scene 'ball' occurs twice"):
        run_bench([scene_of_file(model)] * 2, settings)
    with pytest.raises(OptionError, match="at least one model"):
        run_bench([], settings)
    with pytest.raises(OptionError, match="no metric"):
        run_bench([scene_of_file(model)], BenchSettings(metrics=("mse",)))
    with pytest.raises(OptionError, match="threads must be from 1 to"):
        run_bench([scene_of_file(model)], replace(settings, threads=10**6))


def test_a_metric_whose_package_is_missing_is_refused_before_anything_runs(model, monkeypatch):
    def missing(_reference, _test):
        raise OptionError("lpips needs a package.")

    monkeypatch.setitem(EXTRA_METRICS, "lpips", missing)
    reported = []
    with pytest.raises(OptionError, match="needs a package"):
        run_bench([scene_of_file(model)], BenchSettings(metrics=("lpips",)), on_row=reported.append)
    assert reported == []


def test_external_files_are_scored_and_missing_ones_skipped(model, tmp_path):
    small = nanogs.load(model).take(np.arange(40))
    nanogs.save(small, tmp_path / "ball_0.1_them.ply")
    (tmp_path / "ball_0.1_them.ply.json").write_text('{"seconds": 2, "peak_memory": 5000000}')
    nanogs.save(small.take(np.arange(39)), tmp_path / "ball_0.5_them.ply")
    (tmp_path / "ball_0.05_them.ply").write_bytes(b"ply\nnonsense")
    settings = BenchSettings(
        ratios=(0.1, 0.5, 0.05, 0.01),
        methods=(),
        externals={"them": str(tmp_path / "{scene}_{ratio}_them.ply")},
        views=1,
        sizes=(32,),
    )
    _, exact, short, broken, missing = run_bench([scene_of_file(model)], settings)
    assert (exact.status, exact.splats, exact.seconds) == (Status.OK, 40, 2.0)
    assert exact.peak_memory == 5_000_000
    assert exact.notes == ()
    assert short.notes == ("39 splats instead of the 200 asked for",)
    assert broken.status is Status.FAILED
    assert missing.status is Status.SKIPPED
    assert "ball_0.01_them.ply" in missing.reason


def test_the_count_of_external_files_is_a_share_of_the_finite_splats(model, tmp_path):
    splats = nanogs.load(model)
    splats.means[:100] = np.nan
    nanogs.save(splats, tmp_path / "ball.ply")
    nanogs.save(splats.take(np.arange(100, 130)), tmp_path / "them.ply")
    settings = BenchSettings(
        ratios=(0.1,), methods=(), views=1, sizes=(16,),
        externals={"them": str(tmp_path / "them.ply")},
    )  # fmt: skip
    row = run_bench([scene_of_file(tmp_path / "ball.ply")], settings)[1]
    assert (row.splats, row.notes) == (30, ())


def test_an_unknown_placeholder_is_refused_before_anything_runs(model):
    reported = []
    settings = BenchSettings(ratios=(0.1,), methods=(), externals={"them": "{name}.ply"})
    with pytest.raises(OptionError, match="no other braces"):
        run_bench([scene_of_file(model)], settings, on_row=reported.append)
    assert reported == []


def test_external_files_of_another_degree_or_render_mode_are_noted(model, tmp_path):
    other = replace(nanogs.load(model).take(np.arange(40)), render_mode="mip")
    nanogs.save(other.with_sh_degree(0), tmp_path / "them.ply")
    settings = BenchSettings(
        ratios=(0.1,), methods=(), views=1, sizes=(32,),
        externals={"them": str(tmp_path / "them.ply")},
    )  # fmt: skip
    notes = (
        "SH degree 0, the original has 1",
        "render mode mip, the original has default, and each is drawn in its own",
    )
    assert run_bench([scene_of_file(model)], settings)[1].notes == notes
    drawn_alike = run_bench([scene_of_file(model)], replace(settings, render_mode="mip"))[1]
    assert drawn_alike.notes == notes[:1]


def test_an_external_file_in_another_frame_is_noted(model, tmp_path):
    options = {"spz_version": 4, "frame": "rub"}
    nanogs.save(nanogs.load(model), tmp_path / "them.spz", format_options=options)
    settings = BenchSettings(
        ratios=(0.1,), methods=(), views=1, sizes=(32,),
        externals={"them": str(tmp_path / "them.spz")},
    )  # fmt: skip
    _, row = run_bench([scene_of_file(model)], settings)
    assert any("them.spz is in the frame rub and" in note for note in row.notes)


def test_the_size_of_an_external_folder_is_that_of_all_its_files(model, tmp_path):
    path = tmp_path / "ball_0.1" / "meta.json"
    nanogs.save(nanogs.load(model).take(np.arange(40)), path)
    settings = BenchSettings(
        ratios=(0.1,), methods=(), views=1, sizes=(32,),
        externals={"them": str(tmp_path / "{scene}_{ratio}" / "meta.json")},
    )  # fmt: skip
    _, row = run_bench([scene_of_file(model)], settings)
    assert row.file_bytes == sum(file.stat().st_size for file in path.parent.iterdir())
    assert row.file_bytes > path.stat().st_size


@pytest.mark.parametrize(
    "note", ['{"peak_memory": Infinity}', '{"seconds": null}', "[1]", "3", "{", '{"seconds": "x"}']
)
def test_an_invalid_json_file_beside_an_external_file_is_a_failure(note, model, tmp_path):
    nanogs.save(nanogs.load(model).take(np.arange(40)), tmp_path / "them.ply")
    (tmp_path / "them.ply.json").write_text(note)
    settings = BenchSettings(
        ratios=(0.1,), methods=(), views=1, sizes=(32,),
        externals={"them": str(tmp_path / "them.ply")},
    )  # fmt: skip
    _, row = run_bench([scene_of_file(model)], settings)
    assert row.status is Status.FAILED
    assert "must be a JSON object with the numbers seconds and peak_memory" in row.reason


def write_photographs(folder, model, angle=0.8, size=32):
    """Write a data set of two views in the layout of NeRF-Synthetic, rendered from `model`."""
    frames = []
    for name, distance in (("near", 4.0), ("far", 6.0)):
        pose = np.eye(4)
        pose[2, 3] = distance
        focal = size / 2 / math.tan(angle / 2)
        camera = Camera(size, size, focal, focal, size / 2, size / 2, pose, name)
        color = render(nanogs.load(model), camera, background=(1.0, 1.0, 1.0)).color
        pixels = np.rint(np.clip(color, 0, 1) * 255).astype(np.uint8)
        (folder / "test").mkdir(parents=True, exist_ok=True)
        # Opaque, as in the data set, whose photographs have a white background.
        alpha = np.full((size, size, 1), 255, np.uint8)
        Image.fromarray(np.dstack([pixels, alpha])).save(folder / "test" / f"{name}.png")
        to_world = np.linalg.inv(pose) @ np.diag([1, -1, -1, 1])
        frames.append({"file_path": f"./test/{name}", "transform_matrix": to_world.tolist()})
    data = {"camera_angle_x": angle, "frames": frames}
    (folder / "transforms_test.json").write_text(json.dumps(data))


def test_scores_are_against_photographs_if_a_scene_has_any(model, tmp_path):
    write_photographs(tmp_path, model)
    scene = BenchScene("ball", model, tmp_path)
    settings = BenchSettings(ratios=(0.5,), methods=("significance",), sizes=(32,), fit_views=2)
    whole, small = run_bench([scene], settings)
    assert {whole.against, small.against} == {Against.PHOTOGRAPHS}
    assert whole.psnr > 45  # only the rounding to 8 bits differs
    assert small.psnr < whole.psnr - 3
    assert (whole.views, small.views) == (2, 2)
    assert any("no training views" in note for note in whole.notes)


@pytest.mark.parametrize("targets", [{"ratios": (0.5,)}, {"file_sizes": (6000,)}])
def test_presets_that_render_nothing_are_measured_on_photographs_too(targets, model, tmp_path):
    write_photographs(tmp_path, model)
    transforms = (tmp_path / "transforms_test.json").read_text()
    (tmp_path / "transforms_train.json").write_text(transforms)
    settings = BenchSettings(methods=("fast",), sizes=(32,), **targets)
    rows = run_bench([BenchScene("ball", model, tmp_path)], settings)
    assert [row.reason for row in rows] == [""] * len(rows)
    assert all(row.psnr > 15 for row in rows)


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_runs_with_the_arguments_of_the_warm_up(name, model):
    """Errors in the warm-up are ignored, but then the measured seconds would include compiling."""
    splats = nanogs.load(model)
    cameras = tuple(automatic_cameras(splats, 2, width=32, height=32))
    context = MethodContext(cameras, trained=True)
    assert len(find_method(name)(splats, 40, context)) == 40


def test_compare_and_bench_use_the_same_background_for_photographs(model, tmp_path):
    """White for photographs with alpha, black for opaque ones, or the background that is given."""
    write_photographs(tmp_path, model)
    named_model = ("ball", model)

    def compared(**options):
        comparison = compare_files(named_model, [named_model], photos=tmp_path, **options)
        return comparison.models[0].psnr, comparison.protocol.text

    def measured(**options):
        settings = BenchSettings(ratios=(0.5,), methods=("opacity",), **options)
        whole, _ = run_bench([BenchScene("ball", model, tmp_path)], settings)
        return whole.psnr, whole.notes[0]

    assert compared()[1] == "2 test photographs of 32 pixels over white"
    assert compared()[0] == measured()[0] > 45
    assert measured()[1] == "photographs over white"
    black = (0.0, 0.0, 0.0)
    assert compared(background=black)[0] == measured(background=black)[0] < 45
    for path in (tmp_path / "test").iterdir():
        Image.open(path).convert("RGB").save(path)
    assert compared()[1] == "2 test photographs of 32 pixels over black"
    assert compared()[0] == measured()[0] < 45


def test_a_missing_training_photograph_skips_the_scene_and_no_training_views_do_not(
    model, tmp_path
):
    """All methods would lose the cameras, under a note that there are none."""
    write_photographs(tmp_path, model)
    transforms = json.loads((tmp_path / "transforms_test.json").read_text())
    train = {**transforms, "w": 32, "h": 32}
    train["frames"][1]["file_path"] = "./train/gone"
    (tmp_path / "transforms_train.json").write_text(json.dumps(train))
    settings = BenchSettings(ratios=(0.5,), methods=("opacity",), fit_views=1)
    rows = run_bench([BenchScene("ball", model, tmp_path)], settings)
    assert [row.status for row in rows] == [Status.SKIPPED] * 2
    assert "has no photograph train/gone" in rows[0].reason
    (tmp_path / "transforms_train.json").write_text(json.dumps({**train, "frames": []}))
    whole, small = run_bench([BenchScene("ball", model, tmp_path)], settings)
    assert small.status is Status.OK
    assert any("no training views" in note for note in whole.notes)


def test_a_data_set_without_a_test_split_is_skipped_with_the_reason(model, tmp_path):
    (tmp_path / "transforms_train.json").write_text('{"camera_angle_x": 1, "frames": []}')
    scene = BenchScene("ball", model, tmp_path)
    rows = run_bench([scene], BenchSettings(ratios=(0.5,), methods=("opacity",)))
    assert [entry.status for entry in rows] == [Status.SKIPPED] * 2
    assert "test" in rows[0].reason


# gsplat, which needs a GPU: a fake records the arguments


class OnDevice(np.ndarray):
    def cuda(self):
        return self


def test_gsplat_gets_finite_splats_in_the_expected_shapes(monkeypatch):
    calls = []
    torch = types.SimpleNamespace(
        cuda=types.SimpleNamespace(is_available=lambda: True, synchronize=lambda: None),
        no_grad=contextlib.nullcontext,
        from_numpy=lambda values: values.view(OnDevice),
    )
    library = types.SimpleNamespace(rasterization=lambda **arguments: calls.append(arguments))
    monkeypatch.setattr(importlib.util, "find_spec", lambda _name: object())
    modules = {"torch": torch, "gsplat": library}
    monkeypatch.setattr(importlib, "import_module", modules.__getitem__)
    splats = random_splats(20, degree=2)
    splats.means[3] = np.nan
    camera = Camera(40, 30, 35.0, 36.0, 20.0, 15.0, np.eye(4), "a")
    assert gsplat_fps(splats, [camera] * 2) > 0
    arguments = calls[-1]
    shapes = {name: value.shape for name, value in arguments.items() if hasattr(value, "shape")}
    assert shapes == {
        "means": (19, 3), "quats": (19, 4), "scales": (19, 3), "opacities": (19,),
        "colors": (19, 9, 3), "viewmats": (1, 4, 4), "Ks": (1, 3, 3),
    }  # fmt: skip
    assert (arguments["width"], arguments["height"], arguments["sh_degree"]) == (40, 30, 2)
    assert arguments["Ks"][0].tolist() == [[35, 0, 20], [0, 36, 15], [0, 0, 1]]


def test_without_gsplat_its_frame_rate_is_none(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda _name: None)
    assert gsplat_fps(random_splats(3), []) is None


# The command


def test_a_folder_of_models_gives_a_scene_for_each_model(model, tmp_path):
    folder = tmp_path / "scenes"
    folder.mkdir()
    for name in ("b.ply", "a.ply"):
        shutil.copy(model, folder / name)
    nanogs.save(random_splats(20), folder / "c" / "meta.json")
    assert [scene.name for scene in scenes_of_files([folder, folder / "c"])] == ["a", "b", "c"]


@pytest.mark.parametrize("content", [None, b"no model"])
def test_a_missing_or_damaged_model_is_refused_before_anything_is_written(content, model, tmp_path):
    wrong = tmp_path / "wrong.ply"
    if content is not None:
        wrong.write_bytes(content)
    result = run("bench", model, wrong, "--out", tmp_path / "out")
    assert result.returncode == 2
    assert "wrong.ply" in result.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("options", [("--metrics", "gloss"), ("--threads", "1000")])
def test_a_refused_option_leaves_no_folder(options, model, tmp_path):
    result = run("bench", model, *options, "--out", tmp_path / "out")
    assert result.returncode == 2
    assert list(tmp_path.iterdir()) == []


def test_the_command_fails_with_the_reason_if_nothing_was_measured(tmp_path):
    result = run("bench", "--scene", f"a={tmp_path}/gone.ply", "--methods", "opacity", "--quiet")
    assert result.returncode == 2
    assert "Nothing was measured; a: " in result.stderr
    assert "gone.ply" in result.stderr.split("measured")[1]


def test_the_reason_is_that_of_a_row_that_failed(model, tmp_path):
    options = (
        "--methods",
        "",
        "--external",
        f"them={tmp_path}/gone.ply",
        "--views",
        "1",
        "--quiet",
    )
    result = run("bench", model, *options, "--sizes", "32")
    assert result.returncode == 2
    assert "gone.ply" in result.stderr.split("Nothing was measured")[1]


def test_a_method_that_fails_changes_the_exit_code_but_not_the_tables(model, tmp_path):
    (tmp_path / "bad.ply").write_bytes(b"ply")
    options = ("--methods", "opacity", "--external", f"them={tmp_path}/bad.ply", "--ratios", "0.5")
    out = tmp_path / "out"
    result = run("bench", model, *options, "--views", 1, "--sizes", 16, "--quiet", "--out", out)
    assert result.returncode == 3
    assert result.stderr.startswith(f"error: 1 result failed, first that of them for {model.stem}")
    assert result.stderr.count("\n") == 1
    assert "them at 0.5: failed: " in (out / "results.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("folder_exists", [False, True])
def test_nothing_is_written_if_nothing_was_measured(tmp_path, folder_exists):
    out = tmp_path / "made" / "out"
    if folder_exists:
        out.mkdir(parents=True)
        (out / "results.md").write_text("before")
    options = ("--scene", f"a={tmp_path}/gone.ply", "--methods", "opacity", "--quiet")
    result = run("bench", *options, "--out", out, *(["-w"] if folder_exists else []))
    assert result.returncode == 2
    assert "Nothing was measured; a: " in result.stderr
    if folder_exists:
        assert [path.name for path in out.iterdir()] == ["results.md"]
        assert (out / "results.md").read_text() == "before"
    else:
        assert not list(tmp_path.iterdir())


@pytest.mark.skipif(sys.platform == "win32", reason="needs locks of folders")
def test_a_second_run_in_a_folder_is_refused(model, tmp_path):
    options = ("--ratios", "0.1", "--methods", "opacity", "--pixels", "16", "--views", "1", "-q")
    out = tmp_path / "made" / "out"
    with only_run_in(out):
        second = run("bench", model, *options, "--out", out)
        assert (second.returncode, second.stdout) == (2, "")
        assert f"Another run is at work in {out}; wait for it" in second.stderr
        assert not list(out.iterdir())
    assert not list(tmp_path.iterdir())
    after = run("bench", model, *options, "--out", out)
    assert after.returncode == 0, after.stderr


@pytest.mark.slow
def test_the_command_prints_a_table_and_writes_three_files(model, tmp_path):
    out = tmp_path / "out"
    options = ("--ratios", "0.1", "--methods", "paper,random", "--pixels", "64", "--views", "2")
    missing = f"them={tmp_path}/{{scene}}_{{ratio}}.ply"
    result = run("bench", model, *options, "--external", missing, "--out", out)
    assert result.returncode == 0, result.stderr
    assert result.stdout == (out / "results.md").read_text(encoding="utf-8")
    assert result.stdout.startswith("```\nnanogs bench ")
    assert "| paper | 0.1 | 40 |" in result.stdout
    assert "them at 0.1: skipped: There is no file" in result.stdout
    assert "them at 0.1: skipped" in result.stderr
    lines = [json.loads(line) for line in (out / "results.jsonl").read_text().splitlines()]
    assert [line["method"] for line in lines] == [ORIGINAL, "paper", "random", "them"]
    assert lines[1]["psnr"] > lines[2]["psnr"]
    assert lines[1]["seconds"] > 0
    assert lines[1]["peak_memory"] > 50e6
    assert lines[1]["fps"] > 0
    drawn = (out / "plot.svg").read_text()
    assert all(f">{method}</text>" in drawn for method in ("paper", "random"))
    assert drawn.count("<polyline") >= 2
    again = run("bench", model, *options, "--out", out)
    assert (again.returncode, again.stdout) == (2, "")
    assert "add -w to replace it" in again.stderr
    nanogs.save(nanogs.load(model).take(np.arange(40)), tmp_path / "ball_0.1.ply")
    added = run("bench", model, *options, "--external", missing, "--out", out)
    assert added.returncode == 0, added.stderr
    assert "3 rows are taken from an earlier run" in added.stderr
    both = [json.loads(line) for line in (out / "results.jsonl").read_text().splitlines()]
    assert both[:3] == lines[:3]
    assert both[3]["status"] == "ok"


def test_a_given_up_direction_is_used_for_all_views(model):
    settings = BenchSettings(methods=("opacity",), views=2, fit_views=2, sizes=(32,))
    scene = replace(scene_of_file(model), up=(1.0, 0.0, 0.0))
    views = scene_views(scene, load(model), settings)
    for camera in (*views.cameras, *views.fit_cameras):
        assert camera.world_to_camera[0, 0] == pytest.approx(0, abs=1e-9)
        assert camera.world_to_camera[1, 0] < 0


@pytest.mark.parametrize(
    ("options", "message"),
    [(("--pixels", "64x32"), "square"), (("--pixels", "8"), "16"), (("--up", "0,0,0"), "0,0,0")],
)
def test_invalid_sizes_and_directions_of_views_are_refused(model, options, message):
    result = run("bench", model, *options)
    assert (result.returncode, result.stdout) == (2, "")
    assert message in result.stderr


def test_json_prints_the_rows_and_nothing_else(model):
    options = ("--ratios", "0.1", "--methods", "opacity", "--pixels", "32", "--views", "1")
    result = run("bench", f"--scene=ball={model}", *options, "--json")
    assert result.returncode == 0, result.stderr
    assert result.stderr == ""
    rows = json.loads(result.stdout)["rows"]
    assert [entry["scene"] for entry in rows] == ["ball", "ball"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--ratios", "many"), "many"),
        (("--methods", "magic"), "magic"),
        (("--external", "x"), "NAME=PATTERN"),
        (("--external", "x={nope}"), "nope"),
        (("--external", "x=a", "--external", "x=b"), "'x' occurs twice"),
        (("--metrics", "mse"), "mse"),
        (("--background", "white"), "--background has no effect, because no scene has photographs"),
        (("--model-pattern", "{scene}.ply"), "--model-pattern works only with --dataset"),
        (("--dataset", "mine=x"), "nerf-synthetic"),
    ],
)
def test_bad_options_are_refused_in_one_sentence(model, options, message):
    result = run("bench", model, *options)
    assert result.returncode == 2, result
    assert result.stdout == ""
    assert result.stderr.startswith("error: ")
    assert result.stderr.count("\n") == 1, result.stderr
    assert message in result.stderr


def test_a_number_of_views_is_refused_if_all_scenes_have_photographs(model, tmp_path):
    write_photographs(tmp_path, model)
    options = ("--scene", f"ball={model}:{tmp_path}", "--views", "2", "--methods", "random")
    result = run("bench", *options)
    assert (result.returncode, result.stdout) == (2, "")
    assert "--views has no effect, because all scenes have photographs" in result.stderr
    mixed = run("bench", *options, "--scene", f"other={model}", "--ratios", "0.5", "--json")
    assert (mixed.returncode, len(json.loads(mixed.stdout)["rows"])) == (0, 4)


@pytest.mark.parametrize(
    "option", [("--pixels", "64"), ("--cameras", "roam"), ("--up", "0,0,1")], ids=" ".join
)
def test_options_of_automatic_views_are_refused_if_none_are_made(option, model, tmp_path):
    write_photographs(tmp_path, model)
    words = ("bench", "--scene", f"ball={model}:{tmp_path}", "--methods", "random", *option)
    shutil.copy(tmp_path / "transforms_test.json", tmp_path / "transforms_train.json")
    result = run(*words)
    assert (result.returncode, result.stdout) == (2, "")
    name = option[0].replace("pixels", "sizes")
    assert f"{name} has no effect, because all scenes have photographs" in result.stderr
    (tmp_path / "transforms_train.json").unlink()  # so that methods learn from automatic views
    assert run(*words, "--ratios", "0.5", "--quiet").returncode == 0


def test_help_of_bench_imports_no_numba():
    code = "import sys; sys.modules['numba'] = None; from nanogs.cli import main; main()"
    result = subprocess.run(
        [sys.executable, "-c", code, "bench", "--help"],
        capture_output=True,
        text=True,
        env={**os.environ, "COLUMNS": "200"},
    )
    assert result.returncode == 0, result.stderr
    assert "--ablations" in result.stdout

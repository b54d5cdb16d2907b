"""Levels of detail: `nanogs.levels`, and the folder that `nanogs lod` makes."""

import errno
import hashlib
import json
import math
import os
import subprocess
import sys
import weakref
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import typer

import nanogs
from builders import model_bytes, random_splats
from launch import contents, run
from nanogs import io, levels_of_detail
from nanogs.cli.lod import exit_if_short
from nanogs.errors import OptionError, OutputError
from nanogs.formatting import NONE
from nanogs.io.folder import atomic_folder
from nanogs.io.sog import write as sog_write
from nanogs.levels_of_detail import write_levels
from nanogs.lod import folder as levels_folder
from nanogs.lod.manifest import made_files
from nanogs.report import StopReason
from test_cli import assert_refused

RATIOS = (0.5, 0.1, 0.02)
FEW = ["--views", "2", "--view-size", "64", "--steps", "2"]  # a small fit
LEVELS = ["level_0.ply", "level_1.ply", "level_2.ply", "levels.json"]


@pytest.fixture(scope="module")
def splats():
    return random_splats(400, degree=1)


USUAL_PIXELS = {"finer": 1}  # of levels; see `presets.with_usual_pixels`


def names(folder):
    return sorted(path.name for path in folder.iterdir())


# The library


@pytest.mark.parametrize("preset", ["default", "fast", "paper"])
def test_every_level_equals_the_result_of_simplify(splats, preset, small_views):
    levels = list(nanogs.levels(splats, RATIOS, preset=preset))
    pixels = USUAL_PIXELS if preset == "default" else {}
    assert [report.asked_ratio for _, report in levels] == list(RATIOS)
    for ratio, (small, report) in zip(RATIOS, levels, strict=True):
        alone, expected = nanogs.simplify(splats, ratio=ratio, preset=preset, **pixels)
        assert model_bytes(small) == model_bytes(alone)
        assert report.asked_count == report.achieved_count == expected.achieved_count
        assert (report.stop, report.candidates) == (StopReason.TARGET, expected.candidates)


@pytest.mark.parametrize("preset", ["default", "fast"])
def test_levels_are_fitted_at_the_sh_degree_they_keep(splats, preset, small_views):
    levels = list(nanogs.levels(splats, RATIOS, preset=preset, sh_degree=0))
    for ratio, (small, _) in zip(RATIOS, levels, strict=True):
        alone, _ = nanogs.simplify(splats, ratio=ratio, preset=preset, sh_degree=0, **USUAL_PIXELS)
        assert small.sh_degree == 0
        assert model_bytes(small) == model_bytes(alone)
    with pytest.raises(OptionError, match="SH degree"):
        nanogs.levels(splats, RATIOS, preset=preset, sh_degree=7)


@pytest.mark.parametrize("in_memory", [True, False])
def test_levels_in_a_format_without_harmonics_are_fitted_at_degree_0(
    splats, scene, tmp_path, in_memory, small_views
):
    """The files equal those of `simplify` at degree 0; the lost harmonics are noted once."""
    manifest, _ = write_levels(
        splats if in_memory else scene, tmp_path / "l", RATIOS, suffix=".splat"
    )
    assert sum("harmonics" in note for note in manifest.notes) == 1
    for level, ratio in zip(manifest.levels, RATIOS, strict=True):
        small, _ = nanogs.simplify(splats, ratio=ratio, sh_degree=0, **USUAL_PIXELS)
        nanogs.save(small, tmp_path / "one.splat", overwrite=True)
        assert (tmp_path / "l" / level.file).read_bytes() == (tmp_path / "one.splat").read_bytes()


def test_one_forest_serves_all_levels(splats, monkeypatch):
    from nanogs.pipeline import one_block as pipeline_run

    built = []
    grow = pipeline_run.grow_forest
    monkeypatch.setattr(pipeline_run, "grow_forest", lambda *given: built.append(1) or grow(*given))
    assert len(list(nanogs.levels(splats, RATIOS, preset="fast"))) == 3
    assert built == [1]


def test_only_one_level_is_in_memory_at_a_time(splats):
    """The iterator keeps no array of a level once the next level is requested."""
    levels = nanogs.levels(splats, RATIOS, preset="fast")
    small, _ = next(levels)
    array = weakref.ref(small.sh)
    del small, _
    next(levels)
    assert array() is None


def test_the_number_of_threads_is_restored_between_levels(splats):
    import numba

    before = numba.get_num_threads()
    levels = nanogs.levels(splats, RATIOS, preset="fast", threads=1)
    next(levels)
    assert numba.get_num_threads() == before


@pytest.mark.parametrize(
    ("ratios", "message"),
    [
        ([], "at least one"),
        ([0.1, 0.5], "fine to coarse"),
        ([0.5, 0.5], "twice"),
        ([1.5], "1.5"),
        ("0.5", r"a sequence of numbers, such as \[0.5, 0.1\], not '0.5'"),
        (b"0.5", "a sequence of numbers"),
        (np.array(0.5), "a sequence of numbers"),
    ],
)
def test_bad_ratios_are_refused_at_once(splats, ratios, message):
    with pytest.raises(OptionError, match=message):
        nanogs.levels(splats, ratios)


# The folder


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["fast", "paper"])
def test_every_file_equals_that_of_the_command_simplify(scene, tmp_path, preset):
    folder = tmp_path / "levels"
    options = ["--preset", preset, "-q"]
    result = run("lod", scene, folder, "--levels", "0.5,0.1,0.02", *options)
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")
    assert names(folder) == LEVELS
    for level, ratio in enumerate(RATIOS):
        alone = tmp_path / f"{level}.ply"
        assert run("simplify", scene, alone, "-r", ratio, *options).returncode == 0
        assert (folder / f"level_{level}.ply").read_bytes() == alone.read_bytes()


def test_the_manifest_describes_the_files(scene, tmp_path):
    options = ["--levels", "0.5,0.1,0.02", "--json", *FEW]
    result = run("lod", scene, tmp_path / "levels", *options)
    assert result.returncode == 0, result.stderr
    assert result.stderr == ""
    manifest = json.loads((tmp_path / "levels" / "levels.json").read_text())
    assert json.loads(result.stdout)["levels"] == manifest["levels"]
    assert (manifest["format"], manifest["version"]) == ("nanogs-levels", 1)
    assert (manifest["source"], manifest["source_count"]) == ("scene.ply", 400)
    assert manifest["preset"] == "default"
    assert [level["ratio"] for level in manifest["levels"]] == list(RATIOS)
    assert [level["count"] for level in manifest["levels"]] == [200, 40, 8]
    for level in manifest["levels"]:
        content = (tmp_path / "levels" / level["file"]).read_bytes()
        assert level["bytes"] == len(content)
        assert level["sha256"] == hashlib.sha256(content).hexdigest()
        assert 0 < level["psnr"] <= 100
        assert 0 < level["ssim"] <= 1
        assert "seconds" not in level
    assert manifest["protocol"]["views"] == 8


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"layout": "tiles"}, '"files", "streamed sog", "3d tiles"'),
        ({"suffix": ".obj"}, r"^nanogs does not write a format '\.obj'"),
        ({"suffix": "obj"}, "^nanogs does not write a format 'obj'"),
        ({"layout": "files", "chunk": 5}, "not divided"),
        (
            {"layout": "3d tiles", "suffix": "spz"},
            '"3d tiles" has a format of its own; leave out `s',
        ),
        ({"layout": "spark tree", "suffix": ".sog"}, '"spark tree" has a format of its own'),
    ],
)
def test_unknown_layouts_and_formats_are_refused_before_any_work(tmp_path, options, message):
    with pytest.raises(OptionError, match=message):
        write_levels(tmp_path / "missing.ply", tmp_path / "l", [0.1], **options)


@pytest.mark.parametrize("name", ["block_layout", "inputs", "output", "goal", "ratio"])
def test_options_that_levels_do_not_have_are_refused(splats, tmp_path, name):
    with pytest.raises(OptionError, match=f"has no parameter '{name}'"):
        write_levels(splats, tmp_path / "levels", RATIOS, preset="fast", **{name: 3})


def test_options_for_files_that_are_not_used_are_no_error(splats, tmp_path):
    unused = {"block": None, "job": None, "scratch": None, "resume": False, "executor": None}
    write_levels(splats, tmp_path / "levels", RATIOS, preset="fast", **unused)
    assert names(tmp_path / "levels") == LEVELS


@pytest.fixture(scope="module")
def inputs(splats, tmp_path_factory):
    """One model in memory, as a path, and as a source."""
    path = tmp_path_factory.mktemp("inputs") / "a.ply"
    nanogs.save(splats, path)
    return {"splats": splats, "path": path, "source": nanogs.open(path)}


KINDS = pytest.mark.parametrize("kind", ["splats", "path", "source"])


def test_level_files_are_those_of_simplify_fitted_to_their_palette(inputs, tmp_path, small_views):
    options = {"palette": 30}
    write_levels(inputs["path"], tmp_path / "l", [0.5, 0.2], suffix=".sog", format_options=options)
    for number, count in enumerate((200, 80)):
        small, _ = nanogs.simplify(
            inputs["splats"], count=count, format=".sog", format_options=options, **USUAL_PIXELS
        )
        assert len(np.unique(small.sh[:, 1:].reshape(count, -1), axis=0)) == 30
        nanogs.save(small, tmp_path / "one.sog", overwrite=True, format_options=options)
        level = tmp_path / "l" / f"level_{number}.sog"
        assert level.read_bytes() == (tmp_path / "one.sog").read_bytes()


@KINDS
def test_what_a_format_leaves_out_of_all_levels_is_noted_once(inputs, tmp_path, kind):
    manifest, _ = write_levels(inputs[kind], tmp_path / "l", RATIOS, suffix=".splat", preset="fast")
    assert manifest.notes == (
        "Spherical harmonics above degree 0 are left out, .splat holds no more.",
    )


@KINDS
def test_levels_are_written_with_the_format_options(inputs, tmp_path, kind):
    options = {"suffix": ".sog", "preset": "fast", "format_options": {"bits": 4}}
    write_levels(inputs[kind], tmp_path / "l", [0.5], **options)
    small, _ = nanogs.simplify(inputs["splats"], ratio=0.5, preset="fast")
    nanogs.save(small, tmp_path / "one.sog", format_options={"bits": 4})
    assert (tmp_path / "l" / "level_0.sog").read_bytes() == (tmp_path / "one.sog").read_bytes()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"format_options": {"nonsense": 3}}, "no option 'nonsense'"),
        ({"format_options": {"bits": 3}, "suffix": ".sog"}, "`bits` must be"),
        ({"format_options": {"bits": 4}, "layout": "streamed sog"}, '"streamed sog" has no format'),
        ({"format_options": {"bits": 4}, "layout": "spark tree"}, '"spark tree" has no format'),
    ],
)
@KINDS
def test_format_options_that_cannot_be_kept_are_refused(inputs, tmp_path, kind, options, message):
    with pytest.raises(OptionError, match=message):
        write_levels(inputs[kind], tmp_path / "l", RATIOS, preset="fast", **options)
    assert list(tmp_path.iterdir()) == []


@KINDS
def test_levels_have_the_requested_render_mode(inputs, tmp_path, kind):
    options = {"preset": "fast", "render_mode": "mip"}
    manifest, _ = write_levels(inputs[kind], tmp_path / "l", [0.5], **options)
    assert nanogs.load(tmp_path / "l" / "level_0.ply").render_mode == "mip"
    assert sum("as requested" in note for note in manifest.notes) == 1


def test_no_mip_levels_are_made_of_flat_splats(splats, tmp_path):
    flat = replace(splats, render_mode="2dgs")
    with pytest.raises(OptionError, match="The model is tagged 2dgs"):
        write_levels(flat, tmp_path / "l", [0.5], preset="fast", render_mode="mip")


@pytest.mark.parametrize(
    ("kind", "block"), [("splats", None), ("source", None), ("path", None), ("path", 200)]
)
def test_levels_state_the_frame_to_which_they_are_turned(inputs, tmp_path, kind, block):
    options = {"suffix": ".spz", "preset": "fast", "format_options": {"spz_version": 4}}
    frame = "rub", "rdf"
    write_levels(inputs[kind], tmp_path / "l", [0.5], frame=frame, block=block, **options)
    with nanogs.open(tmp_path / "l" / "level_0.spz") as written:
        assert written.frame == "rdf"


@pytest.mark.parametrize("block", [None, 200])
def test_the_manifest_that_is_written_has_all_notes(splats, tmp_path, block):
    states_rub = {"spz_version": 4, "frame": "rub"}
    nanogs.save(splats, tmp_path / "rub.spz", format_options=states_rub)
    options = {"preset": "fast", "sh_degree": 0, "block": block}
    manifest, _ = write_levels(tmp_path / "rub.spz", tmp_path / "l", [0.5, 0.1], **options)
    assert sum("axes are rub" in note for note in manifest.notes) == 1
    assert sum("harmonics" in note for note in manifest.notes) == 1
    written = json.loads((tmp_path / "l" / "levels.json").read_text())
    assert written == json.loads(json.dumps(manifest.to_dict()))


@pytest.mark.parametrize("kind", ["splats", "source"])
def test_threads_are_limited_while_a_model_is_filtered_and_levels_are_written(
    inputs, tmp_path, monkeypatch, kind
):
    import numba

    used = []
    for module, name in ((levels_of_detail, "changed"), (levels_folder, "save")):
        call = getattr(module, name)

        def noted(*given, call=call, **options):
            used.append(numba.get_num_threads())
            return call(*given, **options)

        monkeypatch.setattr(module, name, noted)
    write_levels(inputs[kind], tmp_path / "l", [0.5], preset="fast", threads=1)
    assert used == [1, 1]


@pytest.mark.parametrize("block", [None, 200])
def test_the_levels_of_a_tree_name_its_file(inputs, tmp_path, block):
    options = {"layout": "spark tree", "preset": "fast", "block": block}
    manifest, _ = write_levels(inputs["path"], tmp_path / "y.rad", [1, 0.5], **options)
    assert [level.files for level in manifest.levels] == [("y.rad",), ("y.rad",)]


def test_presets_without_rendering_measure_nothing(splats, tmp_path):
    manifest, _ = write_levels(splats, tmp_path / "l", [0.1], source="a.ply", preset="fast")
    assert manifest.levels[0].psnr is manifest.levels[0].ssim is manifest.protocol is None


def test_a_level_equal_to_the_model_is_shown_with_infinite_psnr(scene, tmp_path):
    out = tmp_path / "levels"
    result = run("lod", scene, out, "--levels", "1,0.5", "--preset", "fast", "--measure")
    assert result.returncode == 0, result.stderr
    cells = [line.split() for line in result.stderr.splitlines() if line.startswith("level_")]
    assert cells[0][5:7] == ["∞", "1.0000"]
    assert float(cells[1][5]) < 100
    manifest = json.loads((out / "levels.json").read_text())
    assert manifest["levels"][0]["psnr"] == "inf"
    result = run("lod", scene, tmp_path / "fast", "--levels", "1", "--preset", "fast")
    assert [line.split()[5:7] for line in result.stderr.splitlines()[1:2]] == [[NONE, NONE]]


@pytest.mark.parametrize(
    ("out", "fitted"),
    [
        ("levels", FEW),
        ("levels/lod-meta.json", ["--preset", "fast"]),
        ("levels/tileset.json", ["--preset", "fast"]),
        ("levels --format sog", ["--preset", "fast"]),
    ],
)
def test_the_same_input_gives_the_same_bytes(scene, tmp_path, out, fitted):
    """Of every file, for any number of threads; the models are the same in any layout."""
    results = []
    for number in (1, 2):
        (tmp_path / str(number)).mkdir()
        path, *options = out.split(" ")
        options += ["--levels", "0.5,0.1", "--threads", number, "-q", *fitted]
        result = run("lod", scene, tmp_path / str(number) / path, *options)
        assert result.returncode == 0, result.stderr
        folder = tmp_path / str(number) / "levels"
        results.append(contents(folder))
    assert len(results[0]) > 1
    assert results[0] == results[1]


def test_an_infinite_psnr_is_a_text_in_the_manifest(splats, tmp_path):
    manifest, _ = write_levels(splats, tmp_path / "l", [1.0], source="a.ply", measured=True)
    assert (manifest.levels[0].psnr, manifest.levels[0].ssim) == (math.inf, pytest.approx(1))
    assert json.loads((tmp_path / "l" / "levels.json").read_text())["levels"][0]["psnr"] == "inf"


def test_a_memory_limit_that_suffices_changes_no_bytes(scene, tmp_path):
    options = ["--preset", "fast", "--levels", "0.5", "-q"]
    for folder, more in (("a", []), ("b", ["--max-memory", "4GB"])):
        result = run("lod", scene, tmp_path / folder, *options, *more)
        assert result.returncode == 0, result.stderr
    assert names(tmp_path / "a") == names(tmp_path / "b")
    for name in names(tmp_path / "a"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_dry_run_plans_and_writes_nothing(scene, tmp_path):
    result = run("lod", scene, tmp_path / "levels", "--dry-run")
    assert result.returncode == 0
    assert "400, 200, 100, 50 splats" in result.stderr
    assert "peak memory" in result.stderr
    plan = json.loads(run("lod", scene, tmp_path / "levels", "--dry-run", "--json").stdout)
    assert [level["count"] for level in plan["levels"]] == [400, 200, 100, 50]
    assert list(tmp_path.iterdir()) == []


def test_the_planned_memory_includes_levels_that_are_written_whole(scene, tmp_path):
    stages = {}
    for known in ("ply", "sog"):
        options = ("--format", known, "--preset", "fast", "--dry-run", "--json")
        plan = json.loads(run("lod", scene, tmp_path / "levels", *options).stdout)
        stages[known] = plan["memory_bytes"]["stages"]
    assert stages["sog"].pop("write") > max(stages["ply"].values())
    assert stages["sog"] == stages["ply"]


def test_a_plan_of_levels_counts_usable_splats_or_says_that_it_does_not(splats, tmp_path):
    broken = replace(splats, means=splats.means.copy())
    broken.means[:40] = np.nan
    io.save(broken, tmp_path / "a.ply")
    plan = run("lod", tmp_path / "a.ply", tmp_path / "levels", "--dry-run")
    assert "400, 200, 100, 50 splats, if none holds a NaN" in plan.stderr
    options = ("--min-opacity", "0", "--levels", "0.5", "--dry-run", "--json")
    read = run("lod", tmp_path / "a.ply", tmp_path / "levels", *options)
    assert [level["count"] for level in json.loads(read.stdout)["levels"]] == [180]


def test_an_older_folder_is_replaced_only_with_overwrite(splats, tmp_path):
    folder = tmp_path / "levels"
    write_levels(splats, folder, RATIOS, source="a.ply", preset="fast")
    with pytest.raises(OutputError, match="overwrite=True"):
        write_levels(splats, folder, [0.1], source="a.ply", preset="fast")
    assert names(folder) == LEVELS
    write_levels(splats, folder, [0.1], source="a.ply", preset="fast", overwrite=True)
    assert names(folder) == ["level_0.ply", "levels.json"]
    assert names(tmp_path) == ["levels"]


def test_an_empty_folder_is_filled(splats, tmp_path):
    (tmp_path / "levels").mkdir()
    write_levels(splats, tmp_path / "levels", [0.1], source="a.ply", preset="fast")
    assert names(tmp_path / "levels") == ["level_0.ply", "levels.json"]
    assert names(tmp_path) == ["levels"]


def test_a_link_to_a_folder_stays_a_link(splats, tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    write_levels(splats, tmp_path / "link", [0.1], source="a.ply", preset="fast")
    assert (tmp_path / "link").is_symlink()
    assert names(tmp_path / "real") == ["level_0.ply", "levels.json"]


def test_folders_that_nanogs_did_not_make_are_never_deleted(splats, tmp_path):
    folder = tmp_path / "levels"
    folder.mkdir()
    (folder / "mine.txt").write_text("mine")
    with pytest.raises(OutputError, match="did not make"):
        write_levels(splats, folder, [0.1], source="a.ply", preset="fast", overwrite=True)
    (folder / "levels.json").write_text('{"format": "something else"}')
    with pytest.raises(OutputError, match="did not make"):
        write_levels(splats, folder, [0.1], source="a.ply", preset="fast", overwrite=True)
    assert names(folder) == ["levels.json", "mine.txt"]
    assert names(tmp_path) == ["levels"]


def test_foreign_files_beside_older_levels_are_never_deleted(splats, tmp_path):
    folder = tmp_path / "levels"
    write_levels(splats, folder, [0.1], source="a.ply", preset="fast")
    (folder / "mine.txt").write_text("mine")
    with pytest.raises(OutputError, match=r"mine\.txt"):
        write_levels(splats, folder, [0.5], source="a.ply", preset="fast", overwrite=True)
    assert names(folder) == ["level_0.ply", "levels.json", "mine.txt"]


def test_info_explains_that_the_list_of_levels_is_no_model(splats, tmp_path):
    write_levels(splats, tmp_path / "l", [0.5], preset="fast", suffix=".spz")
    result = run("info", tmp_path / "l" / "levels.json")
    assert_refused(result, "is the list of levels that `nanogs lod` wrote", "level_0.spz")
    (tmp_path / "levels.json").write_text("{}")
    assert_refused(run("info", tmp_path / "levels.json"), "unknown suffix")


def test_a_changed_manifest_cannot_name_files_elsewhere(tmp_path):
    entries = [{"file": name} for name in ("../mine.txt", "/etc/passwd", "a.ply")] + [{}, 3]
    manifest = {"format": "nanogs-levels", "levels": [*entries, {"file": 3}]}
    (tmp_path / "levels.json").write_text(json.dumps(manifest))
    assert made_files(tmp_path) == {"levels.json", "a.ply"}
    entries = [{"file": name} for name in ("", ".", "..", "a\0b", "b.ply")]
    (tmp_path / "levels.json").write_text(json.dumps(manifest | {"levels": entries}))
    assert made_files(tmp_path) == {"levels.json", "b.ply"}


@pytest.mark.parametrize("levels", [{}, {"levels": None}, {"levels": 3}, {"levels": ["a", None]}])
def test_info_ignores_the_levels_of_a_damaged_manifest(tmp_path, levels):
    io.save(random_splats(9), tmp_path / "a.ply")
    (tmp_path / "levels.json").write_text(json.dumps({"format": "nanogs-levels"} | levels))
    assert nanogs.info(tmp_path).levels == ()


@pytest.mark.parametrize("name", ["levels.json", "meta.json"])
def test_deeply_nested_json_is_not_taken_for_a_manifest(tmp_path, name):
    (tmp_path / name).write_text("[" * 100_000)
    owner = made_files if name == "levels.json" else sog_write.ours
    assert owner(tmp_path) is None


@pytest.mark.parametrize(
    "make",
    [
        lambda out: io.check_writable(out / "meta.json"),
        lambda out: write_levels(random_splats(9), out, RATIOS, progress=fails),
    ],
)
def test_a_mount_point_is_refused_before_any_work(tmp_path, monkeypatch, make):
    out = tmp_path / "out"
    out.mkdir()
    monkeypatch.setattr("os.path.ismount", lambda path: os.fspath(path) == str(out))
    with pytest.raises(OutputError, match=r"out is a mount point, .* such as .*out.web\."):
        make(out)


def test_a_file_in_place_of_the_folder_around_the_output_is_named(tmp_path):
    (tmp_path / "a.ply").touch()
    with pytest.raises(OutputError, match=r"a\.ply is no folder; choose another output"):
        write_levels(random_splats(9), tmp_path / "a.ply" / "out", RATIOS, progress=fails)
    assert (tmp_path / "a.ply").is_file()


def fails(_step):
    pytest.fail("work has begun")


def test_an_interrupted_call_leaves_the_old_folder_unchanged(splats, tmp_path):
    folder = tmp_path / "levels"
    write_levels(splats, folder, RATIOS, source="a.ply", preset="fast")
    before = (folder / "level_0.ply").read_bytes()

    def progress(step):
        if step.stage == "write" and step.number == step.stages:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_levels(
            splats, folder, [0.1, 0.01], source="a.ply", preset="fast", overwrite=True,
            progress=progress,
        )  # fmt: skip
    assert names(folder) == LEVELS
    assert (folder / "level_0.ply").read_bytes() == before
    assert names(tmp_path) == ["levels"]


def test_a_folder_that_appears_during_the_work_is_kept(tmp_path):
    def make():
        with atomic_folder(tmp_path / "levels", made_files) as temporary:
            (temporary / "level_0.ply").write_text("new")
            (tmp_path / "levels").mkdir()
            (tmp_path / "levels" / "mine.txt").write_text("mine")

    with pytest.raises(OutputError, match="did not make"):
        make()
    assert names(tmp_path) == ["levels"]
    assert names(tmp_path / "levels") == ["mine.txt"]


@pytest.mark.parametrize(
    ("layout", "name", "file"), [("files", "levels", "level_0.ply"), ("spark tree", "a.rad", "")]
)
def test_an_error_names_the_output_not_the_temporary_folder(
    splats, tmp_path, monkeypatch, layout, name, file
):
    def fail(_descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OutputError) as raised:
        write_levels(splats, tmp_path / name, RATIOS, preset="fast", layout=layout)
    full = "the disk or quota is full; free some space and run again."
    assert str(raised.value) == f"{tmp_path / name / file}: {full}"
    assert names(tmp_path) == []


# What the command refuses


@pytest.mark.parametrize(
    ("options", "fragments"),
    [
        (["--levels", "0.1,0.5"], ["fine to coarse"]),
        (["--levels", "0.5,0.5"], ["twice"]),
        (["--levels", "0.5,x"], ["0.5,x"]),
        (["--levels", ""], ["Levels must be ratios"]),
        (["--levels", "2,0.5"], ["at most 1", "2"]),
        (["--levels", "0.5,nan"], ["ratio"]),
        (["--preset", "fast", "--tau", "0.1"], ["fast", "tau"]),
        (["--preset", "fast", "--views", "5"], ["fast", "--views"]),
        (["--preset", "best", "--up", "1,2"], ["1,2"]),
    ],
)
def test_bad_options_are_refused(scene, tmp_path, options, fragments):
    assert_refused(run("lod", scene, tmp_path / "levels", *options), *fragments)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_made_is_refused_before_the_work(scene, tmp_path):
    (tmp_path / "file").write_text("mine")
    assert_refused(run("lod", scene, tmp_path / "file"), "file")
    assert_refused(run("lod", scene, tmp_path / "missing" / "levels"), "missing")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("mine")
    assert_refused(run("lod", scene, tmp_path / "full", "-w"), "full")
    assert names(tmp_path / "full") == ["mine.txt"]


def test_levels_that_stop_early_are_named_on_stderr(capsys):
    levels = [SimpleNamespace(file=f"level_{n}.ply", stop=StopReason.TARGET) for n in range(2)]
    exit_if_short(SimpleNamespace(levels=levels))
    levels[1].stop = StopReason.NO_CANDIDATES
    with pytest.raises(typer.Exit) as stopped:
        exit_if_short(SimpleNamespace(levels=levels))
    assert stopped.value.exit_code == 3
    errors = capsys.readouterr().err
    assert "level_1.ply" in errors
    assert "level_0.ply" not in errors
    with pytest.raises(typer.Exit):  # levels in chunks have no file of their own
        exit_if_short(SimpleNamespace(levels=[SimpleNamespace(stop=StopReason.NO_PROGRESS)]))
    assert "Level 0: stopped before the requested count" in capsys.readouterr().err


def test_full_disk_leaves_no_folder(scene, tmp_path):
    """A limit on the size of files simulates a full disk: the write fails halfway."""
    resource = pytest.importorskip("resource")

    def limit():
        resource.setrlimit(resource.RLIMIT_FSIZE, (5_000, 5_000))

    code = (
        "import signal; signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "from nanogs.cli import main; main()"
    )
    command = [sys.executable, "-c", code, "lod", scene, tmp_path / "l", "--preset", "fast"]
    result = subprocess.run(
        list(map(str, command)), capture_output=True, text=True, preexec_fn=limit, env=os.environ
    )
    assert_refused(result, "full")
    assert list(tmp_path.iterdir()) == []


def test_every_level_has_at_least_one_splat():
    """Every level has at least one splat, however small the ratio."""
    levels = nanogs.levels(random_splats(3), [0.5, 0.1, 0.001], preset="fast")
    assert [len(small) for small, _ in levels] == [2, 1, 1]


@pytest.mark.parametrize(
    ("splats", "counts", "notes"),
    [
        (1, [1, 1, 1, 1], ["Levels 0 to 3 have 1 splat each; fewer levels would do."]),
        (2, [2, 1, 1, 1], ["Levels 1 to 3 have 1 splat each; fewer levels would do."]),
        (8, [8, 4, 2, 1], []),
    ],
)
def test_equal_levels_of_a_tiny_model_are_noted(tmp_path, splats, counts, notes):
    manifest, _ = write_levels(random_splats(splats), tmp_path / "l", preset="fast")
    assert [level.count for level in manifest.levels] == counts
    assert [note for note in manifest.notes if note.startswith("Levels")] == notes

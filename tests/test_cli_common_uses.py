"""Command lines that a user would try first: files and folders, pipes, and quiet runs."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import launch
import nanogs
from builders import random_splats
from nanogs.errors import OptionError
from nanogs.formatting import bytes_text
from nanogs.io import check_writable, registry
from nanogs.scoring.viewing import view_files
from test_cli import assert_refused
from test_cli_usability import run
from viewer_bundle import require_bundle


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A model, a smaller one, and levels of the first as files, as streamed SOG and as 3D Tiles."""
    models = tmp_path_factory.mktemp("models")
    splats = random_splats(400)
    nanogs.save(splats, models / "a.ply")
    nanogs.save(splats.take(np.arange(0, 400, 4)), models / "b.ply")
    for name in ("levels", "stream/lod-meta.json", "tiles/tileset.json"):
        options = ("--preset", "fast", "--levels", "0.5,0.25,0.1,0.01", "-q")
        result = run("lod", models / "a.ply", models / name, *options)
        assert result.returncode == 0, result.stderr
    return models


# Folders


def test_a_folder_with_one_model_can_be_given_for_it(folder, tmp_path):
    small = tmp_path / "small.ply"
    result = run("simplify", folder / "stream", small, "-n", "9", "--preset", "fast")
    assert result.returncode == 0, result.stderr
    assert len(nanogs.load(small)) == 9
    assert_refused(run("simplify", folder, small, "-n", "9", "-w"), "holds 2 models; name one")


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("simplify {a} {out} -r 0.5", "is a folder; name a file in it, such as"),
        ("convert {a} {out}", "is a folder; name a file in it, such as"),
        ("simplify nowhere/ {out}/a.ply -r 0.5", "nowhere: no such file or folder; check the path"),
        ("view nowhere", "nowhere: no such file or folder; check the path"),
        ("compare - {a}", "This command does not read stdin"),
        ("compare {a} half=-", "This command does not read stdin"),
        ("view -", "This command does not read stdin"),
        ("refit {a} - {out}/b.ply", "This command does not read stdin"),
        ("render - {out}/pictures", "This command does not read stdin"),
        ("studio -", "This command does not read stdin"),
        ("refit {a} {a} -", "This command does not write to stdout"),
        ("render {a} -", "This command does not write to stdout"),
        ("compare {a} {a} --report {out}/a.pdf", "pages are written as HTML; name"),
        ("view {a} -o {out}/a.png", "pages are written as HTML; name"),
        ("view {a} -o .", ".: pages are written as HTML; name scene.html."),
        ("lod {a} . --format ssog", "leave it out, and name scene.ssog."),
        ("compare {a} {a} --report ..", f"; name {Path('..', 'scene.html')}."),
        (
            "simplify {a} {out}/meta.json --size 9kB",
            "--size works only for models in one file, and meta.js",
        ),
        (
            "simplify {a} {out}/meta.json --psnr 30",
            "--psnr works only for models in one file, and meta.js",
        ),
        ("simplify {a} {out}/a.sog --size 99B --dry-run", "The size 99 B is too small"),
        ("convert {a} --out-dir {out} --format xyz", "nanogs does not write a format 'xyz'"),
    ],
)
def test_impossible_inputs_and_outputs_are_refused_with_the_reason(
    folder, tmp_path, command, message
):
    arguments = [word.format(a=folder / "a.ply", out=tmp_path) for word in command.split()]
    assert_refused(run(*arguments), message)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("command", ["info", "simplify", "compare"])
def test_an_empty_path_is_refused(folder, command):
    rest = {"simplify": ["b.ply", "-r", "0.5"], "compare": ["b.ply"]}.get(command, [])
    assert_refused(launch.run(command, "", *rest, cwd=folder), "A path is empty; name a file.")


@pytest.mark.parametrize("command", ["info", "simplify", "compare", "render"])
def test_empty_cameras_are_not_those_of_the_current_folder(folder, command):
    rest = {"info": [], "simplify": ["b.ply", "-r", "0.5"]}.get(command, ["a.ply"])
    result = launch.run(command, "a.ply", *rest, "--cameras", "", cwd=folder)
    assert_refused(result, "--cameras is empty; name")


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("info a.ply --pixels", "--pixels must be like 512 or 1280x720"),
        ("info a.ply --photos . --split", "The split must be test or train, not ''."),
        ("compare a.ply b.ply --photos . --split", "The split must be test or train, not ''."),
        ("render a.ply out --background", "The background must be black, white or #rrggbb"),
        ("bench a.ply --sizes", "Sizes of views are like 512,1280x720"),
        ("info a.ply --packed", "--packed names no format"),
        ("compare a.ply b.ply --packed", "--packed names no format"),
        ("bench a.ply --cameras", "--cameras is empty; name a kind of views"),
        ("compare a.ply b.ply --photos . --images", "--images is empty; name a folder"),
        ("compare a.ply b.ply --metrics", "--metrics names no metric"),
        ("compare a.ply b.ply --mixed --metrics", "--metrics names no metric"),
        ("bench a.ply --metrics", "--metrics names no metric"),
        ("bench --dataset deep-blending=. --model-pattern", "--model-pattern is empty; name"),
        ("simplify a.ply out.ply -r 0.5 --preset fast --scratch", "--scratch is empty; name"),
        ("lod a.ply levels --preset fast --scheduler", "--scheduler is empty; name"),
    ],
)
def test_an_empty_value_is_not_the_default(folder, command, message):
    """As of a shell's variable that is not set."""
    assert_refused(launch.run(*command.split(), "", cwd=folder), message)


def test_a_result_is_fitted_with_the_sh_degree_of_its_format(tmp_path):
    nanogs.save(random_splats(500, degree=2), tmp_path / "a.ply")
    fast_fit = ("--views", "4", "--view-size", "64", "--steps", "4")
    options_of = {"a.splat": fast_fit, "b.splat": ("--sh-degree", "0", *fast_fit)}
    options_of["c.splat"] = ("--preset", "fast")
    notes_of = {}
    for name, options in options_of.items():
        result = run(
            "simplify", tmp_path / "a.ply", tmp_path / name, "-r", "0.2", *options, "--json"
        )
        notes_of[name] = [
            n for n in json.loads(result.stdout)["notes"] if "Spherical harmonics" in n
        ]
    assert (tmp_path / "a.splat").read_bytes() == (tmp_path / "b.splat").read_bytes()
    left_out = "Spherical harmonics above degree 0 are left out, .splat holds no more."
    assert notes_of == {"a.splat": [left_out], "b.splat": [], "c.splat": [left_out]}


def test_a_model_that_keeps_all_splats_only_loses_by_packing(folder, tmp_path):
    result = run("simplify", folder / "a.ply", tmp_path / "a.sog", "-r", "1")
    assert "views of 512 pixels, the loss is packing alone, " in result.stderr


def test_compared_models_of_the_same_name_are_told_apart(folder, tmp_path):
    for name in ("x", "y"):
        (tmp_path / name).mkdir()
        shutil.copy(folder / "b.ply", tmp_path / name / "a.ply")
    paths, small = (folder / "a.ply", tmp_path / "x" / "a.ply", tmp_path / "y" / "a.ply"), 32
    options = ("--views", "2", "--sizes", str(small), "--json")
    models = json.loads(run("compare", *paths, f"z={paths[1]}", *options).stdout)["models"]
    assert [model["name"] for model in models] == ["x/a.ply", "y/a.ply", "z"]
    found = nanogs.compare(*paths, nanogs.load(paths[1]), views=2, pixels=small)
    assert [model.name for model in found.models] == ["x/a.ply", "y/a.ply", "model 3"]


# info


def test_info_takes_folders(folder):
    stream = json.loads(run("info", folder / "stream", "--json").stdout)
    assert stream["format"] == "streamed sog"
    assert stream["levels"] == [200, 100, 40, 4]
    files = json.loads(run("info", folder / "levels", "--json").stdout)
    assert files["path"].endswith("level_0.ply")
    assert files["levels"] == [200, 100, 40, 4]
    tiles = json.loads(run("info", folder / "tiles", "--json").stdout)
    assert (tiles["format"], tiles["splats"]) == ("3d tiles", 200)
    assert tiles["levels"] == [200, 100, 40, 4]
    nanogs.save(random_splats(10), folder / "sog" / "meta.json")
    assert json.loads(run("info", folder / "sog", "--json").stdout)["splats"] == 10


def test_info_lists_all_levels_of_a_stream(folder):
    text = run("info", folder / "stream" / "lod-meta.json").stdout
    assert "0: 200, 1: 100, 2: 40, 3: 4 splats" in text
    assert "levels" not in run("info", folder / "a.ply").stdout


def test_info_says_which_of_several_models_to_name(folder, tmp_path):
    assert_refused(run("info", folder), "holds 2 models", "a.ply, b.ply")
    assert_refused(run("info", tmp_path), "holds no file of a format")


def test_info_reads_stdin(folder):
    command = [sys.executable, "-m", "nanogs", "info", "-"]
    with (folder / "a.ply").open("rb") as file:
        result = subprocess.run(command, stdin=file, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith("file ")
    assert "stdin (ply" in result.stdout


# Names of what is written


def test_lod_does_not_suggest_a_format_that_is_only_read(folder, tmp_path):
    result = run("lod", folder / "a.ply", tmp_path / "out.ksplat")
    assert_refused(result, "name a folder", "out/.")
    assert "--format" not in result.stderr


def test_tiles_too_large_for_packing_are_refused_with_a_hint_to_plain(tmp_path):
    model = random_splats(200)
    far = replace(model, means=model.means * np.float32(1e9))
    nanogs.save(far, tmp_path / "far.ply")
    arguments = ("lod", tmp_path / "far.ply", tmp_path / "tiles/tileset.json", "--preset", "fast")
    arguments += ("--levels", "0.5", "-q", "--no-measure")
    assert_refused(run(*arguments), "tiles that are not packed (--plain)")
    assert run(*arguments, "--plain").returncode == 0


def test_errors_about_unreadable_inputs_name_the_input_file(folder, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    for command in (("simplify", "-r", "0.5"), ("convert",)):
        name, *options = command
        arguments = ("notes.txt", folder / "a.ply", "--out-dir", "out", *options, "-w")
        result = launch.run(
            name, *arguments, *(["--preset", "fast"] if options else []), cwd=tmp_path
        )
        assert result.returncode == 2
        assert "error: notes.txt: unknown suffix" in result.stderr
        assert (tmp_path / "out" / "a.ply").is_file()


@pytest.mark.parametrize("name", ["out.sog", "out.ply", "out.html", "out.png"])
def test_lod_refuses_a_single_file_as_output(folder, tmp_path, name):
    assert_refused(run("lod", folder / "a.ply", tmp_path / name), "name a folder", "out/")
    assert list(tmp_path.iterdir()) == []


def test_lod_refuses_to_write_to_stdout(folder, tmp_path):
    for source in (folder / "a.ply", "-"):
        result = launch.run("lod", source, "-", data=(folder / "a.ply").read_bytes(), cwd=tmp_path)
        assert_refused(result, "Levels cannot be written to stdout", "name a folder")
    assert list(tmp_path.iterdir()) == []


def test_render_writes_one_png_file(folder, tmp_path):
    picture = tmp_path / "pic.png"
    result = run("render", folder / "a.ply", picture, "--pixels", "32x24", "--depth")
    assert result.returncode == 0, result.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["pic.png", "pic_depth.png"]
    assert picture.read_bytes()[:4] == b"\x89PNG"
    several = run("render", folder / "a.ply", tmp_path / "new.png", "--views", "3")
    assert_refused(several, "one picture", "3 views", "folder")
    for views in ((), ("--views", 1), ("--views", 4)):
        assert_refused(run("render", folder / "a.ply", tmp_path / "p.gif", *views), ".png", "p.png")
        assert not (tmp_path / "p.gif").exists()
    assert not (tmp_path / "new.png").exists()
    missing = run("render", folder / "a.ply", tmp_path / "new" / "x.png")
    assert_refused(missing, "new does not exist; create it first")
    assert not (tmp_path / "new").exists()


def test_a_picture_keeps_its_given_name(folder, tmp_path):
    small = ("--pixels", "32", "--depth", "--json")
    result = run("render", folder / "a.ply", tmp_path / "Pic.PNG", *small)
    assert result.returncode == 0, result.stderr
    expected = [str(tmp_path / name) for name in ("Pic.PNG", "Pic_depth.PNG")]
    assert json.loads(result.stdout)["images"] == expected
    assert sorted(map(str, tmp_path.iterdir())) == expected


# view


def test_view_takes_two_models(folder, tmp_path):
    require_bundle()
    small = ("--views", "1", "--pixels", "32", "-o", tmp_path / "p.html")
    result = run("view", folder / "a.ply", folder / "b.ply", *small, "--json")
    assert result.returncode == 0, result.stderr
    assert len(json.loads(result.stdout)["models"]) == 2
    three = [folder / "a.ply"] * 3
    assert_refused(run("view", *three, "-o", tmp_path / "x.html"), "one model or two")


def bytes_of(*paths):
    return sum(path.stat().st_size for path in paths)


def test_input_bytes_of_a_converted_level_count_only_its_own_files(folder, tmp_path):
    tiles = folder / "tiles" / "tileset.json"
    result = run("convert", tiles, tmp_path / "c.ply", "--level", "3", "--json")
    assert result.returncode == 0, result.stderr
    [tile] = tiles.parent.glob("3_*.glb")
    assert json.loads(result.stdout)["input_bytes"] == bytes_of(tiles, tile)


def test_view_shows_the_finest_level_that_fits_a_page(folder, tmp_path, monkeypatch):
    require_bundle()
    stream = folder / "stream" / "lod-meta.json"
    assert nanogs.io.open(stream).levels == (200, 100, 40, 4)

    def shown(level=None):
        page = tmp_path / "page.html"
        return view_files([("s", stream)], page, level=level, overwrite=True).models[0]

    assert shown().splats == 200
    assert shown(2).splats == 40
    assert shown(2).input_bytes == bytes_of(stream, *stream.parent.glob("2_0/*"))
    assert shown().input_bytes == bytes_of(stream, *stream.parent.glob("0_0/*"))
    page = tmp_path / "page.html"
    text = page.read_text(encoding="utf-8")
    assert f'"{bytes_text(shown().input_bytes)}"' in text
    assert "(0 to 3)" not in text
    shown(2)
    assert '"level 2 (0 to 3)"' in page.read_text(encoding="utf-8")
    monkeypatch.setattr("nanogs.scoring.viewing.PAGE_SPLATS", 150)
    assert shown().splats == 100
    assert any("`level=0`" in note for note in shown().notes)
    assert '"level 1 (0 to 3)"' in page.read_text(encoding="utf-8")
    assert not any("`level" in note for note in shown(1).notes)
    monkeypatch.setattr("nanogs.scoring.viewing.PAGE_SPLATS", 1)
    assert shown().splats == 4
    assert_refused(run("view", folder / "a.ply", "--level", "1", "-o", tmp_path / "x.html"),
                   "--level")  # fmt: skip


def test_view_says_which_level_of_a_stream_its_psnr_is_against(folder, tmp_path):
    require_bundle()
    page, models = tmp_path / "page.html", [folder / "stream" / "lod-meta.json", folder / "a.ply"]

    def seen(level):
        report = view_files(
            [(path.stem, path) for path in models], page, level=level, views=1, width=32, height=32,
            overwrite=True,
        )  # fmt: skip
        return "against level 1 (0 to 3)" in page.read_text(encoding="utf-8"), report.notes

    assert seen(0) == (False, ())
    in_page, notes = seen(1)
    assert in_page
    assert [note.split(";")[0] for note in notes] == [
        "The PSNR is against level 1 (0 to 3) of lod-meta"
    ]
    models.reverse()
    assert seen(1) == (False, ())


def test_info_and_render_read_the_level_that_is_named(folder, tmp_path):
    stream = folder / "stream" / "lod-meta.json"
    report = json.loads(run("info", stream, "--level", "2", "--json").stdout)
    assert (report["splats"], report["levels"]) == (40, [200, 100, 40, 4])
    assert "; the other rows describe level 2\n" in run("info", stream, "--level", "2").stdout
    nanogs.convert(stream, tmp_path / "level.ply", level=2)
    for model, name in ((stream, "a.png"), (tmp_path / "level.ply", "b.png")):
        level = ("--level", "2") if model == stream else ()
        assert run("render", model, tmp_path / name, "--pixels", "32", *level).returncode == 0
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


@pytest.mark.parametrize("command", ["convert", "view", "info", "render"])
def test_a_level_of_a_folder_of_files_is_refused_with_the_name_of_its_file(
    folder, tmp_path, command
):
    require_bundle()
    output = {
        "convert": (tmp_path / "o.ply",), "view": ("-o", tmp_path / "o.html"), "info": (),
        "render": (tmp_path / "o.png",),
    }[command]  # fmt: skip
    levels = folder / "levels"
    for given in (levels, levels / "level_1.ply"):
        result = run(command, given, *output, "--level", "2")
        assert_refused(result, f"level 2 is in a file beside it; name {levels / 'level_2.ply'}")
    for given, level in ((levels, "9"), (folder / "a.ply", "2")):
        result = run(command, given, *output, "--level", level)
        assert_refused(
            result, f"has no levels of detail, so there is no level {level}; leave --level"
        )
    assert_refused(
        run("view", levels, "-o", tmp_path / "o.html", "--level", "0"), "leave --level out"
    )


@pytest.mark.parametrize("command", ["convert", "view", "info", "render"])
def test_the_help_of_level_names_the_formats_that_have_levels(command):
    text = " ".join(run(command, "--help").stdout.replace("│", " ").split())
    for known in registry.formats():
        if known.open_level is not None:
            assert known.suffix in text[text.index("--level ") :][:250]


# Quiet runs, and notes that name their file


def test_quiet_prints_nothing_on_success(folder, tmp_path):
    small = ("--views", "1", "--pixels", "32", "-q")
    commands = [
        ("compare", folder / "a.ply", folder / "b.ply", *small),
        ("bench", folder / "a.ply", "--methods", "random", "--ratios", "0.5", *small),
        ("render", folder / "a.ply", tmp_path / "pic.png", "--pixels", "32", "-q"),
    ]
    for arguments in commands:
        result = run(*arguments)
        assert (result.returncode, result.stdout, result.stderr) == (0, "", "")


def test_notes_of_many_files_name_the_file(tmp_path):
    for name in ("one", "two"):
        nanogs.save(random_splats(50, degree=2), tmp_path / f"{name}.ply")
    result = run("convert", tmp_path / "one.ply", tmp_path / "two.ply", "--out-dir",
                 tmp_path / "out", "--format", "splat")  # fmt: skip
    assert result.returncode == 0, result.stderr
    notes = [line for line in result.stderr.splitlines() if line.startswith("note:")]
    assert len(notes) >= 2
    assert all("one.ply: " in note or "two.ply: " in note for note in notes)


# Levels


def test_levels_can_be_files_of_any_format(folder, tmp_path):
    out = tmp_path / "levels"
    fast = ("--preset", "fast", "--levels", "0.5,0.1")
    result = run("lod", folder / "a.ply", out, "--format", "sog", *fast, "--json")
    assert result.returncode == 0, result.stderr
    report = json.loads(result.stdout)
    assert [level["file"] for level in report["levels"]] == ["level_0.sog", "level_1.sog"]
    assert report["layout"] == "files"
    small = tmp_path / "alone.sog"
    assert run("simplify", folder / "a.ply", small, "-r", "0.5", "--preset", "fast").returncode == 0
    assert (out / "level_0.sog").read_bytes() == small.read_bytes()
    assert json.loads(run("info", out, "--json").stdout)["levels"] == [200, 40]
    assert run("lod", folder / "a.ply", out, *fast, "-w", "-q").returncode == 0
    assert sorted(path.name for path in out.iterdir()) == [
        "level_0.ply", "level_1.ply", "levels.json",
    ]  # fmt: skip
    splat = run("lod", folder / "a.ply", tmp_path / "s", "--format", "splat", *fast)
    assert "Spherical harmonics above degree 0 are left out" in splat.stderr


@pytest.mark.parametrize(
    ("out", "suffix", "fragments"),
    [
        ("levels", "ksplat", ["nanogs does not write a format 'ksplat'; it writes", ".sog"]),
        ("levels", "lod-meta.json", ["leave it out, and name ", "/x/levels/lod-meta.json."]),
        ("levels", "ssog", ["ssog describes all levels, ", "/x/levels.ssog."]),
        ("lod-meta.json", "spz", ["lod-meta.json", "name a folder"]),
    ],
)
def test_unsupported_formats_of_levels_are_refused(folder, tmp_path, out, suffix, fragments):
    result = run("lod", folder / "a.ply", tmp_path / "x" / out, "--format", suffix)
    assert_refused(result, *fragments)
    assert list(tmp_path.iterdir()) == []


def test_the_finest_default_level_is_the_original(folder, tmp_path):
    fast = ("--preset", "fast", "-w")
    text = run("lod", folder / "a.ply", tmp_path / "l", *fast).stderr
    assert "400 splats -> 4 levels" in text.replace("→", "->")
    levels = [nanogs.load(tmp_path / "l" / f"level_{number}.ply") for number in range(4)]
    assert [len(level) for level in levels] == [400, 200, 100, 50]
    assert (tmp_path / "l" / "level_0.ply").read_bytes() == (folder / "a.ply").read_bytes()
    text = run("lod", folder / "a.ply", tmp_path / "l", *fast, "--levels", "0.4,0.1").stderr
    assert f"400 splats -> 2 levels in {tmp_path / 'l'}, " in text.replace("→", "->")
    assert len(nanogs.load(tmp_path / "l" / "level_0.ply")) == 160


# The degree of spherical harmonics


def test_simplify_drops_bands_of_spherical_harmonics(folder, tmp_path):
    small = tmp_path / "small.ply"
    arguments = ("simplify", folder / "a.ply", small, "--preset", "fast", "--sh-degree", "0")
    result = run(*arguments, "-r", "0.1")
    assert result.returncode == 0, result.stderr
    dropped = "above degree 0 were dropped first; any PSNR is against the model without them."
    assert dropped in result.stderr  # none was measured
    assert nanogs.load(small).sh_degree == 0
    assert run(*arguments, "--size", "3kB", "-w").returncode == 0
    assert nanogs.load(small).sh_degree == 0
    assert 2900 < small.stat().st_size <= 3000
    # A model of that degree has nothing to drop.
    unchanged = run("simplify", small, tmp_path / "same.ply", "-r", "1", *arguments[3:])
    assert "dropped" not in unchanged.stderr


@pytest.mark.parametrize(
    ("options", "fragments"),
    [
        (["--sh-degree", "5", "-r", "0.1"], ["0 to 4", "5", "--sh-degree"]),
        (["--sh-degree", "1", "--psnr", "30", "--preset", "fast"], ["--psnr", "nanogs convert"]),
    ],
)
def test_impossible_sh_degrees_and_combinations_are_refused(folder, tmp_path, options, fragments):
    assert_refused(run("simplify", folder / "a.ply", tmp_path / "x.ply", *options), *fragments)
    assert list(tmp_path.iterdir()) == []


def test_a_psnr_against_a_model_without_its_harmonics_is_refused(folder, tmp_path):
    options = {"psnr": 30.0, "sh_degree": 1, "preset": "fast"}
    for simplify in (
        lambda: nanogs.simplify(folder / "a.ply", **options),
        lambda: nanogs.simplify_blocks(folder / "a.ply", tmp_path / "x.ply", **options),
    ):
        with pytest.raises(OptionError, match=r"`psnr` cannot be combined .* `nanogs convert`"):
            simplify()
    assert list(tmp_path.iterdir()) == []


# Levels take the options of simplify

FAST = ("--preset", "fast", "--levels", "0.5,0.1")


@pytest.mark.parametrize(
    "options",
    [
        ("--crop", "sphere:0,0,0,0.9", "--min-opacity", "0.2"),
        ("--drop-floaters",),
        ("--sh-degree", "0"),
        ("--frame", "rub"),
    ],
)
def test_each_option_has_the_same_effect_in_lod_and_simplify(folder, tmp_path, options):
    result = run("lod", folder / "a.ply", tmp_path / "l", *FAST, *options)
    assert result.returncode == 0, result.stderr
    for level, ratio in enumerate(("0.5", "0.1")):
        path = tmp_path / f"{level}.ply"
        result_of_simplify = run(
            "simplify", folder / "a.ply", path, "-r", ratio, *FAST[:2], *options
        )
        assert result_of_simplify.returncode == 0
        assert (tmp_path / "l" / f"level_{level}.ply").read_bytes() == path.read_bytes()
    plan = run("lod", folder / "a.ply", tmp_path / "new", *FAST, *options, "--dry-run", "--json")
    counts = [level["count"] for level in json.loads(plan.stdout)["levels"]]
    assert counts == [len(nanogs.load(tmp_path / f"{level}.ply")) for level in (0, 1)]
    if "--crop" in options:
        assert "crop sphere:0,0,0,0.9 removed" in result.stderr
        assert counts[0] < 200


def test_parts_of_a_scene_are_joined_into_levels(folder, tmp_path):
    parts = (folder / "a.ply", folder / "b.ply")
    result = run("lod", *parts, tmp_path / "l", "--join", *FAST, "--json")
    assert result.returncode == 0, result.stderr
    report = json.loads(result.stdout)
    assert report["source"] == "a.ply, b.ply"
    assert report["source_count"] == 500
    assert [level["count"] for level in report["levels"]] == [250, 50]
    simplified = run("simplify", *parts, tmp_path / "s.ply", "--join", "-r", "0.5", *FAST[:2])
    assert simplified.returncode == 0
    assert (tmp_path / "l" / "level_0.ply").read_bytes() == (tmp_path / "s.ply").read_bytes()


def test_verbose_prints_a_report_of_each_level(folder, tmp_path):
    plain = run("lod", folder / "a.ply", tmp_path / "l", *FAST).stderr
    verbose = run("lod", folder / "a.ply", tmp_path / "l", *FAST, "-v", "-w").stderr
    assert "level 1" not in plain
    assert "level 1" in verbose
    assert verbose.count("achieved count") == 2
    assert verbose.count("balance 0.8, ") == 2
    assert verbose.count("passes:") == 1  # of the forest, which all levels share
    assert "view size" not in verbose  # nothing is rendered


@pytest.mark.parametrize(
    ("arguments", "fragments"),
    [
        (
            ["a.ply", "b.ply", "out"],
            ["Only one model can stand before OUT, but 2 were given", "--join"],
        ),
        (["a.ply"], ["OUT is missing", "a.ply"]),
        (
            ["a.ply", "out/tileset.json", "--frame", "rub"],
            ["frame of out/tileset.json cannot", "same one", "--frame rub: and nothing after the"],
        ),
        (["a.ply", "out.rad", "--frame", "rdf:"], ["The frame of out.rad is missing"]),
        (["a.ply", "out.ssog", "--frame", "rdf:"], ["The frame of out.ssog is missing"]),
        (["a.ply", "out", "--frame", "rdf:"], ["The frame of out is missing"]),
        (["a.ply", "out", "--crop", "cube"], ["--crop"]),
        (["a.ply", "out", "--max-memory", "240MB", "--drop-floaters"], ["--drop-floaters needs"]),
    ],
)
def test_impossible_arguments_of_lod_are_refused(
    folder, tmp_path, arguments, fragments, monkeypatch
):
    if "--max-memory" in arguments:
        nanogs.save(random_splats(60_000, degree=3), tmp_path / "a.ply")
        monkeypatch.chdir(tmp_path)
    else:
        monkeypatch.chdir(folder)
    assert_refused(run("lod", *arguments), *fragments)
    assert not (folder / "out").exists()


# A page as an output


def test_a_web_page_is_an_output_format(folder, tmp_path):
    require_bundle()
    page = tmp_path / "page.html"
    result = run("simplify", folder / "a.ply", page, "-r", "0.5", "--preset", "fast", "--json")
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout)["output_bytes"] == page.stat().st_size
    text = page.read_text(encoding="utf-8")
    assert "200 splats" in text
    assert "nanogs-program" in text
    assert "default-src &#39;none&#39;" in text
    converted_page = tmp_path / "same.html"
    small = tmp_path / "small.ply"
    assert run("simplify", folder / "a.ply", small, "-r", "0.5", "--preset", "fast").returncode == 0
    converted = run("convert", small, converted_page)
    assert converted.returncode == 0, converted.stderr
    assert converted_page.read_bytes() == page.read_bytes()
    assert_refused(run("convert", folder / "a.ply", converted_page), "-w")
    assert_refused(run("info", page), "writes this format but does not read it")


def test_a_page_as_an_output_names_the_colours_that_it_clamps(tmp_path):
    """The page holds an .spz file, whose losses `nanogs view` names."""
    require_bundle()
    bright = random_splats(40)
    bright.sh[:] *= 0.1
    bright.sh[:3, 0], bright.sh[:2, 1] = 5, 3
    nanogs.save(bright, tmp_path / "a.ply")
    [viewed] = view_files([("a", tmp_path / "a.ply")], tmp_path / "view.html").models
    assert [note.split(" outside")[0] for note in viewed.notes] == [
        "3 splats have base colours", "2 splats have higher SH coefficients",
    ]  # fmt: skip
    report = nanogs.convert(tmp_path / "a.ply", tmp_path / "page.html")
    assert report.losses == viewed.notes
    assert nanogs.info(tmp_path / "a.ply").losses[".html"] == viewed.notes


def test_writing_a_page_without_the_viewer_is_refused_before_any_work(tmp_path, monkeypatch):
    monkeypatch.setattr("nanogs.view.bundle.is_built", lambda: False)
    with pytest.raises(OptionError, match="without the viewer"):
        check_writable(tmp_path / "page.html")

"""Several inputs at once: which files are selected, the names of results, and failures."""

import json
from pathlib import Path

import pytest

import nanogs
from builders import random_splats
from launch import run
from nanogs.errors import FormatError, OptionError
from nanogs.io.collect import Pair, collect, pair_up
from nanogs.io.sog import write as sog_write


def names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture
def folder(tmp_path):
    """Two models, another one in a subfolder, a SOG folder and a text file."""
    inputs = tmp_path / "in"
    (inputs / "below").mkdir(parents=True)
    nanogs.save(random_splats(60, seed=1), inputs / "a.ply")
    nanogs.save(random_splats(70, seed=2), inputs / "b.spz")
    nanogs.save(random_splats(80, seed=3), inputs / "below" / "c.compressed.ply")
    sog_write.write_folder(random_splats(90, seed=4), inputs / "garden")
    (inputs / "notes.txt").write_text("text")
    return inputs


# Which files are selected


def test_folders_files_and_patterns_select_files(folder):
    assert collect([folder]) == [folder / "a.ply", folder / "b.spz"]
    assert collect([folder / "garden"]) == [folder / "garden" / "meta.json"]
    assert collect([folder / "*.ply"]) == [folder / "a.ply"]
    found = collect([folder / "**" / "*.ply", folder / "a.ply"])
    assert sorted(found) == [folder / "a.ply", folder / "below" / "c.compressed.ply"]
    # Files that are named are always taken, so that errors name them.
    assert collect([folder / "no.ply", folder / "notes.txt"]) == [
        folder / "no.ply",
        folder / "notes.txt",
    ]
    assert collect([folder / "gar*"]) == [folder / "garden" / "meta.json"]


def test_hidden_files_of_a_folder_are_not_selected(folder):
    """macOS writes a ._a.ply with attributes of a.ply to disks of other systems."""
    (folder / "._a.ply").write_bytes(b"\0\5\x16\7")
    (folder / ".ply").write_text("")
    assert collect([folder]) == [folder / "a.ply", folder / "b.spz"]
    assert collect([folder / "._a.ply"]) == [folder / "._a.ply"]  # which is named


def test_files_that_only_end_like_a_manifest_are_not_selected(folder):
    for name in ("a.meta.json", "a_tileset.json"):
        (folder / name).write_text("{}")
    assert collect([folder]) == [folder / "a.ply", folder / "b.spz"]


def test_a_file_whose_name_looks_like_a_pattern_is_found(folder):
    odd = folder / "a[1].ply"
    odd.write_bytes((folder / "a.ply").read_bytes())
    assert collect([odd]) == [odd]


def test_selecting_no_file_is_refused(folder, tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(FormatError, match="holds no file"):
        collect([tmp_path / "empty"])
    with pytest.raises(OptionError, match="Nothing matches"):
        collect([folder / "*.glb"])


# Names of results


@pytest.mark.parametrize(
    ("source", "suffix", "target"),
    [
        ("a.ply", None, "a.ply"),
        ("a.ply", "sog", "a.sog"),
        ("a.ply", ".SPZ", "a.spz"),
        ("b.compressed.ply", None, "b.compressed.ply"),
        ("b.compressed.ply", "ply", "b.ply"),
        ("b.v2.PLY", "spz", "b.v2.spz"),
        ("c.ksplat", "ply", "c.ply"),
        ("garden/meta.json", "sog", "garden.sog"),
        ("garden/lod-meta.json", "ply", "garden.ply"),
        ("other.obj", None, "other.obj"),
    ],
)
def test_results_are_named_after_their_inputs(source, suffix, target):
    assert pair_up([Path(source)], Path("out"), suffix) == [
        Pair(Path(source), Path("out") / target)
    ]


@pytest.mark.parametrize(
    ("sources", "suffix", "message"),
    [
        (["x/a.ply", "y/a.ply"], None, "x/a.ply and y/a.ply would both become out/a.ply"),
        (["a.ply", "a.spz"], "sog", "out/a.sog"),
        (["a.ply"], "obj", "does not write"),
        (["a.ksplat"], None, "add `format="),
        (["garden/lod-meta.json"], None, r'does not write lod-meta\.json; add `format="ply"`'),
        (["garden/meta.json"], None, r'results are single files; add `format="sog"`'),
        (["a.ply"], "meta.json", r"^meta\.json describes a folder of files; .* such as \.sog\.$"),
    ],
)
def test_impossible_names_of_results_are_refused(sources, suffix, message):
    with pytest.raises(OptionError, match=message):
        pair_up([Path(source) for source in sources], Path("out"), suffix)


# The commands


def test_each_result_equals_that_of_its_file_alone(folder, tmp_path):
    out, options = tmp_path / "out", ("-r", 0.2, "--preset", "fast", "-q")
    result = run(
        "simplify", folder, folder / "garden", "--out-dir", out, "--format", "ply", *options
    )
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")
    assert names(out) == ["a.ply", "b.ply", "garden.ply"]
    assert [len(nanogs.load(out / f"{n}.ply")) for n in ("a", "b", "garden")] == [12, 14, 18]
    run("simplify", folder / "b.spz", tmp_path / "alone.ply", *options)
    assert (out / "b.ply").read_bytes() == (tmp_path / "alone.ply").read_bytes()


def test_files_that_fail_do_not_stop_the_others(folder, tmp_path):
    (folder / "a.ply").write_bytes((folder / "a.ply").read_bytes()[:-3])
    out = tmp_path / "made" / "out"
    result = run("convert", folder, folder / "notes.txt", "--out-dir", out, "--format", "splat")
    assert result.returncode == 2
    assert names(out) == ["b.splat"]
    errors = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    assert ["a.ply" in errors[0], "notes.txt" in errors[1]] == [True, True]
    assert errors[2] == "error: 2 of 3 files failed; the others are done."
    assert "b.spz: 70 splats" in result.stderr


def test_json_report_of_several_files(folder, tmp_path):
    arguments = (folder, folder / "no.ply", "--out-dir", tmp_path / "out", "--json")
    result = run("simplify", *arguments, "-n", 7, "--preset", "fast")
    assert result.returncode == 2
    report = json.loads(result.stdout)
    assert [entry["achieved_count"] for entry in report["files"]] == [7, 7]
    assert [Path(entry["output"]).name for entry in report["files"]] == ["a.ply", "b.spz"]
    assert [Path(entry["input"]).name for entry in report["failed"]] == ["no.ply"]
    plans = run("simplify", folder, "--out-dir", tmp_path / "x", "-n", 7, "--dry-run", "--json")
    assert [plan["asked_count"] for plan in json.loads(plans.stdout)["files"]] == [7, 7]
    assert not (tmp_path / "x").exists()


def test_nothing_is_overwritten_without_the_flag(folder, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "a.splat").write_text("mine")
    arguments = ("convert", folder, "--out-dir", out, "--format", "splat", "-q")
    result = run(*arguments)
    assert result.returncode == 2
    assert "-w" in result.stderr
    assert (out / "a.splat").read_text() == "mine"
    assert len(nanogs.load(out / "b.splat")) == 70
    assert run(*arguments, "-w").returncode == 0
    assert len(nanogs.load(out / "a.splat")) == 60


def test_conflicting_or_impossible_outputs_write_nothing(folder, tmp_path):
    for arguments, words in (
        ((folder / "a.ply", folder / "b.spz", tmp_path / "x.ply"), "--out-dir"),
        ((folder / "a.ply",), "--out-dir"),
        (
            (folder / "a.ply", tmp_path / "x.ply", "--format", "sog"),
            "--format works only with --out-dir",
        ),
        ((folder, "--out-dir", folder / "a.ply"), "cannot be made"),
        ((folder / "**" / "a*", folder / "a.spz", "--out-dir", "y", "--format", "ply"), "both"),
        ((folder, "--out-dir", "y", "--to", "spz"), "with --out-dir, give --format spz instead."),
    ):
        result = run("convert", *arguments, cwd=tmp_path)
        assert (result.returncode, result.stdout) == (2, "")
        assert result.stderr.count("\n") == 1
        assert words in result.stderr
        assert names(tmp_path) == ["in"]


def test_a_dry_run_checks_the_output_of_a_single_file(folder, tmp_path):
    options = ("-n", 7, "--dry-run")
    result = run("simplify", folder / "a.ply", tmp_path / "no" / "b.ply", *options)
    assert result.returncode == 2
    assert "does not exist" in result.stderr
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "a.ply").write_text("mine")
    result = run("simplify", folder / "a.ply", "--out-dir", tmp_path / "out", *options)
    assert result.returncode == 2
    assert "exists already" in result.stderr


def test_an_output_folder_without_results_is_removed(folder, tmp_path):
    result = run("convert", folder / "notes.txt", "--out-dir", tmp_path / "out")
    assert result.returncode == 2
    assert not (tmp_path / "out").exists()


def test_folders_made_for_results_that_failed_are_removed(folder, tmp_path):
    deep, above = tmp_path / "a" / "b" / "c", tmp_path / "a"
    result = run("convert", folder / "no.ply", "--out-dir", deep, "--format", "splat")
    assert result.returncode == 2, result.stderr
    assert "no.ply: " in result.stderr
    assert not above.exists()
    above.mkdir()  # this folder belongs to the user
    run("convert", folder / "no.ply", "--out-dir", deep, "--format", "splat")
    assert list(above.iterdir()) == []


# A folder in place of a model


@pytest.fixture
def folder_with_one_model(folder):
    """The folder with only one model, beside a text file and subfolders."""
    (folder / "b.spz").unlink()
    return folder


FEW = ("--views", 6, "--pixels", 32)


@pytest.mark.parametrize(
    "command_line",
    [
        ("info", "IN"),
        ("convert", "IN", "OUT.spz"),
        ("simplify", "IN", "OUT.spz", "-r", "0.5", "--preset", "fast"),
        ("lod", "IN", "OUT", "--levels", "0.5", "--preset", "fast"),
        ("render", "IN", "OUT.png", "--pixels", "32"),
        ("compare", "IN", "IN", "--views", "1", "--pixels", "32"),
        ("refit", "IN", "IN", "OUT.spz", "--rounds", "1", *FEW),
    ],
    ids=lambda command_line: command_line[0],
)
@pytest.mark.parametrize("name", ["", "garden"], ids=["a file", "SOG"])
def test_every_command_takes_a_folder_with_one_model(
    folder_with_one_model, tmp_path, command_line, name
):
    paths = {"IN": folder_with_one_model / name}
    arguments = [
        paths.get(word, str(word).replace("OUT", str(tmp_path / "out"))) for word in command_line
    ]
    result = run(*arguments)
    assert result.returncode == 0, result.stderr


@pytest.mark.parametrize(
    "command_line",
    [
        ("lod", "IN", "OUT", "--preset", "fast"),
        ("render", "IN", "OUT"),
        ("compare", "IN", "IN"),
        ("refit", "IN", "IN", "OUT.ply"),
    ],
    ids=lambda command_line: command_line[0],
)
def test_a_folder_of_several_models_is_refused_with_their_names(folder, tmp_path, command_line):
    paths = {"IN": folder, "OUT": tmp_path / "out", "OUT.ply": tmp_path / "out.ply"}
    result = run(*(paths.get(word, word) for word in command_line))
    assert result.returncode == 2
    assert result.stderr == f"error: The folder {folder} holds 2 models; name one: a.ply, b.spz.\n"
    assert names(tmp_path) == ["in"]


def test_of_many_models_in_a_folder_four_are_named(tmp_path):
    for name in "abcdef":
        (tmp_path / f"{name}.ply").touch()
    result = run("info", tmp_path)
    said = f"error: The folder {tmp_path} holds 6 models; name one: a.ply, b.ply, c.ply, d.ply or"
    assert result.stderr == f"{said} another.\n"


def test_load_asks_for_the_file_inside_a_folder(folder):
    with pytest.raises(FormatError, match=r"garden is a folder; name the model file inside it\."):
        nanogs.load(folder / "garden")


@pytest.mark.parametrize("command_start", [["simplify", "-r", "1"], ["lod", "--levels", "1"]])
@pytest.mark.parametrize("pattern", ["", "*.*[yz]"], ids=["folder", "pattern"])
def test_parts_of_a_scene_can_be_given_by_a_folder_or_pattern(
    folder, tmp_path, command_start, pattern
):
    command, *options = command_start
    target = tmp_path / ("out.ply" if command == "simplify" else "out")
    result = run(
        command, folder / pattern, target, "--join", *options, "--preset", "fast", "--json"
    )
    assert result.returncode == 0, result.stderr
    whole = target if command == "simplify" else target / "level_0.ply"
    assert len(nanogs.load(whole)) == 130


@pytest.mark.parametrize("command", ["simplify", "lod"])
def test_a_part_that_is_named_twice_is_taken_once_with_a_note(folder, tmp_path, command):
    same = tmp_path / "in" / ".." / "in" / "a.ply"
    output = {"simplify": ("o.ply", "-r", "0.5"), "lod": ("levels", "--levels", "0.5")}[command]
    result = run(
        command, folder / "a.ply", folder / "b.spz", folder / "a.ply", same, tmp_path / output[0],
        *output[1:], "--join", "--preset", "fast", "--json",
    )  # fmt: skip
    report = json.loads(result.stdout)
    noted = [note for note in report["notes"] if note.endswith("and is taken once.")]
    assert noted == [
        f"{path} was given more than once and is taken once." for path in (folder / "a.ply", same)
    ]
    levels = report.get("levels")
    assert (levels[0]["count"] if levels else report["achieved_count"]) == 65


@pytest.mark.parametrize("call", ["simplify_blocks", "write_levels"])
def test_functions_take_a_part_that_is_given_twice_once_with_a_note(folder, tmp_path, call):
    first, same = folder / "a.ply", tmp_path / "in" / ".." / "in" / "a.ply"
    given = [first, folder / "b.spz", first, str(same)]
    if call == "simplify_blocks":
        report = nanogs.simplify_blocks(given, tmp_path / "o.ply", ratio=0.5, preset="fast")
    else:
        _, [report] = nanogs.write_levels(given, tmp_path / "levels", [0.5], preset="fast")
    assert report.achieved_count == 65
    said = "was given more than once and is taken once."
    assert [note for note in report.notes if note.endswith(said)] == [
        f"{first} {said}", f"{same} {said}"
    ]  # fmt: skip


def test_levels_of_no_file_are_refused(tmp_path):
    with pytest.raises(OptionError, match=r"^Give at least one file\.$"):
        nanogs.write_levels([], tmp_path / "levels")


def test_join_makes_one_result_and_takes_no_folder_for_several(folder, tmp_path):
    options = ("--join", "--preset", "fast", "-r", "0.5")
    result = run("simplify", folder, folder / "garden", "--out-dir", tmp_path / "x", *options)
    assert result.returncode == 2
    assert result.stderr.startswith("error: --join cannot be combined with --out-dir, because it")
    assert names(tmp_path) == ["in"]

"""Mistyped names, listings, completion in the shell, and output into pipes."""

import json
import os
import re
import shutil
import subprocess
import sys
from itertools import pairwise

import pytest

import launch
import nanogs
from builders import random_splats
from nanogs import io
from nanogs.cli.examples import EXAMPLES
from nanogs.errors import FormatError, OptionError, did_you_mean
from nanogs.pipeline.options.presets import PRESETS, parameters


def run(*arguments, cwd=None, **environment):
    clean = {k: v for k, v in os.environ.items() if k not in ("FORCE_COLOR", "NO_COLOR", "COLUMNS")}
    return launch.run(*arguments, cwd=cwd, env=clean | environment)


@pytest.mark.parametrize(
    ("mistyped", "choices", "suggestion"),
    [
        ("fats", PRESETS, " (did you mean 'fast'?)"),
        ("Paper", PRESETS, " (did you mean 'paper'?)"),
        ("quality", PRESETS, ""),
        ("", PRESETS, ""),
        (".plly", [".splat", ".ply"], " (did you mean '.ply'?)"),
    ],
)
def test_the_nearest_name_is_suggested(mistyped, choices, suggestion):
    assert did_you_mean(mistyped, choices) == suggestion


def test_every_error_about_an_unknown_name_suggests_one(tmp_path):
    model = random_splats(3)
    with pytest.raises(OptionError, match="did you mean 'default'"):
        nanogs.simplify(model, ratio=0.5, preset="defualt")
    with pytest.raises(OptionError, match="did you mean 'balance'"):
        parameters("fast", {"balanse": 1})
    with pytest.raises(OptionError, match=r"did you mean '\.spz'"):
        io.save(model, tmp_path / "a.spzz")
    with pytest.raises(FormatError, match=r"did you mean '\.splat'"):
        io.load(tmp_path / "a.splats")
    with pytest.raises(FormatError, match=r"did you mean 'lod-meta\.json'"):
        io.load(tmp_path / "lod-mets.json")
    for name in ("transforms.json", "scene.json"):  # similar to no known name
        with pytest.raises(FormatError, match=r"unknown suffix; .*; give it the suffix"):
            io.load(tmp_path / name)
    for name, remedy in (
        ("a.usdz", "usdcat"),
        ("a.USD", "usdcat"),
        ("a.ssproj", "export a .ply file"),
        ("grid.mjs", "run this script with splat-transform, into a .ply file"),
        ("a.ply.gz", "gunzip"),
        ("a.zip", "rename it to .sog if"),
    ):  # another suffix alone would not make them readable
        with pytest.raises(FormatError, match=f"nanogs does not read .*; .*{remedy}") as other:
            io.load(tmp_path / name)
        assert "mean" not in str(other.value)
    with pytest.raises(OptionError, match="did you mean 'spz_version'"):
        io.save(model, tmp_path / "a.spz", format_options={"spz_versoin": 4})
    # A format that is read but not written is no typing error, so nothing is suggested.
    with pytest.raises(OptionError) as caught:
        io.save(model, tmp_path / "a.ksplat")
    assert "mean" not in str(caught.value)


def test_the_right_option_or_command_is_suggested():
    assert "--preset" in run("simplify", "a", "b", "--presett", "fast").stderr
    assert "simplify" in run("simplfy").stderr
    assert run("simplfy").returncode == 2


def test_presets_are_listed():
    text = run("presets").stdout
    assert all(f"{name} " in text for name in PRESETS)
    assert text.count("balance 0.5 or 1,") == 2  # of the presets that measure candidates
    assert text.count("balance 0.8,") == 1
    report = json.loads(run("presets", "--json").stdout)
    assert set(report) == set(PRESETS)
    assert report["paper"]["tau"] == 0.1
    assert report["fast"]["summary"]


@pytest.mark.parametrize(
    ("typed", "completed"),
    [
        ("nanogs simplify --preset f", ["fast"]),
        ("nanogs simplify --preset ", list(PRESETS)),
        ("nanogs convert a.ply --out-dir x --format sp", ["splat", "spz"]),
        ("nanogs convert - - --to s", ["sog", "splat", "spz"]),
        ("nanogs conv", ["convert"]),
        ("nanogs simplify --min", ["--min-opacity"]),
    ],
)
def test_the_shell_completes_options_values_and_commands(typed, completed):
    count = len(typed.split(" ")) - 1
    environment = {
        "COMP_WORDS": typed,
        "COMP_CWORD": str(count),
        "_NANOGS_COMPLETE": "complete_bash",
    }
    assert sorted(run(**environment).stdout.split()) == sorted(completed)


@pytest.mark.skipif(shutil.which("bash") is None, reason="Bash is absent")
def test_completion_is_installed_where_bash_reads_it(tmp_path):
    # The command finds the shell from its parent process, so it is called from Bash.
    script = f"'{sys.executable}' -m nanogs --install-completion; exit $?"
    env = os.environ | {"HOME": str(tmp_path)}
    subprocess.run(["bash", "-c", script], check=True, env=env)
    assert "nanogs.sh" in (tmp_path / ".bashrc").read_text()


def test_pipes_get_plain_text_in_whole_lines(tmp_path):
    scene = tmp_path / ("long" * 30 + ".ply")
    model = random_splats(40)
    nanogs.save(model, scene)
    info = run("info", scene, TERM="xterm-256color")
    small = run("simplify", scene, tmp_path / "b.ply", "-r", "0.5", "--preset", "fast", "-v")
    for text in (info.stdout, small.stderr):
        assert "\x1b" not in text
        assert str(scene) in text
        assert "\r" not in text
    assert run("info", tmp_path / "no.ply").stderr.startswith("error: ")
    quiet = run("convert", scene, tmp_path / "c.ply", "-q")
    assert (quiet.returncode, quiet.stdout, quiet.stderr) == (0, "", "")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("simplify", "a", "b", "--raito", "1"), "no option --raito (did you mean '--ratio'?)"),
        (("lod", "a", "b", "--ratio", "1"), "no option --ratio (did you mean '--levels'?)"),
        (
            ("-w", "convert", "a", "b"),
            "no option -w before the command, only after it; `nanogs --help`",
        ),
        (("a.ply", "b.spz"), "no command a.ply; name one first, as in `nanogs convert a.ply OUT`"),
        (("convert", "a", "b", "--ratio", "1"), "no option --ratio (`nanogs simplify` has it)"),
        (("convert", "a", "b", "--join"), "no option --join (`nanogs simplify` has it)"),
        (("convert", "a", "b", "-d", "50%"), "no option -d (`nanogs simplify` has --ratio)"),
        (("simplify", "a", "b", "-d", "50%"), "no option -d (did you mean '--ratio'?)"),
        (("convert", "a", "b", "-t", "0,0,1"), "no option -t (did you mean '--translate'?)"),
        (
            ("convert", "a", "b", "--filter-box", "1"),
            "no option --filter-box (did you mean '--crop'",
        ),
        (("lod", "a", "b", "--lod-chunk-count", "16"), "--lod-chunk-count (did you mean '--chunk'"),
        (("simplify", "a", "b", "--max-memory", "lots"), "--max-memory lots: The size must be"),
        (("simplify", "a", "b", "--zzz"), "no option --zzz; `nanogs simplify --help` lists them"),
        (("simplfy", "a"), "no command simplfy (did you mean 'simplify'?); `nanogs --help`"),
        (("convert", "a", "b", "--sh-degree", "x"), "--sh-degree takes a whole number, not 'x'"),
        (("simplify", "a", "b", "--nan", "x"), "'--nan': 'x' is not one of 'drop', 'error'"),
        (("simplify", "a", "b", "--preset"), "an argument; see `nanogs simplify --help`"),
        (("info",), "Missing argument 'IN' of `nanogs info IN`; see `nanogs info --help`"),
        (
            ("compare", "a.ply"),
            "Missing argument 'TEST...' of `nanogs compare REF TEST...`; see `nanogs compare",
        ),
        (("bench",), "Give at least one model to measure on: a file, or a folder of models."),
        (("presets", "fast"), "Too many arguments: fast; see `nanogs presets --help`"),
        (("info", "my", "a.ply", "b.ply"), "arguments: a.ply b.ply (a name with spaces needs"),
    ],
)
def test_a_mistyped_command_line_is_refused_in_one_sentence(arguments, message):
    result = run(*arguments)
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr.startswith("error: ")
    assert result.stderr.count("\n") == 1, result.stderr
    assert message in result.stderr


@pytest.mark.parametrize("name", ["-s.ply", "--s.ply"])
def test_a_file_whose_name_begins_with_a_dash_is_told_from_an_option(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    nanogs.save(random_splats(10), name)
    refused = run("info", name)
    said = f"error: {name} begins like an option; name the file ./{name}.\n"
    assert (refused.returncode, refused.stderr) == (2, said)
    assert run("info", f"./{name}").returncode == 0


@pytest.mark.parametrize("name", ["-a.ply", "-q.ply", "--out.compressed.ply"])
def test_a_file_to_write_whose_name_begins_with_a_dash_is_told_from_an_option(name):
    said = f"error: {name} begins like an option; name the file ./{name}.\n"
    assert run("convert", "in.ply", name).stderr == said


@pytest.mark.parametrize(("word", "option"), [("-Z0.1", "-Z"), ("--zzz=a.ply", "--zzz")])
def test_an_unknown_option_with_a_value_is_not_taken_for_a_file(word, option):
    refused = run("view", "in.ply", "-opage.html", word)
    said = f"error: There is no option {option}; `nanogs view --help` lists them.\n"
    assert refused.stderr == said


def test_without_a_command_the_help_is_printed():
    result = run()
    assert result.returncode == 2
    assert "simplify" in result.stdout + result.stderr
    assert "error" not in result.stdout + result.stderr
    assert (run("--help").returncode, run("--version").returncode) == (0, 0)


@pytest.mark.parametrize("command", EXAMPLES)
def test_help_fits_a_terminal_of_80_columns(command):
    """No line is broken as in the docstring, which is wider, and no word is cut off."""
    text = run(command, "--help", COLUMNS="80").stdout
    assert "…" not in text
    for paragraph in re.split(r"\n\s*\n", text.split("╭")[0].strip()):
        for line, after in pairwise(paragraph.splitlines()):
            assert len(f"{line.rstrip()} {after.split()[0]}") > 79, line


@pytest.mark.parametrize("command", [None, *EXAMPLES])
def test_help_in_a_narrow_terminal_has_every_word(command):
    call = [command] * (command is not None) + ["--help"]
    narrow, wide = (run(*call, COLUMNS=columns).stdout for columns in ("40", "80"))
    assert max(map(len, narrow.splitlines())) <= 40
    assert "Examples:" in narrow or command is None
    # The oldest typer's panels also have the names and types of arguments in Python.
    wide = re.sub(r"^│ [* ] +[a-z]+ +[A-Z_.]{2,}", "", wide, flags=re.MULTILINE)
    for word in re.findall(r"--[a-z-]+|[A-Za-z]{3,}", wide):
        assert word in narrow


def test_tables_in_pipes_have_no_trailing_blanks(tmp_path):
    scene = tmp_path / "a.ply"
    nanogs.save(random_splats(40), scene)
    info = run("info", scene).stdout
    small = run("simplify", scene, tmp_path / "b.ply", "-r", "0.5", "--preset", "fast", "-v").stderr
    for text in (info, small, run("presets").stdout):
        assert text.count("\n") > 4
        assert all(line == line.rstrip() for line in text.splitlines()), text


def test_no_cell_of_a_table_is_cut_off_in_a_narrow_terminal(tmp_path):
    model = random_splats(60)
    names = [f"garden_small_with_a_long_name_{share}pct.ply" for share in (10, 1)]
    for name in ("scene.ply", *names):
        nanogs.save(model, tmp_path / name)
    options = ("--views", "1", "--pixels", "32")
    small = run("compare", "scene.ply", *names, *options, cwd=tmp_path, COLUMNS="60").stdout
    wide = run("compare", "scene.ply", *names, *options, cwd=tmp_path).stdout
    assert small == wide
    assert "garden_small_with_a_long_name_1pct.ply" in wide

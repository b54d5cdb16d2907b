"""What options take, what is said of values they do not take, and what the help shows."""

import re
import shlex

import pytest
from typer.main import get_command

import nanogs
from builders import random_splats
from nanogs.cli import options
from nanogs.cli.app import app
from nanogs.cli.examples import EXAMPLES
from nanogs.errors import OptionError
from nanogs.quantities import as_bytes, parse_bytes
from test_cli import assert_refused
from test_comfort import run

COMMANDS = get_command(app).commands


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "a.ply"
    nanogs.save(random_splats(2000), path)
    return path


@pytest.mark.parametrize(
    ("text", "value"),
    [("0.1", 0.1), ("10%", 0.1), ("7 %", 0.07), (".5", 0.5), ("1", 1.0), ("1e-2", 0.01)],
)
def test_ratios(text, value):
    assert options.parse_ratio(text) == value


@pytest.mark.parametrize(
    ("text", "value"),
    [("12", 12), ("100k", 100_000), ("100K", 100_000), ("1.5M", 1_500_000), ("2G", 2 * 10**9)],
)
def test_counts(text, value):
    assert options.parse_count(text) == value


@pytest.mark.parametrize(
    ("text", "value"),
    [("4G", 4 * 10**9), ("4GB", 4 * 10**9), ("20M", 2 * 10**7), ("512k", 512_000), ("7", 7)],
)
def test_bytes(text, value):
    assert parse_bytes(text) == as_bytes(text) == as_bytes(value) == as_bytes(float(value)) == value


@pytest.mark.parametrize("size", ["ten", "1.5e3", None, True, 1.5, float("inf"), [1]])
def test_no_bytes(size):
    with pytest.raises(OptionError, match="20MB"):
        as_bytes(size)


@pytest.mark.parametrize("text", ["", "ten", "10%%", "1,5", "nan", "1e9999", "1.2.3"])
def test_no_ratios(text):
    with pytest.raises(OptionError, match=r"0\.1 or 10%"):
        options.parse_ratio(text)


@pytest.mark.parametrize("text", ["", "ten", "1.5", "1.0005k", "-3", "3kB"])
def test_no_counts(text):
    with pytest.raises(OptionError, match="100k"):
        options.parse_count(text)


def test_shares_and_multiples_on_the_command_line(scene, tmp_path):
    for number, asked in enumerate((("-r", "10%"), ("--count", "0.2k"))):
        small = tmp_path / f"{number}.ply"
        result = run("simplify", scene, small, *asked, "--preset", "fast", "--max-memory", "4G")
        assert result.returncode == 0, result.stderr
        assert len(nanogs.load(small)) == 200


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["b.ply", "-r", "ten"], ["0.1 or 10%", "'ten'"]),
        (["b.ply", "--count", "1.5"], ["100k", "'1.5'"]),
        (["b.ply", "-r", "0.1", "--threads", "x"], ["--threads takes a whole number, not 'x'"]),
        (["b.ply", "-r", "0.1", "--threads", "0"], ["--threads takes 1 or more, not '0'"]),
        (["b.ply", "-r", "0.1", "--lambda-app", "x"], ["--lambda-app takes a number, not 'x'"]),
        (["b.ply", "-r", "0.1", "--max-memory", "4"], ["4 B", "--max-memory 4GB"]),
        (["b.ply", "--size", "2", "MB"], ["MB is a unit and no file", "one word, as in 2MB"]),
        (["b.ply", "-r", "10", "%"], ["% is a unit", "as in 2%"]),
        ([], ["OUT is missing", "a.ply"]),
        (["-r", "0.1"], ["OUT is missing", "a.ply"]),
    ],
)
def test_each_wrong_value_has_a_sentence_of_its_own(scene, arguments, words):
    result = run("simplify", scene, *arguments)
    assert_refused(result, *words)
    assert "Input should be" not in result.stderr


def test_sizes_are_bytes_and_views_have_pixels(scene, tmp_path):
    for command in ("render", "compare", "view", "refit", "bench"):
        names = {name for param in COMMANDS[command].params for name in param.opts}
        assert "--pixels" in names
        assert "--size" not in names
    assert_refused(run("render", scene, tmp_path / "x", "--size", "64"), "no option --size")


@pytest.mark.parametrize("name", [*COMMANDS, ""])
def test_the_help_speaks_of_values_and_not_of_types(name):
    text = run(*filter(None, [name]), "--help", COLUMNS="200").stdout
    assert not re.search(r"<[a-z]+|list\[|\]\.\.\.\]|[{}]\.\.\.", text.replace("{folder}", ""))
    if name:
        usage = next(line for line in text.splitlines() if "Usage:" in line)
        assert usage.strip().endswith("[OPTIONS]")
        for example in EXAMPLES[name]:
            assert example in text


@pytest.mark.parametrize("name", COMMANDS)
def test_every_example_can_be_parsed(name):
    assert EXAMPLES[name]
    for example in EXAMPLES[name]:
        program, command, *arguments = shlex.split(example)
        assert (program, command) == ("nanogs", name)
        COMMANDS[name].make_context(name, arguments)

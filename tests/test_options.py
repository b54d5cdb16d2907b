"""Values that options accept, the errors for others, and the help."""

import importlib
import math
import pkgutil
import re
import shlex
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import pytest
import typer
from typer.main import get_command

import nanogs
from builders import random_splats
from launch import run_here
from nanogs.cli import options, parsing
from nanogs.cli.app import app
from nanogs.cli.examples import EXAMPLES
from nanogs.cli.groups import with_options
from nanogs.cli.many import refuse_units
from nanogs.errors import OptionError
from nanogs.fit.parameters import RefitParameters
from nanogs.method.paper.parameters import PaperParameters
from nanogs.method.parameters import ForestParameters
from nanogs.pipeline.options.presets import idle_notes, parameters
from nanogs.quantities import as_bytes, parse_bytes
from nanogs.ranges import check_ranges, known_parameters, parameter
from nanogs.scoring.modes import ModelViews
from nanogs.scoring.view_sets import Photographs
from test_cli import assert_refused
from test_cli_usability import run
from viewer_bundle import require_bundle

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
def test_ratios_are_parsed(text, value):
    assert parsing.parse_ratio(text, "--ratio") == value


@pytest.mark.parametrize(
    ("text", "value"),
    [("12", 12), ("100k", 100_000), ("100K", 100_000), ("1.5M", 1_500_000), ("2G", 2 * 10**9)],
)
def test_counts_are_parsed(text, value):
    assert parsing.parse_count(text, "--count") == value


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("4G", 4 * 10**9), ("4GB", 4 * 10**9), ("20M", 2 * 10**7), ("20 mb", 2 * 10**7),
        ("512k", 512_000), ("512kB", 512_000), ("7", 7), ("7 B", 7), ("1.5KiB", 1536),
        ("2MiB", 2 * 1024**2), ("1GiB", 1024**3),
    ],
)  # fmt: skip
def test_sizes_in_bytes_are_parsed(text, value):
    assert parse_bytes(text) == as_bytes(text) == as_bytes(value) == as_bytes(float(value)) == value


@pytest.mark.parametrize("size", ["ten", "1.5e3", None, True, 1.5, float("inf"), [1], np.ones(2)])
def test_wrong_sizes_in_bytes_are_refused(size):
    with pytest.raises(OptionError, match="20MB"):
        as_bytes(size)


@pytest.mark.parametrize("text", ["", "ten", "10%%", "1,5", "nan", "1e400", "1e9999", "1.2.3"])
def test_wrong_ratios_are_refused(text):
    with pytest.raises(OptionError, match=r"^--ratio takes a number like 0\.1 or 10%, not '"):
        parsing.parse_ratio(text, "--ratio")


def test_more_than_the_whole_in_per_cent_is_refused_as_it_was_typed():
    assert parsing.parse_ratio("100%", "-r") == 1
    with pytest.raises(OptionError, match=r"^-r takes 100% or less, not '101 %'\.$"):
        parsing.parse_ratio("101 %", "-r")


@pytest.mark.parametrize("text", ["", "1", "1,2", "1,2,3,4", "a,b,c", "nan,0,0", "0,-inf,0"])
def test_what_is_not_three_numbers_is_refused_as_it_was_typed(text):
    with pytest.raises(OptionError, match=f"^--scale takes three finite numbers, .* not '{text}'"):
        parsing.parse_vector(text, "--scale")


@pytest.mark.parametrize("text", ["", "ten", "1.5", "1.0005k", "-3", "3kB"])
def test_wrong_counts_are_refused(text):
    with pytest.raises(OptionError, match=f"^--chunk takes a whole number .*100k.* not '{text}'"):
        parsing.parse_count(text, "--chunk")


def test_too_little_memory_is_refused_with_the_likely_remedy():
    assert parsing.parse_memory("1MB") == 10**6
    for text, remedy in (("4", "name the unit too"), ("4kB", "allow more")):
        with pytest.raises(OptionError, match=f"too little for any model; {remedy}, as in"):
            parsing.parse_memory(text)


def test_models_can_be_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "c=d.ply").touch()
    url = "https://a.org/b.ply"
    given = ["ours=a.ply", "=a.ply", "c=d.ply", f"{url}?key=1", f"theirs={url}"]
    names, paths = zip(*parsing.parse_named(given), strict=True)
    assert names == ("ours", "=a.ply", "c=d.ply", "b.ply", "theirs")
    assert list(map(str, paths)) == ["a.ply", "=a.ply", "c=d.ply", url, url]


def test_formats_are_completed_with_and_without_their_dot():
    assert options.complete_format(".sp") == options.complete_format("sp") == ["splat", "spz"]


def test_percentages_and_unit_prefixes_work_on_the_command_line(scene, tmp_path):
    for number, target in enumerate((("-r", "10%"), ("--count", "0.2k"))):
        small = tmp_path / f"{number}.ply"
        result = run("simplify", scene, small, *target, "--preset", "fast", "--max-memory", "4G")
        assert result.returncode == 0, result.stderr
        assert len(nanogs.load(small)) == 200


@pytest.mark.parametrize(
    ("arguments", "fragments"),
    [
        (["b.ply", "-r", "ten"], ["0.1 or 10%", "'ten'"]),
        (
            ["b.ply", "--draw-cost", "half"],
            ["--draw-cost takes a number like 0.1 or 10%, not 'half'"],
        ),
        (["b.ply", "--count", "1.5"], ["--count takes a whole number", "100k", "'1.5'"]),
        (["b.ply", "-r", "0.1", "--threads", "x"], ["--threads takes a whole number, not 'x'"]),
        (["b.ply", "-r", "0.1", "--threads", "0"], ["--threads takes 1 or more, not '0'"]),
        (["b.ply", "-r", "0.1", "--lambda-app", "x"], ["--lambda-app takes a number, not 'x'"]),
        (["b.ply", "-r", "0.1", "--max-memory", "4"], ["4 B", "--max-memory 4GB"]),
        (["b.ply", "-r", "0.1", "--max-memory", "1KB"], ["1,000 B", "; allow more, as in"]),
        (["b.ply", "-r", "0.1", "--workers", "9" * 20], ["--workers takes 1024 or less"]),
        (
            ["b.ply", "-r", "0.1", "--up", "nan,0,1"],
            ["--up takes a direction, finite", "'nan,0,1'"],
        ),
        (["b.ply", "-r", "0.1", "--lambda-app", "-1"], ["error: --lambda-app must be 0 or more"]),
        (["b.ply", "-r", "0.1", "--threads", "5000"], ["error: --threads must be from 1 to"]),
        (["b.ply", "--size", "2", "MB"], ["MB is a unit, not a file", "one word, as in 2MB"]),
        (["b.ply", "-r", "10", "%"], ["% is a unit", "as in 10%"]),
        (["b.ply", "0.1"], ["0.1 is a number, not a file", "as in --ratio 0.1."]),
        (["b.ply", "50k"], ["50k is a number, not a file"]),
        (
            ["b", "c", "d", "-n", "1"],
            ["4 paths were given without --out-dir", "simplify A B OUT --join"],
        ),
        ([], ["OUT is missing", "a.ply"]),
        (["-r", "0.1"], ["OUT is missing", "a.ply"]),
    ],
)
def test_each_wrong_value_has_its_own_error_message(scene, arguments, fragments):
    result = run("simplify", scene, *arguments)
    assert_refused(result, *fragments)


def test_words_like_units_may_be_files_or_values_of_other_options(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["nanogs", "simplify", "a.ply", "--size", "2", "MB"])
    refuse_units([Path("a.ply")])
    with pytest.raises(OptionError, match="MB is a unit"):
        refuse_units([Path("a.ply"), Path("MB")])
    (tmp_path / "MB").write_bytes(b"")
    refuse_units([Path("a.ply"), Path("MB")])
    monkeypatch.setattr("sys.argv", ["nanogs", "simplify", "x2", "KB"])
    refuse_units([Path("x2"), Path("KB")])


def test_a_parameter_of_another_name_is_named_by_its_option(scene, tmp_path):
    result = run("refit", scene, scene, tmp_path / "b.ply", "--pixels", "8")
    assert_refused(result, "error: --pixels must be from 16 to 8192 pixels, not 8.")
    with pytest.raises(OptionError, match=r"^size must be from 16 to 8192 pixels, not 8\.$"):
        RefitParameters(size=8)


def test_values_that_are_too_large_are_refused(scene):
    result = run("studio", scene, "--port", "99999")
    assert_refused(result, "--port takes 65535 or less, not '99999'")


def test_the_studio_refuses_memory_that_does_not_hold_the_model(scene):
    result = run("studio", scene, "--max-memory", "100MB", "--no-open", "--idle", "1")
    assert_refused(result, "MB of memory in the studio", "; raise --max-memory")


def test_errors_list_the_options_that_a_preset_has(scene, tmp_path):
    """Of those about views only if it renders."""
    words, forest = ("simplify", scene, tmp_path / "b.ply", "-r", "0.5"), "--k, --lambda-app, "
    for preset, last in (("fast", "--rounds, --steps"), ("default", "--views, --view-size")):
        result = run(*words, "--preset", preset, "--tau", "3")
        start = f"--tau cannot be used with the preset {preset}, which has {forest}"
        assert_refused(result, start, f"{last}; leave it out, or choose another preset.")
    assert not re.search("lambda_app|halves|measure", result.stderr)


def test_the_size_of_views_is_called_pixels(scene, tmp_path):
    for command in ("render", "compare", "view", "refit", "bench"):
        names = {name for param in COMMANDS[command].params for name in param.opts}
        assert "--pixels" in names
        assert "--size" not in names
    assert_refused(run("render", scene, tmp_path / "x", "--size", "64"), "no option --size")


@pytest.mark.parametrize("name", [*COMMANDS, ""])
def test_the_help_names_values_instead_of_types(name, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "200")
    assert run_here(*filter(None, [name]), "--help") == 0
    text = capsys.readouterr().out
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


REACHED = {
    "render a.ply out --views 3 --pixels 64x32 --up 0,0,1": (
        "nanogs.views.cameras.chosen_cameras",
        ["auto", 3, (64, 32), (0, 0, 1)],
    ),
    "render a.ply out --views 1 --pixels 32 --background #ff0000 --depth -w": (
        "nanogs.views.pictures.render_images",
        {"background": (1, 0, 0), "transparent": False, "depth": True, "overwrite": True},
    ),
    "render a.ply out --views 1 --pixels 32 --transparent": (
        "nanogs.views.pictures.render_images",
        {"transparent": True, "depth": False, "overwrite": False},
    ),
    "compare a.ply a.ply --views 3 --sizes 64x32,16 --cameras orbit,roam --up 0,0,1 --packed .spz"
    " --sh-bits 4 --report page.html --no-interactive -w --render-mode mip --max-memory 1GB": (
        "nanogs.scoring.run.compare_files",
        {
            "views": 3, "sizes": [(64, 32), (16, 16)], "cameras": "orbit,roam", "up": (0, 0, 1),
            "packed": [".spz"], "format_options": {"sh_bits": 4}, "report": "page.html",
            "interactive": False, "overwrite": True, "render_mode": "mip", "max_memory": 10**9,
        },
    ),
    "compare a.ply a.ply --photos data --images images_4 --split train --background white"
    " --metrics flip": (
        "nanogs.scoring.run.compare_files",
        {
            "photos": "data", "images": "images_4", "split": "train", "background": (1, 1, 1),
            "extras": ["flip"], "overwrite": False,
        },
    ),
    "compare a.ply a.ply --mixed --budget 1k --views 3 --sizes 64x32 --cameras orbit --up 0,0,1"
    " --background white --threads 1 --max-memory 1GB": (
        "nanogs.scoring.mixed.compare_mixed",
        {
            "budget": 1000, "views": 3, "pixels": [(64, 32)], "cameras": "orbit", "up": (0, 0, 1),
            "background": (1, 1, 1), "threads": 1, "max_memory": 10**9,
        },
    ),
    "view a.ply n=a.ply -o page.html --views 3 --pixels 64x32 --cameras orbit --up 0,0,1"
    " --background white --level 0 --render-mode mip --max-memory 1GB -w --no-open": (
        "nanogs.scoring.viewing.view_files",
        {
            "views": 3, "width": 64, "height": 32, "cameras": "orbit", "up": (0, 0, 1),
            "background": (1, 1, 1), "level": 0, "render_mode": "mip", "max_memory": 10**9,
            "psnr": True, "overwrite": True,
        },
    ),
    "info a.ply --views 3 --pixels 64x32 --cameras orbit --up 0,0,1 --threads 1 --max-memory 1GB": (
        "nanogs.scoring.modes.render_findings",
        [
            ModelViews("orbit", 3, (64, 32), (0, 0, 1)), "'threads', 1",
            "'max_memory', 1000000000",
        ],
    ),
    "info a.ply --photos data --images images_4 --split train --background white": (
        "nanogs.scoring.modes.render_findings",
        [Photographs(Path("data"), "images_4", "train"), "'background', (1.0, 1.0, 1.0)"],
    ),
    "info a.ply --packed .sog --palette 64 --bits 6 --threads 1 --max-memory 1GB": (
        "nanogs.scoring.packing_cost.packing_cost",
        {"format_options": {"palette": 64, "bits": 6}, "threads": 1, "max_memory": 10**9},
    ),
    "refit a.ply a.ply out.sog --device cuda": (
        "nanogs.card.device.check_device",
        ["cuda"],
    ),
    "refit a.ply a.ply out.sog --views 4 --pixels 32": (
        "nanogs.fit.api.refit",
        {"format": ".sog", "parameters": RefitParameters(views=4, size=32)},
    ),
    "refit a.ply a.ply out.ply --views 4 --cameras orbit --up 0,0,1 --pixels 32": (
        "nanogs.pipeline.options.cameras.fit_cameras",
        ["orbit", (0, 0, 1), 5, 32],  # one more view is held out
    ),
    "lod a.ply out/lod-meta.json --chunk 1k --chunk-min 10 --device auto --levels 0.5,0.1": (
        "nanogs.cli.lod_run.write_levels_of_files",
        ["StreamedSog(most=1000, least=10)", "device='auto'", "ratios=(0.5, 0.1)"],
    ),
    "lod a.ply out/tileset.json --plain --longitude 8 --latitude 47 --height 400 --heading 30"
    " --pitch 2 --roll 3": (
        "nanogs.cli.lod_run.write_levels_of_files",
        ["packed=False", "place="],
    ),
    "simplify a.ply out.sog -r 0.5 --bits 6 --sh-bits 4 --spare-bits 1 --device auto --dry-run": (
        "nanogs.cli.simplify_run.plan_run",
        ["'bits': 6", "'sh_bits': 4", "'spare_bits': 1", "device='auto'"],
    ),
    "bench a.ply --ratios 0.5 --methods fast --ablations --metrics flip --views 3 --sizes 64,32"
    " --cameras orbit,roam --seed 7 --threads 1 --render-mode mip": (
        "nanogs.bench.run.run_bench",
        [
            "ratios=(0.5,)", "'default:steps=0'", "metrics=('flip',)", "views=3", "sizes=(64, 32)",
            "kinds=('orbit', 'roam')", "seed=7", "threads=1", "render_mode='mip'",
        ],
    ),
    "convert a.ply out.sog --level 0 --frame rub:rdf --scale 2 --rotate 0,0,90 --translate 1,2,3"
    " --sh-degree 1 --render-mode mip --bits 6 --max-memory 1GB -w": (
        "nanogs.conversion.convert",
        {
            "level": 0, "frame": ("rub", "rdf"), "scale": 2, "rotate": (0, 0, 90),
            "translate": (1, 2, 3), "sh_degree": 1,
            "render_mode": "mip", "format_options": {"bits": 6}, "max_memory": 10**9,
            "overwrite": True,
        },
    ),
    "bench --dataset deep-blending=data --model-pattern {folder}/{scene}.ply": (
        "nanogs.bench.scenes.parse_dataset",
        ["deep-blending=data", "{folder}/{scene}.ply"],
    ),
    "bench a.ply --up 0,0,1": ("nanogs.bench.run.run_bench", ["up=Direction(x=0.0, y=0.0, z=1.0)"]),
    "bench --scene n=a.ply:data --background white": (
        "nanogs.bench.run.run_bench",
        ["background=(1.0, 1.0, 1.0)"],
    ),
    "studio a.ply --port 8123 --idle 5 --preset best --up 0,0,1 --render-mode mip --device auto"
    " --threads 1 --max-memory 1GB": (
        "nanogs.studio.server.Studio",
        [
            "preset='best'", "up='+z'", "render_mode='mip'", "device='auto'", "threads=1",
            "max_memory=1000000000", "('port', 8123)", "('idle', 5.0)",
        ],
    ),
    "warm --workers 3": ("nanogs.warming.warm", [3]),
}  # fmt: skip


@pytest.fixture(scope="module")
def all_imported():
    """Modules that are first imported while a function is replaced would keep the replacement."""
    for module in pkgutil.walk_packages(nanogs.__path__, "nanogs."):
        if not module.name.endswith("__main__") and ".card." not in module.name:  # that needs Warp
            importlib.import_module(module.name)


@pytest.mark.usefixtures("all_imported")
@pytest.mark.parametrize("words", REACHED)
def test_options_reach_the_library(words, scene, tmp_path, monkeypatch, capsys):
    """Of each command, by what a function of the library that it calls is given."""
    function, expected = REACHED[words]
    if words.startswith("view"):
        require_bundle()
    calls = []

    def refuse(*arguments, **given):
        calls.append((arguments, given))
        raise OptionError("That is enough.")

    monkeypatch.chdir(tmp_path)
    shutil.copy(scene, "a.ply")
    (tmp_path / "data").mkdir()
    monkeypatch.setattr(function, refuse)
    assert run_here(*words.split()) == 2
    assert "That is enough." in capsys.readouterr().err
    [(arguments, given)] = calls
    if isinstance(expected, dict):
        found = {name: plain_path(given[name]) for name in expected}
        assert found == expected
    for value in expected if isinstance(expected, list) else ():
        assert value in (
            repr((arguments, list(given.items()))) if isinstance(value, str) else arguments
        )


def plain_path(value):
    return str(value) if isinstance(value, Path) else value


def test_every_parameter_with_a_help_is_an_option():
    """Its help, default and range are stated only where the parameter is defined."""
    kinds = {"simplify": (ForestParameters, PaperParameters), "refit": (RefitParameters,)}
    kinds["lod"] = kinds["simplify"]
    for command, owners in kinds.items():
        options = {param.name: param for param in COMMANDS[command].params}
        for name, known in (known_parameters(owners[0]) | known_parameters(owners[-1])).items():
            assert (name in options) == bool(known.help), name
            assert not known.help or options[name].help == known.help
    assert COMMANDS["refit"].make_context("refit", ["a", "b", "c"]).params["size"] == 512


@dataclass(frozen=True)
class Cut:
    """Parameters with a range of each kind."""

    share: float = parameter(0.5, 0, 1, above=True)
    count: int = parameter(3, 1)
    width: int = parameter(64, 16, 8192, unit=" pixels")
    rate: float = parameter(1.0, above=True)

    def __post_init__(self):
        check_ranges(self)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"share": 0}, "share must be above 0, at most 1, not 0."),
        ({"share": 1.5}, "share must be above 0, at most 1, not 1.5."),
        ({"count": 0}, "count must be 1 or more, not 0."),
        ({"count": 10**400}, "count must be at most 1,000,000, not 1.00000e+400."),
        ({"count": 1_000_001}, "count must be at most 1,000,000, not 1000001."),
        ({"rate": -1}, "rate must be above 0, not -1."),
        ({"width": 8193}, "width must be from 16 to 8192 pixels, not 8193."),
        ({"rate": 0.0}, "rate must be above 0, not 0."),
        ({"rate": math.inf}, "rate must be a finite number, not inf."),
        ({"share": math.nan}, "share must be a finite number, not nan."),
    ],
)
def test_ranges_are_checked_and_stated_in_errors(values, message):
    assert Cut(share=1, count=1, width=16) == Cut(share=1.0, count=1, width=16)
    with pytest.raises(OptionError) as refused:
        Cut(**values)
    assert str(refused.value) == message


@dataclass(frozen=True)
class Inner:
    """A group of options that contains another group."""

    deep: Annotated[int, typer.Option(help="Deep.")] = 1
    cut: Annotated[dict, {"k": (Annotated[int | None, typer.Option()], None)}] = None


def test_a_group_is_expanded_into_its_options():
    calls = []

    @with_options
    def command(*, name: Annotated[str, typer.Argument()], inner: Inner):
        """Do it."""
        calls.append((name, inner))

    app = typer.Typer()
    app.command()(command)
    for arguments in (["x"], ["x", "--deep", "4", "--k", "2"]):
        get_command(app)(arguments, standalone_mode=False)
    assert calls == [("x", Inner(1, {})), ("x", Inner(4, {"k": 2}))]
    assert command.__doc__ == "Do it."


@pytest.mark.parametrize(
    ("preset", "given", "note"),
    [
        ("fast", {"views": 3}, "`views` has no effect, because nothing is rendered"),
        ("fast", {"views": 3, "view_size": 64}, "`views` and `view_size` have no effect, because"),
        ("fast", {"hidden": 0.1}, "`hidden` has no effect"),
        ("fast", {"steps": 2, "corrections": 2}, "no effect, because nothing guides the"),
        ("default", {"steps": 0, "halves": False}, "`halves` has no effect, because nothing is fi"),
        ("fast", {"views": 14, "k": 6, "steps": 2}, None),
        ("default", {"steps": 0, "views": 3}, None),
        ("paper", {"k": 6}, None),
    ],
)
def test_a_parameter_without_an_effect_is_noted(preset, given, note):
    notes = idle_notes(preset, parameters(preset, given))
    assert len(notes) == (note is not None)
    if notes:
        assert note in notes[0]
        assert notes[0].endswith(" out or choose another preset.")


def test_reports_note_a_parameter_without_an_effect(tmp_path):
    model, given = random_splats(300), {"preset": "fast", "views": 3}
    _, report = nanogs.simplify(model, ratio=0.5, **given)
    nanogs.save(model, tmp_path / "a.ply")
    in_blocks = nanogs.simplify_blocks(
        tmp_path / "a.ply", tmp_path / "b.ply", ratio=0.5, block=200, **given
    )
    for each in (report, in_blocks):
        assert "`views` has no effect, because nothing is rendered with" in " ".join(each.notes)

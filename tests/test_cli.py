"""The command, run in a process of its own as a user runs it."""

import json
import os
import re
import subprocess
import sys
from dataclasses import dataclass

import numpy as np
import pytest
from typer.main import get_command

import nanogs
from builders import random_splats
from launch import run, run_here
from nanogs.cli.app import app
from nanogs.cli.console import show_report
from nanogs.datasets.synthetic import make_scene
from nanogs.errors import OptionError


def assert_refused(result, *words):
    """Expect exit code 2, one sentence with all of `words` on stderr, and an empty stdout."""
    assert result.returncode == 2, result
    assert result.stdout == ""
    # A slow machine prints lines of progress too.
    message = re.sub(r"^\d+/\d+ .*\n", "", result.stderr, flags=re.MULTILINE)
    assert message.count("\n") == 1, result.stderr
    assert message.startswith("error: ")
    assert "Traceback" not in message
    for word in words:
        assert word in message


QUICK = ("--views", "2", "--view-size", "64", "--steps", "1", "--no-measure")


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "scene.ply"
    nanogs.save(random_splats(500, degree=1), path)
    return path


# Results and reports


def test_simplify_writes_the_requested_number_of_splats(scene, tmp_path):
    small = tmp_path / "small.ply"
    result = run("simplify", scene, small, "--ratio", "0.1", *QUICK)
    assert result.returncode == 0
    assert result.stdout == ""
    assert "50 splats" in result.stderr
    assert len(nanogs.load(small)) == 50


def test_json_prints_the_report_and_nothing_else(scene, tmp_path):
    result = run(
        "simplify", scene, tmp_path / "small.ply", "-n", "7", "--preset", "paper", "--json"
    )
    assert result.returncode == 0
    assert result.stderr == ""
    report = json.loads(result.stdout)
    assert report["asked_count"] == report["achieved_count"] == 7
    assert report["input_count"] == 500
    assert report["stop"] == "target"
    assert report["passes"][0]["count_before"] == 500 - report["pruned"]
    assert set(report["passes"][0]["seconds"]) == {"graph", "cost", "match", "merge"}
    assert {"read", "prune", "graph", "cost", "match", "merge", "write"} <= set(report["seconds"])
    assert report["output_bytes"] == (tmp_path / "small.ply").stat().st_size


def test_the_command_and_the_library_give_the_same_bytes(scene, tmp_path):
    splats = nanogs.load(scene)
    common = {"preset": "paper", "k": 8, "lambda_app": 0.5}
    small_fit = common | {"views": 4, "view_size": 64, "steps": 3}
    for options in (
        common | {"seed": 3, "tau": 0, "samples": 2, "lambda_geo": 2, "merge_cap": 0.3},
        small_fit | {"preset": "default", "balance": 0.3, "rounds": 1},
    ):
        flags = [(f"--{name.replace('_', '-')}", value) for name, value in options.items()]
        arguments = [part for flag in flags for part in flag]
        result = run("simplify", scene, tmp_path / "a.ply", "-r", "0.2", *arguments, "-q", "-w")
        assert result.returncode == 0, result.stderr
        small, _ = nanogs.simplify(splats, ratio=0.2, **options)
        nanogs.save(small, tmp_path / "b.ply", overwrite=True)
        assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


@pytest.mark.parametrize("size", ["20kB", "19.5 KiB", "20000"])
def test_the_file_fills_the_requested_size_and_never_exceeds_it(scene, tmp_path, size):
    small = tmp_path / "small.ply"
    options = ("--size", size, "--preset", "fast", "--json")
    report = json.loads(run("simplify", scene, small, *options).stdout)
    requested = 19_968 if "KiB" in size else 20_000
    row = 26 * 4
    assert report["asked_size"] == requested
    assert requested - row < small.stat().st_size <= requested
    plan = json.loads(run("simplify", scene, tmp_path / "x.ply", *options, "--dry-run").stdout)
    assert plan["asked_count"] == report["achieved_count"] == len(nanogs.load(small))


def test_a_file_size_is_kept_in_a_compressed_format(scene, tmp_path):
    small = tmp_path / "small.spz"
    options = ("--size", "6kB", "--preset", "fast", "--spz-version", "4")
    plan = run("simplify", scene, small, *options, "--dry-run")
    assert "as many splats as fit into 6,000 B" in plan.stderr
    result = run("simplify", scene, small, *options, "--json")
    report = json.loads(result.stdout)
    assert report["output_bytes"] == report["achieved_size"] == small.stat().st_size <= 6000
    assert nanogs.io.inspect(small).encoding == "zstd"
    shown = run("simplify", scene, small, *options, "-v", "-w").stderr
    assert f"{small.stat().st_size:,}" in shown


def test_a_psnr_is_reached_or_the_run_ends_with_code_3(scene, tmp_path):
    options = ("--preset", "fast", "--json")
    reached = run("simplify", scene, tmp_path / "a.ply", "--psnr", "23", *options)
    report = json.loads(reached.stdout)
    assert (reached.returncode, report["stop"], reached.stderr) == (0, "target", "")
    assert 23 <= report["judged"]["psnr"] <= 23.3
    [compared] = json.loads(run("compare", scene, tmp_path / "a.ply", "--json").stdout)["models"]
    assert compared["psnr"] == pytest.approx(report["judged"]["psnr"], abs=1e-9)
    missed = run("simplify", scene, tmp_path / "b.sog", "--psnr", "100", *options)
    report = json.loads(missed.stdout)
    assert (missed.returncode, report["stop"]) == (3, "unreached")
    text = " dB with 495 of 500 splats is less than 100 dB, so the whole model was written"
    assert text in missed.stderr
    assert len(nanogs.load(tmp_path / "b.sog")) == 500


def test_a_whole_model_that_alone_reaches_a_psnr_is_no_failure(tmp_path):
    nanogs.save(random_splats(2), tmp_path / "a.ply")
    arguments = ("simplify", tmp_path / "a.ply", tmp_path / "b.ply", "--psnr", "100", "-w")
    whole = run(*arguments, "--preset", "fast")
    assert whole.returncode == 0, whole.stderr
    assert re.search("note: .* dB with 1 of 2 splats is less than 100 dB, so the", whole.stderr)
    hushed = run(*arguments, "--preset", "fast", "--json")
    assert (hushed.returncode, hushed.stderr) == (0, "")
    assert json.loads(hushed.stdout)["stop"] == "unreached"


def test_the_option_steps_is_passed_to_the_method(scene, tmp_path):
    options = ("-r", "0.1", "--preset", "fast", "--steps", "6", "--view-size", "64", "--json")
    report = json.loads(run("simplify", scene, tmp_path / "a.ply", *options).stdout)
    assert report["parameters"]["steps"] == 6
    assert report["fit"]["psnr_after"] >= report["fit"]["psnr_before"]


def test_the_options_for_views_are_passed_to_the_method(scene, tmp_path):
    def candidates(name, up):
        options = ("-r", "0.1", "--cameras", "orbit", "--up", up, "--json", *QUICK)
        report = json.loads(run("simplify", scene, tmp_path / name, *options).stdout)
        return [entry["psnr"] for entry in report["candidates"]]

    first = candidates("a.ply", "0,0,1")
    assert candidates("b.ply", "0,0,1") == first
    assert candidates("c.ply", "0,1,0") != first


def test_quiet_prints_nothing_and_verbose_prints_the_candidates(scene, tmp_path):
    quiet = run("simplify", scene, tmp_path / "a.ply", "-r", "0.1", "-q", *QUICK)
    verbose = run("simplify", scene, tmp_path / "b.ply", "-r", "0.1", "-v", *QUICK)
    assert (quiet.stdout, quiet.stderr) == ("", "")
    assert "candidates" in verbose.stderr
    assert "balance 0.5 or 1, " in verbose.stderr  # as tried, and no longer 0.8, which was not


def test_dry_run_prints_a_plan_and_writes_nothing(scene, tmp_path):
    result = run("simplify", scene, tmp_path / "small.ply", "-r", "0.1", "--dry-run")
    assert result.returncode == 0
    assert "peak memory" in result.stderr
    as_json = run("simplify", scene, tmp_path / "small.ply", "-r", "0.1", "--dry-run", "--json")
    assert json.loads(as_json.stdout)["asked_count"] == 50
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "balances"),
    [((), "0.5 or 1"), (("--balance", "0.3"), "0.3 or 0.5 or 1"), (("--preset", "fast"), "0.8")],
)
def test_a_plan_lists_the_balances_that_are_tried(scene, tmp_path, options, balances):
    plan = run("simplify", scene, tmp_path / "small.ply", "-r", "0.1", *options, "--dry-run")
    [line] = [line for line in plan.stderr.splitlines() if line.startswith("parameters")]
    assert f", balance {balances}, rounds" in line


def test_a_plan_and_a_report_print_parameters_in_the_same_form(scene, tmp_path):
    options = ("-n", 50, "--preset", "fast", "--lambda-app", "1")
    planned, done = (
        run("simplify", scene, tmp_path / "a.ply", *options, extra).stderr.splitlines()
        for extra in ("--dry-run", "-v")
    )
    [line] = {" ".join(each.split()) for each in planned + done if each.startswith("parameters")}
    assert line.startswith("parameters k 5, lambda app 1, balance 0.8, ")


def test_a_plan_lists_the_longer_fit_of_a_packing_that_is_searched_for(scene, tmp_path):
    given = "simplify", scene, tmp_path / "small.sog", "--dry-run", "--json"
    planned = [json.loads(run(*given, *goal).stdout) for goal in (("--size", "9kB"), ("-r", "0.1"))]
    assert [plan["parameters"]["steps"] for plan in planned] == [84, 28]


def test_an_existing_file_is_overwritten_only_with_its_flag(scene, tmp_path):
    small = tmp_path / "small.ply"
    small.write_text("mine")
    assert_refused(run("simplify", scene, small, "-r", "0.1"), "small.ply", "-w")
    assert small.read_text() == "mine"
    assert run("simplify", scene, small, "-r", "0.1", "--preset", "fast", "-w").returncode == 0
    assert len(nanogs.load(small)) == 50


def test_output_may_replace_the_input(tmp_path):
    path = tmp_path / "scene.ply"
    nanogs.save(random_splats(100), path)
    assert run("simplify", path, path, "-r", "0.5", "--preset", "fast", "-w").returncode == 0
    assert len(nanogs.load(path)) == 50


def test_rows_with_nan_are_reported_or_refused(tmp_path):
    splats = random_splats(100)
    splats.means[3] = np.nan
    nanogs.save(splats, tmp_path / "scene.ply")
    options = ("-r", "0.1", "--preset", "fast")
    result = run("simplify", tmp_path / "scene.ply", tmp_path / "small.ply", *options)
    assert result.returncode == 0
    assert "1 splat holds a NaN" in result.stderr
    refused = run(
        "simplify", tmp_path / "scene.ply", tmp_path / "x.ply", *options, "--nan", "error"
    )
    assert_refused(refused, "row 3", "--nan drop")
    assert not (tmp_path / "x.ply").exists()


def test_info_prints_text_or_json(scene):
    text = run("info", scene)
    assert text.returncode == 0
    assert "500" in text.stdout
    report = json.loads(run("info", scene, "--json").stdout)
    assert report["splats"] == 500
    assert report["sh_degree"] == 1
    assert report["nonfinite"] == 0
    assert len(report["bounds"][0]) == 3


def test_info_counts_infinite_opacities(tmp_path):
    splats = random_splats(10)
    splats.opacity_logits[:3] = np.inf
    splats.opacity_logits[3] = -np.inf
    nanogs.save(splats, tmp_path / "a.ply")
    report = json.loads(run("info", tmp_path / "a.ply", "--json").stdout)
    assert (report["opaque"], report["transparent"], report["nonfinite"]) == (3, 1, 0)


def test_demo_generates_a_scene_of_the_requested_count(tmp_path):
    assert run("demo", tmp_path / "demo.ply", "-n", "2000").returncode == 0
    assert len(nanogs.load(tmp_path / "demo.ply")) == 2000


def test_demo_generates_another_scene_for_another_seed(tmp_path):
    for seed in (0, 7):
        assert run("demo", tmp_path / f"{seed}.ply", "-n", "500", "--seed", seed).returncode == 0
        expected = make_scene(500, seed=seed)
        assert np.array_equal(nanogs.load(tmp_path / f"{seed}.ply").means, expected.means)


def test_demo_refuses_an_existing_file_before_it_makes_a_scene(tmp_path, monkeypatch, capsys):
    (tmp_path / "a.ply").write_bytes(b"precious")
    monkeypatch.setattr("nanogs.datasets.synthetic.make_scene", None)
    assert run_here("demo", tmp_path / "a.ply", "-n", "500") == 2
    assert "exists already; add -w to replace it." in capsys.readouterr().err


def test_demo_names_what_the_format_leaves_out(tmp_path):
    result = run("demo", tmp_path / "demo.splat", "-n", "2000")
    assert result.returncode == 0
    assert "note: Spherical harmonics" in result.stderr
    assert run("demo", tmp_path / "quiet.splat", "-n", "2000", "-q").stderr == ""


def test_demo_writes_the_plant_and_names_its_author(tmp_path):
    result = run("demo", tmp_path / "plant.ply")
    assert result.returncode == 0
    assert "Marcel Padilla, CC-BY-4.0" in result.stderr
    assert len(nanogs.load(tmp_path / "plant.ply")) == 113_648


def test_demo_refuses_a_seed_for_the_scene_that_is_not_generated(tmp_path):
    result = run("demo", tmp_path / "plant.ply", "--seed", "1")
    assert result.returncode == 2
    assert "--count" in result.stderr
    assert not (tmp_path / "plant.ply").exists()


@dataclass(frozen=True)
class Entry:
    name: str
    gain: float | None
    parts: tuple[int, ...] = ()
    chosen: bool = False


@dataclass(frozen=True)
class Fit:
    text = "20.00 to 20.46 dB"


@dataclass(frozen=True)
class Report:
    """A report with entries of every type, whose names the command does not know."""

    input_count: int
    share: float
    seconds: dict[str, float]
    fit: Fit | None = None
    new_stage: Entry | None = None
    many: tuple[Entry, ...] = ()
    notes: tuple[str, ...] = ()
    pruned: int = 0


def test_every_entry_of_a_report_is_shown(capsys):
    entry = Entry("a", 1234.5678, (1, 2, 3))
    entries = (entry, Entry("b", None, chosen=True))
    show_report(Report(2000, 0.12345, {"read": 1.0}, Fit(), entry, entries, ("Said.",)))
    lines = [line.split() for line in capsys.readouterr().err.splitlines()]
    assert lines == [
        "input count 2,000".split(),
        "share 0.1235".split(),
        "seconds read 1".split(),
        "fit 20.00 to 20.46 dB".split(),
        "new stage name a, gain 1235, parts 3, chosen no".split(),
        ["many:"],
        "name gain parts chosen".split(),
        "a 1235 3 no".split(),
        "b - 0 yes".split(),
    ]


def modules_after(*arguments):
    """Return the names of the modules that a command has imported by its end."""
    program = (
        "import sys; from nanogs.cli import main\n"
        "try: main()\n"
        "finally: print(*sys.modules, file=sys.stderr)"
    )
    command = [sys.executable, "-c", program, *map(str, arguments)]
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    return set(result.stderr.split())


def test_info_never_imports_numba(scene):
    assert "numba" not in modules_after("info", scene)


COMMANDS = "simplify lod refit convert info presets render compare view bench demo warm".split()


@pytest.mark.parametrize("command", COMMANDS)
def test_help_texts_have_no_brackets_that_rich_reads_as_markup(command):
    import typer

    from nanogs.cli.app import app

    entry = typer.main.get_command(app).commands[command]
    for text in (
        entry.help,
        *(getattr(parameter, "help", "") for parameter in entry.params),
    ):
        assert not re.search(r"\[[a-z]", text or ""), text


def test_help_imports_no_heavy_modules():
    """All commands run in one process: a module that one imports is still there after the next."""
    code = (
        "import sys; from nanogs.cli import main\n"
        "heavy = 'numpy numba scipy PIL jinja2 rich.progress '\n"
        "heavy += 'nanogs.splats nanogs.io nanogs.report'\n"
        "for words in sys.argv[1:]:\n"
        "    sys.argv[1:] = words.split()\n"
        "    try: main()\n"
        "    except SystemExit as end: assert not end.code, words\n"
        "    assert not set(heavy.split()) & set(sys.modules), words\n"
        "    assert {'typer', 'nanogs.cli.app'} <= set(sys.modules), words\n"
    )
    calls = ["--version", "--help", *(f"{command} -h" for command in COMMANDS)]
    result = subprocess.run([sys.executable, "-c", code, *calls], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert result.stdout.count("Usage:") == len(calls) - 1


def test_completion_imports_neither_numpy_nor_rich():
    words = {"COMP_WORDS": "nanogs simplify a b --preset ", "COMP_CWORD": "5"}
    code = (
        "import sys; from nanogs.cli import main\n"
        "try: main()\n"
        "finally: assert not {'numpy', 'rich'} & set(sys.modules), set(sys.modules)"
    )
    result = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env={**os.environ, "_NANOGS_COMPLETE": "complete_bash", **words},
    )
    assert result.returncode == 0, result.stderr
    assert "default" in result.stdout.split()


def test_public_names_are_callable_when_submodules_are_imported_first():
    code = (
        "import nanogs.pipeline.options.presets, nanogs\n"
        "for name in ('load', 'save', 'simplify', 'levels', 'Splats', 'SimplifyReport'):\n"
        "    assert callable(getattr(nanogs, name)), name\n"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


def test_public_names_do_not_depend_on_what_is_imported_first():
    """For each case the modules of nanogs are imported anew; other libraries stay imported."""
    code = (
        "import sys, types\n"
        "for before in sys.argv[1:]:\n"
        "    for name in [n for n in sys.modules if n.split('.')[0] == 'nanogs']:\n"
        "        del sys.modules[name]\n"
        "    exec(before, {})\n"
        "    import nanogs\n"
        "    for name in nanogs.__all__: assert getattr(nanogs, name) is not None, before\n"
        "    for name in ('simplify', 'refit'):\n"
        "        value = getattr(nanogs, name)\n"
        "        assert isinstance(value, types.FunctionType), (before, value)\n"
        "        assert value.__name__ == name, before\n"
        "    assert not hasattr(nanogs, 'simplfy')\n"
        "    assert {*nanogs.__all__, 'io', 'frames'} <= set(dir(nanogs)), before\n"
        "    assert nanogs.io.losses and nanogs.frames.change_frame and nanogs.errors.OptionError\n"
        "    assert nanogs.filters.crop_box and nanogs.NanogsError is nanogs.errors.NanogsError\n"
    )
    before = [
        "import nanogs.pipeline.api, nanogs.fit.api",
        "import nanogs.fit.parameters, nanogs.method.paper.passes",
        "from nanogs import refit, simplify; from nanogs.pipeline.options import presets",
        "import nanogs; nanogs.simplify, nanogs.refit; import nanogs.fit.rounds",
        "from nanogs import *",
    ]
    result = subprocess.run([sys.executable, "-c", code, *before], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


def test_all_options_of_simplify_reach_the_library(scene, tmp_path, monkeypatch):
    """The library's function is replaced by one that raises with the request it gets."""

    def refuse_with_request(request, _progress):
        raise OptionError(repr(request))

    monkeypatch.setattr("nanogs.cli.simplify_run.simplify_files", refuse_with_request)
    words = "--cameras orbit --up 0,0,1 --ratio 0.2 --crop box:0,0,0,1,1,1 --sh-degree 0 --k 5"
    words += " --frame rub --scratch s --patience 3 --max-memory 210.1MB --threads 1 --nan error"
    with pytest.raises(OptionError) as caught:
        get_command(app)(
            ["simplify", str(scene), str(tmp_path / "a.ply"), *words.split()],
            standalone_mode=False,
        )
    for part in (
        "cameras='orbit'", "up=Direction(x=0.0, y=0.0, z=1.0)", "'k': 5", "ratio=0.2",
        "sh_degree=0", "frame=('rdf', 'rub')", "nan='error'", "scratch='s'", "patience=3.0",
        "max_memory=210100000", "name='crop'", "threads=1", "resume=False", "overwrite=False",
    ):  # fmt: skip
        assert part in str(caught.value), part


# Refused inputs


def ply(header, body=b""):
    return (
        "\n".join(["ply", "format binary_little_endian 1.0", *header, "end_header"]) + "\n"
    ).encode() + body


NAMES = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()
PROPERTIES = [f"property float {name}" for name in NAMES]
ROW = np.zeros(14, np.float32).tobytes()

BAD_FILES = {
    "empty": (b"", ["empty"]),
    "not_a_ply": (b"hello world, this is text\n" * 10, ["ply"]),
    "truncated_header": (ply(["element vertex 1", *PROPERTIES])[:60], ["header"]),
    "truncated_body": (ply(["element vertex 9", *PROPERTIES], ROW * 4), ["9", "4"]),
    "no_vertex": (ply(["element face 1", "property float x"], b"0000"), ["vertex"]),
    "missing_property": (ply(["element vertex 1", *PROPERTIES[:-1]], ROW[:-4]), ["rot_3"]),
    "no_splats": (ply(["element vertex 0", *PROPERTIES]), ["no rows"]),
    "absurd_count": (
        ply(["element vertex 99999999999999", *PROPERTIES], ROW),
        ["99,999,999,999,999"],
    ),
    "negative_count": (ply(["element vertex -5", *PROPERTIES], ROW), ["-5"]),
    "list_property": (
        ply(["element vertex 1", *PROPERTIES, "property list uchar int l"], ROW + b"\0"),
        ["list", "l"],
    ),
    "wrong_row_size": (ply(["element vertex 4", *PROPERTIES], ROW * 4 + b"xyz"), ["bytes"]),
    "all_opacities_nan": (
        ply(["element vertex 4", *PROPERTIES], np.full(14, np.nan, np.float32).tobytes() * 4),
        ["NaN"],
    ),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_a_damaged_file_is_refused_and_nothing_is_written(name, tmp_path):
    content, words = BAD_FILES[name]
    (tmp_path / f"{name}.ply").write_bytes(content)
    result = run("simplify", tmp_path / f"{name}.ply", tmp_path / "out.ply", "-r", "0.5")
    expected = [] if name == "all_opacities_nan" else [f"{name}.ply"]
    assert_refused(result, *expected, *words)
    assert [path.name for path in tmp_path.iterdir()] == [f"{name}.ply"]


def test_missing_files_folders_and_unknown_formats_are_refused(tmp_path):
    assert_refused(run("simplify", tmp_path / "no.ply", tmp_path / "o.ply", "-r", "1"), "no.ply")
    (tmp_path / "d.ply").mkdir()
    assert_refused(run("simplify", tmp_path / "d.ply", tmp_path / "o.ply", "-r", "1"), "d.ply")
    assert_refused(run("info", tmp_path / "no.ply"), "no.ply")
    (tmp_path / "a.xyz").write_bytes(b"1")
    assert_refused(run("info", tmp_path / "a.xyz"), ".xyz", ".ply")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--ratio", "0"], "ratio"),
        (["--ratio", "1.5"], "ratio"),
        (["--ratio", "nan"], "ratio"),
        (["--count", "501"], "501"),
        (["--count", "0"], "count"),
        ([], "ratio"),
        (["--ratio", "0.5", "--count", "5"], "ratio"),
        (["--ratio", "0.5", "--preset", "papr"], "papr"),
        (["--ratio", "0.5", "--tau", "2"], "tau"),
        (["--ratio", "0.5", "--preset", "paper", "--tau", "2"], "tau"),
        (["--ratio", "0.5", "--preset", "paper", "--steps", "6"], "steps"),
        (["--ratio", "0.5", "--preset", "paper", "--views", "4"], "views"),
        (["--ratio", "0.5", "--preset", "fast", "--cameras", "orbit"], "--cameras"),
        (["--ratio", "0.5", "--size", "5MB"], "exactly one"),
        (["--size", "5XB"], "5XB"),
        (["--size", "300"], "300 B"),
        (["--psnr", "-3"], "PSNR"),
        (["--psnr", "30", "--preset", "paper"], "paper"),
        (["--ratio", "0.5", "--threads", "9999"], "threads"),
    ],
)
def test_an_invalid_option_is_refused_and_nothing_is_written(scene, tmp_path, options, message):
    assert_refused(run("simplify", scene, tmp_path / "out.ply", *options), message)
    assert list(tmp_path.iterdir()) == []


def test_an_output_that_cannot_be_written_is_refused_before_the_work(scene, tmp_path):
    (tmp_path / "folder.ply").mkdir()
    for target in ("missing/out.ply", "folder.ply", "out.unknown"):
        result = run("simplify", scene, tmp_path / target, "-r", "0.5")
        assert_refused(result, target.split("/")[0].split(".")[-1])


@pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write into read-only folders"
)
def test_an_output_in_a_read_only_folder_is_refused(scene, tmp_path):
    tmp_path.chmod(0o500)
    assert_refused(run("simplify", scene, tmp_path / "out.ply", "-r", "0.5"), "out.ply")


def test_full_disk_leaves_no_file(scene, tmp_path):
    """A limit on the size of files replaces a full disk: the write fails half-way."""
    resource = pytest.importorskip("resource")

    def limit():
        resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, 10_000))

    code = (
        "import signal; signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "from nanogs.cli import main; main()"
    )
    arguments = ["simplify", scene, tmp_path / "out.ply", "-r", "0.9", "--preset", "fast"]
    result = subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)],
        capture_output=True,
        text=True,
        preexec_fn=limit,
    )
    assert_refused(result, "out.ply")
    assert list(tmp_path.iterdir()) == []

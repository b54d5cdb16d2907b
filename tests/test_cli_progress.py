"""How the command shows its progress, and the summary line it ends with."""

import io
import os
import re
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest
from rich.console import Console

import nanogs
from builders import random_splats
from launch import run, run_here
from nanogs.cli import progress
from nanogs.cli.many import Run
from nanogs.cli.progress import Watch, shown
from nanogs.cli.simplify_report import summary
from nanogs.formatting import counted, sizes_text, time_text
from nanogs.kernels import compiling
from nanogs.progress import WAITING, Stage, Step, Tracker
from nanogs.protocol import Judged, Protocol

PLAN = [Stage("first", 1.0), Stage("second", 3.0)]


@pytest.fixture
def no_delay(monkeypatch):
    monkeypatch.setattr(progress, "PATIENCE", 0.0)
    monkeypatch.setattr(progress, "_TICK", 0.01)


def lines_of(capsys):
    return capsys.readouterr().err.splitlines()


def run_stages(watch, pause=0.0):
    tracker = Tracker(watch, PLAN)
    for stage in PLAN:
        tracker.begin(stage.name)
        for part in range(4):
            tracker.part(part, 4)
            time.sleep(pause)
    tracker.finish()


@pytest.mark.parametrize(
    "words",
    [
        "convert a.ply out.spz",
        "simplify a.ply out.ply -r 0.5 --preset fast",
        "lod a.ply levels --preset fast",
        "refit a.ply b.ply out.ply --views 4 --pixels 32",
        "render a.ply pictures --views 1 --pixels 32",
        "compare a.ply b.ply --views 1 --pixels 32",
        "info a.ply --views 1 --pixels 32",
        "info a.ply --packed .spz",
    ],
)
def test_commands_show_all_stages_up_to_the_end(words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, count in (("a.ply", 400), ("b.ply", 100)):
        nanogs.save(random_splats(count), name)
    steps = []
    monkeypatch.setattr(Watch, "__call__", lambda _watch, step: steps.append(step))
    assert run_here(*words.split()) == 0
    assert {step.number for step in steps} == set(range(1, steps[-1].stages + 1))
    assert steps[-1].fraction == 1


def test_a_pipe_gets_one_numbered_line_for_each_stage(capsys, no_delay):
    with shown(quiet=False) as watch:
        run_stages(watch, 0.02)
    assert lines_of(capsys) == ["1/2 first", "2/2 second"]


def test_a_long_stage_gets_further_lines_with_the_time_left(capsys, no_delay, monkeypatch):
    monkeypatch.setattr(progress, "EVERY", 0.05)
    with shown(quiet=False) as watch:
        Tracker(watch, PLAN).begin("second")  # no further step for a while
        time.sleep(0.3)
    first, *others = lines_of(capsys)
    assert first == "2/2 second"
    assert len(others) >= 2
    assert all(re.fullmatch(r"2/2 second: 25 %, \d+ s left", line) for line in others), others


def test_short_and_quiet_runs_are_silent(capsys, no_delay, monkeypatch):
    with shown(quiet=True) as watch:
        run_stages(watch)
    monkeypatch.setattr(progress, "PATIENCE", 5.0)
    with shown(quiet=False) as watch:
        run_stages(watch, 0.02)
    assert lines_of(capsys) == []


def test_files_share_one_bar(capsys, no_delay):
    fractions = []
    with shown(quiet=False) as watch:
        for number in (1, 2):
            report_step = watch.of_file(number, 2)
            for step in (Step("a", 1, 1, 0, 1, 0.0), Step("a", 1, 1, 1, 2, 0.5)):
                report_step(step)
                fractions.append(watch.step.fraction)
    assert fractions == [0, 0.25, 0.5, 0.75]
    assert lines_of(capsys) == ["file 1 of 2: 1/1 a", "file 2 of 2: 1/1 a"]


def test_compiling_is_announced_once_a_run_and_left_out_of_the_estimate(capsys, no_delay):
    with shown(quiet=False) as watch:
        tracker = Tracker(watch, PLAN)
        tracker.begin("first")
        for _ in range(2):
            compiling.begin()
            assert watch.left() is None
            time.sleep(0.1)
            compiling.end()
        watch._start -= 1
        tracker.part(1, 2)
        total = watch._told - watch._start
        assert watch.left() == pytest.approx(7 * (total - 0.2), abs=0.5)
    assert lines_of(capsys) == ["1/2 first", f"1/2 first, {compiling.COMPILING}"]


def test_a_wait_for_workers_is_announced_once_until_work_goes_on(capsys):
    watch = Watch()
    for stage in (WAITING, WAITING, "grow", WAITING):
        watch(Step(stage, 1, 2, 0, 1, 0.1))
    note = "note: The cluster has no worker; waiting for one."
    assert lines_of(capsys) == [note, note]


def test_a_terminal_gets_one_bar_that_is_not_full_before_the_end(monkeypatch, no_delay):
    file = io.StringIO()
    console = Console(file=file, force_terminal=True, width=100)
    monkeypatch.setattr(progress, "err", console)
    with shown(quiet=False) as watch:
        run_stages(watch, 0.15)
    output = file.getvalue()
    assert "1/2 first" in output
    assert "2/2 second" in output
    percentages = [int(text) for text in re.findall(r"(\d+) %", output)]
    assert percentages == sorted(percentages)
    assert len(set(percentages)) > 3
    assert re.search(r"\d+ %, \d+ s left", output)
    before_the_end = [percentage for percentage in percentages[:-1] if percentage != 100]
    assert len(before_the_end) >= len(percentages) - 2


def test_time_left_is_estimated_from_the_fraction_done():
    watch = Watch()
    assert watch.left() is None
    watch._start -= 10
    watch(Step("a", 1, 1, 1, 4, 0.25))
    assert watch.left() == pytest.approx(30, abs=0.5)
    watch._told -= 5  # 5 seconds pass without a step
    watch._start -= 5
    assert watch.left() == pytest.approx(25, abs=0.5)


def test_time_left_does_not_shrink_while_kernels_are_compiled():
    watch = Watch()
    watch._start -= 10
    watch(Step("a", 1, 1, 1, 4, 0.25))
    watch.note_compiling(True)
    for attribute in ("_start", "_told", "_since"):
        setattr(watch, attribute, getattr(watch, attribute) - 20)  # compiling takes 20 seconds
    watch.note_compiling(False)
    assert watch.left() == pytest.approx(30, abs=0.5)


def test_the_summary_is_one_line(tmp_path):
    def summary_of(files, **changes):
        defaults = {
            "read_count": 500_000,
            "achieved_count": 50_000,
            "judged": None,
            "packed": None,
            "cost": None,
            "original_cost": None,
            "format_options": {},
            "total_seconds": 6.2,
        }
        report = SimpleNamespace(**defaults | changes)
        return summary(Run(report, files)).replace("->", "→")

    files = {"input_bytes": 76_000_000, "output_bytes": 1_200_000}
    files |= {"input": "a.ply", "output": "b.ply"}
    assert summary_of(files) == "500,000 → 50,000 splats in b.ply, 76.0 → 1.2 MB, 6 s"
    chosen = {"bits": 6, "palette": 3429}
    assert " in b.ply (--bits 6 --palette 3429), 76" in summary_of(files, format_options=chosen)
    packed = files | {"input": "a.sog", "input_bytes": 1_100_000}
    assert ", 1.1 → 1.2 MB (.sog → .ply), 6 s" in summary_of(packed)
    assert ", 1.1 → 1.2 MB, 6 s" in summary_of(packed | {"input": "stdin"})
    judged = Judged(33.1, 0.9, Protocol(views=12))
    assert ", 33.10 dB on 12 held-out views of 512 pixels, 6 s" in summary_of(files, judged=judged)
    nanogs.save(random_splats(100), tmp_path / "in.ply")
    for verbose, least_lines in (((), 1), (("-v",), 10)):
        options = ("-r", "0.1", "-w", "--views", "4", "--view-size", "64", "--steps", "2", *verbose)
        shown = command("simplify", "in.ply", "out.ply", *options, cwd=tmp_path)
        summary_lines = [line for line in shown.splitlines() if not re.match(r"\d+/\d+ ", line)]
        assert len(summary_lines) >= least_lines
        assert re.fullmatch(r"100 (→|->) 10 splats in out.ply, .* [kM]?B, .* s", summary_lines[-1])
        assert len(summary_lines) == 1 or verbose


def command(*arguments, **options):
    result = run(*arguments, **options)
    assert result.returncode == 0, result.stderr
    return result.stderr


def test_an_ascii_terminal_gets_a_plain_arrow(tmp_path):
    nanogs.save(random_splats(100), tmp_path / "in.ply")
    ascii_only = {**os.environ, "PYTHONIOENCODING": "ascii"}
    stderr = command("convert", "in.ply", "out.spz", cwd=tmp_path, env=ascii_only)
    assert re.search(r"100 splats of SH degree \d in .*, .* -> ", stderr)


@pytest.mark.parametrize(
    ("before", "after", "text"),
    [(76e6, 1.2e6, "76.0 → 1.2 MB"), (76e6, 5e5, "76.0 MB → 500.0 kB"), (None, 10, "– → 10 B")],  # noqa: RUF001
)
def test_sizes_before_and_after_name_their_unit_once_if_it_is_the_same(before, after, text):
    assert sizes_text(before, after, "→") == text


@pytest.mark.parametrize(
    ("count", "text"), [(0, "0 splats hold"), (1, "1 splat holds"), (2000, "2,000 splats hold")]
)
def test_counts_take_the_singular_or_plural(count, text):
    assert counted(count, "splat holds", "splats hold") == text


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.04, "0.0 s"),
        (0.44, "0.4 s"),
        (6.2, "6 s"),
        (89, "89 s"),
        (600, "10 min"),
        (9000, "2.5 h"),
    ],
)
def test_times_are_rounded_to_readable_units(seconds, text):
    assert time_text(seconds) == text


LIBRARY = """
import numpy as np, sys
from nanogs.kernels import compiling, radix
if sys.argv[1] == "watched":
    stack = compiling.watching(lambda begun: None)
    stack.__enter__()
for dtype in (np.uint64, np.uint64):
    radix.radix_sort(np.arange(4, dtype=dtype), np.empty(4, dtype))
"""


@pytest.mark.parametrize(("mode", "lines"), [("alone", 1), ("watched", 0)])
def test_the_library_logs_compiling_unless_a_callback_watches_it(tmp_path, mode, lines):
    cache = {"NUMBA_CACHE_DIR": str(tmp_path), "NUMBA_DISABLE_JIT": "0", "NANOGS_SIMD": "0"}
    for expected in (lines, 0):  # the second time, nothing is left to compile
        result = subprocess.run(
            [sys.executable, "-c", LIBRARY, mode], capture_output=True, text=True, check=True,
            env={**os.environ, **cache},
        )  # fmt: skip
        assert result.stderr.count("compiled for this processor") == expected
        assert len(result.stderr.splitlines()) == expected

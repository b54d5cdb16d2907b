"""`nanogs lod`: plan the levels, make them, in memory or in blocks, and print them."""

import shlex
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rich.table import Table

from nanogs.cli.console import arrow, err, say, show, show_report, warn
from nanogs.cli.filtering import report_filters
from nanogs.cli.framing import frames_of
from nanogs.cli.many import Run
from nanogs.cli.method import Method
from nanogs.cli.plan import execute, plan_run, show_plan
from nanogs.cli.simplify_report import as_tried, warn_of_input
from nanogs.environments import AUTO, NOTHING, EnvironmentRequest
from nanogs.formatting import NONE, bytes_text, counted, number_text, time_text
from nanogs.io import bytes_on_disk
from nanogs.io.collect import Pair
from nanogs.levels_of_detail import sink_of, usual_levels, write_levels_of_files
from nanogs.lod.layout import LodLayout, Output
from nanogs.lod.manifest import ChunkedLevel, Level
from nanogs.pipeline.options.target import target_count
from nanogs.pipeline.request import Request
from nanogs.progress import Progress
from nanogs.switches import SCREEN, SwitchQuality

_ONE_FILE = (LodLayout.TREE, LodLayout.ARCHIVE)  # layouts with one file for all levels


@dataclass(frozen=True, slots=True, kw_only=True)
class Arguments:
    """The options of a run of `lod`, parsed.

    Attributes:
        request: The request to the library.
        method: Options of the method and of its execution.
        output: The output folder or file, and its layout.
        usual: Whether to use the default levels instead of those of the request.
        sky: The requested environment.
    """

    request: Request
    method: Method
    output: Output
    usual: bool = False
    sky: EnvironmentRequest = NOTHING


def run_levels(arguments: Arguments, pair: Pair, progress: Progress) -> Run:
    """Make the levels and return the manifest with the reports, or with --dry-run the plan.

    Raises:
        NanogsError: The levels cannot be made.
    """
    method, output = arguments.method, arguments.output
    inputs = (pair.source, *arguments.request.inputs[1:])  # stdin is now a temporary file
    turn = frames_of(inputs, output.model, method.edits.frame, output.path)
    request = replace(arguments.request, inputs=inputs, frame=turn)
    if arguments.usual:
        request = replace(request, ratios=usual_levels(request.inputs, output.layout))
    sink = sink_of(request, layout=output.layout)
    if not request.continues_job():
        sink.check()
    plan = plan_run(request, method)
    if not method.hushed:
        for note in plan.notes():
            warn(note)
    record: dict[str, Any] = {
        "input": plan.name,
        "output": str(output.path),
        "layout": output.layout,
    }
    if method.dry_run:
        request, beside = arguments.sky.planned(request, divided=plan.divided)
        for note in () if method.hushed else arguments.sky.notes(beside):
            warn(note)
        record["environment"] = beside and {"source": beside.source, "count": beside.count}
        shown = replace(plan, request=request).shown()
        usable = shown.info.splats if shown.usable is None else shown.usable
        counts = [target_count(usable, ratio, None) for ratio in request.ratios]
        asked = [{"ratio": r, "count": c} for r, c in zip(request.ratios, counts, strict=True)]
        return Run(shown, record | {"levels": asked})
    start = time.perf_counter()
    manifest, reports = execute(
        plan, lambda request: write_levels_of_files(request, sink, progress, arguments.sky)
    )
    if method.hushed and not plan.divided:
        manifest = replace(manifest, notes=(*plan.notes(), *manifest.notes))
    first, seconds = reports[0], time.perf_counter() - start
    made = {"reports": reports, "filters": first.filters, "total_seconds": seconds}
    return Run(manifest, record | made | {"dropped_nonfinite": first.dropped_nonfinite})


def print_plan(run: Run) -> None:
    """Print the plan of a dry run on stderr."""
    counts = ", ".join(f"{level['count']:,}" for level in run.files["levels"])
    beside = run.files["environment"]
    sky = f", and {_environment(beside['count'], beside['source'])}" if beside else ""
    text = f"{run.files['output']}: levels of {counts} splats{sky}"
    show_plan(run.report, text + run.report.condition)


def print_levels(run: Run, *, verbose: bool) -> None:
    """Print the levels on stderr.

    Args:
        run: The manifest with the files' names and the reports.
        verbose: Also print each level's report.
    """
    manifest, files = run.report, run.files
    reports = files["reports"]
    report_filters(files["filters"])
    warn_of_input(manifest.notes, files["dropped_nonfinite"])
    drawn = any(level.draws is not None for level in manifest.levels)
    switched = any(map(_switch, manifest.levels))
    show(err, _table(run, drawn=drawn, switched=switched))
    if manifest.protocol:
        text = f"PSNR in dB; means over {manifest.protocol.text}"
        text += "; draws: splats a pixel, as a share of the original's" * drawn
        err.print(text, markup=False, soft_wrap=True)
        if switched:
            err.print(
                "from: the distance, in scene units, at which a viewer begins to draw the level,"
                f" on {SCREEN} pixels and 45 degrees; there: PSNR and SSIM at that distance",
                markup=False, soft_wrap=True,
            )  # fmt: skip
    for number, report in enumerate(reports if verbose else []):
        err.print(f"level {number}")
        known = number and report.passes == reports[0].passes  # those of the one forest
        show_report(as_tried(replace(report, passes=()) if known else report))
    _say_totals(run)


def _table(run: Run, *, drawn: bool, switched: bool) -> Table:
    """Return the table of the levels.

    Args:
        run: As for `print_levels`.
        drawn: Whether draw costs were measured.
        switched: Whether quality was measured where viewers switch levels.
    """
    table = Table("level", box=None, pad_edge=False)
    more = ["draws"] * drawn + ["from", "there"] * switched
    for heading in ("asked", "splats", "file", "PSNR", "SSIM", *more, "seconds"):
        table.add_column(heading, justify="right")
    pairs = zip(run.report.levels, run.files["reports"], strict=True)
    for number, (level, report) in enumerate(pairs):
        draws = [NONE if level.draws is None else f"{level.draws:.1%}"] * drawn
        there = _switch_cells(_switch(level)) if switched else ()
        first = _heading(number, level, run.files["layout"])
        # In blocks, all levels are made together.
        seconds = NONE if report.blocks else f"{report.total_seconds:.2f}"
        table.add_row(first, *_cells(level), *draws, *there, seconds)
    return table


def _say_totals(run: Run) -> None:
    """Print what all levels take together, and what a viewer needs for its first picture."""
    manifest, files = run.report, run.files
    levels, sky = manifest.levels, manifest.environment
    if sky:
        text = _environment(sky.count, sky.source)
        say(f"{text}, {bytes_text(sky.bytes)}, drawn with every level")
    beside, further = (sky.bytes, sky.requests) if sky else (0, 0)
    place = Path(files["output"])  # if a file, the description of the levels, or all of them
    described = bytes_on_disk(place) if place.is_file() else 0
    taken = described
    if files["layout"] not in _ONE_FILE:
        taken += sum(level.bytes for level in levels) + beside
    made = f"{counted(len(levels), 'level')} in {files['output']}, {bytes_text(taken)}"
    whole = counted(manifest.source_count, "splat")
    say(f"{whole} {arrow()} {made}, {time_text(files['total_seconds'])}")
    folder = files["layout"] != LodLayout.ARCHIVE
    if folder and isinstance(coarsest := levels[-1], ChunkedLevel) and coarsest.requests:
        asked = counted(coarsest.requests + further + 1, "request")  # 1 for the manifest
        size = bytes_text(coarsest.bytes + beside + described)
        say(f"a viewer's first picture takes {asked} and {size}")
    if files["layout"] != LodLayout.FILES:
        command = shlex.join(["nanogs", "view", str(files["output"])])
        say(f"`{command}` makes a page of one level, to look at it")


def _switch(level: Level | ChunkedLevel) -> SwitchQuality | None:
    return level.switch if isinstance(level, ChunkedLevel) else None


def _switch_cells(switch: SwitchQuality | None) -> tuple[str, str]:
    """Format the distance at which a viewer switches to a level, and the scores there."""
    return (switch.distance_text, switch.marks) if switch else (NONE, NONE)


def _environment(count: int, source: str) -> str:
    found = "separated from the model" if source == AUTO else f"of {source}"
    return f"an environment of {counted(count, 'splat')}, {found}"


def _heading(number: int, level: Level | ChunkedLevel, layout: LodLayout) -> str:
    """Return a level's file, or its index, with its number of files unless one file has all."""
    if isinstance(level, Level):
        return level.file
    return str(number) if layout in _ONE_FILE else f"{number}, {counted(len(level.files), 'file')}"


def _cells(level: Level | ChunkedLevel) -> Iterator[str]:
    """Yield the cells of a level's counts and scores."""
    yield from (f"{level.ratio:g}", f"{level.count:,}", bytes_text(level.bytes))
    yield from (number_text(level.psnr), number_text(level.ssim, 4))

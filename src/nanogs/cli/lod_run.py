"""`nanogs lod`: plan the levels, make them, whole or in blocks, and show them."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rich.table import Table

from nanogs.ahead import compile_ahead
from nanogs.cli.console import arrow, err, say, show, show_report, warn
from nanogs.cli.filtering import report_filters
from nanogs.cli.importing import uncollected
from nanogs.cli.many import Run
from nanogs.cli.method import Method
from nanogs.cli.plan import Plan, plan_run, show_plan
from nanogs.cli.simplify_report import warn_of_input
from nanogs.clock import StageClock
from nanogs.formatting import bytes_text, counted, number_text, time_text
from nanogs.io.collect import Pair
from nanogs.io.folder import check_folder_writable
from nanogs.kernels.compiling import when_compiling
from nanogs.levels_of_detail import write_levels, write_levels_in_blocks, write_levels_stages
from nanogs.lod.folder import made_files
from nanogs.lod.layout import Layout, Output, chunks_of
from nanogs.lod.manifest import ChunkedLevel, Level, Manifest
from nanogs.pipeline.cameras import requested_cameras
from nanogs.pipeline.job import import_stages
from nanogs.pipeline.presets import renders
from nanogs.pipeline.reading import read_changed, reading_stages
from nanogs.pipeline.request import Request
from nanogs.pipeline.rows import Changes
from nanogs.pipeline.target import Goal, target_count
from nanogs.progress import Progress, Tracker
from nanogs.report import SimplifyReport


@dataclass(frozen=True, slots=True, kw_only=True)
class Wishes:
    """What is asked for, as the options say it.

    Attributes:
        wish: What is asked of the library for the finest level.
        method: What the options say of how.
        output: Where the levels go.
        ratios: From the finest level to the coarsest.
        chunk: Most splats of a chunk of the finest level, or None.
        plain: Whether the contents of 3D Tiles are not packed.
    """

    wish: Request
    method: Method
    output: Output
    ratios: tuple[float, ...]
    chunk: int | None
    plain: bool

    @property
    def given(self) -> dict[str, Any]:
        """What the library takes, whole models and blocks alike."""
        own = {"layout": self.output.layout, "suffix": self.output.suffix, "chunk": self.chunk}
        own |= {"plain": self.plain, "overwrite": self.wish.overwrite}
        return self.method.given | own


def run_levels(wishes: Wishes, pair: Pair, progress: Progress) -> Run:
    """Make levels, or plan to; the manifest with the reports.

    Raises:
        NanogsError: It cannot be done.
    """
    plan, method, output = _plan(wishes, pair.source), wishes.method, wishes.output
    if not method.hushed and (plan.divided or method.dry_run):
        for note in plan.notes():
            warn(note)
    if method.dry_run:
        shown = plan.shown()
        counts = [target_count(shown.info.splats, ratio, None) for ratio in wishes.ratios]
        asked = [{"ratio": r, "count": c} for r, c in zip(wishes.ratios, counts, strict=True)]
        told: dict[str, Any] = {
            "levels": asked,
            "layout": output.layout,
            "output": str(output.path),
        }
        return Run(shown, {"input": plan.name} | told)
    start = time.perf_counter()
    make = _in_blocks if plan.divided else _whole
    manifest, reports, took = make(wishes, plan, progress)
    run: dict[str, Any] = {
        "input": plan.name,
        "output": str(output.path),
        "filters": took,
        "reports": reports,
    }
    run |= {"layout": output.layout, "dropped_nonfinite": reports[0].dropped_nonfinite}
    return Run(manifest, run | {"total_seconds": time.perf_counter() - start})


def _plan(wishes: Wishes, source: Path) -> Plan:
    """Check what can be checked without the splats, and plan."""
    wish, output = wishes.wish, wishes.output
    wish = replace(wish, inputs=(source, *wish.inputs[1:]))  # stdin is a file by now
    if not wish.goes_on():
        check_folder_writable(output.folder, made_files, overwrite=wish.overwrite)
    goals = [Goal(ratio=ratio) for ratio in wishes.ratios]
    chunks = chunks_of(output.layout, wishes.chunk, plain=wishes.plain)
    return plan_run(wish, wishes.method, goals, chunks)


def _in_blocks(
    wishes: Wishes, plan: Plan, progress: Progress
) -> tuple[Manifest, Sequence[SimplifyReport], Sequence[Any]]:
    """Make levels of a model that does not fit; with what filters took."""
    from nanogs.pipeline.stored_job import Where  # which brings Numba

    wish = plan.wish
    with plan.executor() as executor:
        manifest, reports = write_levels_in_blocks(
            wish.inputs, wish.output, wishes.ratios, max_memory=plan.process_memory,
            job=wish.job, scratch=wish.scratch, resume=wish.resume, changes=wish.changes,
            where=Where(wish.threads, executor, wish.patience), progress=progress,
            **wishes.given,
        )  # fmt: skip
    return manifest, reports, reports[0].filters


def _whole(
    wishes: Wishes, plan: Plan, told: Progress
) -> tuple[Manifest, Sequence[SimplifyReport], Sequence[Any]]:
    """Read, and make every level; with what filters took."""
    wish, splats, output = plan.wish, plan.info.splats, wishes.output
    chosen, measured = wish.parameters, plan.method.measured
    with uncollected():
        import_stages(chosen)
    if renders(chosen) or measured:
        when_compiling(compile_ahead)
    stages = write_levels_stages(
        chosen, splats, wishes.ratios, output.layout, output.suffix, measured=measured
    )
    changes = Changes(wish.filters, wish.sh_degree, wish.frame)
    progress = Tracker(told, [*reading_stages(changes, splats), *stages])
    prepared = read_changed(wish.inputs, changes, progress, StageClock())
    manifest, reports = write_levels(
        prepared.splats,
        output.folder,
        wishes.ratios,
        source=", ".join(part.name for part in wish.inputs),
        frame=wish.frame,
        measured=measured,
        cameras=requested_cameras(prepared.splats, plan.method.cameras, wish.up, chosen),
        threads=wish.threads,
        max_memory=wish.max_memory,
        progress=progress.passing(),
        **wishes.given,
    )
    notes = (*plan.notes(), *manifest.notes, *prepared.notes)
    return replace(manifest, notes=notes), reports, prepared.took


def print_plan(run: Run) -> None:
    """Show on stderr what would be made."""
    counts = ", ".join(f"{level['count']:,}" for level in run.files["levels"])
    show_plan(run.report, f"{run.files['output']}: levels of {counts} splats")


def print_levels(run: Run, *, verbose: bool, chosen: bool) -> None:
    """Show on stderr the levels that were made.

    Args:
        run: The manifest with the files' names and the reports.
        verbose: Show how each came to be too.
        chosen: Whether the levels are those that were asked for, and not the default.
    """
    manifest, files = run.report, run.files
    levels, reports = manifest.levels, files["reports"]
    report_filters(files["filters"])
    warn_of_input(manifest.notes, files["dropped_nonfinite"])
    if levels[0].ratio < 1 and not chosen:
        ratios = ",".join(f"{level.ratio:g}" for level in levels)
        warn(
            f"The finest level has {levels[0].count:,} of {manifest.source_count:,} splats;"
            f" --levels 1,{ratios} has all of them too."
        )
    table = Table("level", box=None, pad_edge=False)
    for heading in ("asked", "splats", "file", "PSNR", "SSIM", "seconds"):
        table.add_column(heading, justify="right")
    for number, (level, report) in enumerate(zip(levels, reports, strict=True)):
        table.add_row(*_cells(number, level), f"{report.total_seconds:.2f}")
    show(err, table)
    if manifest.protocol:
        text = f"PSNR in dB; means over {manifest.protocol.text}"
        err.print(text, markup=False, soft_wrap=True)
    for number, report in enumerate(reports if verbose else []):
        err.print(f"level {number}")
        show_report(report)
    size = bytes_text(sum(level.bytes for level in levels))
    made = f"{counted(len(levels), 'level')} in {files['output']}, {size}"
    whole = counted(manifest.source_count, "splat")
    say(f"{whole} {arrow()} {made}, {time_text(files['total_seconds'])}")
    if files["layout"] != Layout.FILES:
        say(f"`nanogs view {files['output']}` makes a page of one level, to look at it")


def _cells(number: int, level: Level | ChunkedLevel) -> Iterator[str]:
    """A level's file, or its number and that of its files; and what there is to say of it."""
    if isinstance(level, Level):
        yield level.file
    else:
        yield f"{number}, {counted(len(level.files), 'file')}"
    yield from (f"{level.ratio:g}", f"{level.count:,}", bytes_text(level.bytes))
    yield from (number_text(level.psnr), number_text(level.ssim, 4))

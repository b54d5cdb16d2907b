"""`nanogs lod` of a model that fits into memory, and how its levels are shown."""

import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.table import Table

from nanogs.ahead import compile_ahead
from nanogs.cli.console import arrow, err, key_value_table, print_json, say, show, warn
from nanogs.cli.filtering import report_filters
from nanogs.cli.importing import uncollected
from nanogs.cli.progress import shown
from nanogs.cli.reading import Reading
from nanogs.cli.simplify_report import (
    Plan,
    choice_text,
    describe_plan,
    print_divided,
    refit_text,
    show_plan,
    warn_of_input,
)
from nanogs.clock import StageClock
from nanogs.formatting import bytes_text, counted, number_text, time_text
from nanogs.kernels.compiling import when_compiling
from nanogs.lod.layout import Layout, Output
from nanogs.pipeline.cameras import requested_cameras
from nanogs.pipeline.job import import_stages
from nanogs.pipeline.presets import renders
from nanogs.pipeline.target import target_count
from nanogs.pipeline.write_levels import write_levels, write_levels_stages
from nanogs.progress import Tracker
from nanogs.protocol import Protocol

if TYPE_CHECKING:
    from nanogs.pipeline.plan import ScalePlan


def write_whole(
    plan: Plan,
    parts: Sequence[Path],
    read: Reading,
    output: Output,
    ratios: tuple[float, ...],
    overwrite: bool,
    cameras: str,
    up: tuple[float, float, float] | None,
    given: dict[str, Any],
    quiet: bool,
) -> dict[str, Any]:
    """Read, and make every level; the manifest with the files' names and the reports."""
    start, info = time.perf_counter(), plan.info
    with uncollected():
        import_stages(plan.parameters)
    if renders(plan.parameters) or plan.measured:
        when_compiling(compile_ahead)
    layout = given["layout"]
    stages = write_levels_stages(
        plan.parameters, info.splats, ratios, layout, output.suffix, measured=plan.measured
    )
    with shown(quiet=quiet) as watch:
        progress = Tracker(watch, [*read.stages(info.splats), *stages])
        prepared = read.load(parts, progress, StageClock())
        splats = prepared.splats
        manifest, reports = write_levels(
            splats,
            output.folder,
            ratios,
            source=", ".join(part.name for part in parts),
            suffix=output.suffix,
            overwrite=overwrite,
            cameras=requested_cameras(splats, cameras, up, plan.parameters),
            progress=progress.passing(),
            **given,
        )
    run = manifest.to_dict() | {"input": ", ".join(map(str, parts))}
    run |= {"output": str(output.path), "filters": [asdict(each) for each in prepared.took]}
    run["notes"] = [*run["notes"], *prepared.notes]
    run["layout"] = output.layout.value
    run["dropped_nonfinite"] = reports[0].dropped_nonfinite
    run["reports"] = [report.to_dict() for report in reports]
    return run | {"total_seconds": time.perf_counter() - start}


def print_levels_plan(
    plan: Plan,
    output: Output,
    ratios: tuple[float, ...],
    divided: "ScalePlan | None",
    *,
    json: bool,
) -> None:
    """Show what would be made."""
    counts = [target_count(plan.info.splats, ratio, None) for ratio in ratios]
    asked = [{"ratio": r, "count": c} for r, c in zip(ratios, counts, strict=True)]
    text = f"{output.path}: levels of {', '.join(f'{c:,}' for c in counts)} splats"
    told = {"levels": asked, "layout": output.layout.value}
    if divided is None:
        show_plan(plan, told, text, json=json)
    elif json:
        print_json(describe_plan(plan, told) | {"blocks": asdict(divided)})
    else:
        from nanogs.cli.in_blocks import plan_rows

        print_divided(plan, text)
        plan_rows(divided)


def print_levels(run: dict[str, Any], *, verbose: bool, chosen: bool) -> None:
    """Show on stderr the levels that were made.

    Args:
        run: The manifest with the files' names and the reports.
        verbose: Show how each came to be too.
        chosen: Whether the levels are those that were asked for, and not the default.
    """
    report_filters(run)
    warn_of_input(run)
    finest = run["levels"][0]
    if finest["ratio"] < 1 and not chosen:
        ratios = ",".join(f"{level['ratio']:g}" for level in run["levels"])
        warn(
            f"The finest level has {finest['count']:,} of {run['source_count']:,} splats; --levels"
            f" 1,{ratios} has all of them too."
        )
    table = Table("level", box=None, pad_edge=False)
    for heading in ("asked", "splats", "file", "PSNR", "SSIM", "seconds"):
        table.add_column(heading, justify="right")
    for number, level in enumerate(run["levels"]):
        table.add_row(
            _name(number, level),
            f"{level['ratio']:g}",
            f"{level['count']:,}",
            bytes_text(level["bytes"]),
            number_text(level["psnr"]),
            number_text(level["ssim"], 4),
            f"{run['reports'][number]['total_seconds']:.2f}",
        )
    show(err, table)
    if run["protocol"]:
        text = f"PSNR in dB; means over {Protocol(**run['protocol']).text}"
        err.print(text, markup=False, soft_wrap=True)
    for number, report in enumerate(run["reports"] if verbose else []):
        show(err, key_value_table({f"level {number}": ""} | _details(report)))
    levels = counted(len(run["levels"]), "level")
    size = bytes_text(sum(level["bytes"] for level in run["levels"]))
    seconds = time_text(run["total_seconds"])
    whole = counted(run["source_count"], "splat")
    say(f"{whole} {arrow()} {levels} in {run['output']}, {size}, {seconds}")
    if run["layout"] != Layout.FILES.value:
        say(f"`nanogs view {run['output']}` makes a page of one level, to look at it")


def _details(report: dict[str, Any]) -> dict[str, str]:
    """How a level was made: passes, what was chosen, and where its time went."""
    stages = ", ".join(f"{name} {value:.2f}" for name, value in report["seconds"].items())
    rows = {
        "passes": f"{len(report['passes'])}" if report["passes"] else "",
        "chosen": choice_text(report["candidates"]),
        "fitted": refit_text(report["refit"]),
        "stages (s)": stages,
    }
    return {f"  {name}": text for name, text in rows.items() if text}


def _name(number: int, level: dict[str, Any]) -> str:
    """A level's file, or its number and that of its files."""
    if "file" in level:
        return str(level["file"])
    return f"{number}, {counted(len(level['files']), 'file')}"

"""Printing of the report of `nanogs simplify`."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from nanogs.cli.console import arrow, say, show_report, warn
from nanogs.cli.filtering import report_filters
from nanogs.cli.many import Run
from nanogs.formatting import bytes_text, counted, sizes_text, time_text
from nanogs.io import registry
from nanogs.pipeline.options.presets import effective, parameters
from nanogs.report import SimplifyReport, measures


def warn_of_input(notes: Iterable[str], dropped: int) -> None:
    """Print the notes, and the number of splats left out because they are not finite."""
    for note in notes:
        warn(note)
    if dropped:
        left = "was" if dropped == 1 else "were"
        held = counted(dropped, "splat holds", "splats hold")
        warn(f"{held} a NaN or infinite value and {left} left out.")


def print_report(run: Run, *, verbose: bool) -> None:
    """Print the result in one line on stderr; with `verbose`, also the whole report."""
    report: SimplifyReport = run.report
    report_filters(report.filters)
    warn_of_input(report.notes, report.dropped_nonfinite)
    if report.prune_limited:
        warn(
            "Pruning alone would have gone below the requested count; the most opaque splats were"
            " kept."
        )
    if verbose:
        counts = {"input": report.read_count, "output": report.achieved_count}
        show_report(
            as_tried(report), {end: _file_text(run, end, count) for end, count in counts.items()}
        )
    say(summary(run))


def as_tried(report: SimplifyReport) -> SimplifyReport:
    """Return the report with the parameters that had an effect, and every balance tried."""
    return replace(report, parameters=effective(parameters(report.preset, report.parameters)))


def _file_text(run: Run, end: str, splats: int) -> str:
    size = bytes_text(run.files[f"{end}_bytes"])
    return f"{run.files[end]}: {counted(splats, 'splat')}, {size}"


def summary(run: Run) -> str:
    """Format the result: "500,000 → 50,000 splats in b.ply, 76.0 → 1.2 MB, 6 s", PSNR if known."""
    files, report, to = run.files, run.report, arrow()
    made = counted(report.achieved_count, "splat")
    given = report.format_options.items()
    chosen = " ".join(f"--{name.replace('_', '-')} {value}" for name, value in given)
    parts = [
        f"{report.read_count:,} {to} {made} in {files['output']}"
        + (f" ({chosen})" if chosen else ""),
        sizes_text(files["input_bytes"], files["output_bytes"], to) + _formats_text(run, to),
        *measures(report),
        time_text(report.total_seconds),
    ]
    return ", ".join(part for part in parts if part)


def _formats_text(run: Run, to: str) -> str:
    """Return a change of format that explains a larger file, such as " (.sog → .ply)"; else ""."""
    files = run.files
    if files["output_bytes"] <= files["input_bytes"]:
        return ""
    known = [registry.find(Path(files[end])) for end in ("input", "output")]
    names = [each.suffix for each in known if each]
    return f" ({names[0]} {to} {names[1]})" if len(set(names)) == 2 else ""

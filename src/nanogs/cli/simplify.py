"""`nanogs simplify`."""

import time
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from nanogs.cli.console import count_down, print_json, warn
from nanogs.cli.simplify_report import print_plan, print_report
from nanogs.io import check_writable, inspect, load, save
from nanogs.report import StageClock, StopReason
from nanogs.simplify.api import simplify as library_simplify
from nanogs.simplify.presets import DEFAULT_PRESET, PRESETS, parameters
from nanogs.simplify.target import target_count

_METHOD = "Parameters of the method (each replaces the preset's value)"


class Nan(StrEnum):
    """What to do with splats that hold a NaN or an infinite value."""

    drop = "drop"
    error = "error"


def simplify(
    source: Annotated[Path, typer.Argument(metavar="IN", help="Model to read.")],
    target: Annotated[Path, typer.Argument(metavar="OUT", help="File to write.")],
    ratio: Annotated[
        float | None, typer.Option("--ratio", "-r", help="Share of the splats to keep, e.g. 0.1.")
    ] = None,
    count: Annotated[
        int | None, typer.Option("--count", "-n", help="Number of splats to keep.")
    ] = None,
    preset: Annotated[str, typer.Option(help=f"Method: {', '.join(PRESETS)}.")] = DEFAULT_PRESET,
    nan: Annotated[
        Nan, typer.Option(help="Splats with a NaN or infinite value: leave out, or stop.")
    ] = Nan.drop,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", "-w", help="Replace OUT if it exists.")
    ] = False,
    threads: Annotated[
        int | None, typer.Option(min=1, help="Threads to use.", show_default="all")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Report as JSON on stdout.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing but errors.")] = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Show every pass.")] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what would be done and how much memory it takes.")
    ] = False,
    tau: Annotated[
        float | None, typer.Option(help="Prune alpha below this.", rich_help_panel=_METHOD)
    ] = None,
    k: Annotated[
        int | None, typer.Option(help="Neighbours in the graph.", rich_help_panel=_METHOD)
    ] = None,
    samples: Annotated[
        int | None, typer.Option(help="Samples in the divergence.", rich_help_panel=_METHOD)
    ] = None,
    seed: Annotated[
        int | None, typer.Option(help="Seed of the samples.", rich_help_panel=_METHOD)
    ] = None,
    lambda_geo: Annotated[
        float | None, typer.Option(help="Weight of the geometry.", rich_help_panel=_METHOD)
    ] = None,
    lambda_app: Annotated[
        float | None, typer.Option(help="Weight of the colours.", rich_help_panel=_METHOD)
    ] = None,
    merge_cap: Annotated[
        float | None, typer.Option(help="Largest share merged in a pass.", rich_help_panel=_METHOD)
    ] = None,
) -> None:
    """Make a smaller model of the same scene, with exactly the count asked for."""
    overrides = {
        "tau": tau, "k": k, "samples": samples, "seed": seed,
        "lambda_geo": lambda_geo, "lambda_app": lambda_app, "merge_cap": merge_cap,
    }  # fmt: skip
    # Whatever can be refused is refused here, before minutes of computing.
    chosen = parameters(preset, overrides)
    info = inspect(source)
    goal = target_count(info.splats, ratio, count)
    check_writable(target, overwrite=overwrite)
    if dry_run:
        print_plan(info, goal, preset, chosen, json=json)
        return
    options: dict[str, Any] = {"ratio": ratio, "count": count, "preset": preset, **overrides}
    options |= {"nan": nan.value, "threads": threads}
    run = _simplify_file(source, target, overwrite, options, info.splats, goal, quiet or json)
    if json:
        print_json(run)
    elif not quiet:
        print_report(run, verbose=verbose)
    if run["stop"] != StopReason.TARGET:
        warn(f"Stopped before the asked count: {run['stop']}.")
        raise typer.Exit(3)


def _simplify_file(
    source: Path,
    target: Path,
    overwrite: bool,
    options: dict[str, Any],
    count: int,
    goal: int,
    quiet: bool,
) -> dict[str, Any]:
    """Read, simplify and write; the report with the files' names and the seconds of I/O."""
    start = time.perf_counter()
    clock = StageClock()
    with count_down(count, goal, quiet=quiet) as progress:
        progress("read", count)
        with clock.time("read"):
            splats = load(source)
        small, report = library_simplify(splats, progress=progress, **options)
        progress("write", len(small))
        with clock.time("write"):
            save(small, target, overwrite=overwrite)
    run = report.to_dict()
    run["seconds"] = {
        "read": clock.seconds["read"],
        **run["seconds"],
        "write": clock.seconds["write"],
    }
    run["total_seconds"] = time.perf_counter() - start
    run |= {"input": str(source), "output": str(target)}
    run |= {"input_bytes": source.stat().st_size, "output_bytes": target.stat().st_size}
    return run

"""`nanogs simplify`."""

import time
from pathlib import Path
from typing import Annotated, Any

import typer

from nanogs.cli import method, options
from nanogs.cli.console import count_down, print_json, warn, with_file_seconds
from nanogs.cli.simplify_report import Plan, print_plan, print_report, stop_text
from nanogs.io import check_writable, inspect, load, losses, registry, save
from nanogs.report import StageClock, StopReason
from nanogs.simplify.api import simplify as library_simplify
from nanogs.simplify.api import target_of
from nanogs.simplify.cameras import requested_cameras
from nanogs.simplify.job import usable_rows
from nanogs.simplify.presets import DEFAULT_PRESET, Parameters, parameters, refuse_psnr
from nanogs.simplify.target import Goal


def simplify(
    source: Annotated[Path, typer.Argument(metavar="IN", help="Model to read.")],
    target: Annotated[Path, typer.Argument(metavar="OUT", help="File to write.")],
    ratio: Annotated[
        float | None, typer.Option("--ratio", "-r", help="Share of the splats to keep, e.g. 0.1.")
    ] = None,
    count: Annotated[
        int | None, typer.Option("--count", "-n", help="Number of splats to keep.")
    ] = None,
    size: Annotated[
        str | None,
        typer.Option(help="Largest size of OUT, e.g. 20MB or 20MiB: as many splats as fit."),
    ] = None,
    psnr: Annotated[
        float | None,
        typer.Option(help="dB to reach on views of the original, e.g. 35: the fewest that do."),
    ] = None,
    preset: method.Preset = DEFAULT_PRESET,
    nan: method.NanOption = method.Nan.drop,
    overwrite: options.Overwrite = False,
    threads: options.Threads = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Show every pass and probe.")
    ] = False,
    dry_run: method.DryRun = False,
    views: method.Views = None,
    cameras: options.Cameras = "auto",
    up: options.Up = None,
    k: method.K = None,
    lambda_app: method.LambdaApp = None,
    balance: method.Balance = None,
    rounds: method.Rounds = None,
    refit: method.Refit = False,
    tau: method.Tau = None,
    samples: method.Samples = None,
    seed: method.Seed = None,
    lambda_geo: method.LambdaGeo = None,
    merge_cap: method.MergeCap = None,
) -> None:
    """Make a smaller model of the same scene: of a ratio, a count, a file size or a PSNR."""
    overrides: dict[str, Any] = {
        "k": k, "lambda_app": lambda_app, "balance": balance, "rounds": rounds,
        "refit": refit or None, "views": views, "tau": tau, "samples": samples, "seed": seed,
        "lambda_geo": lambda_geo, "merge_cap": merge_cap,
    }  # fmt: skip
    # Whatever can be refused is refused here, before minutes of computing.
    chosen = parameters(preset, overrides)
    goal = Goal(ratio, count, None if size is None else options.parse_bytes(size), psnr)
    if psnr is not None:
        refuse_psnr(preset)
    direction = method.check_views(preset, chosen, views, cameras, up, judged=psnr is not None)
    plan = _plan(source, target, goal, preset, chosen, nan, overwrite=overwrite, dry_run=dry_run)
    if dry_run:
        print_plan(plan, json=json)
        return
    given = {name: value for name, value in overrides.items() if value is not None}
    given |= {"preset": preset, "nan": nan.value, "threads": threads}
    run = _simplify_file(plan, target, overwrite, cameras, direction, given, quiet or json)
    if json:
        print_json(run)
    elif not quiet:
        print_report(run, verbose=verbose)
    if run["stop"] != StopReason.TARGET:
        warn(stop_text(run))
        raise typer.Exit(3)


def _plan(
    source: Path,
    target: Path,
    goal: Goal,
    preset: str,
    chosen: Parameters,
    nan: method.Nan,
    *,
    overwrite: bool,
    dry_run: bool,
) -> Plan:
    """Check the files and the goal; the count that it comes to, where that is known yet."""
    info = inspect(source)
    check_writable(target, overwrite=overwrite)
    if goal.size is None:
        count = goal.target(info.splats, lambda _count: 0)
    elif dry_run:  # what a row takes is only known from the columns
        splats = load(source)
        count = target_of(goal, splats, len(usable_rows(splats, nan.value)), _suffix(target))
    else:
        count = None
    return Plan(info, goal, count, preset, chosen)


def _suffix(target: Path) -> str:
    known = registry.find(target)
    return known.suffix if known else target.suffix


def _simplify_file(
    plan: Plan,
    target: Path,
    overwrite: bool,
    cameras: str,
    up: tuple[float, float, float] | None,
    given: dict[str, Any],
    quiet: bool,
) -> dict[str, Any]:
    """Read, simplify and write; the report with the files' names and the seconds of I/O."""
    start, clock, goal, source = time.perf_counter(), StageClock(), plan.goal, plan.info.path
    with count_down(plan.info.splats, plan.count or 1, quiet=quiet) as progress:
        progress("read", plan.info.splats)
        with clock.time("read"):
            splats = load(source)
        small, report = library_simplify(
            splats,
            ratio=goal.ratio,
            count=goal.count,
            size=goal.size,
            psnr=goal.psnr,
            format=_suffix(target),
            cameras=requested_cameras(splats, cameras, up, plan.parameters),
            progress=progress,
            **given,
        )
        progress("write", len(small))
        with clock.time("write"):
            save(small, target, overwrite=overwrite)
    run = with_file_seconds(report.to_dict(), clock, start)
    run["notes"] = [*run["notes"], *losses(small, target)]
    run |= {"input": str(source), "output": str(target)}
    run |= {"input_bytes": plan.info.file_bytes, "output_bytes": inspect(target).file_bytes}
    return run

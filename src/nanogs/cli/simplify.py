"""`nanogs simplify`."""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Annotated, Any

import typer

from nanogs.ahead import compile_ahead
from nanogs.cli import blocks as scale
from nanogs.cli import filtering, framing, many, method, options, streams
from nanogs.cli.console import count_down, warn, with_file_seconds
from nanogs.cli.simplify_report import (
    Plan,
    plan_json,
    print_plan,
    print_report,
    print_wish,
    stop_text,
)
from nanogs.errors import OptionError
from nanogs.filters import Filter, FilterReport, apply
from nanogs.frames import change_frame
from nanogs.io import bytes_on_disk, check_writable, inspect, load, losses, registry, save
from nanogs.io.collect import Pair
from nanogs.kernels.compiling import when_compiling
from nanogs.report import StageClock, StopReason
from nanogs.scale.settings import PATIENCE
from nanogs.scale.source import load_joined
from nanogs.simplify.api import refuse_searches, target_of
from nanogs.simplify.api import simplify as library_simplify
from nanogs.simplify.cameras import requested_cameras
from nanogs.simplify.job import usable_rows
from nanogs.simplify.presets import DEFAULT_PRESET, Parameters, parameters, renders
from nanogs.simplify.target import Goal


def simplify(
    paths: many.Paths,
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
    frame: framing.FrameOption = None,
    spz_version: options.SpzVersion = None,
    overwrite: options.Overwrite = False,
    threads: options.Threads = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Show every pass and probe.")
    ] = False,
    dry_run: method.DryRun = False,
    out_dir: many.OutDir = None,
    out_format: many.FormatOption = None,
    read_as: streams.From = None,
    write_as: streams.To = None,
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
    crop: filtering.Crop = None,
    min_opacity: filtering.MinOpacity = None,
    drop_floaters: filtering.DropFloaters = False,
    max_memory: scale.MaxMemory = None,
    join: scale.Join = False,
    job: scale.JobFolder = None,
    resume: scale.Resume = False,
    scratch: scale.Scratch = None,
    workers: scale.Workers = None,
    scheduler: scale.Scheduler = None,
    patience: scale.Patience = PATIENCE,
) -> None:
    """Make a smaller model of the same scene: of a ratio, a count, a file size or a PSNR."""
    overrides: dict[str, Any] = {
        "k": k, "lambda_app": lambda_app, "balance": balance, "rounds": rounds,
        "refit": refit or None, "views": views, "tau": tau, "samples": samples, "seed": seed,
        "lambda_geo": lambda_geo, "merge_cap": merge_cap,
    }  # fmt: skip
    # Whatever can be refused is refused here, before minutes of computing.
    given = {name: value for name, value in overrides.items() if value is not None}
    chosen = parameters(preset, overrides)
    request = _Request(
        goal=Goal(ratio, count, None if size is None else options.parse_bytes(size), psnr),
        preset=preset,
        chosen=chosen,
        filters=filtering.parse_filters(crop, min_opacity, drop_floaters=drop_floaters),
        saving={"overwrite": overwrite, "spz_version": spz_version},
        frames=framing.parse_frames(frame),
        cameras=cameras,
        up=method.check_views(preset, chosen, views, cameras, up, judged=psnr is not None),
        given=given | {"preset": preset, "nan": nan.value, "threads": threads},
        quiet=quiet or json,
        folder_later=out_dir is not None and not out_dir.exists(),
        blocks=scale.parse_blocks(
            paths,
            max_memory,
            join=join,
            job=job,
            resume=resume,
            scratch=scratch,
            workers=workers,
            scheduler=scheduler,
            patience=patience,
        ),
        looks=views is not None or cameras != "auto" or up is not None,
    )

    def plan_one(pair: Pair) -> dict[str, Any]:
        plan = _plan(pair, request, dry_run=True)
        divided = None
        if request.blocks.needed(plan):
            divided = scale.plan_of(pair, plan, request.blocks, nan.value)
        if not json and divided is None:
            print_plan(plan)
        elif not json and divided is not None:
            print_wish(plan)
            scale.plan_rows(divided)
        return plan_json(plan) | {"blocks": asdict(divided) if divided else None}

    def run_one(pair: Pair) -> dict[str, Any]:
        plan = _plan(pair, request, dry_run=False)
        if request.blocks.needed(plan):
            options = {"overwrite": overwrite, "spz_version": spz_version}
            return scale.simplify_in_blocks(
                pair, plan, request.blocks, request.given | options, quiet=request.quiet
            )
        return _simplify_file(plan, pair, request)

    def show(run: dict[str, Any]) -> None:
        print_report(run, verbose=verbose)

    parts = [paths[0], paths[-1]] if join else paths
    pairs = many.plan_pairs(parts, out_dir, out_format)
    pipes = streams.Streams(read_as, write_as)
    if dry_run:
        many.run_all(
            pairs, plan_one, _nothing, out_dir, pipes, json=json, quiet=quiet, writes=False
        )
        return
    runs = many.run_all(pairs, run_one, show, out_dir, pipes, json=json, quiet=quiet)
    _exit_if_short(runs)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Request:
    """What is asked for every file.

    Attributes:
        goal: The wish.
        preset: Name of the preset.
        chosen: Parameters of the method.
        filters: To apply first.
        saving: What `save` takes.
        frames: From and to where the result is turned, as given, or None.
        cameras: As `requested_cameras` takes it.
        up: Up direction of automatic views, or None.
        given: What the library's `simplify` takes beside.
        quiet: Whether no progress is shown.
        folder_later: Whether the folder of the results is still to be made.
        blocks: How a model is treated that does not fit into memory.
        looks: Whether views are asked for.
    """

    goal: Goal
    preset: str
    chosen: Parameters
    filters: Sequence[Filter]
    saving: dict[str, Any]
    frames: framing.Frames | None
    cameras: str
    up: tuple[float, float, float] | None
    given: dict[str, Any]
    quiet: bool
    folder_later: bool
    blocks: scale.Blocks
    looks: bool


def _nothing(_run: dict[str, Any]) -> None:
    pass


def _exit_if_short(runs: list[dict[str, Any]]) -> None:
    """Say which results are not what was asked for, and leave with exit code 3."""
    short = [run for run in runs if run["stop"] != StopReason.TARGET]
    for run in short:
        warn(stop_text(run) if len(runs) == 1 else f"{run['output']}: {stop_text(run)}")
    if short:
        raise typer.Exit(3)


def _plan(pair: Pair, request: _Request, *, dry_run: bool) -> Plan:
    """Check the files and the goal; the count that it comes to, where that is known yet."""
    goal, filters = request.goal, request.filters
    refuse_searches(goal, request.preset, pair.target)
    frames = framing.frames_of(pair, request.frames)
    if frames and goal.size is not None and not registry.has_known_size(pair.target):
        raise OptionError(
            f"--frame changes the size of a {pair.target.suffix} file that --size has found; turn"
            " it with `nanogs convert` before."
        )
    info, blocks = inspect(pair.source), request.blocks
    if blocks.joined:
        info = replace(info, splats=sum(inspect(path).splats for path in blocks.joined))
    begun = blocks.is_begun(pair.target, overwrite=request.saving["overwrite"])
    if not (dry_run and request.folder_later) and not begun:
        check_writable(pair.target, **request.saving)
    whole = Plan(info, goal, None, request.preset, request.chosen)
    if blocks.needed(whole):
        scale.refuse_whole_model_wishes(
            whole, filtered=bool(filters), looks=request.looks, turned=bool(frames)
        )
    else:
        blocks.refuse_fitting(pair.target)
    if goal.size is None and not (filters and dry_run):
        count = goal.target(info.splats, lambda _count: 0)
    elif dry_run:  # what a row takes and what filters leave is only known from the columns
        splats, _ = apply(load(pair.source), filters)
        info = replace(info, splats=len(splats))
        usable = usable_rows(splats, request.given["nan"])
        count = target_of(goal, splats, len(usable), pair.target)
    else:
        count = None
    return Plan(info, goal, count, request.preset, request.chosen)


def _simplify_file(plan: Plan, pair: Pair, request: _Request) -> dict[str, Any]:
    """Read, simplify and write; the report with the files' names and the seconds of I/O."""
    start, clock, goal = time.perf_counter(), StageClock(), plan.goal
    source, target, saving = pair.source, pair.target, request.saving
    known = registry.find(target)
    if renders(plan.parameters):
        when_compiling(compile_ahead)
    with count_down(plan.info.splats, plan.count or 1, quiet=request.quiet) as progress:
        progress("read", plan.info.splats)
        with clock.time("read"):
            joined = request.blocks.joined
            splats = load_joined(joined) if joined else load(source)
        took: Sequence[FilterReport] = ()
        if request.filters:
            progress("filter", len(splats))
            with clock.time("filter"):
                splats, took = apply(splats, request.filters)
        small, report = library_simplify(
            splats,
            ratio=goal.ratio,
            count=goal.count,
            size=goal.size,
            psnr=goal.psnr,
            format=known.suffix if known else target.suffix,
            format_options={"spz_version": saving["spz_version"]},
            cameras=requested_cameras(splats, request.cameras, request.up, request.chosen),
            progress=progress,
            **request.given,
        )
        if frames := framing.frames_of(pair, request.frames):
            small = change_frame(small, *frames)
        progress("write", len(small))
        with clock.time("write"):
            save(small, target, **saving)
    run = with_file_seconds(report.to_dict(), clock, start)
    run["notes"] = [*run["notes"], *losses(small, target)]
    run |= {"read_count": plan.info.splats, "filters": [asdict(report) for report in took]}
    run["frames"] = frames
    run |= {"input": str(source), "output": str(target)}
    run |= {"input_bytes": plan.info.file_bytes, "output_bytes": bytes_on_disk(target)}
    return run

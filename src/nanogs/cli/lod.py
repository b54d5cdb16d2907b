"""`nanogs lod`."""

import time
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from nanogs.ahead import compile_ahead
from nanogs.cli import blocks as scale
from nanogs.cli import method, options
from nanogs.cli.console import count_down, err, print_json, show, warn
from nanogs.cli.simplify_report import (
    Plan,
    describe_plan,
    print_divided,
    show_plan,
    warn_of_input,
)
from nanogs.formatting import bytes_text, number_text
from nanogs.io import inspect, load
from nanogs.io.folder import check_folder_writable
from nanogs.kernels.compiling import when_compiling
from nanogs.lod.chunks import CHUNK
from nanogs.lod.layout import Output, check_options, made_files, output_of
from nanogs.lod.levels import check_ratios
from nanogs.lod.write import write_levels
from nanogs.report import StopReason
from nanogs.scale.plan import ScalePlan
from nanogs.scale.settings import PATIENCE
from nanogs.simplify.cameras import requested_cameras
from nanogs.simplify.presets import DEFAULT_PRESET, parameters, renders
from nanogs.simplify.target import Goal, target_count


def lod(
    source: Annotated[Path, typer.Argument(metavar="IN", help="Model to read.")],
    target: Annotated[
        Path,
        typer.Argument(
            metavar="OUT",
            help="Folder to make, for .ply files; or lod-meta.json (streamed SOG) or tileset.json"
            " (3D Tiles) in it.",
        ),
    ],
    levels: Annotated[
        str, typer.Option(help="Ratios from the finest level to the coarsest, commas between.")
    ] = "0.5,0.25,0.1,0.01",
    preset: method.Preset = DEFAULT_PRESET,
    nan: method.NanOption = method.Nan.drop,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", "-w", help="Replace the folder if nanogs lod made it.")
    ] = False,
    chunk: Annotated[
        int | None,
        typer.Option(
            help="Most splats of a chunk of the finest level, in streamed SOG and 3D Tiles.",
            show_default=str(CHUNK),
        ),
    ] = None,
    spz: Annotated[
        bool, typer.Option("--spz", help="3D Tiles with contents packed as CesiumJS draws them.")
    ] = False,
    threads: options.Threads = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
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
    max_memory: scale.MaxMemory = None,
    job: scale.JobFolder = None,
    resume: scale.Resume = False,
    scratch: scale.Scratch = None,
    workers: scale.Workers = None,
    scheduler: scale.Scheduler = None,
    patience: scale.Patience = PATIENCE,
) -> None:
    """Make levels of detail from one build: a file each, or chunks for a viewer that streams.

    OUT/level_0.ply, the finest, and so on are the files that `nanogs simplify --ratio` writes, and
    levels.json says what is in the folder. OUT/lod-meta.json makes streamed SOG of the levels,
    OUT/tileset.json 3D Tiles 1.1.
    """
    overrides: dict[str, Any] = {
        "k": k, "lambda_app": lambda_app, "balance": balance, "rounds": rounds,
        "refit": refit or None, "views": views, "tau": tau, "samples": samples, "seed": seed,
        "lambda_geo": lambda_geo, "merge_cap": merge_cap,
    }  # fmt: skip
    # Whatever can be refused is refused here, before minutes of computing.
    chosen = parameters(preset, overrides)
    ratios = options.parse_ratios(levels)
    check_ratios(ratios)
    output = output_of(target)
    check_options(output.layout, chunk, spz=spz)
    direction = method.check_views(preset, chosen, views, cameras, up, judged=False)
    blocks = scale.parse_blocks(
        [source], max_memory, join=False, job=job, resume=resume, scratch=scratch,
        workers=workers, scheduler=scheduler, patience=patience,
    )  # fmt: skip
    info = inspect(source)
    # A job sees to its output itself.
    if not blocks.is_begun(output.folder, overwrite=overwrite):
        check_folder_writable(output.folder, made_files, overwrite=overwrite)
    finest = target_count(info.splats, ratios[0], None)
    encoding = scale.levels_encoding(info, ratios, output, chunk, spz=spz)
    plan = Plan(info, Goal(ratio=ratios[0]), finest, preset, chosen, encoding)
    given = {name: value for name, value in overrides.items() if value is not None}
    given |= {"preset": preset, "nan": nan.value, "chunk": chunk, "spz": spz}
    given["layout"] = output.layout
    divided = blocks.needed(plan)
    if divided:
        looks = views is not None or cameras != "auto" or up is not None
        scale.refuse_whole_model_wishes(plan, filtered=False, looks=looks)
    if dry_run:
        made_in = scale.levels_plan(source, ratios, blocks, given) if divided else None
        _print_plan(plan, output, ratios, made_in, json=json)
        return
    if divided:
        run = scale.levels_in_blocks(
            source, output, ratios, blocks, threads, given | {"overwrite": overwrite},
            quiet=quiet or json,
        )  # fmt: skip
    else:
        blocks.refuse_fitting(output.folder)
        given["threads"] = threads
        run = _write(plan, output, ratios, overwrite, cameras, direction, given, quiet or json)
    if json:
        print_json(run)
    elif not quiet:
        _print_report(run)
    exit_if_short(run)


def _write(
    plan: Plan,
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
    if renders(plan.parameters):
        when_compiling(compile_ahead)
    with count_down(info.splats, 1, quiet=quiet) as progress:
        progress("read", info.splats)
        splats = load(info.path)
        manifest, reports = write_levels(
            splats,
            output.folder,
            ratios,
            source=info.path.name,
            overwrite=overwrite,
            cameras=requested_cameras(splats, cameras, up, plan.parameters),
            progress=progress,
            **given,
        )
    run = manifest.to_dict() | {"input": str(info.path), "output": str(output.path)}
    run["layout"] = output.layout.value
    run["dropped_nonfinite"] = reports[0].dropped_nonfinite
    run["reports"] = [report.to_dict() for report in reports]
    return run | {"total_seconds": time.perf_counter() - start}


def _print_plan(
    plan: Plan,
    output: Output,
    ratios: tuple[float, ...],
    divided: ScalePlan | None,
    *,
    json: bool,
) -> None:
    counts = [target_count(plan.info.splats, ratio, None) for ratio in ratios]
    asked = [{"ratio": r, "count": c} for r, c in zip(ratios, counts, strict=True)]
    text = f"{output.path}: levels of {', '.join(f'{c:,}' for c in counts)} splats"
    told = {"levels": asked, "layout": output.layout.value}
    if divided is None:
        show_plan(plan, told, text, json=json)
    elif json:
        print_json(describe_plan(plan, told) | {"blocks": asdict(divided)})
    else:
        print_divided(plan, text)
        scale.plan_rows(divided)


def _print_report(run: dict[str, Any]) -> None:
    warn_of_input(run)
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
            f"{level['seconds']:.2f}",
        )
    show(err, table)
    text = f"{run['output']}: {len(run['levels'])} levels, {run['total_seconds']:.2f} s"
    err.print(text, markup=False, soft_wrap=True)


def _name(number: int, level: dict[str, Any]) -> str:
    """A level's file, or its number and that of its files."""
    if "file" in level:
        return str(level["file"])
    files = len(level["files"])
    return f"{number}, {files} {'file' if files == 1 else 'files'}"


def exit_if_short(run: dict[str, Any]) -> None:
    """Name the levels that have more splats than asked for, and leave with exit code 3."""
    levels = list(enumerate(run["levels"]))
    short = [(number, level) for number, level in levels if level["stop"] != StopReason.TARGET]
    for number, level in short:
        name = level.get("file", f"Level {number}")
        warn(f"{name}: stopped before the asked count: {level['stop']}.")
    if short:
        raise typer.Exit(3)

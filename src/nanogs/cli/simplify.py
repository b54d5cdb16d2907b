"""`nanogs simplify`."""

from functools import partial
from typing import Annotated, Any

import typer

from nanogs.cli import blocks, file_options, method, options
from nanogs.cli.groups import with_options
from nanogs.cli.importing import uncollected
from nanogs.defaults import PATIENCE
from nanogs.pipeline.presets import DEFAULT_PRESET, parameters
from nanogs.quantities import parse_bytes


@with_options
def simplify(
    *,
    paths: file_options.Paths,
    ratio: Annotated[
        float | None,
        typer.Option(
            "--ratio",
            "-r",
            parser=options.parse_ratio,
            metavar="RATIO",
            help="Share of the splats to keep, e.g. 0.1 or 10%.",
        ),
    ] = None,
    count: Annotated[
        int | None,
        options.count("Number of splats to keep, e.g. 50000, 100k or 1.5M."),
    ] = None,
    size: Annotated[
        str | None,
        typer.Option(
            help="Largest size of OUT, e.g. 20MB or 20MiB: as many splats as fit.", metavar="SIZE"
        ),
    ] = None,
    psnr: Annotated[
        float | None,
        typer.Option(
            help="dB that `nanogs compare` is to say, e.g. 35: the fewest splats that reach it.",
            metavar="DB",
        ),
    ] = None,
    preset: method.Preset = DEFAULT_PRESET,
    measure: method.Measure = None,
    nan: method.NanOption = method.Nan.drop,
    frame: file_options.FrameOption = None,
    sh_degree: file_options.ShDegree = None,
    spz_version: options.SpzVersion = None,
    overwrite: options.Overwrite = False,
    threads: options.Threads = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Show how it was done: stages, passes, probes.")
    ] = False,
    dry_run: method.DryRun = False,
    out_dir: file_options.OutDir = None,
    out_format: file_options.FormatOption = None,
    read_as: file_options.From = None,
    write_as: file_options.To = None,
    overrides: Annotated[dict[str, Any], method.PARAMETERS],
    cameras: options.Cameras = "auto",
    up: options.Up = None,
    crop: file_options.Crop = None,
    min_opacity: file_options.MinOpacity = None,
    drop_floaters: file_options.DropFloaters = False,
    max_memory: blocks.MaxMemory = None,
    join: blocks.Join = False,
    job: blocks.JobFolder = None,
    resume: blocks.Resume = False,
    scratch: blocks.Scratch = None,
    workers: blocks.Workers = None,
    scheduler: blocks.Scheduler = None,
    patience: blocks.Patience = PATIENCE,
) -> None:
    """Make a smaller model of the same scene: of a ratio, a count, a file size or a PSNR."""
    # What only a run needs is imported here, and not for `--help`.
    with uncollected():
        from nanogs.cli import framing, many, reading, streams, too_large
        from nanogs.cli.simplify_report import print_report
        from nanogs.cli.simplify_run import Request, plan_one, run_one
        from nanogs.pipeline.target import Goal

    # Whatever can be refused is refused here, before minutes of computing.
    parts = [paths[0], paths[-1]] if join else paths
    pairs = many.plan_pairs(parts, out_dir, out_format)
    chosen = parameters(preset, overrides)
    method.refuse_views(preset, chosen, overrides, cameras, up)
    request = Request(
        goal=Goal(ratio, count, None if size is None else parse_bytes(size), psnr),
        preset=preset,
        chosen=chosen,
        reading=reading.parse_reading(
            crop, min_opacity, drop_floaters=drop_floaters, sh_degree=sh_degree, psnr=psnr
        ),
        saving={"overwrite": overwrite, "format_options": {"spz_version": spz_version}},
        frames=framing.parse_frames(frame),
        cameras=cameras,
        up=up,
        given=overrides | {"preset": preset, "nan": nan.value, "threads": threads},
        json=json,
        quiet=quiet or json,
        folder_later=out_dir is not None and not out_dir.exists(),
        blocks=too_large.parse_blocks(
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
        measure=measure,
    )
    pipes = streams.Streams(read_as, write_as)
    if dry_run:
        many.run_all(
            pairs, partial(plan_one, request), _nothing, out_dir, pipes, json=json, quiet=quiet,
            writes=False,
        )  # fmt: skip
        return
    runs = many.run_all(
        pairs, partial(run_one, request), partial(print_report, verbose=verbose), out_dir, pipes,
        json=json, quiet=quiet,
    )  # fmt: skip
    _exit_if_short(runs)


def _nothing(_run: dict[str, Any]) -> None:
    pass


def _exit_if_short(runs: list[dict[str, Any]]) -> None:
    """Say which results are not what was asked for, and leave with exit code 3."""
    from nanogs.cli.console import warn
    from nanogs.cli.simplify_report import stop_text

    short = [run for run in runs if not run["stop"].met]
    for run in short:
        warn(stop_text(run) if len(runs) == 1 else f"{run['output']}: {stop_text(run)}")
    if short:
        raise typer.Exit(3)

"""`nanogs lod`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from nanogs.cli import blocks, file_options, method, options
from nanogs.cli.groups import with_options
from nanogs.cli.importing import uncollected
from nanogs.defaults import CHUNK, PATIENCE
from nanogs.errors import OptionError
from nanogs.pipeline.presets import DEFAULT_PRESET, parameters

_LEVELS = "0.5,0.25,0.1,0.01"


@with_options
def lod(
    *,
    paths: Annotated[
        list[Path],
        typer.Argument(
            metavar="IN OUT",
            help="Model to read, and folder to make, for a file a level; or lod-meta.json (streamed"
            " SOG) or tileset.json (3D Tiles) in it. With --join several models before OUT.",
        ),
    ],
    levels: Annotated[
        str | None,
        typer.Option(
            help="Ratios from the finest level to the coarsest, commas between; 1 is the original"
            " itself, which the default leaves out.",
            metavar="RATIOS",
            show_default=_LEVELS,
        ),
    ] = None,
    level_format: Annotated[
        str | None,
        typer.Option(
            "--format",
            help="Format of the levels' files, e.g. sog.",
            show_default="ply",
            metavar="FORMAT",
            autocompletion=options.complete_format,
        ),
    ] = None,
    preset: method.Preset = DEFAULT_PRESET,
    measure: method.Measure = None,
    nan: method.NanOption = method.Nan.drop,
    frame: file_options.FrameOption = None,
    sh_degree: file_options.ShDegree = None,
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
    plain: Annotated[
        bool,
        typer.Option(
            "--plain",
            help="3D Tiles with every number as it is, not packed as SPZ; CesiumJS 1.145 does not"
            " draw these.",
        ),
    ] = False,
    threads: options.Threads = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Show how each level was made.")
    ] = False,
    dry_run: method.DryRun = False,
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
    """Make levels of detail from one build: a file each, or chunks for a viewer that streams.

    OUT/level_0.ply, the finest, and so on are the files that `nanogs simplify --ratio` writes, and
    levels.json says what is in the folder. The finest has half of the splats by default: --levels
    1,0.5,0.25,0.1,0.01 keeps all of them. OUT/lod-meta.json makes streamed SOG of the levels,
    OUT/tileset.json 3D Tiles 1.1.
    """
    # What only a run needs is imported here, and not for `--help`.
    with uncollected():
        from nanogs.cli import framing, lod_request, reading, too_large
        from nanogs.cli.console import print_json
        from nanogs.cli.lod_run import print_levels
        from nanogs.io.collect import Pair
        from nanogs.lod.layout import check_options, output_of
        from nanogs.pipeline.levels import check_ratios

    # Whatever can be refused is refused before minutes of computing.
    chosen = parameters(preset, overrides)
    ratios = options.parse_ratios(_LEVELS if levels is None else levels)
    check_ratios(ratios)
    parts, target = _parts(paths, join=join)
    read = reading.parse_reading(
        crop, min_opacity, drop_floaters=drop_floaters, sh_degree=sh_degree
    )
    output = output_of(target, level_format)
    turn = framing.frames_of(Pair(parts[0], output.model), framing.parse_frames(frame))
    check_options(output.layout, chunk, plain=plain)
    method.refuse_views(preset, chosen, overrides, cameras, up)
    asked = too_large.parse_blocks(
        paths, max_memory, join=join, job=job, resume=resume, scratch=scratch,
        workers=workers, scheduler=scheduler, patience=patience,
    )  # fmt: skip
    given = overrides | {"preset": preset, "nan": nan.value, "chunk": chunk, "plain": plain}
    request = lod_request.Request(
        parts=parts, output=output, ratios=ratios, preset=preset, chosen=chosen, reading=read,
        blocks=asked, given=given | {"layout": output.layout}, turn=turn, measure=measure,
        cameras=cameras,
        up=up, threads=threads, overwrite=overwrite, json=json, quiet=quiet,
    )  # fmt: skip
    plan = lod_request.plan_levels(request)
    if dry_run:
        lod_request.show_levels_plan(request, plan)
        return
    run = lod_request.make_levels(request, plan)
    if json:
        print_json(run)
    elif not quiet:
        print_levels(run, verbose=verbose, chosen=levels is not None)
    exit_if_short(run)


def _parts(paths: Sequence[Path], *, join: bool) -> tuple[list[Path], Path]:
    """The files of the model, and the output.

    Raises:
        OptionError: There is none of one, or several models without --join.
    """
    from nanogs.cli.many import refuse_units

    refuse_units(paths)
    if len(paths) == 1:
        raise OptionError(f"OUT is missing: name the folder to make of {paths[0]}.")
    if len(paths) > 2 and not join:
        raise OptionError(
            f"These are {len(paths) - 1} models before OUT; name one, or give --join where they are"
            " parts of one scene."
        )
    return list(paths[:-1]), paths[-1]


def exit_if_short(run: dict[str, Any]) -> None:
    """Name the levels that have more splats than asked for, and leave with exit code 3."""
    from nanogs.cli.console import warn
    from nanogs.report import StopReason

    levels = list(enumerate(run["levels"]))
    short = [(number, level) for number, level in levels if level["stop"] != StopReason.TARGET]
    for number, level in short:
        name = level.get("file", f"Level {number}")
        warn(f"{name}: stopped before the asked count: {level['stop']}.")
    if short:
        raise typer.Exit(3)

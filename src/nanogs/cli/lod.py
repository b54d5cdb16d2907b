"""`nanogs lod`."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nanogs.cli import file_options, options, parsing
from nanogs.cli.blocks import DASH
from nanogs.cli.groups import with_options
from nanogs.cli.importing import without_gc
from nanogs.cli.method import Method
from nanogs.cli.placing import Placing
from nanogs.defaults import CHUNK, LEAST_CHUNK
from nanogs.errors import OptionError

if TYPE_CHECKING:
    from nanogs.lod.manifest import Manifest

_LEVELS = "1,0.5,0.25,0.125 and on down to a million splats; for .rad down to 0.015625"


@with_options
def lod(
    *,
    paths: Annotated[
        list[Path],
        typer.Argument(
            metavar="IN OUT",
            parser=parsing.parse_path,
            help="Model to read, a file, its URL or - for stdin, and what to write: a folder, for"
            " one file per level; lod-meta.json (streamed SOG) or tileset.json (3D Tiles) in a"
            " folder; or one file, .ssog (streamed SOG) or .rad (a tree, for Spark). With --join"
            " several models before OUT.",
        ),
    ],
    levels: Annotated[
        str | None,
        typer.Option(
            help="Ratios from the finest level to the coarsest, separated by commas; 1 is the"
            " original itself.",
            metavar="RATIOS",
            show_default=_LEVELS,
        ),
    ] = None,
    read_as: file_options.From = None,
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
    overwrite: Annotated[
        bool,
        typer.Option("--overwrite", "-w", help="Replace a file, or a folder that nanogs lod made."),
    ] = False,
    chunk: Annotated[
        int | None,
        typer.Option(
            parser=lambda text: parsing.parse_count(text, "--chunk"),
            metavar="COUNT",
            help="Largest number of splats in a chunk of the finest level, in streamed SOG and 3D"
            " Tiles.",
            show_default=str(CHUNK),
        ),
    ] = None,
    chunk_min: Annotated[
        int | None,
        typer.Option(
            parser=lambda text: parsing.parse_count(text, "--chunk-min"),
            metavar="COUNT",
            help="Smallest number of splats in such a chunk, and in a file of streamed SOG, unless"
            " a level has fewer.",
            show_default=f"{LEAST_CHUNK}, or a quarter of --chunk",
        ),
    ] = None,
    plain: Annotated[
        bool,
        typer.Option(
            "--plain",
            help="Write 3D Tiles with every number unchanged, not packed as SPZ; CesiumJS 1.145"
            " does not draw these.",
        ),
    ] = False,
    environment: Annotated[
        str,
        typer.Option(
            help="Environment of streamed SOG, such as the sky, which is drawn with every level:"
            " auto separates it from the model if it is far away all around, none leaves all"
            " splats in the levels; or the path of a model, in the frame of IN.",
            metavar="auto|none|FILE",
        ),
    ] = "auto",
    environment_ratio: Annotated[
        float | None,
        typer.Option(
            parser=lambda text: parsing.parse_ratio(text, "--environment-ratio"),
            metavar="RATIO",
            help="Compaction ratio of the environment, all of which is loaded at once.",
            show_default="1",
        ),
    ] = None,
    placing: Placing,
    device: options.Device = "cpu",
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Show how each level was made.")
    ] = False,
    method: Method,
) -> None:
    """Make levels of detail of a model: a file each, or chunks for a viewer that streams.

    A folder OUT gets level_0.ply, the finest level, level_1.ply and so on, each the file that
    `nanogs simplify --ratio` writes, and levels.json, which lists them. By default the finest is
    the original, and each other level has half of the splats of the one before. OUT/lod-meta.json
    makes streamed SOG of the levels, OUT.ssog the same in one file, OUT/tileset.json 3D Tiles 1.1,
    and OUT.rad one file with a tree of splats, as Spark streams it.
    """
    # Imported here because `--help` does not need it.
    with without_gc():
        from nanogs.cli import lod_run, many, plan
        from nanogs.environments import surroundings
        from nanogs.io.collect import Pair
        from nanogs.io.url_files import refuse_address
        from nanogs.lod.layout import block_layout_of, output_of
        from nanogs.pipeline.levels import checked_ratios
        from nanogs.pipeline.options.target import Goal

    # All checks are made before minutes of computing.
    method.check(paths)
    parts, target, notes = _parts(paths, join=method.blocks.join)
    refuse_address(target, "levels are written to a folder or file: name one")
    output = output_of(target, level_format)
    # Default levels follow from the model's count, which for stdin is known only once it is read.
    ratios = (1.0,) if levels is None else checked_ratios(parsing.parse_ratios(levels))
    arguments = lod_run.Arguments(
        request=plan.request_of(
            method, Goal(ratio=ratios[0]), inputs=parts, notes=notes, output=output.folder,
            overwrite=overwrite, ratios=ratios, device=device, level_suffix=output.suffix,
            block_layout=block_layout_of(
                output.layout, chunk, chunk_min, plain=plain, place=placing.place
            ),
        ),
        method=method, output=output, usual=levels is None,
        sky=surroundings(environment, environment_ratio, output.layout),
    )  # fmt: skip
    show = partial(lod_run.print_levels, verbose=verbose)
    [run] = many.run_all(
        [Pair(parts[0], output.folder)], partial(lod_run.run_levels, arguments),
        lod_run.print_plan if method.dry_run else show,
        method, file_options.Files(read_as=read_as), writes=not method.dry_run,
    )  # fmt: skip
    if not method.dry_run:
        exit_if_short(run.report)


def _parts(paths: Sequence[Path], *, join: bool) -> tuple[tuple[Path, ...], Path, tuple[str, ...]]:
    """Split the paths into the model's files and the output; the third are notes on the files.

    Raises:
        FormatError: A folder holds no model, or several without --join.
        OptionError: The output is missing or stdout, there are several models without --join, or
            nothing matches a pattern.
    """
    from nanogs.cli.many import refuse_units
    from nanogs.io.collect import collect_parts, model_in

    refuse_units(paths)
    if len(paths) == 1:
        raise OptionError(f"OUT is missing: name the folder or file to write after {paths[0]}.")
    if len(paths) > 2 and not join:
        raise OptionError(
            f"Only one model can stand before OUT, but {len(paths) - 1} were given; name one, or"
            " give --join if they are parts of one scene."
        )
    if paths[-1] == DASH:
        raise OptionError(
            "Levels cannot be written to stdout; name a folder in place of -, or a .ssog or .rad"
            " file."
        )
    *models, target = paths
    parts, notes = collect_parts(models) if join else ((model_in(models[0]),), ())
    return parts, target, notes


def exit_if_short(manifest: "Manifest") -> None:
    """Name the levels that have more splats than requested, and exit with code 3 if there are any.

    Raises:
        typer.Exit: With code 3.
    """
    from nanogs.cli.console import warn
    from nanogs.report import StopReason

    levels = enumerate(manifest.levels)
    short = [(number, level) for number, level in levels if level.stop != StopReason.TARGET]
    for number, level in short:
        name = getattr(level, "file", f"Level {number}")
        warn(f"{name}: stopped before the requested count: {level.stop}.")
    if short:
        raise typer.Exit(3)

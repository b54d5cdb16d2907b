"""`nanogs convert`."""

from typing import TYPE_CHECKING, Annotated, Any

import typer

from nanogs.cli import file_options, options
from nanogs.errors import OptionError

if TYPE_CHECKING:
    from nanogs.io.collect import Pair
    from nanogs.progress import Progress


def convert(
    paths: file_options.Paths,
    level: Annotated[
        int,
        typer.Option(min=0, help="Level of detail to read of a lod-meta.json; 0 is the finest."),
    ] = 0,
    sh_degree: file_options.ShDegree = None,
    turn: Annotated[
        bool,
        typer.Option(
            "--turn",
            help="Turn by 180 degrees about x: from y up (SPZ by its specification) to y down"
            " (3DGS), or back. The same as --frame rub:rdf.",
        ),
    ] = False,
    frame: file_options.FrameOption = None,
    spz_version: options.SpzVersion = None,
    overwrite: options.Overwrite = False,
    max_memory: options.MaxMemory = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
    out_dir: file_options.OutDir = None,
    out_format: file_options.FormatOption = None,
    read_as: file_options.From = None,
    write_as: file_options.To = None,
    crop: file_options.Crop = None,
    min_opacity: file_options.MinOpacity = None,
    drop_floaters: file_options.DropFloaters = False,
) -> None:
    """Write a model in another format; the suffixes of the names say which."""
    # What only a run needs is imported here, and not for `--help`.
    from nanogs.cli import filtering, framing, many, streams
    from nanogs.cli.convert_run import convert_file, print_report, refuse_too_large
    from nanogs.frames import TRAINED, Y_UP
    from nanogs.io import check_writable

    saving: dict[str, Any] = {
        "overwrite": overwrite,
        "format_options": {"spz_version": spz_version},
    }
    filters = filtering.parse_filters(crop, min_opacity, drop_floaters=drop_floaters)
    if turn and frame:
        raise OptionError("--turn and --frame both turn the model; give one of them.")
    asked = framing.parse_frames(frame)

    def run_one(pair: "Pair", progress: "Progress") -> dict[str, Any]:
        frames = (Y_UP, TRAINED) if turn else framing.frames_of(pair, asked)
        check_writable(pair.target, **saving)
        refuse_too_large(pair, level, filters, max_memory)
        return convert_file(
            pair, filters, sh_degree, frames, level=level, saving=saving, told=progress
        )

    pairs = many.plan_pairs(paths, out_dir, out_format)
    pipes = streams.Streams(read_as, write_as)
    many.run_all(pairs, run_one, print_report, out_dir, pipes, json=json, quiet=quiet)

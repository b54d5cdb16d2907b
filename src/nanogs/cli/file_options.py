"""Options for files: inputs and outputs, formats, coordinate frames, and filters.

This module has options only, so that `--help` does not import the code that uses them.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import typer

from nanogs.cli import options, parsing
from nanogs.errors import OptionError

_several = options.in_panel("Several files")
_pipe = options.in_panel("Pipes (- in place of a file) and URLs")
_filter = options.in_panel("Filters (applied before anything else, in this order)")


class Frames(NamedTuple):
    """The coordinate frames of --frame, before and after the colon; empty if not given."""

    before: str
    after: str


def parse_frames(text: str) -> Frames:
    """Parse --frame: the frames before and after the colon; one without a colon is the second.

    Raises:
        OptionError: One of them is not a frame, or none is given.
    """
    from nanogs.frames import checked_frame

    before, colon, after = text.partition(":")
    given = (before, after) if colon else ("", before)
    checked = [checked_frame(name) if name else "" for name in given]
    if not any(checked):
        raise OptionError("--frame needs a frame, like rub or rdf:rub.")
    return Frames(*checked)


Paths = Annotated[
    list[Path],
    typer.Argument(
        metavar="IN... OUT",
        parser=parsing.parse_path,
        help="Model to read and file to write: paths, URLs (https://, s3://), or - for stdin and"
        " stdout. With --out-dir all are inputs: models, folders of models or patterns.",
    ),
]
From = Annotated[
    str | None,
    _pipe(
        "Format of stdin, or of a URL whose name does not say it, e.g. splat; .splat, .ksplat and"
        " .gltf are not recognised by their first bytes.",
        "--from",
        show_default="recognised by its first bytes",
        metavar="FORMAT",
        autocompletion=options.complete_format,
    ),
]


@dataclass(frozen=True, slots=True, kw_only=True)
class Files:
    """Options for several models, and for pipes."""

    out_dir: Annotated[
        Path | None,
        _several(
            "Folder for the results; made if missing.",
            parser=parsing.parse_local,
            metavar="FOLDER",
        ),
    ] = None
    out_format: Annotated[
        str | None,
        _several(
            "Format of the results, e.g. sog.",
            "--format",
            show_default="each file's own",
            metavar="FORMAT",
            autocompletion=options.complete_format,
        ),
    ] = None
    read_as: From = None
    write_as: Annotated[
        str | None,
        _pipe(
            "Format of stdout, e.g. spz.",
            "--to",
            show_default="that of IN",
            metavar="FORMAT",
            autocompletion=options.complete_format,
        ),
    ] = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Edits:
    """Options that change a model other than simplifying it; filters are applied before that."""

    frame: Annotated[
        Frames | None,
        typer.Option(
            parser=parse_frames,
            help="Coordinate frame of OUT, named by the directions of x, y and z: rdf (right,"
            " down, forward: 3DGS), rub (right, up, back: OpenGL, SPZ). IN:OUT, like rub:rdf,"
            " gives the frame of IN too, if it is not the usual one of its format.",
            metavar="[IN:]OUT",
        ),
    ] = None
    sh_degree: Annotated[
        int | None,
        typer.Option(
            help="Highest degree of spherical harmonics to keep, 0 to 4.",
            metavar="DEGREE",
        ),
    ] = None
    render_mode: options.AsMode = None
    drop_nan: Annotated[
        bool,
        _filter(
            "Leave out splats with a NaN or infinite value, which most formats cannot store"
            " (simplify and lod do so by default).",
            "--drop-nan",
        ),
    ] = False
    crop: Annotated[
        list[str] | None,
        _filter(
            "Keep only splats inside box:x0,y0,z0,x1,y1,z1 or sphere:x,y,z,r, in scene units of"
            " IN; given several times, only those inside all of them.",
            metavar="REGION",
        ),
    ] = None
    min_opacity: Annotated[float | None, _filter("Leave out splats with an alpha below this.")] = (
        None
    )
    drop_floaters: Annotated[
        bool,
        _filter("Leave out splats that are far from all others except a few.", "--drop-floaters"),
    ] = False

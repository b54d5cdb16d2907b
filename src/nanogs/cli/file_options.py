"""Options about the files: which are read and written, in what format and frame, and what is left.

Nothing but options is here, so that `--help` imports none of what acts on them.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import typer

from nanogs.cli import options
from nanogs.errors import OptionError

_SEVERAL = "Several files"
_PIPES = "Pipes (- in place of a file)"
_FILTERS = "Filters (before anything else, in this order)"


class Frames(NamedTuple):
    """The frames before and after the colon; empty where none is given."""

    before: str
    after: str


def parse_frames(text: str) -> Frames:
    """The frames before and after the colon, empty where none is given.

    Raises:
        OptionError: One of them is no frame, or there is none.
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
        help="Model to read and file to write, - for stdin and stdout; with --out-dir all are"
        " models, folders of them or patterns.",
    ),
]
OutDir = Annotated[
    Path | None,
    typer.Option(
        help="Folder for the results; made if missing.",
        metavar="FOLDER",
        rich_help_panel=_SEVERAL,
    ),
]
FormatOption = Annotated[
    str | None,
    typer.Option(
        "--format",
        help="Format of the results, e.g. sog.",
        show_default="each file's own",
        metavar="FORMAT",
        autocompletion=options.complete_format,
        rich_help_panel=_SEVERAL,
    ),
]
From = Annotated[
    str | None,
    typer.Option(
        "--from",
        help="Format of stdin, e.g. splat.",
        show_default="by its first bytes",
        metavar="FORMAT",
        autocompletion=options.complete_format,
        rich_help_panel=_PIPES,
    ),
]
To = Annotated[
    str | None,
    typer.Option(
        "--to",
        help="Format of stdout, e.g. spz.",
        show_default="that of IN",
        metavar="FORMAT",
        autocompletion=options.complete_format,
        rich_help_panel=_PIPES,
    ),
]


@dataclass(frozen=True, slots=True, kw_only=True)
class Files:
    """Options of commands that read and write models: several of them, or a pipe."""

    out_dir: OutDir = None
    out_format: FormatOption = None
    read_as: From = None
    write_as: To = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Edits:
    """Options that change a model besides making it smaller, or before that."""

    frame: Annotated[
        Frames | None,
        typer.Option(
            parser=parse_frames,
            help="Frame of OUT, by where x, y and z point: rdf (right, down, forward: 3DGS), rub"
            " (right, up, back: OpenGL, SPZ); with that of IN before it where IN is in another"
            " than its format's, like rub:rdf.",
            metavar="[IN:]OUT",
        ),
    ] = None
    sh_degree: Annotated[
        int | None,
        typer.Option(
            help="Drop the spherical harmonics above this degree, 0 to 4, before anything else.",
            metavar="DEGREE",
        ),
    ] = None
    crop: Annotated[
        list[str] | None,
        typer.Option(
            metavar="REGION",
            help="Keep what lies in box:x0,y0,z0,x1,y1,z1 or sphere:x,y,z,r, scene units of IN;"
            " several times: in all of them.",
            rich_help_panel=_FILTERS,
        ),
    ] = None
    min_opacity: Annotated[
        float | None,
        typer.Option(help="Leave out splats with an alpha below this.", rich_help_panel=_FILTERS),
    ] = None
    drop_floaters: Annotated[
        bool,
        typer.Option(
            "--drop-floaters",
            help="Leave out splats far from all others but a few.",
            rich_help_panel=_FILTERS,
        ),
    ] = False

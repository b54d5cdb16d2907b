"""Options about the files: which are read and written, in what format and frame, and what is left.

Nothing but options is here, so that `--help` imports none of what acts on them.
"""

from pathlib import Path
from typing import Annotated

import typer

from nanogs.cli import options

_SEVERAL = "Several files"
_PIPES = "Pipes (- in place of a file)"
_FILTERS = "Filters (before anything else, in this order)"

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
FrameOption = Annotated[
    str | None,
    typer.Option(
        "--frame",
        help="Frame of OUT, by where x, y and z point: rdf (right, down, forward: 3DGS), rub"
        " (right, up, back: OpenGL, SPZ); with that of IN before it where IN is in another than"
        " its format's, like rub:rdf.",
        metavar="[IN:]OUT",
    ),
]
ShDegree = Annotated[
    int | None,
    typer.Option(
        help="Drop the spherical harmonics above this degree, 0 to 4, before anything else.",
        metavar="DEGREE",
    ),
]
Crop = Annotated[
    list[str] | None,
    typer.Option(
        metavar="REGION",
        help="Keep what lies in box:x0,y0,z0,x1,y1,z1 or sphere:x,y,z,r, scene units of IN;"
        " several times: in all of them.",
        rich_help_panel=_FILTERS,
    ),
]
MinOpacity = Annotated[
    float | None,
    typer.Option(help="Leave out splats with an alpha below this.", rich_help_panel=_FILTERS),
]
DropFloaters = Annotated[
    bool,
    typer.Option(
        "--drop-floaters",
        help="Leave out splats far from all others but a few.",
        rich_help_panel=_FILTERS,
    ),
]

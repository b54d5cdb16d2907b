"""Options that several commands share."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import typer

from nanogs.cli import parsing
from nanogs.ranges import Parameter

MOST_PROCESSES = 1024  # on this machine; more are a slip of the keyboard
# What --level chooses a level of, in helps.
OF_LEVELS = "a model that holds several (lod-meta.json, tileset.json, .ssog, .rad, .lcc, .lcc2)"


def complete_format(start: str) -> list[str]:
    """Return the writable formats that begin with `start`, without dots, for shell completion."""
    from nanogs.io.registry import formats

    names = [known.suffix.lstrip(".") for known in formats() if known.write]
    return [name for name in names if name.startswith(start.lstrip("."))]


VIEWS = "Views (automatic, or from a file)"


def in_panel(panel: str) -> Callable[..., Any]:
    """Return a variant of `typer.Option` for a panel of the help, with the help text first."""

    def option(help: str, *names: str, **more: Any) -> Any:  # noqa: A002, ANN401 - typer's own
        return typer.Option(*names, help=help, rich_help_panel=panel, **more)

    return option


_view = in_panel(VIEWS)


def views(usual: int | str) -> Any:  # noqa: ANN401 - as typer has it
    """Return the option --views with a number of views shown as default."""
    return _view("Number of automatic views.", "--views", min=1, show_default=str(usual))


def pixels(usual: int | str) -> Any:  # noqa: ANN401 - as typer has it
    """Return the option --pixels with a size shown as default."""
    about = "Width and height of an automatic view: 512 or 1280x720."
    return _view(about, "--pixels", metavar="W[xH]", show_default=str(usual))


_KINDS = (
    "auto, orbit (around an object), inside (a room or landscape), roam (anywhere, near and far), "
)
_FILES = "or a file or folder: transforms.json, cameras.json, COLMAP."

ViewsOfKinds = Annotated[
    int | None,
    _view(
        "Number of automatic views of each kind.", "--views", min=1, show_default="8; 24 of roam"
    ),
]
Sizes = Annotated[
    str | None,
    _view(
        "Width and height of the automatic views, 512 or 1280x720; several, separated by commas,"
        " are measured one by one.",
        "--sizes",
        "--pixels",
        metavar="W[xH],...",
        show_default="512",
    ),
]


Cameras = Annotated[
    str, _view(f"{_KINDS}{_FILES}", parser=parsing.parse_cameras, metavar="CAMERAS")
]
Kinds = Annotated[
    str,
    _view(
        f"{_KINDS}or several of these, separated by commas; {_FILES}",
        "--cameras",
        parser=parsing.parse_cameras,
        metavar="CAMERAS",
    ),
]


def _up(usual: str) -> Any:  # noqa: ANN401 - as typer has it
    about = f"Up direction of automatic views: x,y,z; by default {usual}."
    return _view(about, "--up", parser=parsing.parse_direction, metavar="X,Y,Z")


Up = Annotated[parsing.Direction | None, _up("away from the ground, or 0,-1,0")]
FitUp = Annotated[
    parsing.Direction | None,
    _up(
        "found from the model; if nothing is clear, cameras stand all around it, or with orbit and"
        " inside 0,-1,0 is up"
    ),
]
"""The up direction of views to learn from."""


def _background(usual: str | bool = True) -> Any:  # noqa: ANN401 - as typer has it
    return _view("black, white, or #rrggbb.", "--background", metavar="COLOUR", show_default=usual)


BackgroundOption = Annotated[str, _background()]
GivenBackground = Annotated[str | None, _background("black")]  # None if not given
PhotoBackground = Annotated[
    str | None, _background("black; white for NeRF-Synthetic photographs with alpha")
]
PhotoImages = Annotated[
    str | None, _view("Folder of the photographs, such as images_4.", "--images")
]
PhotoSplit = Annotated[
    str | None, _view("Photographs to use: test or train.", "--split", show_default="test")
]
SpzVersion = Annotated[
    int | None,
    typer.Option(
        help="Version of a .spz file: 3 (gzip), which Spark reads; 4 (zstd), which PlayCanvas"
        " reads; or 2 (gzip), for old readers, with less exact rotations.",
        show_default="3, 2 with fewer bits, or 4 for a model with extension records",
    ),
]
Palette = Annotated[
    int | None,
    typer.Option(
        help="Number of entries in the palette of spherical harmonics of a .sog or .spz file, at"
        " most 65536 in .sog; fewer make the file smaller and its colours less exact.",
        show_default=".sog: two thirds of the splats; .spz: no palette",
        metavar="ENTRIES",
    ),
]
Bits = Annotated[
    int | None,
    typer.Option(
        help="Precision of all values but the harmonics in a .sog or .spz file, 4 (coarse) to 8;"
        " one less makes the file a tenth smaller, and its errors up to twice as large.",
        show_default=".sog: 7; .spz: 8",
        metavar="BITS",
    ),
]
ShBits = Annotated[
    int | None,
    typer.Option(
        help="Bits of a coefficient of the spherical harmonics above degree 0 in a .sog or .spz"
        " file, 2 to 8; in .spz those above degree 1 have one bit less.",
        show_default=".sog: 5, or 6 if no sets of harmonics are merged; .spz: 5",
        metavar="BITS",
    ),
]
SpareBits = Annotated[
    int | None,
    typer.Option(
        help="Bits by which the centres in a .sog or .spz file are shortened, 0 to 6; one more"
        " makes their errors twice as large.",
        show_default="the larger the splats, the more",
        metavar="BITS",
    ),
]
OfFormat = Annotated[
    dict[str, Any],
    {
        "spz_version": (SpzVersion, None),
        "palette": (Palette, None),
        "bits": (Bits, None),
        "sh_bits": (ShBits, None),
        "spare_bits": (SpareBits, None),
    },
]
"""Options that apply to some formats only: the keyword arguments of `save`."""
Packed = Annotated[
    str | None,
    typer.Option(
        help="Formats, as in .sog,.spz: measure what packing alone costs, by writing the models in"
        " these formats, reading them back and comparing renders of both.",
        metavar="FORMAT,...",
        show_default=False,
    ),
]
Level = Annotated[
    int, typer.Option(min=0, help=f"Level of detail to read of {OF_LEVELS}; 0 is the finest.")
]
AsMode = Annotated[
    Literal["default", "mip"] | None,
    typer.Option(
        "--render-mode",
        metavar="default|mip",
        help="Render mode of the model, regardless of its file: mip is for models trained with"
        " antialiasing. Written models state the same mode.",
        show_default="what the file says",
    ),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", "-w", help="Overwrite existing output.")]
Json = Annotated[bool, typer.Option("--json", help="Print the results as JSON on stdout.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")]
MaxMemory = Annotated[
    int | None,
    typer.Option(
        parser=parsing.parse_memory,
        help="Memory that may be used, e.g. 4GB; what cannot be done in it is refused at once.",
        metavar="SIZE",
        show_default="nine tenths of the free memory",
    ),
]
Threads = Annotated[int | None, typer.Option(min=1, help="Threads to use.", show_default="all")]

Device = Annotated[
    str,
    typer.Option(
        metavar="cpu|cuda|auto",
        help="Where pictures are rendered: on the CPU, on a graphics card (cuda), or on a card if"
        " there is one (auto); a card needs nanogs with its extra cuda.",
    ),
]


@dataclass(frozen=True, slots=True, kw_only=True)
class Reporting:
    """The options `--json` and `--quiet`, and the printing of results according to them."""

    json: Json = False
    quiet: Quiet = False

    @property
    def hushed(self) -> bool:
        """Whether no progress and notes are printed during the run."""
        return self.json or self.quiet

    def report(
        self, run: dict[str, Any], show: Callable[[], object], notes: Sequence[str] = ()
    ) -> None:
        """Print a result: as JSON on stdout, or the notes followed by `show()` for people."""
        from nanogs.cli.console import print_json, warn

        if self.json:
            print_json(run)
        elif not self.quiet:
            for note in notes:
                warn(note)
            show()


@dataclass(frozen=True, slots=True, kw_only=True)
class Running(Reporting):
    """Options of commands that render models: output, overwriting, threads and memory."""

    overwrite: Overwrite = False
    threads: Threads = None
    max_memory: MaxMemory = None


def count(about: str) -> Any:  # noqa: ANN401 - as typer has it
    """Return the option --count with a help text."""
    return typer.Option(
        "--count",
        "-n",
        parser=lambda text: parsing.parse_count(text, "--count"),
        metavar="COUNT",
        help=about,
    )


def of_parameter(
    name: str, known: Parameter, panel: str | None = None, shown: str | bool = True
) -> Any:  # noqa: ANN401 - as typer has it
    """Return the option of a parameter, from its field's metadata; `shown` is its shown default."""
    return typer.Option(
        f"--{(known.option or name).replace('_', '-')}",
        help=known.help,
        rich_help_panel=VIEWS if known.views else panel,
        show_default=shown,
    )

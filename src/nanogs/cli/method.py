"""Options of the method, shared by the commands that simplify."""

from enum import StrEnum
from typing import Annotated

import typer

from nanogs.cli import options
from nanogs.pipeline.cameras import refuse_unused_views
from nanogs.pipeline.presets import PRESETS, SUMMARIES, Parameters

_ALL = "Parameters of every preset (each replaces the preset's value)"
_FOREST = "Parameters of the presets default, fast and best"
_PAPER = "Parameters of the preset paper"


class Nan(StrEnum):
    """Ways to treat splats that hold a NaN or an infinite value."""

    drop = "drop"
    error = "error"


def _summaries() -> str:
    return "\n\n".join(f"{name}: {text}." for name, text in SUMMARIES.items())


def _defaults(parameter: str) -> str:
    """The values of a parameter where something is rendered: "20, 40 in best"."""
    usual, best = (getattr(PRESETS[preset], parameter) for preset in ("default", "best"))
    return f"{usual}, {best} in best"


Preset = Annotated[
    str,
    typer.Option(
        help=f"The method.\n\n{_summaries()}",
        metavar="NAME",
        autocompletion=lambda: list(SUMMARIES.items()),
    ),
]
NanOption = Annotated[
    Nan,
    typer.Option("--nan", help="Splats with a NaN or infinite value: leave out, or stop."),
]
Measure = Annotated[
    bool | None,
    typer.Option(
        "--measure/--no-measure",
        help="Say the PSNR that `nanogs compare` measures.",
        show_default="where the preset renders",
    ),
]
DryRun = Annotated[
    bool,
    typer.Option("--dry-run", help="Say what would be done and how much memory it takes."),
]
Steps = Annotated[
    int | None,
    typer.Option(
        "--steps",
        min=0,
        help="Steps of fitting the result to renders of the original; 0 fits nothing.",
        show_default=_defaults("steps"),
        rich_help_panel=_FOREST,
    ),
]
Views = Annotated[
    int | None,
    typer.Option(
        "--views",
        min=1,
        help="Views of the original to render.",
        show_default=_defaults("views"),
        rich_help_panel=options.VIEWS,
    ),
]
K = Annotated[int | None, typer.Option(help="Neighbours in the graph.", rich_help_panel=_ALL)]
LambdaApp = Annotated[
    float | None, typer.Option(help="Weight of the colours.", rich_help_panel=_ALL)
]
Balance = Annotated[
    float | None,
    typer.Option(
        help="From groups of equal size (0) to groups of equal error (1).",
        rich_help_panel=_FOREST,
    ),
]
Rounds = Annotated[
    int | None,
    typer.Option(help="Rounds of reassignment after the cut.", rich_help_panel=_FOREST),
]
Tau = Annotated[float | None, typer.Option(help="Prune alpha below this.", rich_help_panel=_PAPER)]
Samples = Annotated[
    int | None, typer.Option(help="Samples in the divergence.", rich_help_panel=_PAPER)
]
Seed = Annotated[int | None, typer.Option(help="Seed of the samples.", rich_help_panel=_PAPER)]
LambdaGeo = Annotated[
    float | None, typer.Option(help="Weight of the geometry.", rich_help_panel=_PAPER)
]
MergeCap = Annotated[
    float | None, typer.Option(help="Largest share merged in a pass.", rich_help_panel=_PAPER)
]


def check_views(
    preset: str,
    chosen: Parameters,
    views: int | None,
    cameras: str,
    up: str | None,
) -> tuple[float, float, float] | None:
    """The up direction asked for; views are refused where the preset renders nothing.

    Raises:
        OptionError: Views are given and nothing is rendered, or the direction is none.
    """
    direction = options.parse_direction(up)
    given = views is not None or cameras != "auto" or direction is not None
    refuse_unused_views(preset, chosen, given=given)
    return direction

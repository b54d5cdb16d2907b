"""Options of `simplify` and `lod`: the method, its parameters, and how the work is done."""

from enum import StrEnum
from typing import Annotated, Any, get_type_hints

import typer

from nanogs.cli import options
from nanogs.cli.groups import Fields
from nanogs.method.paper.parameters import PaperParameters
from nanogs.method.parameters import ForestParameters
from nanogs.pipeline.cameras import refuse_unused_views
from nanogs.pipeline.presets import PRESETS, SUMMARIES, Parameters
from nanogs.ranges import known_parameters

_ALL = "Parameters of every preset (each replaces the preset's value)"
_FOREST = "Parameters of the presets default, fast and best"
_PAPER = "Parameters of the preset paper"


class Nan(StrEnum):
    """Ways to treat splats that hold a NaN or an infinite value."""

    drop = "drop"
    error = "error"


def _summaries() -> str:
    return "\n\n".join(f"{name}: {text}." for name, text in SUMMARIES.items())


def _defaults(name: str) -> str | bool:
    """The values of a parameter where presets that render differ: "28, 224 in best"."""
    usual, best = (getattr(PRESETS[preset], name, None) for preset in ("default", "best"))
    return usual == best or f"{usual}, {best} in best"


def _parameters() -> Fields:
    """An option for each parameter of a method that has one; None leaves the preset's value."""
    forest, paper = known_parameters(ForestParameters), known_parameters(PaperParameters)
    types = get_type_hints(PaperParameters) | get_type_hints(ForestParameters)
    found: Fields = {}
    for name, known in (forest | paper).items():
        panel = _ALL if name in forest and name in paper else _FOREST if name in forest else _PAPER
        option = options.of_parameter(name, known, panel, _defaults(name))
        if known.help:
            found[name] = (Annotated[types[name] | None, option], None)
    return found


PARAMETERS = _parameters()
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


def refuse_views(
    preset: str,
    chosen: Parameters,
    overrides: dict[str, Any],
    cameras: str,
    up: options.Direction | None,
) -> None:
    """Refuse views where the preset renders nothing.

    Raises:
        OptionError: Views are given, and nothing is rendered.
    """
    given = "views" in overrides or cameras != "auto" or up is not None
    refuse_unused_views(preset, chosen, given=given)

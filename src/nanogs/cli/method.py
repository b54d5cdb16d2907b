"""Options of `simplify` and `lod`: the preset, its parameters, views, filters and blocks."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

import typer

from nanogs.cli import file_options, options
from nanogs.cli.blocks import Blocks
from nanogs.cli.groups import Fields
from nanogs.cli.looking import refuse_beside_file
from nanogs.errors import OptionError
from nanogs.method.paper.parameters import PaperParameters
from nanogs.method.parameters import ForestParameters
from nanogs.pipeline.options.cameras import refuse_unused_views
from nanogs.pipeline.options.presets import (
    DEFAULT_PRESET,
    FORESTS,
    PRESETS,
    SUMMARIES,
    Parameters,
    parameters,
    renders,
)
from nanogs.ranges import known_parameters

_ALL = "Parameters of every preset (each replaces the preset's value)"
_FOREST = f"Parameters of the presets {', '.join(FORESTS)}"
_PAPER = "Parameters of the preset paper"


def _summaries() -> str:
    return "\n\n".join(f"{name}: {text}." for name, text in SUMMARIES.items())


def _defaults(name: str) -> str | bool:
    """Return the shown default of a parameter that differs in `best`, as "28, 224 in best".

    True if it does not differ, for the option's own default.
    """
    usual, best = (getattr(PRESETS[preset], name, None) for preset in ("default", "best"))
    return usual == best or f"{usual}, {best} in best"


def _parameters() -> Fields:
    """Build an option for each parameter that has a help text; None keeps the preset's value."""
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


def refuse_others(preset: str, given: dict[str, Any]) -> None:
    """Refuse parameters that a preset does not have.

    Raises:
        OptionError: Such a parameter is given.
    """
    if preset not in PRESETS:
        return
    known, seen = known_parameters(PRESETS[preset]), renders(PRESETS[preset])
    for name in given:
        if name not in known:
            useful = (each for each, one in known.items() if seen or not one.views)
            options = (f"--{each.replace('_', '-')}" for each in useful if each in PARAMETERS)
            raise OptionError(
                f"--{name.replace('_', '-')} cannot be used with the preset {preset}, which has"
                f" {', '.join(options)}; leave it out, or choose another preset."
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class Method(options.Reporting):
    """Options of `simplify` and `lod`."""

    preset: Annotated[
        str,
        typer.Option(
            help=f"The method.\n\n{_summaries()}",
            metavar="NAME",
            autocompletion=lambda: list(SUMMARIES.items()),
        ),
    ] = DEFAULT_PRESET
    measure: Annotated[
        bool | None,
        typer.Option(
            "--measure/--no-measure",
            help="Print the PSNR that `nanogs compare` measures. If --measure is given, also the"
            " draw cost and, for levels, the quality at the distance where viewers begin to"
            " draw them.",
            show_default="if the preset renders, but not in blocks",
        ),
    ] = None
    nan: Annotated[
        Literal["drop", "error"],
        typer.Option(
            metavar="drop|error",
            help="What to do with splats that have a NaN or infinite value (opacities of exactly 0"
            " or 1 and scales of 0 are allowed): drop leaves them out, error stops.",
        ),
    ] = "drop"
    threads: options.Threads = None
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run", help="Print what would be done and how much memory it takes, and stop."
        ),
    ] = False
    overrides: Annotated[dict[str, Any], PARAMETERS]
    cameras: options.Cameras = "auto"
    up: options.FitUp = None
    edits: file_options.Edits
    blocks: Blocks

    @property
    def chosen(self) -> Parameters:
        """The parameters of the method.

        Raises:
            OptionError: There is no such preset or parameter, or a value is out of range.
        """
        refuse_others(self.preset, self.overrides)
        return parameters(self.preset, self.overrides)

    def check(self, paths: Sequence[Path]) -> None:
        """Refuse combinations of options that are invalid whatever the files hold.

        Raises:
            OptionError: A value is out of range, views are given where nothing is rendered, an up
                direction beside views of a file, or options for blocks contradict each other.
        """
        given = {"views", "view_size"} & {*self.overrides}
        found = self.cameras != "auto" or self.up is not None
        refuse_unused_views(self.preset, self.chosen, given=bool(given) or found)
        refuse_beside_file(self.cameras, {"--up": self.up})
        self.blocks.check(paths)

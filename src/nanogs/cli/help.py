"""Help with the words of the documentation: metavars, how a command is called, and examples."""

import typing
from enum import Enum
from pathlib import Path
from typing import Any

from typer.core import TyperCommand, TyperGroup

_METAVARS = {bool: "", int: "N", float: "X", str: "TEXT", Path: "PATH"}
"""How values of a type are called where an option names nothing better; flags have none."""


class Command(TyperCommand):
    """A command whose usage names the arguments first, as the documentation shows them."""

    def collect_usage_pieces(self, ctx: Any) -> list[str]:  # noqa: ANN401 - click's own
        """The words after the command's name."""
        params: list[Any] = self.get_params(ctx)
        arguments = [param for param in params if param.param_type_name == "argument"]
        return [*(param.metavar or param.name.upper() for param in arguments), "[OPTIONS]"]

    def format_help(self, ctx: Any, formatter: Any) -> None:  # noqa: ANN401 - click's own
        """Write the help."""
        _name_values(self, ctx)
        super().format_help(ctx, formatter)


class Group(TyperGroup):
    """The program itself."""

    def format_help(self, ctx: Any, formatter: Any) -> None:  # noqa: ANN401 - click's own
        """Write the help."""
        _name_values(self, ctx)
        super().format_help(ctx, formatter)


def examples_text(lines: typing.Sequence[str]) -> str:
    """The examples that follow the options, each on a line of its own."""
    return "\n\n".join(["Examples:", *(f"  {line}" for line in lines)])


def _name_values(command: Any, ctx: Any) -> None:  # noqa: ANN401 - click's own
    """Give every option a metavar, and take the types of Python away."""
    hints = typing.get_type_hints(command.callback) if command.callback else {}
    for param in command.get_params(ctx):
        if param.param_type_name == "argument":
            param.display_type_rich = lambda **_: ""  # the name says it
        elif param.metavar is None:
            param.metavar = _metavar(hints.get(param.name, bool))


def _metavar(hint: Any) -> str:  # noqa: ANN401 - any type
    """The word for values of a type, of those in a union or list for the first."""
    inner = [each for each in typing.get_args(hint) if each is not type(None)]
    if inner:
        return _metavar(inner[0])
    if issubclass(hint, Enum):
        return "|".join(str(choice.value) for choice in hint)
    return _METAVARS.get(hint, "TEXT")

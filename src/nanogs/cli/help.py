"""Help pages in the style of the documentation: usage, metavars and examples."""

import typing
from enum import Enum
from pathlib import Path
from typing import Any

from typer.core import TyperCommand, TyperGroup

_METAVARS = {bool: "", int: "N", float: "X", str: "TEXT", Path: "PATH"}
"""Default metavar for options of each type; flags have none."""


class Command(TyperCommand):
    """A command whose usage line names the arguments before the options."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:  # noqa: ANN401 - click's own
        """Parse the arguments; an error of the parser, too, knows which command it is about."""
        try:
            return super().parse_args(ctx, args)
        except Exception as error:
            if getattr(error, "ctx", ctx) is None:
                error.ctx = ctx  # type: ignore[attr-defined]
            raise

    def collect_usage_pieces(self, ctx: Any) -> list[str]:  # noqa: ANN401 - click's own
        """Return the words after the command's name in the usage line."""
        params: list[Any] = self.get_params(ctx)
        arguments = [param for param in params if param.param_type_name == "argument"]
        return [*(param.metavar or param.name.upper() for param in arguments), "[OPTIONS]"]

    def format_help(self, ctx: Any, formatter: Any) -> None:  # noqa: ANN401 - click's own
        """Write the help; its paragraphs fill the lines of the terminal, not of the docstring."""
        _name_values(self, ctx)
        paragraphs = (self.help or "").split("\n\n")
        self.help = "\n\n".join(" ".join(each.split()) for each in paragraphs)
        super().format_help(ctx, formatter)


class Group(TyperGroup):
    """The top-level command `nanogs`."""

    def format_help(self, ctx: Any, formatter: Any) -> None:  # noqa: ANN401 - click's own
        """Write the help."""
        _name_values(self, ctx)
        super().format_help(ctx, formatter)


def examples_text(lines: typing.Sequence[str]) -> str:
    """Return the examples shown after the options, each on a line of its own."""
    return "\n\n".join(["Examples:", *(f"  {line}" for line in lines)])


def _name_values(command: Any, ctx: Any) -> None:  # noqa: ANN401 - click's own
    """Give each option a metavar, and hide the Python types of arguments."""
    hints = typing.get_type_hints(command.callback) if command.callback else {}
    for param in command.get_params(ctx):
        if param.param_type_name == "argument":
            param.display_type_rich = lambda **_: ""  # an argument's name is clear without a type
        elif param.metavar is None:
            param.metavar = _metavar(hints.get(param.name, bool))


def _metavar(hint: Any) -> str:  # noqa: ANN401 - any type
    """Return the metavar for a type; for a union or list, that of its first type."""
    inner = [each for each in typing.get_args(hint) if each is not type(None)]
    if inner:
        return _metavar(inner[0])
    if issubclass(hint, Enum):
        return "|".join(str(choice.value) for choice in hint)
    return _METAVARS.get(hint, "TEXT")

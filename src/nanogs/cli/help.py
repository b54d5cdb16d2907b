"""Help pages in the style of the documentation: usage, metavars and examples."""

import shutil
import textwrap
import typing
from enum import Enum
from pathlib import Path
from typing import Any

from typer.core import TyperCommand, TyperGroup

_METAVARS = {bool: "", int: "N", float: "X", str: "TEXT", Path: "PATH"}
"""Default metavar for options of each type; flags have none."""
_PANELS = 80  # columns that the panels need so that none of their words is cut


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

    def get_short_help_str(self, limit: int = 45) -> str:  # noqa: ARG002 - click's own
        """Return the first paragraph of the help, whole, for the list of commands."""
        return " ".join((self.help or "").split("\n\n")[0].split())

    def format_help(self, ctx: Any, formatter: Any) -> None:  # noqa: ANN401 - click's own
        """Write the help; its paragraphs fill the lines of the terminal, not of the docstring."""
        _name_values(self, ctx)
        paragraphs = (self.help or "").split("\n\n")
        self.help = "\n\n".join(" ".join(each.split()) for each in paragraphs)
        _fit(self, formatter)
        super().format_help(ctx, formatter)

    def format_options(self, ctx: Any, formatter: Any) -> None:  # noqa: ANN401 - click's own
        """Write the options under the names of their panels, where there is no room for panels."""
        panels: dict[str, list[tuple[str, str]]] = {}
        for param in self.get_params(ctx):
            if record := param.get_help_record(ctx):
                panel = getattr(param, "rich_help_panel", None)
                name = panel or f"{param.param_type_name.capitalize()}s"
                panels.setdefault(name, []).append(record)
        for name, records in panels.items():
            with formatter.section(name):
                formatter.write_dl(records)


class Group(TyperGroup):
    """The top-level command `nanogs`."""

    def format_help(self, ctx: Any, formatter: Any) -> None:  # noqa: ANN401 - click's own
        """Write the help."""
        _name_values(self, ctx)
        _fit(self, formatter)
        super().format_help(ctx, formatter)


def examples_text(lines: typing.Sequence[str]) -> str:
    """Return the examples shown after the options, each on a line of its own."""
    return "\n\n".join(["Examples:", *(f"  {line}" for line in lines)])


def _fit(command: Any, formatter: Any) -> None:  # noqa: ANN401 - click's own
    """On a terminal too narrow for panels, write each help text below its option, without them."""
    columns = shutil.get_terminal_size().columns
    if columns >= _PANELS:
        return

    def write_text(text: str) -> None:
        indent = " " * formatter.current_indent
        wrapper = textwrap.TextWrapper(
            columns, initial_indent=indent, subsequent_indent=indent, break_on_hyphens=False
        )
        formatter.write("\n\n".join(map(wrapper.fill, text.split("\n\n"))) + "\n")

    def write_list(rows: typing.Sequence[tuple[str, str]]) -> None:
        for name, text in rows:
            write_text(name)
            with formatter.indentation():
                write_text(text)

    command.rich_markup_mode = None
    formatter.width, formatter.write_text, formatter.write_dl = columns, write_text, write_list
    formatter.write_heading = lambda heading: write_text(f"{heading}:")


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

"""The reference of the commands, from what the program itself knows of them."""

import re
from typing import Any

from typer.main import get_command

from nanogs.cli.app import app
from nanogs.cli.examples import EXAMPLES


def tree() -> dict[str, Any]:
    """The commands by name; each has `params`, `help` and `make_context`."""
    group: Any = get_command(app)
    return dict(group.commands)


def reference() -> str:
    """A page with a section for every command."""
    head = "# Commands\n\n`nanogs COMMAND --help` says the same in the terminal.\n"
    return "\n".join([head, *(_section(name, command) for name, command in tree().items())])


def _section(name: str, command: Any) -> str:  # noqa: ANN401 - click's, from within typer
    arguments = [param for param in command.params if param.param_type_name == "argument"]
    options = [param for param in command.params if param.param_type_name == "option"]
    usage = " ".join(["nanogs", name, *(_shown(argument) for argument in arguments), "[OPTIONS]"])
    parts = [f"## nanogs {name}", command.help or "", f"```text\n{usage}\n```"]
    parts.append("\n".join(["```console", *(f"$ {line}" for line in EXAMPLES[name]), "```"]))
    if arguments:
        rows = [f"| `{_shown(param)}` | {_cell(param.help)} |" for param in arguments]
        parts.append("\n".join(["| argument | |", "|---|---|", *rows]))
    for panel, members in _panels(options).items():
        rows = [
            f"| {_names(param)} | {_cell(param.help)} | {_default(param)} |" for param in members
        ]
        parts += [f"**{_cell(panel)}**"] if panel else []
        parts.append("\n".join(["| option | | default |", "|---|---|---|", *rows]))
    return "\n\n".join(parts) + "\n"


def _panels(options: list[Any]) -> dict[str, list[Any]]:
    panels: dict[str, list[Any]] = {}
    for option in options:
        title = getattr(option, "rich_help_panel", None) or ""
        panels.setdefault(title, []).append(option)
    return panels


def _shown(argument: Any) -> str:  # noqa: ANN401
    return str(argument.metavar or argument.name.upper())


def _names(option: Any) -> str:  # noqa: ANN401
    names = [*option.opts, *option.secondary_opts]
    return ", ".join(f"`{name}`" for name in names)


def _default(option: Any) -> str:  # noqa: ANN401
    if isinstance(option.show_default, str):
        return _cell(option.show_default)
    if option.default is None or (option.is_flag and not option.secondary_opts):
        return ""
    value = option.default
    if callable(value):
        return ""
    if isinstance(value, bool):
        return "on" if value else "off"
    text = str(getattr(value, "value", value))
    return f"`{text}`" if text else ""


def _cell(text: str | None) -> str:
    """Text that may stand in a table; of Markdown, only code between backticks is read as such."""
    parts = " ".join((text or "").split()).split("`")
    parts[::2] = [
        re.sub(r"[\\*_{}\[\]>|#]", r"\\\g<0>", part).replace("<", "&lt;") for part in parts[::2]
    ]
    return "`".join(parts)

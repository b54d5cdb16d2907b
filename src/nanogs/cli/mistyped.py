"""Mistyped commands and options in one sentence, as all other errors are said.

What typer raises for them is not exported by it, and has changed its module; so it is told by what
it can do.
"""

from typing import Any

from nanogs.errors import did_you_mean


def is_usage(error: Exception) -> bool:
    """Whether typer raised it, for what was typed."""
    return hasattr(error, "format_message") and hasattr(error, "exit_code")


def sentence(error: Any) -> str:  # noqa: ANN401 - typer's own
    """The sentence for people; empty where all has been said.

    Args:
        error: Of which `is_usage` holds.
    """
    context = getattr(error, "ctx", None)
    if type(error).__name__ == "NoArgsIsHelpError":
        error.show()  # the help itself
        return ""
    command = f"{context.command_path} --help" if context else "nanogs --help"
    if option := _unknown_option(error):
        return f"There is no option {option}{_meant(option, context)}; `{command}` lists them."
    message = " ".join(error.format_message().replace("Value error, ", "").split())
    if message.startswith("No such command"):
        return f"{_unknown_command(message, context)}; `{command}` lists them."
    return f"{message.rstrip('.')}; see `{command}`."


def _unknown_option(error: Any) -> str:  # noqa: ANN401
    return str(error.option_name) if type(error).__name__ == "NoSuchOption" else ""


def _meant(option: str, context: Any) -> str:  # noqa: ANN401
    if context is None:
        return ""
    known = {name for param in context.command.params for name in param.opts}
    return did_you_mean(option, known | {"--help"})


def _unknown_command(message: str, context: Any) -> str:  # noqa: ANN401
    typed = message.split("'")[1] if message.count("'") > 1 else ""
    known = getattr(context.command, "commands", {}) if context else {}
    return f"There is no command {typed}{did_you_mean(typed, known)}"

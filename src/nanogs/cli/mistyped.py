"""Usage errors, such as mistyped commands and options, as one sentence like all other errors.

Typer does not export the exceptions that it raises for them, and has moved them between modules, so
they are recognised by their attributes.
"""

import re
import sys
from typing import Any

from nanogs.errors import did_you_mean
from nanogs.paths import exists

# Patterns in the messages of Typer and Click, and the kind of value that the option takes.
_TAKES = (
    ("integer", "a whole number"),
    ("number|float", "a number"),
    ("greater than or equal|not in the range", "a larger number"),
    ("less than or equal", "a smaller number"),
)
# Options of other commands and of splat-transform, and the one to use in a command that has it.
_INSTEAD = {
    "--ratio": "--levels", "--count": "--levels", "-t": "--translate", "-r": "--rotate",
    "-s": "--scale", "-H": "--sh-degree", "--filter-harmonics": "--sh-degree", "-N": "--drop-nan",
    "-B": "--crop", "--filter-box": "--crop", "-S": "--crop", "--filter-sphere": "--crop",
    "-d": "--ratio", "--decimate": "--ratio", "--decimate-adaptive": "--ratio",
    "-F": "--drop-floaters", "-L": "--level", "--select-lod": "--level",
    "--lod-chunk-count": "--chunk", "-g": "--device", "--gpu": "--device",
    "--max-workers": "--threads", "--resolution": "--pixels", "-v": "--version",
}  # fmt: skip


def is_usage(error: Exception) -> bool:
    """Return whether the error is a usage error of Typer."""
    return hasattr(error, "format_message") and hasattr(error, "exit_code")


def sentence(error: Any) -> str:  # noqa: ANN401 - typer's own
    """Return the message for a usage error; empty if nothing more is to be printed.

    Args:
        error: An error for which `is_usage` is True.
    """
    context = getattr(error, "ctx", None)
    if type(error).__name__ == "NoArgsIsHelpError":
        error.show()  # prints the help
        return ""
    command = f"{context.command_path} --help" if context else "nanogs --help"
    if option := _unknown_option(error):
        dashed = (word for word in sys.argv[1:] if _is_dashed_file(word, option))
        if file := next(dashed, ""):
            return f"{file} begins like an option; name the file ./{file}."
        return f"There is no option {option}{_meant(option, context)}; `{command}` lists them."
    if value := _bad_value(error):
        return f"{value}; see `{command}`."
    message = " ".join(error.format_message().replace("Value error, ", "").split())
    if message.startswith("No such command"):
        return f"{_unknown_command(message, context)}; `{command}` lists them."
    if extra := re.search(r"unexpected extra argument\S* \((.*)\)", message):
        params = context.command.params if context else ()
        takes_names = any(param.param_type_name == "argument" for param in params)
        hint = " (a name with spaces needs quotes)" if takes_names else ""
        return f"Too many arguments: {extra[1]}{hint}; see `{command}`."
    if message.startswith("Missing argument") and context:
        words = " ".join(context.command.collect_usage_pieces(context)[:-1])  # without [OPTIONS]
        message = f"{message.rstrip('.')} of `{context.command_path} {words}`"
    return f"{message.rstrip('.')}; see `{command}`."


def _unknown_option(error: Any) -> str:  # noqa: ANN401
    return str(error.option_name) if type(error).__name__ == "NoSuchOption" else ""


def _is_dashed_file(word: str, option: str) -> bool:
    """Return whether a word with the unknown option is a file, or a name for one to write."""
    named = word.startswith(option) or option == "-."  # as in -q.ply, of which -q is an option
    return word.startswith("-") and (
        exists(word) or (named and re.fullmatch(r"[^=]+\.[A-Za-z]\w*", word) is not None)
    )


def _meant(option: str, context: Any) -> str:  # noqa: ANN401
    if context is None:
        return ""
    known, instead = _options(context.command), _INSTEAD.get(option)
    if instead in known:
        return f" (did you mean {instead!r}?)"
    commands = getattr((context.parent or context).command, "commands", {})
    having = {one: name for name in reversed(commands) for one in _options(commands[name])}
    if option in having and not context.parent:
        return " before the command, only after it"
    for wanted, called in ((option, "it"), (instead, instead)):
        if wanted in having and context.parent:
            return f" (`nanogs {having[wanted]}` has {called})"
    return did_you_mean(option, known | {"--help"})


def _options(command: Any) -> set[str]:  # noqa: ANN401
    return {name for param in command.params for name in param.opts}


def _unknown_command(message: str, context: Any) -> str:  # noqa: ANN401
    typed = message.split("'")[1] if message.count("'") > 1 else ""
    known = getattr(context.command, "commands", {}) if context else {}
    if "." in typed:
        return f"There is no command {typed}; name one first, as in `nanogs convert {typed} OUT`"
    return f"There is no command {typed}{did_you_mean(typed, known)}"


def _bad_value(error: Any) -> str:  # noqa: ANN401
    """Return which values an option takes and the one given; "" if something else is wrong."""
    param, message = getattr(error, "param", None), str(getattr(error, "message", ""))
    takes = next((word for sign, word in _TAKES if re.search(sign, message)), "")
    if param is None or not takes:
        return ""
    number = re.search(r"(?:equal to|x>=) ?(-?[\d.]+)", message)
    side = "less" if takes == "a smaller number" else "more"
    bound = f"{number[1].rstrip('.')} or {side}" if number else takes
    return f"{max(param.opts, key=len)} takes {bound}, not {_given(error, message)}"


def _given(error: Any, message: str) -> str:  # noqa: ANN401
    """Return the value as typed, quoted."""
    if hasattr(error.__cause__, "errors"):
        return repr(error.__cause__.errors()[0]["input"])
    word = re.match(r"'?([^' ]*)'? is not", message)
    return repr(word[1]) if word else "what was given"

"""The library's errors in the words of the command."""

import re

from nanogs.errors import ExistsError, NanogsError

# Arguments of Python, as the library's sentences name them, that the command has as options.
_ARGUMENT = re.compile(r"`(chunk|job|k|max_memory|nan|resume|scheduler|scratch)(?:=([^`]+))?`")


def wording(error: NanogsError) -> str:
    """The sentence for a user of the command, whose remedies are options."""
    said = error.sentence("add -w") if isinstance(error, ExistsError) else str(error)
    return _ARGUMENT.sub(_option, said)


def _option(argument: re.Match[str]) -> str:
    """Such as `--nan drop` for `nan="drop"`, and `--resume` for `resume=True`."""
    name, value = argument.groups()
    option = f"--{name.replace('_', '-')}"
    return option if value in (None, "True") else f"{option} {value.strip(chr(34))}"

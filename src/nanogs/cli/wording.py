"""Rewording of the library's messages for the command: options instead of Python arguments."""

import re

from nanogs.errors import ExistsError, NanogsError, RangeError

# Python arguments in the library's messages that are also options of the command.
_ARGUMENT = re.compile(
    r"`(bits|budget|cameras|chunk|count|device|draw_cost|drop_nan|environment|format|frame|images|interactive|job|k|level|levels|max_memory|model_pattern|nan|palette|pixels"
    r"|plain|psnr|ratio|render_mode|resume|scheduler|scratch|sh_bits|sh_degree|size|spare_bits|spz_version|steps|up|view_size|views)(?:=([^`]+))?`"
)


def wording(error: NanogsError) -> str:
    """Return an error's message with options instead of arguments."""
    if isinstance(error, RangeError):
        return error.for_command
    return reworded(error.sentence("add -w") if isinstance(error, ExistsError) else str(error))


def reworded(text: str) -> str:
    """Replace Python arguments in a message of the library by options of the command."""
    return _ARGUMENT.sub(_option, text)


def _option(argument: re.Match[str]) -> str:
    """Convert an argument to an option: `nan="drop"` to `--nan drop`, `resume=True` to `--resume`.

    `name=False` gives `--no-name`, and the two frames of `frame=("rub", "rdf")` give `rub:rdf`.
    """
    name, value = argument.groups()
    option = f"--{'no-' * (value == 'False')}{name.replace('_', '-')}"
    if value and value.startswith("("):
        value = ":".join(re.findall(r"\w+", value))
    return option if value in (None, "True", "False") else f"{option} {value.strip(chr(34))}"

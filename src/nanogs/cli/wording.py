"""The library's errors in the words of the command."""

import re

from nanogs.errors import ExistsError, NanogsError

# Arguments of Python, as the library's sentences name them, that the command has as options.
_ARGUMENT = re.compile(
    r"`(bits|budget|cameras|chunk|count|device|draw_cost|environment|format|frame|images|interactive|job|k|level|levels|max_memory|model_pattern|nan|palette|pixels"
    r"|plain|psnr|ratio|render_mode|resume|scheduler|scratch|sh_bits|sh_degree|size|spare_bits|spz_version|up|view_size|views)(?:=([^`]+))?`"
)


def wording(error: NanogsError) -> str:
    """The sentence for a user of the command, whose remedies are options."""
    return with_options(error.sentence("add -w") if isinstance(error, ExistsError) else str(error))


def with_options(text: str) -> str:
    """A sentence of the library, with options in place of arguments."""
    return _ARGUMENT.sub(_option, text)


def _option(argument: re.Match[str]) -> str:
    """Say an argument as an option: `--nan drop` for `nan="drop"`, `--resume` for `resume=True`."""
    name, value = argument.groups()
    option = f"--{'no-' * (value == 'False')}{name.replace('_', '-')}"
    return option if value in (None, "True", "False") else f"{option} {value.strip(chr(34))}"

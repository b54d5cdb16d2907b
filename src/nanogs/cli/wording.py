"""The library's errors in the words of the command."""

from nanogs.errors import ExistsError, NanogsError


def wording(error: NanogsError) -> str:
    """The sentence for a user of the command, whose remedies are options."""
    return error.sentence("add -w") if isinstance(error, ExistsError) else str(error)

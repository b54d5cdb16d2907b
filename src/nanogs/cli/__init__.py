"""The command `nanogs`: arguments in, reports out. Whatever computes is in the library."""

import sys


def main() -> None:
    """Run the command; errors of the user's end with one sentence and exit code 2."""
    from nanogs.cli.app import app
    from nanogs.cli.console import fail
    from nanogs.errors import NanogsError

    try:
        app(prog_name="nanogs")
    except NanogsError as error:
        fail(str(error))
        sys.exit(2)
    except BrokenPipeError:
        sys.exit(1)

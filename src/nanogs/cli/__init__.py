"""The command `nanogs`: arguments in, reports out. Whatever computes is in the library."""

import sys
from typing import NoReturn


def main() -> None:
    """Run the command; errors of the user's end with one sentence and exit code 2."""
    import typer

    from nanogs.cli.app import app
    from nanogs.errors import NanogsError

    try:
        code = app(prog_name="nanogs", standalone_mode=False)
    except NanogsError as error:
        _refuse(str(error))
    except BrokenPipeError:
        sys.exit(1)
    except typer.Abort:
        sys.exit(130)  # as the shell has it of interrupted programs
    except Exception as error:
        from nanogs.cli.mistyped import is_usage, sentence

        if not is_usage(error):
            raise
        _refuse(sentence(error))
    sys.exit(code if isinstance(code, int) else 0)


def _refuse(sentence: str) -> NoReturn:
    """Say what is wrong, unless that has been said, and end."""
    if sentence:
        from nanogs.cli.console import fail

        fail(sentence)
    sys.exit(2)

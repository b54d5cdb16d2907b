"""The command `nanogs`: arguments in, reports out. Whatever computes is in the library."""

import sys


def main() -> None:
    """Run the command; errors of the user's end with one sentence and exit code 2."""
    import typer

    from nanogs.cli.app import app
    from nanogs.cli.console import fail
    from nanogs.cli.mistyped import is_usage, sentence
    from nanogs.errors import NanogsError

    try:
        code = app(prog_name="nanogs", standalone_mode=False)
    except NanogsError as error:
        fail(str(error))
        sys.exit(2)
    except BrokenPipeError:
        sys.exit(1)
    except typer.Abort:
        sys.exit(130)  # as the shell has it of interrupted programs
    except Exception as error:
        if not is_usage(error):
            raise
        if text := sentence(error):
            fail(text)
        sys.exit(2)
    sys.exit(code if isinstance(code, int) else 0)

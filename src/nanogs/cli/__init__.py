"""The command `nanogs`: arguments in, reports out. Whatever computes is in the library."""

import gc
import os
import sys

from nanogs.cli.cancel import listen
from nanogs.cli.importing import uncollected


def main() -> None:
    """Run the command; errors of the user's end with one sentence and exit code 2."""
    listen()
    try:
        code = _run()
    finally:
        gc.freeze()  # or Python would search all that is left, though it frees it in any case
    sys.exit(code)


def _run() -> int:
    """Run the command; its exit code."""
    with uncollected():
        import typer

        from nanogs.cli.app import app
        from nanogs.cli.wording import wording
        from nanogs.errors import NanogsError
        from nanogs.memory import refuse_without_numpy

    try:
        if not {"--help", "-h", "--version"} & set(sys.argv):  # these need nothing else
            refuse_without_numpy()
        code = app(prog_name="nanogs", standalone_mode=False)
        sys.stdout.flush()
    except NanogsError as error:
        return _refuse(wording(error))
    except BrokenPipeError:
        return _unread()
    except SystemExit as ended:  # Typer and Rich end programs themselves whose pipe is closed
        if isinstance(ended.__context__, BrokenPipeError):
            return _unread()
        raise
    except typer.Abort:
        return 130  # as the shell has it of interrupted programs
    except Exception as error:
        from nanogs.cli.failures import sentence_of
        from nanogs.cli.mistyped import is_usage, sentence

        said = sentence(error) if is_usage(error) else sentence_of(error)
        if said is None:
            raise
        return _refuse(said)
    return code if isinstance(code, int) else 0


def _unread() -> int:
    """The exit code once nobody reads what is said, as of a program that SIGPIPE ended.

    What is still held back for the pipe goes nowhere, or Python would complain of it as it ends.
    """
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (sys.stdout, sys.stderr):
        os.dup2(nowhere, stream.fileno())
    return 141


def _refuse(sentence: str) -> int:
    """Say what is wrong, unless that has been said; the exit code."""
    if sentence:
        from nanogs.cli.console import fail

        fail(sentence)
    return 2

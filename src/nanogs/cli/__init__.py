"""The command `nanogs`: it parses options, calls the library, and prints its reports."""

import gc
import sys

from nanogs.cli.cancel import listen
from nanogs.cli.importing import without_gc
from nanogs.cli.standard_streams import discard, named_stdout, optional_stderr


def main() -> None:
    """Run the command; a user's error prints one sentence and exits with code 2."""
    listen()
    try:
        with optional_stderr():
            code = _run()
    finally:
        gc.freeze()  # no final garbage collection: the operating system frees the memory anyway
    sys.exit(code)


def _run() -> int:
    """Run the command and return its exit code."""
    with without_gc():
        import typer

        from nanogs.cli.app import app
        from nanogs.cli.wording import wording
        from nanogs.errors import NanogsError
        from nanogs.memory import refuse_without_numpy

    try:
        if not {"--help", "-h", "--version"} & set(sys.argv):  # these do not need NumPy
            refuse_without_numpy()
        with named_stdout():
            code = app(prog_name="nanogs", standalone_mode=False)
            sys.stdout.flush()
    except NanogsError as error:
        return _refuse(wording(error))
    except BrokenPipeError:
        return _on_closed_pipe()
    except SystemExit as ended:  # Typer and Rich exit by themselves when the pipe is closed
        if isinstance(ended.__context__, BrokenPipeError):
            return _on_closed_pipe()
        raise
    except typer.Abort:
        return 130  # the shell's exit code for interrupted programs: 128 + SIGINT
    except Exception as error:
        from nanogs.cli.failures import sentence_of
        from nanogs.cli.mistyped import is_usage, sentence

        said = sentence(error) if is_usage(error) else sentence_of(error)
        if said is None:
            raise
        return _refuse(said)
    return code if isinstance(code, int) else 0


def _on_closed_pipe() -> int:
    """Handle a closed pipe: return 141, the exit code of a program ended by SIGPIPE (128 + 13)."""
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:  # None: closed from the start
            discard(stream)
    return 141


def _refuse(sentence: str) -> int:
    """Print the error, unless it is empty because it was printed before, and return exit code 2."""
    if sentence:
        from nanogs.cli.console import fail

        fail(sentence)
    return 2

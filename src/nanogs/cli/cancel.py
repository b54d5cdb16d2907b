"""Signal handlers for Ctrl-C and other requests to stop: clean up, print "cancelled", and exit.

No exception is raised, because running code could swallow it (Numba's import does), and because
Python would wait for threads to end.
"""

import atexit
import os
import signal
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from types import FrameType
from typing import TYPE_CHECKING

from nanogs.cleanup import clean_all, exit_when_allowed

if TYPE_CHECKING:
    from pathlib import Path

_CLEAR = b"\r\x1b[K\x1b[?25h"  # clears the line of a progress bar, and shows the cursor again

_manifest: "Path | None" = None  # of the job that runs


@contextmanager
def resumable(manifest: "Path") -> Iterator[None]:
    """Within the context, name the job of this manifest on a request to stop, if it is kept."""
    global _manifest  # noqa: PLW0603
    _manifest = manifest
    try:
        yield
    finally:
        _manifest = None


def listen() -> None:
    """Install the signal handlers; signals that the parent process ignores stay ignored.

    At exit the signals are ignored: Python restores the default handlers when it ends, so that a
    late signal would turn a completed run into a failure.
    """
    atexit.register(_ignore)  # atexit runs in reverse order, so this one runs last
    for number in _requests():
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _stop)


def _requests() -> Iterable[signal.Signals]:
    names = ("SIGINT", "SIGTERM", "SIGHUP")  # Windows has no SIGHUP
    return [signal.Signals[name] for name in names if hasattr(signal, name)]


def _stop(number: int, _frame: FrameType | None) -> None:
    _ignore()
    exit_when_allowed(partial(_end, number))


def _ignore() -> None:
    for number in _requests():
        signal.signal(number, signal.SIG_IGN)


def _end(number: int) -> None:
    # Threads may fail when the clean-up takes away what they use, such as the pipes of workers.
    threading.excepthook = _ignore_failure
    clean_all()
    with suppress(OSError):
        os.write(2, (_CLEAR if os.isatty(2) else b"") + _kept() + b"cancelled\n")
    if number == signal.SIGINT and os.name != "nt" and (os.isatty(1) or os.isatty(2)):
        # A shell goes on with its loop if the program exits by itself, whatever its code.
        with suppress(ValueError):  # another thread than the first has to end the program
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)
    os._exit(128 + number)  # the shell's exit code for programs ended by a signal


def _ignore_failure(_failure: threading.ExceptHookArgs) -> None:
    pass


def _kept() -> bytes:
    if _manifest is None or not _manifest.exists():
        return b""
    return b"note: %b is kept; --resume continues the run.\n" % os.fsencode(_manifest.parent)

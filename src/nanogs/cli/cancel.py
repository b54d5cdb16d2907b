"""Ctrl-C and other requests to stop: the command cleans up, says so in a word, and ends at once.

No exception is raised: one could be swallowed by whatever happens to run, in Numba's import for
one, or wait for threads to end.
"""

import atexit
import os
import signal
from collections.abc import Iterable
from contextlib import suppress
from functools import partial
from types import FrameType

from nanogs.cleanup import clean_all, when_undisturbed

_CLEAR = b"\r\x1b[K\x1b[?25h"  # the line of a progress bar, which hides the cursor


def listen() -> None:
    """Have requests to stop end the command; those that its caller ignores stay ignored.

    They are ignored once the work is done: Python gives up its handlers as it ends, so that one
    that comes then would make a failure of a run that has delivered.
    """
    atexit.register(_ignore)  # the first to be registered is called last
    for number in _requests():
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _stop)


def _requests() -> Iterable[signal.Signals]:
    names = ("SIGINT", "SIGTERM", "SIGHUP")  # the last is not known on Windows
    return [signal.Signals[name] for name in names if hasattr(signal, name)]


def _stop(number: int, _frame: FrameType | None) -> None:
    _ignore()
    when_undisturbed(partial(_end, number))


def _ignore() -> None:
    for number in _requests():
        signal.signal(number, signal.SIG_IGN)


def _end(number: int) -> None:
    clean_all()
    with suppress(OSError):
        os.write(2, (_CLEAR if os.isatty(2) else b"") + b"cancelled\n")
    os._exit(128 + number)  # as the shell has it of programs that a signal ended

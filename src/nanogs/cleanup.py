"""Files and processes that must not outlive a run that is ended in the middle.

An exception runs `finally` blocks; a signal that ends the process at once does not. So what they
would do is also noted here, for the command to do before it ends (`nanogs.cli.cancel`).
"""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

_pending: dict[object, Callable[[], None]] = {}
_undisturbed = 0  # blocks that are not to be ended in their middle
_postponed: Callable[[], None] | None = None


@contextmanager
def cleaned_up(clean: Callable[[], None]) -> Iterator[None]:
    """Clean up when the block ends, and also if the process is ended in it.

    Args:
        clean: May be called twice, and when there is nothing to clean up.
    """
    entry = object()
    _pending[entry] = clean
    try:
        yield
    finally:
        clean()
        del _pending[entry]


@contextmanager
def temporary_folder(prefix: str) -> Iterator["Path"]:
    """An empty folder where the system keeps temporary ones; it goes when the block ends."""
    from pathlib import Path
    from tempfile import TemporaryDirectory  # here, as the command imports this file at once

    made: list[TemporaryDirectory[str]] = []

    def remove() -> None:
        for folder in made:
            folder.cleanup()

    with cleaned_up(remove):
        with undisturbed():
            made.append(TemporaryDirectory(prefix=prefix, ignore_cleanup_errors=True))
        yield Path(made[0].name)


def clean_at_end(clean: Callable[[], None]) -> None:
    """Have something done if the process is ended from outside."""
    _pending[object()] = clean


def clean_all() -> None:
    """Do all that is pending, the latest first; what fails is left."""
    for clean in reversed(list(_pending.values())):
        with suppress(Exception):
            clean()


@contextmanager
def undisturbed() -> Iterator[None]:
    """Put off the end of the process until the block is done, which takes no time to speak of."""
    global _undisturbed  # noqa: PLW0603
    _undisturbed += 1
    try:
        yield
    finally:
        _undisturbed -= 1
        if _postponed and not _undisturbed:
            _postponed()


@contextmanager
def starting_processes() -> Iterator[None]:
    """Start processes in this block: they are there whole, or not at all, when this one is ended.

    One that was left while it starts would miss what it is to do, and say so in a traceback. They
    inherit from the thread that starts them that interrupts wait (not on Windows): Ctrl-C reaches
    every process of a terminal, and is for the first of them to deal with.
    """
    with undisturbed():
        if not hasattr(signal, "pthread_sigmask"):
            yield
            return
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def when_undisturbed(end: Callable[[], None]) -> None:
    """End the process now, or as soon as nothing speaks against it.

    Args:
        end: Does not return.
    """
    global _postponed  # noqa: PLW0603
    if _undisturbed:
        _postponed = end
    else:
        end()

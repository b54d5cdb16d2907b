"""Clean-up of temporary files and child processes when a run is killed by a signal.

An exception runs `finally` blocks; a signal that ends the process at once does not. So their
actions are also registered here, and the command runs them before it ends (`nanogs.cli.cancel`).
"""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from threading import RLock
from typing import TYPE_CHECKING

from nanogs.errors import OutputError

if TYPE_CHECKING:
    from pathlib import Path

# What to do if the system's temporary folder takes no more files.
NO_ROOM_REMEDY = "free some space, or name another place in TMPDIR"

_pending: dict[object, Callable[[], None]] = {}
_undisturbed = 0  # number of blocks, nested or in several threads, in which it must not end
_postponed: Callable[[], None] | None = None  # ends the process as soon as it may
# Held to read or change these two. A handler of a signal may hold it while its thread does.
_counting = RLock()


@contextmanager
def cleaned_up(clean: Callable[[], None]) -> Iterator[None]:
    """Clean up when the block ends, and also if a signal ends the process within it.

    Args:
        clean: Clean-up function; may be called twice, and when there is nothing to clean up.
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
    """Make an empty folder in the system's temporary folder; it is removed when the block ends.

    Raises:
        OutputError: It cannot be made.
    """
    from pathlib import Path
    from tempfile import TemporaryDirectory  # imported late: the command imports this file at start

    made: list[TemporaryDirectory[str]] = []

    def remove() -> None:
        for folder in made:
            folder.cleanup()

    with cleaned_up(remove):
        try:
            with defer_exit():
                made.append(TemporaryDirectory(prefix=prefix, ignore_cleanup_errors=True))
        except OSError as error:
            raise OutputError(
                f"No temporary folder can be made ({error.strerror or error}); {NO_ROOM_REMEDY}."
            ) from error
        yield Path(made[0].name)


def on_signal(clean: Callable[[], None]) -> Callable[[], None]:
    """Register a function to be called if a signal ends the process.

    Returns:
        A function that takes it back; may be called twice.
    """
    entry = object()
    _pending[entry] = clean

    def forget() -> None:
        _pending.pop(entry, None)

    return forget


def clean_all() -> None:
    """Call all registered functions, the latest first; exceptions are ignored."""
    for clean in reversed(list(_pending.values())):
        with suppress(Exception):
            clean()


@contextmanager
def defer_exit() -> Iterator[None]:
    """Postpone the end of the process by a signal until the block, which must be short, is done."""
    global _undisturbed  # noqa: PLW0603
    with _counting:
        _undisturbed += 1
    try:
        yield
    finally:
        with _counting:
            _undisturbed -= 1
        _end_if_allowed()


@contextmanager
def starting_processes() -> Iterator[None]:
    """Protect the start of child processes in this block from signals.

    If this process ends, each child has either started completely or not at all: one that lost its
    parent while it starts would print a traceback. The children inherit a signal mask that blocks
    interrupts (not on Windows), because Ctrl-C reaches every process of a terminal, and the parent
    alone handles it.
    """
    with defer_exit():
        if not hasattr(signal, "pthread_sigmask"):
            yield
            return
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def exit_when_allowed(end: Callable[[], None]) -> None:
    """End the process now, or after the last `defer_exit` block.

    Args:
        end: Function that ends the process; does not return.
    """
    global _postponed  # noqa: PLW0603
    with _counting:
        _postponed = end
    _end_if_allowed()


def _end_if_allowed() -> None:
    """End the process if that was asked for, no block postpones it, and no thread does it yet."""
    global _postponed
    end = None
    with _counting:
        if not _undisturbed:
            end, _postponed = _postponed, None
    if end:
        end()

"""Whom to tell when kernels are compiled rather than taken from the cache; imports no Numba."""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Lock

_log = logging.getLogger("nanogs")
_lock = Lock()
_waiting: list[Callable[[], None]] = []
_watching: list[Callable[[bool], None]] = []
_running = 0  # kernels that are being compiled, one within the other
_logged = False


def when_compiling(callback: Callable[[], None]) -> None:
    """Have a function called once, should a kernel not be in the cache and so take seconds."""
    _waiting.append(callback)


@contextmanager
def watching(callback: Callable[[bool], None]) -> Iterator[None]:
    """Have a function called with True when compiling begins and with False when it ends.

    Who watches tells it, so that nothing is logged.
    """
    _watching.append(callback)
    try:
        yield
    finally:
        _watching.remove(callback)


def begin() -> None:
    """A kernel is being compiled."""
    global _running  # noqa: PLW0603
    with _lock:
        _running += 1
        first = _running == 1
    while _waiting:
        _waiting.pop()()
    if first:
        _tell(begun=True)


def end() -> None:
    """A kernel has been compiled."""
    global _running  # noqa: PLW0603
    with _lock:
        _running -= 1
        last = _running == 0
    if last:
        _tell(begun=False)


def _tell(*, begun: bool) -> None:
    global _logged  # noqa: PLW0603
    for callback in _watching:
        callback(begun)
    if begun and not _watching and not _logged:
        _logged = True
        _log.warning(
            "Kernels are being compiled for this processor, which takes up to half a minute;"
            " later runs find them on the disk."
        )

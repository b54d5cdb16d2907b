"""Callbacks for when kernels are compiled rather than loaded from the cache; imports no Numba."""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Lock

# What the displays of progress say meanwhile; the second if the cache cannot be written to.
COMPILING = "compiling for this processor; later runs find it on the disk"
COMPILING_UNSAVED = "compiling for this processor"

_log = logging.getLogger("nanogs")
_lock = Lock()
_waiting: list[Callable[[], None]] = []
_watching: list[Callable[[bool], None]] = []
_running = 0  # number of kernels being compiled; nested if one calls another
_logged = False
_savable = True  # whether the cache of every kernel compiled so far can be written to
_unsaved = ""  # why compiled kernels were not saved; empty if they were


def when_compiling(callback: Callable[[], None]) -> None:
    """Register a function to be called once, when a kernel has to be compiled, which takes seconds.

    It is not called if all kernels are in the cache.
    """
    with _lock:
        _waiting.append(callback)


@contextmanager
def watching(callback: Callable[[bool], None]) -> Iterator[None]:
    """Within the block, call a function with True when compiling begins and False when it ends.

    The caller is expected to report it, so that no warning is logged.
    """
    _watching.append(callback)
    try:
        yield
    finally:
        _watching.remove(callback)


def begin(*, savable: bool = True) -> None:
    """Record that a kernel is being compiled, and call the callbacks that wait for that.

    Args:
        savable: Whether its cache can be written to, as far as is known.
    """
    global _running, _savable  # noqa: PLW0603
    with _lock:
        _running += 1
        _savable &= savable
        first = _running == 1
        callbacks = _waiting.copy()
        _waiting.clear()
    for callback in callbacks:
        callback()
    if first:
        _notify(begun=True)


def end() -> None:
    """Record that a kernel has been compiled; if it was the last, call those of `watching`."""
    global _running  # noqa: PLW0603
    with _lock:
        _running -= 1
        last = _running == 0
    if last:
        _notify(begun=False)


def remark() -> str:
    """Return what a display of progress says while kernels are compiled."""
    return COMPILING if _savable else COMPILING_UNSAVED


def note_unsaved(folder: str, error: OSError) -> None:
    """Record that a compiled kernel could not be saved, so that the next run compiles it again.

    It is logged once, unless `watching` is in use: then the caller is to report `unsaved`.
    """
    global _unsaved
    first, _unsaved = not _unsaved, unsaved_text(folder, error)
    if first and not _watching:
        _log.warning(_unsaved)


def unsaved() -> str:
    """Return a sentence for the user if a compiled kernel could not be saved; else an empty one."""
    return _unsaved


def unsaved_text(folder: str, error: OSError) -> str:
    """Return a sentence that says why compiled kernels are not saved, and what to do."""
    return (
        f"Compiled kernels cannot be saved in {folder} ({error.strerror or error}); set"
        " NUMBA_CACHE_DIR to a folder that can be written to."
    )


def _notify(*, begun: bool) -> None:
    global _logged  # noqa: PLW0603
    for callback in _watching:
        callback(begun)
    if begun and not _watching and not _logged:
        _logged = True
        found = "; later runs find them on the disk" if _savable else ""
        _log.warning(
            "Kernels are being compiled for this processor, which takes some 5 to 30 seconds%s.",
            found,
        )

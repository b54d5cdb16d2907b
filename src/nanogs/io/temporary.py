"""Temporary files and folders beside an output, and what killed runs have left of them.

Each is locked by the process that fills it. The system lets go of the lock when the process ends,
however that is; so what is not locked, and was made on this machine for the same output, is left
over.
"""

import hashlib
import os
import shutil
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from secrets import token_hex

from nanogs.cleanup import cleaned_up
from nanogs.errors import OutputError

try:
    import fcntl
except ImportError:  # Windows: nothing is locked, and nothing taken away
    fcntl = None  # type: ignore[assignment]


def name_beside(target: Path, suffix: str = ".tmp") -> Path:
    """A name that nothing has yet, in the folder of a target and of the same file system."""
    return target.with_name(f"{_prefix(target)}{token_hex(8)}{suffix}")


@contextmanager
def temporary(target: Path, make: Callable[[Path], None]) -> Iterator[Path]:
    """Something new beside a target; it is gone when the block ends, unless it was renamed.

    Args:
        target: What it is to become.
        make: Makes an empty file or folder of a name.

    Raises:
        OSError: It cannot be made.
    """
    sweep(target)
    path = name_beside(target)
    with cleaned_up(partial(_remove, path)):
        make(path)
        with locked(path):
            yield path


def no_room(what: str, error: OSError) -> OutputError:
    """The error of something that a temporary file does not take.

    Args:
        what: What cannot be done: "scene.spz cannot be unpacked".
        error: Why.
    """
    reason = error.strerror or str(error)
    return OutputError(
        f"{what} into a temporary file ({reason}); free some space, or name another place in"
        " TMPDIR."
    )


def left_beside(target: Path, suffix: str) -> Iterator[Path]:
    """Yield the files that killed runs left beside a target, each locked until the next."""
    if not fcntl:
        return
    for path in target.parent.glob(f"{_prefix(target)}*{suffix}"):
        with suppress(OSError), _taken(path):
            yield path


def _prefix(target: Path) -> str:
    """The prefix of all names that are made for a target on this machine."""
    whose = f"{socket.gethostname()}/{target.name}".encode(errors="surrogateescape")
    return f".nanogs-{hashlib.sha256(whose).hexdigest()[:8]}-"


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold a file or folder for as long as this process lives, where the file system can."""
    held = None
    if fcntl:
        held = os.open(path, os.O_RDONLY)
        with suppress(OSError):
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
    try:
        yield
    finally:
        if held is not None:
            os.close(held)


def sweep(target: Path) -> None:
    """Take away what killed runs have left beside a target."""
    for path in left_beside(target, ".tmp"):
        _remove(path)


@contextmanager
def _taken(path: Path) -> Iterator[None]:
    """Hold what no living process does.

    Raises:
        OSError: One does, or the file system does not tell.
    """
    held = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(held)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink(missing_ok=True)

"""Temporary files and folders beside an output, and nameless files in the system's folder for them.

Those that killed runs have left beside an output are removed. Each is locked by the process that
fills it. The system releases the lock when the process ends, in whatever way; so one that is not
locked, and was made on this machine for the same output, is a leftover.
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
from tempfile import TemporaryFile
from typing import IO

from nanogs.cleanup import NO_ROOM_REMEDY, cleaned_up
from nanogs.errors import OutputError

try:
    import fcntl
except ImportError:  # Windows: nothing is locked, and leftovers are not removed
    fcntl = None  # type: ignore[assignment]


def name_beside(target: Path, suffix: str = ".tmp") -> Path:
    """Return an unused path in the folder of a target, and so on the same file system."""
    return target.with_name(f"{_prefix(target)}{token_hex(8)}{suffix}")


@contextmanager
def temporary(target: Path, make: Callable[[Path], None]) -> Iterator[Path]:
    """Make a temporary file or folder beside a target; removed after the block unless renamed.

    Args:
        target: The final path.
        make: Creates an empty file or folder at a path.

    Raises:
        OSError: It cannot be made.
    """
    sweep(target)
    path = name_beside(target)
    with cleaned_up(partial(_remove, path)):
        make(path)
        with locked(path):
            yield path


@contextmanager
def into_temporary(what: str = "The model cannot be written") -> Iterator[None]:
    """Convert an `OSError` of making or writing temporary files to an `OutputError`.

    Without it, the output would be named, which may be on another disk.

    Args:
        what: The operation that fails; see `temporary_file_error`.
    """
    try:
        yield
    except OSError as error:
        raise temporary_file_error(what, error) from error


@contextmanager
def nameless_file() -> Iterator[IO[bytes]]:
    """Make a file without a name in the system's temporary folder; it is gone after the block.

    Raises:
        OutputError: It cannot be made.
    """
    with into_temporary():
        file = TemporaryFile(prefix="nanogs-")  # noqa: SIM115 - closed below
    try:
        yield file
    finally:
        close_quietly(file)


def close_quietly(file: IO[bytes]) -> None:
    """Close a file that is not needed any more; a full disk would raise for its last bytes."""
    with suppress(OSError):
        file.close()


def temporary_file_error(what: str, error: OSError) -> OutputError:
    """Build the error for a temporary file that cannot be written, such as for a full disk.

    Args:
        what: The operation that failed: "scene.spz cannot be unpacked".
        error: The reason.
    """
    reason = error.strerror or str(error)
    return OutputError(f"{what} into a temporary file ({reason}); {NO_ROOM_REMEDY}.")


def left_beside(target: Path, suffix: str) -> Iterator[Path]:
    """Yield the leftovers of killed runs beside a target, each locked until the next is yielded."""
    if not fcntl:
        return
    for path in target.parent.glob(f"{_prefix(target)}*{suffix}"):
        with suppress(OSError), _taken(path):
            yield path


def _prefix(target: Path) -> str:
    """Return the prefix of all temporary names for a target on this machine."""
    whose = f"{socket.gethostname()}/{target.name}".encode(errors="surrogateescape")
    return f".nanogs-{hashlib.sha256(whose).hexdigest()[:8]}-"


@contextmanager
def locked(path: Path) -> Iterator[bool]:
    """Lock a file or folder during the block, if it can be read and the file system supports locks.

    Yields:
        False if another process has locked it.
    """
    held, alone = None, True
    if fcntl:
        with suppress(OSError):
            held = os.open(path, os.O_RDONLY)
            try:
                fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                alone = False
    try:
        yield alone
    finally:
        if held is not None:
            os.close(held)


def sweep(target: Path) -> None:
    """Remove the temporary files and folders that killed runs have left beside a target."""
    for path in left_beside(target, ".tmp"):
        _remove(path)


@contextmanager
def _taken(path: Path) -> Iterator[None]:
    """Lock a file or folder during the block, if no living process has locked it.

    Raises:
        OSError: It is locked, or the file system does not support locks.
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

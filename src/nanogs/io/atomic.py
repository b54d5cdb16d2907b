"""Output files that appear whole or not at all.

The bytes go to a temporary file beside the target, which then takes the target's place. A target
that is a symbolic link is written through: the file it points to is replaced, the link stays.
"""

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from nanogs.errors import ExistsError, OutputError
from nanogs.io.temporary import temporary

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_DENIED = (errno.EACCES, errno.EPERM, errno.EROFS)


@contextmanager
def atomic_write(path: Path, *, overwrite: bool = False) -> Iterator[BinaryIO]:
    """Yield a temporary binary file, renamed to `path` if the block ends without an exception.

    A new file gets the permission bits of a plain `open`, a replaced one keeps its own.

    Raises:
        OutputError: The target exists and `overwrite` is off, or it cannot be written.
    """
    target = _target(path, overwrite=overwrite)
    with writing(path), temporary(target, _make) as made:
        with made.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        _take_place(made, target, path, overwrite=overwrite)


def move_into_place(made: Path, path: Path, *, overwrite: bool = False) -> None:
    """Give a finished file its final name, in a folder of the same file system.

    Args:
        made: The file, of which all bytes reach the disk first.
        path: Its final path.
        overwrite: Replace a file that exists.

    Raises:
        OutputError: As for `atomic_write`; the file is then still where it was.
    """
    target = _target(path, overwrite=overwrite)
    with writing(path):
        with made.open("r+b") as file:
            os.fsync(file.fileno())
        _take_place(made, target, path, overwrite=overwrite)


def check_writable(path: Path, *, overwrite: bool = False) -> None:
    """Fail now if `atomic_write` would fail later, short of a full disk.

    Raises:
        OutputError: As for `atomic_write`.
    """
    target = _target(path, overwrite=overwrite)
    # Read-only mounts and access control lists only show when a file is created.
    with writing(path), temporary(target, _make):
        pass


def _make(path: Path) -> None:
    path.open("xb").close()


def _target(path: Path, *, overwrite: bool) -> Path:
    """Resolve symbolic links and check the target; nothing is created or changed."""
    with writing(path):
        target = Path(os.path.realpath(path))
        _check_target(path, target, overwrite=overwrite)
        return target


def refuse_without_parent(path: Path, target: Path) -> None:
    """Refuse an output for which there is no folder.

    Args:
        path: The output.
        target: The same with its symbolic links resolved.

    Raises:
        OutputError: The folder does not exist, or is a file; or the links lead round in a circle.
    """
    if target.is_symlink():  # those that lead somewhere are resolved
        raise OutputError(f"{path} is a symbolic link to itself; remove it first.")
    if not target.parent.exists():
        raise OutputError(f"The folder {target.parent} does not exist; create it first.")
    if not target.parent.is_dir():
        raise OutputError(f"{target.parent} is no folder; choose another output.")


def _check_target(path: Path, target: Path, *, overwrite: bool) -> None:
    if target.is_dir():
        raise OutputError(f"{path} is a folder; name a file in it as the output.")
    refuse_without_parent(path, target)
    if not target.exists():
        return
    if not target.is_file():
        raise OutputError(f"{path} is no regular file; choose another output.")
    if not overwrite:
        raise ExistsError(f"{path} exists already")
    refuse_read_only(path, target)


def refuse_read_only(path: Path, target: Path) -> None:
    """Refuse to replace a file or folder that may not be written to.

    Args:
        path: The output, or a part of it, for the message.
        target: The same with symbolic links resolved.

    Raises:
        OutputError: It is read-only.
    """
    if not os.access(target, os.W_OK):
        raise OutputError(f"{path} is read-only; change its permissions or the output.")


def keep_mode(made: Path, target: Path) -> None:
    """Give what takes the place of a file or folder the permission bits that this has."""
    made.chmod(stat.S_IMODE(target.stat().st_mode))


def _take_place(made: Path, target: Path, path: Path, *, overwrite: bool) -> None:
    """Rename the file, after a second check: minutes may have passed since the first."""
    _check_target(path, target, overwrite=overwrite)
    if target.exists():
        keep_mode(made, target)
    if overwrite or not _linked(made, target, path):
        made.replace(target)


def _linked(made: Path, target: Path, path: Path) -> bool:
    """Rename a file by a link, which never replaces another; False if the system makes no links."""
    try:
        os.link(made, target)
    except FileExistsError:
        raise ExistsError(f"{path} exists already") from None
    except OSError:
        return False
    made.unlink()
    return True


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Convert an `OSError` of the block to an `OutputError`.

    Args:
        path: The output, for the message.
    """
    try:
        yield
    except OSError as error:
        raise output_error(path, error) from error


def output_error(path: Path, error: OSError) -> OutputError:
    """Build the `OutputError` for an `OSError`, with a message for the user."""
    if error.errno in _FULL:
        return OutputError(f"{path}: the disk or quota is full; free some space and run again.")
    if error.errno in _DENIED:
        return OutputError(
            f"{path}: the folder {path.parent} cannot be written to; change its permissions or"
            " choose another output."
        )
    reason = error.strerror or str(error)
    return OutputError(f"{path} cannot be written ({reason}); choose another output.")

"""Checks on an input file that every reader makes first."""

import errno
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from nanogs.errors import FormatError

# Bytes in memory of a model that is never refused as a decompression bomb, however small its file:
# a model of many equal splats compresses to almost nothing.
_SMALL_MODEL = 128 << 20
# Most bytes in memory for each byte of the file, for a larger model. Centres and colours compress
# badly: real files have 10 to 50 bytes per splat, and its 56 to 344 bytes in memory are 3 to 30
# times that.
_MAX_EXPANSION = 64
_LFS_POINTER = b"version https://git-lfs.github.com/spec/"
_WEB_PAGE = (b"<!doctype", b"<html", b"<head", b"<body", b"<?xml")
HEAD_BYTES = 256  # bytes at the start of a file that show whether it is a pointer or a web page


def input_size(path: Path) -> int:
    """Return the size of an input file in bytes, after the checks that every reader needs.

    Raises:
        FormatError: There is no such file, it is no regular file, it is empty, or it is a Git LFS
            pointer or a web page; see `refuse_stand_in`.
    """
    try:
        status = path.stat()
    except FileNotFoundError:
        raise FormatError(f"{path}: no such file; check the path.") from None
    except (OSError, ValueError) as error:
        raise unreadable(path, error) from error
    if stat.S_ISDIR(status.st_mode):
        raise FormatError(f"{path} is a folder; name the model file inside it.")
    if not stat.S_ISREG(status.st_mode):
        raise FormatError(f"{path} is no regular file; copy the model to a file first.")
    if status.st_size == 0:
        raise FormatError(f"{path} is empty (0 bytes); export or download it again.")
    with reading(path) as file:
        refuse_stand_in(path, file.read(HEAD_BYTES))
    return status.st_size


@contextmanager
def reading(path: Path, buffering: int = -1) -> Iterator[BinaryIO]:
    """Open a file for reading bytes, converting an `OSError` to a `FormatError`.

    Args:
        path: The file.
        buffering: Passed to `open`.

    Raises:
        FormatError: The file cannot be opened, or the block raises an `OSError`.
    """
    try:
        with path.open("rb", buffering=buffering) as file:
            yield file
    except OSError as error:
        raise unreadable(path, error) from error


def refuse_stand_in(path: Path, start: bytes, wanted: str = "model") -> None:
    """Refuse a Git LFS pointer or a web page, which downloads leave in place of a file.

    Args:
        path: The file, for the message.
        start: Its first bytes.
        wanted: What the file should be, for the message.

    Raises:
        FormatError: It is one of these.
    """
    if start.startswith(_LFS_POINTER):
        raise FormatError(f"{path} is a Git LFS pointer, not the file itself: run git lfs pull.")
    if start.removeprefix(b"\xef\xbb\xbf").lstrip().lower().startswith(_WEB_PAGE):
        raise FormatError(
            f"{path} is a web page, not a {wanted}; download the file that it links to."
        )


def splat_bytes(degree: int) -> int:
    """Compute the bytes that a splat of an SH degree takes in memory, without extra columns."""
    return 4 * (3 + 3 + 4 + 1 + 3 * (degree + 1) ** 2)


def check_expansion(where: str, model_bytes: int, file_bytes: int) -> None:
    """Refuse a decompression bomb: a file that states a model far too large for its own size.

    Args:
        where: The file, for the message.
        model_bytes: Size of the model in memory, computed from the counts that the file states.
        file_bytes: Size of the file.

    Raises:
        FormatError: The ratio of both is too large.
    """
    if model_bytes > max(_SMALL_MODEL, _MAX_EXPANSION * file_bytes):
        raise FormatError(
            f"{where} describes a model of {model_bytes:,} bytes in a file of {file_bytes:,}, far"
            " more than splats can be compressed; export or download it again."
        )


def unreadable(path: Path, error: Exception) -> FormatError:
    """Build the error for a file that exists but that the system does not let us read."""
    if isinstance(error, OSError) and error.errno == errno.ELOOP:
        return FormatError(f"{path} is a symbolic link to itself; name the file that is meant.")
    reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return FormatError(f"{path} cannot be read ({reason}); check its permissions.")


def damaged(where: object, what: str) -> FormatError:
    """Build the error for a file whose contents contradict each other.

    Args:
        where: The file, and perhaps the part of it.
        what: The contradiction.
    """
    return FormatError(f"{where} is damaged: {what}; export or download it again.")

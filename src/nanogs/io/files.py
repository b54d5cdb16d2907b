"""Checks on an input file that every reader makes first."""

import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from nanogs.errors import FormatError

# Rows decoded or encoded at a time: bounds the memory beside the model; at 250 bytes a row a block
# of this size stays in the cache, and is encoded twice as fast as one of 64 K rows.
BLOCK_ROWS = 8192
# Packed files whose model takes no more are never refused for it, however small they are: models of
# equal splats are honest.
_SMALL_MODEL = 128 << 20
# Most bytes in memory for each byte of the file of a larger model. Centres and colours do not pack
# well: real files have 10 to 50 bytes a splat, whose 56 to 344 in memory are 3 to 30 times that.
_MAX_EXPANSION = 64
_LFS_POINTER = b"version https://git-lfs.github.com/spec/"
_WEB_PAGE = (b"<!doctype", b"<html", b"<head", b"<body", b"<?xml")
TOLD_BY = 256  # bytes at a file's beginning that tell a pointer or a web page


def input_size(path: Path) -> int:
    """Size of an input file in bytes.

    Raises:
        FormatError: There is no such file, it is no regular file, it is empty, or something else
            lies in its place; see `refuse_stand_in`.
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
        refuse_stand_in(path, file.read(TOLD_BY))
    return status.st_size


@contextmanager
def reading(path: Path, buffering: int = -1) -> Iterator[BinaryIO]:
    """A file, open for reading bytes.

    Args:
        path: The file.
        buffering: As `open` takes it.

    Raises:
        FormatError: The system refuses, now or in the block.
    """
    try:
        with path.open("rb", buffering=buffering) as file:
            yield file
    except OSError as error:
        raise unreadable(path, error) from error


def refuse_stand_in(path: Path, start: bytes) -> None:
    """Refuse what downloads leave in a file's place: a Git LFS pointer, or a web page.

    Args:
        path: The file, for the message.
        start: Its first bytes.

    Raises:
        FormatError: It is one of these.
    """
    if start.startswith(_LFS_POINTER):
        raise FormatError(f"{path} is a Git LFS pointer, not the file itself: run git lfs pull.")
    if start.removeprefix(b"\xef\xbb\xbf").lstrip().lower().startswith(_WEB_PAGE):
        raise FormatError(f"{path} is a web page, not a model; download the file that it links to.")


def splat_bytes(degree: int) -> int:
    """Bytes that a splat of an SH degree takes in memory, extra columns aside."""
    return 4 * (3 + 3 + 4 + 1 + 3 * (degree + 1) ** 2)


def check_expansion(where: str, model_bytes: int, file_bytes: int) -> None:
    """Refuse a packed file that states a model far larger than an honest one of its size has.

    Args:
        where: The file, for the message.
        model_bytes: What the model would take in memory, by what the file states.
        file_bytes: Size of the file.

    Raises:
        FormatError: It is a bomb.
    """
    if model_bytes > max(_SMALL_MODEL, _MAX_EXPANSION * file_bytes):
        raise FormatError(
            f"{where} states a model of {model_bytes:,} bytes in {file_bytes:,}, far more than"
            " splats can be packed; export or download it again."
        )


def unreadable(path: Path, error: Exception) -> FormatError:
    """The error for a file that exists but that the system will not let us read."""
    reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return FormatError(f"{path} cannot be read ({reason}); check its permissions.")

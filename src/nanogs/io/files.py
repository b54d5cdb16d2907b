"""Checks on an input file that every reader makes first."""

import stat
from pathlib import Path

from nanogs.errors import FormatError

# Rows decoded or encoded at a time: bounds the memory beside the model; at 250 bytes a row a block
# of this size stays in the cache, and is encoded twice as fast as one of 64 K rows.
BLOCK_ROWS = 8192


def input_size(path: Path) -> int:
    """Size of an input file in bytes.

    Raises:
        FormatError: There is no such file, it is no regular file, or it is empty.
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
    return status.st_size


def unreadable(path: Path, error: Exception) -> FormatError:
    """The error for a file that exists but that the system will not let us read."""
    reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return FormatError(f"{path} cannot be read ({reason}); check its permissions.")

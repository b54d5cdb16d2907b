"""Error messages for failures of the system, such as running out of memory or names too long."""

import re
import traceback
from pathlib import Path

from nanogs.cli.wording import reworded

_REMEDY = (
    "free some, raise its limit (`ulimit`, the container), or let simplify and lod work in less"
    " with --max-memory"
)


def sentence_of(error: Exception) -> str | None:
    """Return a message for an error that the system caused; None for any other error.

    Args:
        error: The error that ended the command. If memory ran out, the objects that its traceback's
            frames hold are released first.

    Returns:
        One sentence, followed by the notes that the library added to the error.
    """
    said = _reason(error)
    notes = map(reworded, getattr(error, "__notes__", ()))
    return said and " ".join([said, *notes])


def _reason(error: Exception) -> str | None:
    if is_shortage(error):
        traceback.clear_frames(error.__traceback__)
        asked = re.search(r"Unable to allocate ([\d.]+) (\w+)", str(error))  # NumPy: `183. MiB`
        wanted = f" ({asked[1].rstrip('.')} {asked[2]} more were needed)" if asked else ""
        return f"Memory ran out{wanted}; {_REMEDY}."
    if isinstance(error, OSError) and error.errno is not None and error.filename is not None:
        reason = error.strerror or type(error).__name__
        return f"{error.filename}: {reason}; name another file or folder."
    if isinstance(error, FileNotFoundError) and not _has_folder():
        return "The current folder does not exist any more; change to another one."
    return None


def _has_folder() -> bool:
    """Return whether the current folder still exists."""
    try:
        Path.cwd()
    except FileNotFoundError:
        return False
    return True


def is_shortage(error: Exception) -> bool:
    """Return whether the error means that memory ran out: for data, a thread, or a library."""
    if isinstance(error, MemoryError):
        return True
    if isinstance(error, RuntimeError):
        return "can't start new thread" in str(error)
    if isinstance(error, ImportError | OSError):
        said = str(error).lower()
        unmapped = "shared object" in said or "cannot allocate memory" in said
        return unmapped and _is_limited()
    return False


def _is_limited() -> bool:
    """Return whether a `ulimit` bounds memory, which also limits the mapping of libraries."""
    from nanogs.memory import set_ulimits

    return any(True for _ in set_ulimits())

"""Whether paths exist, answered also where the system refuses to look, and paths to suggest.

The methods of `Path` raise for a name that is too long and, before Python 3.14, for a
folder that may not be searched.
"""

import os
from os import PathLike
from pathlib import Path


def exists(path: str | PathLike[str]) -> bool:
    """Return whether there is a file or folder that can be looked at."""
    return os.path.exists(path)  # noqa: PTH110


def is_file(path: str | PathLike[str]) -> bool:
    """Return whether there is a file that can be looked at."""
    return os.path.isfile(path)  # noqa: PTH113


def is_folder(path: str | PathLike[str]) -> bool:
    """Return whether there is a folder that can be looked at."""
    return os.path.isdir(path)  # noqa: PTH112


def why_refused(path: str | PathLike[str]) -> str | None:
    """Return why the system refuses to look at a path; None if it exists or simply does not."""
    try:
        os.stat(path)  # noqa: PTH116
    except (FileNotFoundError, NotADirectoryError, ValueError):  # the last for a NUL in the name
        return None
    except OSError as error:
        return error.strerror or str(error)
    return None


def suggested(path: Path, suffix: str) -> Path:
    """Return a path with another suffix, for a message; of `.`, `..` and `/` a file in them."""
    return path.with_suffix(suffix) if path.name.strip(".") else path / f"scene{suffix}"

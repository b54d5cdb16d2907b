"""The name of the program in the files that it writes, and recognising these files by it."""

import json
from pathlib import Path
from typing import Any

from nanogs._version import __version__
from nanogs.paths import is_file

_NAME = "nanogs"
GENERATOR = f"{_NAME} {__version__}"
"""The program's name and version, as written into files."""


def read_own(path: Path, *keys: str) -> dict[str, Any] | None:
    """Read a JSON file if nanogs wrote it, in any version; None for other files and for pipes.

    Args:
        path: The file.
        keys: Names of the nested fields that lead to the name of the program.
    """
    if not is_file(path):
        return None
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        named: Any = data
        for key in keys:
            named = named[key]
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return None
    own = isinstance(named, str) and named.partition(" ")[0] == _NAME
    return data if own and isinstance(data, dict) else None

"""Shared by the chunked layouts: the splats of a level in the order of their cells."""

import json
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from nanogs._types import I64
from nanogs._version import __version__
from nanogs.errors import OptionError
from nanogs.io.json_fields import is_plain
from nanogs.lod.cells import Cells
from nanogs.splats import Splats

GENERATOR = "nanogs"


class Written(NamedTuple):
    """The files of a level.

    Attributes:
        names: Each model's file, as a path from the folder with slashes.
        bytes: Size of these files and of those that they name.
    """

    names: tuple[str, ...]
    bytes: int


class SortedLevel:
    """A level whose splats are taken cell by cell."""

    def __init__(self, splats: Splats, cells: Cells) -> None:
        """Sort the splats.

        Args:
            splats: N splats, all finite.
            cells: What they are sorted into.
        """
        # What no chunk holds is not copied into any.
        self._splats = replace(splats, extras={}, comments=(), elements=(), notes=())
        self.leaves = cells.leaf_of(splats.means)
        self.counts = np.bincount(self.leaves, minlength=cells.count)
        self._order = np.argsort(self.leaves, kind="stable")
        self._starts = np.concatenate([[0], np.cumsum(self.counts)])

    def take(self, first: int, end: int) -> tuple[Splats, I64]:
        """The splats of a range of leaves, and the leaf of each, ascending."""
        rows = self._order[self._starts[first] : self._starts[end]]
        return self._splats.take(rows), self.leaves[rows]


def check_chunk(chunk: int) -> None:
    """Refuse what is no size of chunks.

    Raises:
        OptionError: It is below 1.
    """
    if chunk < 1:
        raise OptionError(f"A chunk must hold at least 1 splat, not {chunk}.")


def generator() -> str:
    """The program and its version, as it names itself in what it writes."""
    return f"{GENERATOR} {__version__}"


def read_own(path: Path, *keys: str) -> dict[str, Any] | None:
    """The JSON object of a file in which nanogs is named under these keys; None for other files."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        named: Any = data
        for key in keys:
            named = named[key]
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return None
    return data if isinstance(named, str) and named.startswith(GENERATOR) else None


def plain_paths(names: Iterable[object]) -> list[str]:
    """Keep paths that lead below the folder: those of a changed description may not."""
    return [name for name in names if isinstance(name, str) and all(map(is_plain, name.split("/")))]

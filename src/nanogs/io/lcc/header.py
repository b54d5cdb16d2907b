"""The header of an `.lcc` model, and the locations of its splats.

Layout, as splat-transform reads it (https://github.com/playcanvas/splat-transform, MIT), all
little-endian: a JSON file, `scene.lcc`, and files beside it, which have fixed names.

- The JSON has `totalLevel`, `splats` (the count of each level, 0 the finest), `fileType`
  ("Portable" without harmonics, "Quality" with degree 3; in older files, which lack this field,
  harmonics exist if `attributes` has `shcoef`) and `attributes`, of which `scale` and `shcoef` have
  a `min` and a `max` for x, y, z and for red, green, blue; `envscale` and `envshcoef` are those of
  the environment.
- `index.bin` has a row for each cell: its position x and y (i16), and for each level the number of
  splats (i32), the byte offset of the first in `data.bin` (i64) and the size in bytes (i32).
- `data.bin` has 32 bytes per splat, and `shcoef.bin` 64 for its harmonics, at twice the offset.
- `environment.bin`, which is optional, has the sky, 32 or 96 bytes per splat.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from nanogs._types import F64, I64
from nanogs.errors import FormatError
from nanogs.formatting import counted
from nanogs.io.files import input_size, reading
from nanogs.io.json_fields import integer, numbers, read_json, refused, rows, table

INDEX, DATA, HARMONICS, ENVIRONMENT = "index.bin", "data.bin", "shcoef.bin", "environment.bin"
ROW = np.dtype([
    ("mean", "<f4", 3), ("rgba", "u1", 4), ("scale", "<u2", 3), ("quat", "<u4"),
    ("normal", "<u2", 3),
])  # fmt: skip
SH_ROW = np.dtype([("sh", "<u4", 15), ("rest", "<u4")])
_MAX_JSON = 4 << 20
_MAX_INDEX = 64 << 20  # bytes; with five levels, a cell of some metres takes 84 bytes
MAX_LEVELS = 64
FRAME = "rfu"
_AGAIN = "export or download the model again."


@dataclass(frozen=True, slots=True)
class Ranges:
    """The values of the lowest and the highest code of quantised columns.

    Attributes:
        scale: (2, 3) float64, standard deviations, scene units.
        sh: (2, 3) float64, coefficients; None without harmonics.
    """

    scale: F64
    sh: F64 | None


@dataclass(frozen=True, slots=True)
class LevelLocation:
    """The location of the splats of a level, cell by cell.

    Attributes:
        offsets: (C,) int64, byte offset in `data.bin` of the first splat of each cell.
        ends: (C + 1,) int64, prefix sum of the number of splats per cell.
    """

    offsets: I64
    ends: I64

    @property
    def count(self) -> int:
        """Number of splats of the level."""
        return int(self.ends[-1])


class Header:
    """The header of an `.lcc` model, checked against the files beside it.

    Args:
        path: The JSON file.

    Raises:
        FormatError: A file is missing or damaged, or they contradict each other.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        data = read_json(path, _MAX_JSON)
        depth = integer(data.get("totalLevel"), f"{path}, totalLevel", 1, MAX_LEVELS)
        stated = rows(data.get("splats"), f"{path}, splats", depth)
        self.counts = [integer(count, f"{path}, splats", 0) for count in stated]
        attributes = _attributes(data, path)
        self.harmonics = _has_harmonics(data, attributes, path)
        self.ranges = self._ranges(attributes, "scale", "shcoef")
        self._environment_ranges = attributes
        self.levels = self._levels(depth)

    def beside(self, name: str) -> Path:
        """Return the path of the file with this name beside the JSON."""
        return self.path.with_name(name)

    @property
    def degree(self) -> int:
        """SH degree, 0 or 3."""
        return 3 if self.harmonics else 0

    @cached_property
    def environment_ranges(self) -> Ranges:
        """The ranges of the environment; those of the levels if it has none of its own.

        Raises:
            FormatError: They are damaged.
        """
        known = self._environment_ranges
        names = (f"env{name}" if f"env{name}" in known else name for name in ("scale", "shcoef"))
        return self._ranges(known, *names)

    @property
    def environment_row(self) -> "np.dtype[Any]":
        """The dtype of a row of `environment.bin`."""
        return np.dtype(ROW.descr + (SH_ROW.descr if self.harmonics else []))

    @cached_property
    def environment(self) -> int:
        """Number of splats of the environment; 0 if there is none.

        Raises:
            FormatError: Its file is damaged.
        """
        path, width = self.beside(ENVIRONMENT), self.environment_row.itemsize
        if not path.exists() or path.stat().st_size == 0:
            return 0
        count, rest = divmod(input_size(path), width)
        if rest:
            raise FormatError(f"{path} has no whole number of splats of {width} bytes; {_AGAIN}")
        return count

    def files(self) -> list[Path]:
        """Return the paths of all files of the model."""
        names = [INDEX, DATA, *([HARMONICS] if self.harmonics else [])]
        names += [ENVIRONMENT] if self.environment else []
        return [self.path, *map(self.beside, names)]

    def _ranges(self, attributes: Mapping[str, dict[str, Any]], scale: str, sh: str) -> Ranges:
        found = self._range(attributes, scale)
        if found.min() < 0:
            raise refused(f"{self.path}, attributes, {scale}", "has scales below 0")
        return Ranges(found, self._range(attributes, sh) if self.harmonics else None)

    def _range(self, attributes: Mapping[str, dict[str, Any]], name: str) -> F64:
        where, found = f"{self.path}, attributes, {name}", attributes.get(name)
        if found is None:
            raise refused(where, "is missing")
        edges = [numbers(found.get(edge), f"{where}, {edge}", 3) for edge in ("min", "max")]
        return np.array(edges)

    def _levels(self, depth: int) -> list[LevelLocation]:
        """Read the locations of each level's splats and check them against the files."""
        path = self.beside(INDEX)
        place = np.dtype([("count", "<i4"), ("offset", "<i8"), ("size", "<i4")])
        row = np.dtype([("x", "<i2"), ("y", "<i2"), ("levels", place, (depth,))])
        size = input_size(path)
        if size % row.itemsize or size > _MAX_INDEX:
            what = f"{size:,} bytes are not a whole number of cells of {counted(depth, 'level')}"
            raise FormatError(f"{path}: {what}, or too many; {_AGAIN}")
        with reading(path) as file:
            cells = np.frombuffer(file.read(size), row)["levels"]
        room = min(self._sizes())
        found = []
        for level, stated in enumerate(self.counts):
            counts = cells["count"][:, level].astype(np.int64)
            offsets = cells["offset"][:, level].astype(np.int64)
            held = counts != 0
            counts, offsets = counts[held], offsets[held]
            # No sum below can overflow: a cell has less than 2^31 splats, which is 2^36 bytes.
            if (counts < 0).any() or (offsets < 0).any() or (offsets > room).any():
                raise FormatError(
                    f"{path} has counts or offsets that are negative or too large; {_AGAIN}"
                )
            if (offsets + counts * ROW.itemsize > room).any() or counts.sum() * ROW.itemsize > room:
                raise FormatError(
                    f"{path}: the splats of level {level} do not fit into {DATA}; {_AGAIN}"
                )
            by_offset = np.argsort(offsets)
            starts, ends = offsets[by_offset], (offsets + counts * ROW.itemsize)[by_offset]
            if (starts[1:] < ends[:-1]).any():
                raise FormatError(f"{path}: cells of level {level} share splats; {_AGAIN}")
            if counts.sum() != stated:
                raise FormatError(
                    f"{path} has {counted(int(counts.sum()), 'splat')} in level {level}, but the"
                    f" .lcc says {stated:,}; {_AGAIN}"
                )
            found.append(LevelLocation(offsets, np.append(0, np.cumsum(counts))))
        return found

    def _sizes(self) -> list[int]:
        """Return the bytes of `data.bin` for which each of the files has data."""
        sizes = [input_size(self.beside(DATA))]
        return [*sizes, input_size(self.beside(HARMONICS)) // 2] if self.harmonics else sizes


def _attributes(data: Mapping[str, Any], path: Path) -> dict[str, dict[str, Any]]:
    """Return the attributes of the JSON by name."""
    where = f"{path}, attributes"
    given = [table(each, where) for each in rows(data.get("attributes"), where)]
    return {str(each.get("name")): each for each in given}


def _has_harmonics(data: Mapping[str, Any], attributes: Mapping[str, object], path: Path) -> bool:
    kind = data.get("fileType")
    if kind in ("Portable", "Quality"):
        return bool(kind == "Quality")
    if kind is not None:
        raise refused(f"{path}, fileType", 'must be "Portable" or "Quality"')
    return "shcoef" in attributes

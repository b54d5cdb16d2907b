"""The chunks of a streamed SOG: for each region of the scene, its rows in each level of detail."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nanogs._types import F64, I64
from nanogs.io.json_fields import numbers, refused, table
from nanogs.io.sog.levels import read_manifest


@dataclass(frozen=True, slots=True, eq=False)
class Chunks:
    """C regions of the scene, each with consecutive rows in L levels of detail.

    Attributes:
        boxes: (C, 2, 3) float64, the lowest and the highest corner of each region, scene units.
        starts: (C, L) int64, first row of the region in a level that is read; 0 if it has none.
        counts: (C, L) int64, number of rows of the region in a level.
        environment: Number of rows after those of all regions, the same in every level.
    """

    boxes: F64
    starts: I64
    counts: I64
    environment: int


def read_chunks(path: Path) -> Chunks:
    """Read the chunks from a `lod-meta.json`, or from the one in a `.ssog`.

    Raises:
        FormatError: It is missing or damaged, or a region has no box or a level twice.
    """
    manifest = read_manifest(path)
    leaves, levels = manifest.leaves, len(manifest.levels)
    boxes = np.stack([_box(leaf.bound, f"{path}, tree") for leaf in leaves])
    starts, counts = np.zeros((2, len(leaves), levels), np.int64)
    runs: list[list[tuple[int, int, int, int]]] = [[] for _ in range(levels)]
    for number, leaf in enumerate(leaves):
        if len({level for level, _, _ in leaf.entries}) < len(leaf.entries):
            raise refused(f"{path}, tree, lods", "must not name a level twice")
        for level, file, (offset, count) in leaf.entries:
            runs[level].append((file, offset, count, number))
    for level, each in enumerate(runs):
        row = 0  # a level is read file by file, and the runs of a file in order of their offset
        for _file, _offset, count, number in sorted(each):
            starts[number, level], counts[number, level] = row, count
            row += count
    apart = manifest.environment.count if manifest.environment else 0
    return Chunks(boxes, starts, counts, apart)


def _box(bound: object, where: str) -> F64:
    found = table(bound, f"{where}, bound")
    corners = [numbers(found.get(name), f"{where}, bound.{name}", 3) for name in ("min", "max")]
    return np.stack(corners)

"""Writing streamed SOG: a `lod-meta.json` over SOG models, each of some cells of one level.

Specification: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/streamed-sog/
Its reader is `io.sog_levels`. A viewer chooses a level for each leaf of the tree and loads the
models that hold it; leaves near each other share a model, since the palettes of small ones take
more room.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from nanogs._types import F64, I64
from nanogs.io import sog_write
from nanogs.io.registry import LEVELS
from nanogs.io.sog_write import write_files
from nanogs.lod.boxes import Box, box_around, union
from nanogs.lod.cells import Cells, divide
from nanogs.lod.chunks import SortedLevel, Written, generator, plain_paths, read_own
from nanogs.lod.manifest import Manifest
from nanogs.splats import Splats

NAME = LEVELS
_CHUNKS_A_FILE = 4  # full ones; that makes files of 1 to 2 MB
# As the format's own tool has it. A viewer chooses levels by the distance to these boxes, so that
# larger ones would bring fine levels too early.
_DEVIATIONS = 1.0
_META = "meta.json"


class StreamedSog:
    """A folder that is being filled, level by level."""

    def __init__(self, folder: Path, chunk: int) -> None:
        """Begin.

        Args:
            folder: Where to; it exists and is empty.
            chunk: Most splats of the finest level in a leaf, 1 or more.
        """
        self._folder, self._chunk = folder, chunk
        self._cells: Cells | None = None
        self._names: list[str] = []
        self._counts: list[int] = []
        self._entries: list[dict[str, dict[str, int]]] = []
        self._boxes: list[list[Box]] = []

    def add(self, splats: Splats) -> Written:
        """Write the next level, the finest first, one model at a time.

        Args:
            splats: N splats, all finite.
        """
        if self._cells is None:
            self._cells = divide(splats.means, self._chunk)
            self._entries = [{} for _ in range(self._cells.count)]
            self._boxes = [[] for _ in range(self._cells.count)]
        level, known = SortedLevel(splats, self._cells), len(self._names)
        written = sum(
            self._write_model(level, number, first, end)
            for number, (first, end) in enumerate(_runs(level.counts, _CHUNKS_A_FILE * self._chunk))
        )
        self._counts.append(len(splats))
        return Written(tuple(self._names[known:]), written)

    def _write_model(self, level: SortedLevel, number: int, first: int, end: int) -> int:
        """Write a range of leaves and note where each is; the bytes."""
        part, leaves = level.take(first, end)
        depth = len(self._counts)
        folder = f"{depth}_{number}"
        offset = 0
        for leaf in range(first, end):
            if count := int(level.counts[leaf]):
                place = {"file": len(self._names), "offset": offset, "count": count}
                self._entries[leaf][str(depth)] = place
                rows = np.arange(offset, offset + count)
                self._boxes[leaf].append(box_around(part.take(rows), _DEVIATIONS))
                offset += count
        self._names.append(f"{folder}/{_META}")
        (self._folder / folder).mkdir()
        return write_files(part, self._folder / folder, leaves)

    def finish(self, _made: Manifest) -> None:
        """Write `lod-meta.json`."""
        data = {
            "version": 1,
            "asset": {"generator": generator(), "chunkGaussians": self._chunk},
            "count": sum(self._counts),
            "counts": self._counts,
            "lodLevels": len(self._counts),
            "lodErrors": False,
            "filenames": self._names,
            "tree": self._tree()[0],
        }
        text = json.dumps(data, separators=(",", ":"), allow_nan=False)
        (self._folder / NAME).write_text(text, encoding="utf-8")

    def _tree(self) -> tuple[dict[str, Any], Box]:
        """The tree and the box around all of it; from the leaves up, as boxes grow."""
        cells = self._cells
        assert cells is not None, "a folder of levels has at least one"  # noqa: S101
        nodes: dict[int, tuple[dict[str, Any], Box]] = {}
        for node in range(len(cells.axes) - 1, -1, -1):
            inner: dict[str, Any]
            if cells.is_leaf(node):
                leaf = int(cells.leaves[node, 0])
                box, inner = union(self._boxes[leaf]), {"lods": self._entries[leaf]}
            else:
                near, far = (nodes.pop(child) for child in cells.children[node].tolist())
                box, inner = union([near[1], far[1]]), {"children": [near[0], far[0]]}
            nodes[node] = {"bound": _bound(box)} | inner, box
        return nodes[0]

    def losses(self, splats: Splats) -> tuple[str, ...]:
        """What the files leave out of a model, one sentence each."""
        return sog_write.losses(splats)


def made_files(folder: Path) -> frozenset[str] | None:
    """The files of a streamed SOG folder that nanogs wrote; None for other folders."""
    data = read_own(folder / NAME, "asset", "generator")
    if data is None:
        return None
    names = {NAME}
    given = data.get("filenames")
    for name in plain_paths(given if isinstance(given, list) else []):
        inner, _, file = name.rpartition("/")
        if inner and file == _META:
            names |= {f"{inner}/{own}" for own in sog_write.ours(folder / inner) or ()}
    return frozenset(names)


def _runs(counts: I64, most: int) -> Iterator[tuple[int, int]]:
    """Ranges of leaves whose splats fit into a file together; one that does not has its own."""
    first = held = 0
    for leaf, count in enumerate(counts.tolist()):
        if held and held + count > most:
            yield first, leaf
            first, held = leaf, 0
        held += count
    if held:
        yield first, len(counts)


def _bound(box: Box) -> dict[str, list[float]]:
    """The box in single precision, rounded outwards."""
    return {"min": _rounded(box.low, -np.inf), "max": _rounded(box.high, np.inf)}


def _rounded(corner: F64, towards: float) -> list[float]:
    single = corner.astype(np.float32)
    outside = single <= corner if towards < 0 else single >= corner
    outer = np.where(outside, single, np.nextafter(single, np.float32(towards)))
    return [float(str(value)) for value in outer]

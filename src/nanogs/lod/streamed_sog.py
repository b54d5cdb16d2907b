"""Writing streamed SOG: a `lod-meta.json` over SOG models, each of some cells of one level.

Specification: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/streamed-sog/
Its reader is `io.sog.levels`. A viewer chooses a level for each leaf of the tree and loads the
models that hold it; leaves near each other share a model, since the palettes of small ones take
more room.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from nanogs._types import F64, I64
from nanogs.io.registry import LEVELS
from nanogs.lod.boxes import Box, box_around, union
from nanogs.lod.cells import Cells, divide
from nanogs.lod.chunks import SortedLevel, Written, generator, plain_paths, read_own
from nanogs.lod.manifest import Manifest
from nanogs.progress import Parts, untold
from nanogs.splats import Splats

NAME = LEVELS
CHUNKS_A_FILE = 4  # full ones; that makes files of 1 to 2 MB
# As the format's own tool has it. A viewer chooses levels by the distance to these boxes, so that
# larger ones would bring fine levels too early.
_DEVIATIONS = 1.0
META = "meta.json"


class Place(NamedTuple):
    """The splats of a leaf in a model, and the box around them."""

    leaf: int
    offset: int
    splats: int
    box: Box


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """A range of leaves of one level.

    Attributes:
        folder: Its name.
        places: Where each leaf is that has anything in it.
        files: The contents of its files by name.
    """

    folder: str
    places: list[Place]
    files: Mapping[str, bytes]


class Tree:
    """Some of the scene: which splats of which models stand for each leaf."""

    def __init__(self, cells: Cells) -> None:
        self.cells = cells
        self._entries: list[dict[str, dict[str, int]]] = [{} for _ in range(cells.count)]
        self._boxes: list[list[Box]] = [[] for _ in range(cells.count)]

    def add(self, level: int, file: int, places: Sequence[Place]) -> None:
        """Note the places in a file of a level; the finest level, which fills all leaves, first."""
        for leaf, offset, splats, box in places:
            place = {"file": file, "offset": offset, "count": splats}
            self._entries[leaf][str(level)] = place
            self._boxes[leaf].append(box)

    def described(self) -> tuple[dict[str, Any], Box]:
        """The tree and the box around all of it; from the leaves up, as boxes grow."""
        cells = self.cells
        nodes: dict[int, tuple[dict[str, Any], Box]] = {}
        for node in range(len(cells.axes) - 1, -1, -1):
            if cells.is_leaf(node):
                leaf = int(cells.leaves[node, 0])
                box = union(self._boxes[leaf])
                nodes[node] = {"bound": _bound(box), "lods": self._entries[leaf]}, box
            else:
                nodes[node] = _parent(*map(nodes.pop, cells.children[node].tolist()))
        return nodes[0]


def describe(trees: Sequence[Tree], names: Sequence[str], counts: Sequence[int], chunk: int) -> str:
    """The contents of `lod-meta.json`.

    Args:
        trees: One or more, neighbours beside each other.
        names: Each model's `meta.json`.
        counts: Splats of each level.
        chunk: Most splats of the finest level in a leaf.
    """
    data = {
        "version": 1,
        "asset": {"generator": generator(), "chunkGaussians": chunk},
        "count": sum(counts),
        "counts": list(counts),
        "lodLevels": len(counts),
        "lodErrors": False,
        "filenames": list(names),
        "tree": _joined([tree.described() for tree in trees])[0],
    }
    return json.dumps(data, separators=(",", ":"), allow_nan=False)


def _joined(trees: list[tuple[dict[str, Any], Box]]) -> tuple[dict[str, Any], Box]:
    """Trees beside each other as one, as binary as each of them."""
    while len(trees) > 1:
        pairs = [trees[i : i + 2] for i in range(0, len(trees), 2)]
        trees = [_parent(*pair) if len(pair) == 2 else pair[0] for pair in pairs]
    return trees[0]


def _parent(
    near: tuple[dict[str, Any], Box], far: tuple[dict[str, Any], Box]
) -> tuple[dict[str, Any], Box]:
    box = union([near[1], far[1]])
    return {"bound": _bound(box), "children": [near[0], far[0]]}, box


def encode(level: SortedLevel, most: int, prefix: str) -> Iterator[Model]:
    """The models of a level, one at a time.

    Args:
        level: Its splats.
        most: Splats of a model.
        prefix: How names of folders begin.
    """
    from nanogs.io.sog import write as sog_write

    for number, (first, end) in enumerate(_runs(level.counts, most)):
        part, leaves = level.take(first, end)
        yield Model(
            f"{prefix}{number}",
            list(_places(part, level.counts, first, end)),
            sog_write.contents(part, leaves),
        )


def _places(part: Splats, counts: I64, first: int, end: int) -> Iterator[Place]:
    offset = 0
    for leaf in range(first, end):
        if count := int(counts[leaf]):
            rows = np.arange(offset, offset + count)
            yield Place(leaf, offset, count, box_around(part.take(rows), _DEVIATIONS))
            offset += count


class StreamedSog:
    """A folder that is being filled, level by level."""

    def __init__(self, folder: Path, chunk: int) -> None:
        """Begin.

        Args:
            folder: Where to; it exists and is empty.
            chunk: Most splats of the finest level in a leaf, 1 or more.
        """
        self._folder, self._chunk = folder, chunk
        self._tree: Tree | None = None
        self._names: list[str] = []
        self._counts: list[int] = []

    def add(self, splats: Splats, tell: Parts = untold) -> Written:
        """Write the next level, the finest first, one model at a time.

        Args:
            splats: N splats, all finite.
            tell: Told of the splats written, and of N.
        """
        if self._tree is None:
            self._tree = Tree(divide(splats.means, self._chunk))
        level, known, depth = (
            SortedLevel(splats, self._tree.cells),
            len(self._names),
            len(self._counts),
        )
        written = 0
        ready = 0
        for model in encode(level, CHUNKS_A_FILE * self._chunk, f"{depth}_"):
            ready += sum(place.splats for place in model.places)
            tell(ready, len(splats))
            self._tree.add(depth, len(self._names), model.places)
            self._names.append(f"{model.folder}/{META}")
            written += write_model(self._folder, model)
        self._counts.append(len(splats))
        return Written(tuple(self._names[known:]), written)

    def finish(self, _made: Manifest) -> None:
        """Write `lod-meta.json`."""
        assert self._tree is not None, "a folder of levels has at least one"  # noqa: S101
        text = describe([self._tree], self._names, self._counts, self._chunk)
        (self._folder / NAME).write_text(text, encoding="utf-8")

    def losses(self, splats: Splats) -> tuple[str, ...]:
        """Name the parts of a model that the files leave out, one sentence each."""
        from nanogs.io.sog import write as sog_write

        return sog_write.losses(splats)


def write_model(folder: Path, model: Model) -> int:
    """Write the files of a model into a folder of its own in this one; their bytes."""
    (folder / model.folder).mkdir()
    for name, data in model.files.items():
        (folder / model.folder / name).write_bytes(data)
    return sum(map(len, model.files.values()))


def made_files(folder: Path) -> frozenset[str] | None:
    """The files of a streamed SOG folder that nanogs wrote; None for other folders."""
    from nanogs.io.sog import write as sog_write

    data = read_own(folder / NAME, "asset", "generator")
    if data is None:
        return None
    names = {NAME}
    given = data.get("filenames")
    for name in plain_paths(given if isinstance(given, list) else []):
        inner, _, file = name.rpartition("/")
        if inner and file == META:
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

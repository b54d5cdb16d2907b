"""Writing streamed SOG: a `lod-meta.json` over SOG models, each of some cells of one level.

Specification: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/streamed-sog/
Its reader is `io.sog.levels`. A viewer chooses a level for each leaf of the tree and loads the
models that hold it; leaves near each other share a model, since the palettes of small ones take
more room.
"""

import json
from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np

from nanogs._types import F64, I64
from nanogs.io.registry import LEVELS
from nanogs.lod.boxes import box_around, union
from nanogs.lod.cells import Cells
from nanogs.lod.chunks import (
    ChunkLayout,
    ChunkTree,
    Made,
    SortedLevel,
    generator,
    plain_paths,
    read_own,
)
from nanogs.progress import Parts
from nanogs.splats import Splats
from nanogs.switches import streamed_pixel

# As the format's own tool has it. A viewer chooses levels by the distance to these boxes, so that
# larger ones would bring fine levels too early.
_DEVIATIONS = 1.0
META = "meta.json"
ENVIRONMENT = "env"  # its folder, as the format's own tool calls it
_Node = tuple[dict[str, Any], F64]
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class StreamedSog(ChunkLayout):
    """Levels as streamed SOG. A chunk, as plain data, is a leaf: number, row, count, box.

    What a level gives are models: the name of each one's folder, and its leaves.
    """

    name: ClassVar[str] = LEVELS
    suffix: ClassVar[str] = ".sog"
    chunks_a_file: ClassVar[int] = 4  # full ones; that makes files of 1 to 2 MB

    weight: ClassVar[float] = 25.0
    held: ClassVar[tuple[float, int]] = 6.0, 300
    _seconds: ClassVar[tuple[float, float]] = 1e-5, 8e-5

    def _made(
        self,
        level: SortedLevel,
        finer: Sequence[Any] | None,  # noqa: ARG002 - tiles follow it
        prefix: str,
        tell: Parts,
    ) -> Made:
        from nanogs.io.sog import write as sog_write  # here, as `--help` does without

        runs = _runs(level.counts, self.chunks_a_file * self.most, self.least)

        def begun() -> Iterator[tuple[str, list[Any], Callable[[], dict[str, bytes]]]]:
            for number, (first, end) in enumerate(runs):
                part, leaves = level.take(first, end)
                places = list(_places(part, level.counts, first, end))
                files = sog_write.begun(pool, part, leaves)
                tell(level.counts[:end].sum(), level.counts.sum())
                yield f"{prefix}{number}", places, files

        with sog_write.encoders() as pool:
            # The textures of one are encoded while the palette of the next is found.
            for folder, places, files in _late(begun()):
                made = files()
                yield [folder, places], {f"{folder}/{name}": made[name] for name in made}

    @property
    def fewest(self) -> int:
        """As `Chunked` says: of each file of a level."""
        return self.least

    def switch_pixel(self, level: int, deviation: float) -> float:  # noqa: ARG002 - by distance
        """As `ChunkLayout` says."""
        return streamed_pixel(level)

    def losses(self, splats: Splats) -> tuple[str, ...]:
        """As `ChunkLayout` says."""
        from nanogs.io.sog import write as sog_write

        return sog_write.losses(splats)

    def environment_files(self, splats: Splats) -> Mapping[str, bytes]:
        """As `ChunkLayout` says: of a model in a folder of its own."""
        from nanogs.io.sog import write as sog_write

        files = sog_write.contents(splats)
        return {f"{ENVIRONMENT}/{name}": data for name, data in files.items()}

    def describe(
        self, trees: Sequence[ChunkTree], counts: Sequence[int], environment: bool = False
    ) -> str:
        """As `ChunkLayout` says; what is not in the tree, the environment, counts nowhere."""
        names: list[str] = []
        found = [_Leaves(tree.cells) for tree in trees]
        for level in range(len(counts)):
            for number, tree in enumerate(trees):
                for folder, places in tree.levels[level]:
                    _add(found[number:], level, len(names), places)
                    names.append(f"{folder}/{META}")
        data = {
            "version": 1,
            "asset": {
                "generator": generator(),
                "chunkGaussians": self.most,
                "chunkMinGaussians": self.least,
            },
            "count": sum(counts),
            "counts": list(counts),
            "lodLevels": len(counts),
            "lodErrors": False,
            **({"environment": f"{ENVIRONMENT}/{META}"} if environment else {}),
            "filenames": names,
            "tree": _joined([leaves.tree() for leaves in found])[0],
        }
        return json.dumps(data, separators=(",", ":"), allow_nan=False)


class _Leaves:
    """Which splats of which models stand for each leaf, and the boxes around them."""

    def __init__(self, cells: Cells) -> None:
        self._cells = cells
        self._entries: list[dict[str, dict[str, int]]] = [{} for _ in range(cells.count)]
        self._boxes: list[list[F64]] = [[] for _ in range(cells.count)]

    @property
    def count(self) -> int:
        """The number of leaves."""
        return self._cells.count

    def add(self, level: int, leaf: int, place: dict[str, int], box: Sequence[Any]) -> None:
        """Note a place in a file of a level; the finest level, which fills all leaves, first."""
        self._entries[leaf][str(level)] = place
        self._boxes[leaf].append(np.array(box))

    def tree(self) -> _Node:
        """The tree and the box around all of it; from the leaves up, as boxes grow."""
        cells = self._cells
        nodes: dict[int, _Node] = {}
        for node in range(len(cells.axes) - 1, -1, -1):
            if cells.is_leaf(node):
                leaf = int(cells.leaves[node, 0])
                box = union(self._boxes[leaf])
                nodes[node] = {"bound": _bound(box), "lods": self._entries[leaf]}, box
            else:
                nodes[node] = _parent(*map(nodes.pop, cells.children[node].tolist()))
        return nodes[0]


def _add(trees: Sequence[_Leaves], level: int, file: int, places: Sequence[Any]) -> None:
    """Note the places in a file, whose leaves are numbered from those of the first tree on."""
    before = [0, *accumulate(tree.count for tree in trees)]
    for leaf, offset, splats, box in places:
        number = bisect_right(before, leaf) - 1
        place = {"file": file, "offset": offset, "count": splats}
        trees[number].add(level, leaf - before[number], place, box)


def _joined(trees: list[_Node]) -> _Node:
    """Trees beside each other as one, as binary as each of them."""
    while len(trees) > 1:
        pairs = [trees[i : i + 2] for i in range(0, len(trees), 2)]
        trees = [_parent(*pair) if len(pair) == 2 else pair[0] for pair in pairs]
    return trees[0]


def _parent(near: _Node, far: _Node) -> _Node:
    box = union([near[1], far[1]])
    return {"bound": _bound(box), "children": [near[0], far[0]]}, box


def _places(part: Splats, counts: I64, first: int, end: int) -> Iterator[list[Any]]:
    """Number, first row, splats and box of each leaf of a model that has anything in it."""
    offset = 0
    for leaf in range(first, end):
        if count := int(counts[leaf]):
            rows = np.arange(offset, offset + count)
            box = box_around(part.take(rows), _DEVIATIONS)
            yield [leaf, offset, count, box.tolist()]
            offset += count


def _late(parts: Iterable[T]) -> Iterator[T]:
    """Each part when the next one has come, and the last at the end."""
    waiting = list[T]()
    for part in parts:
        yield from waiting
        waiting = [part]
    yield from waiting


def made_files(folder: Path) -> frozenset[str] | None:
    """The files of a streamed SOG folder that nanogs wrote; None for other folders."""
    from nanogs.io.sog import write as sog_write

    data = read_own(folder / LEVELS, "asset", "generator")
    if data is None:
        return None
    names = {LEVELS}
    given = data.get("filenames")
    named = [*(given if isinstance(given, list) else []), data.get("environment")]
    for name in plain_paths(named):
        inner, _, file = name.rpartition("/")
        if inner and file == META:
            names |= {f"{inner}/{own}" for own in sog_write.ours(folder / inner) or ()}
    return frozenset(names)


def _runs(counts: I64, most: int, least: int) -> list[tuple[int, int]]:
    """Ranges of leaves whose splats fit into a file together; one that does not has its own.

    Neighbours of which one has too few for a file are divided anew, as evenly as leaves allow, or
    are one file, if need be a larger one.

    Args:
        counts: (L,) splats of each leaf.
        most: Splats of a file, at most.
        least: Splats of a file, at least, unless all leaves have fewer.
    """
    before = np.concatenate([[0], np.cumsum(counts)])

    def held(run: tuple[int, int]) -> int:
        return int(before[run[1]] - before[run[0]])

    runs, first = [], 0
    for leaf, count in enumerate(counts.tolist()):
        if (full := held((first, leaf))) and full + count > most:
            runs.append((first, leaf))
            first = leaf
    if held((first, len(counts))):
        runs.append((first, len(counts)))
    number = 0
    while number < len(runs):
        if held(runs[number]) >= least or len(runs) == 1:
            number += 1
            continue
        pair = max(number - 1, 0)
        (begin, _), (_, end) = runs[pair : pair + 2]
        runs[pair : pair + 2] = _evened(before[begin : end + 1], begin, most, least)
        number = pair
    return runs


def _evened(before: I64, first: int, most: int, least: int) -> list[tuple[int, int]]:
    """A range of leaves as two files of about equal size, or as one where that cannot be.

    Args:
        before: (L + 1,) splats before each leaf, and before the one after the last.
        first: Number of the first leaf.
        most: As in `_runs`.
        least: As in `_runs`.
    """
    whole, end = before[-1] - before[0], first + len(before) - 1
    left = before - before[0]
    fewer = np.minimum(left, whole - left)
    middle = int(fewer.argmax())
    fits = whole <= most
    if fits or fewer[middle] < least or whole - fewer[middle] > most:
        return [(first, end)]
    return [(first, first + middle), (first + middle, end)]


def _bound(box: F64) -> dict[str, list[float]]:
    """The box in single precision, rounded outwards."""
    return {"min": _rounded(box[0], -np.inf), "max": _rounded(box[1], np.inf)}


def _rounded(corner: F64, towards: float) -> list[float]:
    single = corner.astype(np.float32)
    outside = single <= corner if towards < 0 else single >= corner
    outer = np.where(outside, single, np.nextafter(single, np.float32(towards)))
    return [float(str(value)) for value in outer]

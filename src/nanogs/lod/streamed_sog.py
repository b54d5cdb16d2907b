"""Writing streamed SOG: a `lod-meta.json` that refers to SOG models, each with cells of one level.

Specification: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/streamed-sog/
Its reader is `io.sog.levels`. A viewer chooses a level for each leaf of the tree and loads the
models that hold it; neighbouring leaves share a model, because the palettes of small models take
more room in total.
"""

import json
from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np

from nanogs import parallel
from nanogs._types import F64, I64
from nanogs.io.generator import GENERATOR, read_own
from nanogs.io.registry import LEVELS, META
from nanogs.lod.boxes import box_around, union
from nanogs.lod.cells import Cells
from nanogs.lod.chunks import (
    ChunkLayout,
    ChunkTree,
    Made,
    SortedLevel,
    plain_paths,
)
from nanogs.progress import PartProgress
from nanogs.splats import Splats
from nanogs.switches import streamed_pixel

# Extent of splats in boxes, as in the format's own tool. A viewer chooses levels by the distance to
# the boxes, so that larger ones would load fine levels too early.
_DEVIATIONS = 1.0
ENVIRONMENT = "env"  # its folder, named as by the format's own tool
_Node = tuple[dict[str, Any], F64]
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class StreamedSog(ChunkLayout):
    """The layout of streamed SOG.

    The plain data of a level are models: the name of a model's folder, and its leaves, each as
    number of the leaf, first row, number of splats and box.
    """

    name: ClassVar[str] = LEVELS
    suffix: ClassVar[str] = ".sog"
    chunks_a_file: ClassVar[int] = 4  # most, if they are full; files then have 1 to 2 MB

    weight: ClassVar[float] = 25.0
    held: ClassVar[tuple[float, int]] = 6.0, 300
    _seconds: ClassVar[tuple[float, float]] = 1e-5, 8e-5

    def _made(
        self,
        level: SortedLevel,
        finer: Sequence[Any] | None,  # noqa: ARG002 - tiles follow it
        prefix: str,
        on_progress: PartProgress,
    ) -> Made:
        from nanogs.io.sog import write as sog_write  # imported here to keep `--help` fast

        runs = _runs(level.counts, self.chunks_a_file * self.most, self.least)

        def start_encoding() -> Iterator[tuple[str, list[Any], Callable[[], dict[str, bytes]]]]:
            for number, (first, end) in enumerate(runs):
                part, leaves = level.take(first, end)
                places = _places(part, level.counts, first, end)
                files = sog_write.start_encoding(pool, part, leaves)
                on_progress(int(level.counts[:end].sum()), int(level.counts.sum()))
                yield f"{prefix}{number}", places, files

        with sog_write.encoders() as pool:
            # The textures of a model are encoded while the palette of the next is computed.
            for folder, places, files in _one_behind(start_encoding()):
                made = files()
                yield [folder, places], {f"{folder}/{name}": made[name] for name in made}

    @property
    def fewest(self) -> int:
        """Least splats of a file; smaller blocks are joined to the next one; see `Chunked`."""
        return self.least

    def switch_pixel(self, level: int, deviation: float) -> float:  # noqa: ARG002 - by distance
        """Return the size of a pixel at which a viewer switches to a level; see `ChunkLayout`."""
        return streamed_pixel(level)

    def losses(self, splats: Splats) -> tuple[str, ...]:
        """Name the parts of a model that SOG leaves out; see `ChunkLayout`."""
        from nanogs.io.sog.unstorable import losses

        return losses(splats)

    def environment_files(self, splats: Splats) -> Mapping[str, bytes]:
        """Make the files of the environment, a SOG model in its own folder; see `ChunkLayout`."""
        from nanogs.io.sog import write as sog_write

        files = sog_write.contents(splats)
        return {f"{ENVIRONMENT}/{name}": data for name, data in files.items()}

    def describe(
        self, trees: Sequence[ChunkTree], counts: Sequence[int], environment: bool = False
    ) -> str:
        """Return the contents of `lod-meta.json`; its counts exclude the environment."""
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
                "generator": GENERATOR,
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
    """The row ranges of models that represent each leaf at each level, and their boxes."""

    def __init__(self, cells: Cells) -> None:
        self._cells = cells
        self._entries: list[dict[str, dict[str, int]]] = [{} for _ in range(cells.count)]
        self._boxes: list[list[F64]] = [[] for _ in range(cells.count)]

    @property
    def count(self) -> int:
        """Number of leaves."""
        return self._cells.count

    def add(self, level: int, leaf: int, place: dict[str, int], box: Sequence[Any]) -> None:
        """Record the row range of a leaf at a level; the finest, which fills all, comes first."""
        self._entries[leaf][str(level)] = place
        self._boxes[leaf].append(np.array(box))

    def tree(self) -> _Node:
        """Build the JSON of the tree and its box, bottom-up, as boxes depend on their children."""
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
    """Record the row ranges of a file, whose leaf numbers continue through all the trees."""
    before = [0, *accumulate(tree.count for tree in trees)]
    for leaf, offset, splats, box in places:
        number = bisect_right(before, leaf) - 1
        place = {"file": file, "offset": offset, "count": splats}
        trees[number].add(level, leaf - before[number], place, box)


def _joined(trees: list[_Node]) -> _Node:
    """Join neighbouring trees into one, by binary nodes."""
    while len(trees) > 1:
        pairs = [trees[i : i + 2] for i in range(0, len(trees), 2)]
        trees = [_parent(*pair) if len(pair) == 2 else pair[0] for pair in pairs]
    return trees[0]


def _parent(near: _Node, far: _Node) -> _Node:
    box = union([near[1], far[1]])
    return {"bound": _bound(box), "children": [near[0], far[0]]}, box


def _places(part: Splats, counts: I64, first: int, end: int) -> list[list[Any]]:
    """Return number, first row, number of splats and box of each non-empty leaf of a model."""
    ends = np.cumsum(counts[first:end])

    def place(leaf: int) -> list[Any]:
        count, stop = int(counts[leaf]), int(ends[leaf - first])
        box = box_around(part.span(stop - count, stop), _DEVIATIONS)
        return [leaf, stop - count, count, box.tolist()]

    return parallel.map_ordered((leaf for leaf in range(first, end) if counts[leaf]), place)


def _one_behind(parts: Iterable[T]) -> Iterator[T]:
    """Yield each part with a delay: after the next one has been produced."""
    waiting = list[T]()
    for part in parts:
        yield from waiting
        waiting = [part]
    yield from waiting


def made_files(folder: Path) -> frozenset[str] | None:
    """Return the files of a streamed SOG folder that nanogs wrote; None for other folders."""
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
    """Group consecutive leaves into files of at most `most` splats; a larger leaf has its own.

    A range with too few splats is combined with the neighbour that gives the smaller files: both
    are divided again, as evenly as leaves allow, or become one file, if necessary a larger one.

    Args:
        counts: (L,) splats of each leaf.
        most: Most splats of a file.
        least: Least splats of a file, unless all leaves have fewer.
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
        tried = {}
        for pair in range(max(number - 1, 0), min(number + 1, len(runs) - 1)):
            (begin, _), (_, end) = runs[pair : pair + 2]
            tried[pair] = _evened(before[begin : end + 1], begin, most, least)
        number = min(tried, key=lambda pair: max(map(held, tried[pair])))
        runs[number : number + 2] = tried[number]
    return runs


def _evened(before: I64, first: int, most: int, least: int) -> list[tuple[int, int]]:
    """Divide a range of leaves into two files of about equal size.

    It stays one file if that is not too large, or if the two would break the limits.

    Args:
        before: (L + 1,) prefix sum of the number of splats per leaf.
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
    """Return the JSON of a box, in single precision, finite, and rounded outwards."""
    return {"min": _rounded(box[0], -np.inf), "max": _rounded(box[1], np.inf)}


def _rounded(corner: F64, towards: float) -> list[float]:
    with np.errstate(over="ignore"):
        single = corner.astype(np.float32)
        outside = single <= corner if towards < 0 else single >= corner
        outer = np.where(outside, single, np.nextafter(single, np.float32(towards)))
    limit = np.finfo(np.float32).max
    return [float(str(value)) for value in np.clip(outer, -limit, limit)]

"""Joining the trees of a scene's blocks to one tree of levels, without holding them in memory.

Each block has a tree of its own levels with several roots. These are few, and the tree above them
is built in memory. In the file, the rows of each layer below the roots follow the order of the
roots in that tree; those below one root are contiguous in the tree of its block.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import ClassVar, NamedTuple

import numpy as np

from nanogs._types import I64
from nanogs.block_layouts import BlockTree, Encoding
from nanogs.io.rad.header import CHUNK_ROWS
from nanogs.lod.tree import COLUMNS, Moments, build, layers_of, refuse_many, tree_units_of
from nanogs.progress import PartProgress, ignore_progress
from nanogs.slices import overlapping
from nanogs.source import InMemory, Source
from nanogs.source.base import joined_rows
from nanogs.splats import Splats, concatenate

_COUNTS = "counts"  # of `Moments`, beside `COLUMNS` of its nodes
_SEARCHED = 240  # bytes per splat of the finest level while it is linked to the next; measured
_LAYER = 100  # bytes per splat of all layers: their order, links and moments; measured
_WRITTEN = 6  # memory while a chunk is written, as a factor of its rows' size

Children = Callable[[int, int], I64]


@dataclass(frozen=True, slots=True)
class Linked:
    """The layout of levels as one tree; see `block_layouts.Linked`."""

    suffix: ClassVar[str] = ".rad"
    weight: ClassVar[float] = 9.0

    def link(self, levels: Sequence[Source], some: Splats, steps: int) -> BlockTree:
        """Build the tree of a block; see `block_layouts.Linked`."""
        layers = layers_of(levels, steps=steps)
        leaves = InMemory(levels[0].load())
        made = build(leaves, layers, tree_units_of(InMemory(some)))
        children = [partial(_part, counts) for counts in made.children]
        nodes, counts = made.moments
        roots = {_COUNTS: counts, **{name: getattr(nodes, name) for name in COLUMNS}}
        return BlockTree(made.layers, children, roots)

    def encoding(
        self,
        row: int,
        degree: int,  # noqa: ARG002 - chunks have it
        splats: int,
        shares: Sequence[float],
    ) -> Encoding:
        """Estimate memory and time for linking, from measurements; see `block_layouts.Linked`."""
        kept = [min(1.0, 2 * share) for share in shares]  # one block can keep more than others
        # The parts of a layer are still held while they are concatenated.
        built = kept[0] * row + 1.5 * sum(kept[1:]) * row + sum(kept) * _LAYER
        return Encoding(
            each=max(kept[0] * _SEARCHED, built),
            described=min(CHUNK_ROWS, int(2 * sum(shares) * splats)) * row * _WRITTEN,
            seconds=sum(shares) * splats * self.weight / 1e6,
            sized=False,
        )

    def whole(self, row: int) -> int:
        """Return the extra bytes per splat for a model in memory; see `block_layouts.Linked`."""
        return 3 * row + 2 * _LAYER


class _Run(NamedTuple):
    """A range of rows of a block's layer that are contiguous in the file too."""

    source: Source
    children: Children
    start: int
    stop: int


class TreeRows(Source):
    """A source of all rows of a tree in the order of the file; see `io.rad.write.Tree`.

    Args:
        runs: The ranges that make up the rows.
        on_progress: Progress callback for reading; the writer reads all rows twice.
    """

    def __init__(self, runs: Sequence[_Run], on_progress: PartProgress = ignore_progress) -> None:
        self._runs, self._on_progress, self._read = runs, on_progress, 0
        self._ends = np.cumsum([0, *(run.stop - run.start for run in runs)])
        self.count, self.columns = int(self._ends[-1]), runs[0].source.columns

    def _span(self, start: int, stop: int) -> Splats:
        """Read rows `start` to `stop`, and report progress; see `Source`."""
        self._on_progress(min(self._read, 2 * self.count), 2 * self.count)
        self._read += stop - start
        parts = [run.source.read(low, high) for run, low, high in self._within(start, stop)]
        return joined_rows(parts or [self._runs[0].source.read(0, 0)])

    def children(self, start: int, stop: int) -> I64:
        """Return the number of children of rows `start` to `stop`."""
        parts = [run.children(low, high) for run, low, high in self._within(start, stop)]
        return np.concatenate([np.empty(0, np.int64), *parts])

    def _within(self, start: int, stop: int) -> list[tuple[_Run, int, int]]:
        """Return the runs that contain rows `start` to `stop`, each with a range of its rows."""
        found = overlapping(self._ends, start, stop)
        runs = ((self._runs[number], low, high) for number, low, high in found)
        return [(run, run.start + low, run.start + high) for run, low, high in runs]


def joined_trees(
    trees: Sequence[BlockTree],
    further: Sequence[Source],
    some: Splats,
    on_progress: PartProgress = ignore_progress,
) -> TreeRows:
    """Join the trees of blocks and return all rows of the scene's tree.

    Args:
        trees: The trees of the blocks, all with the same number of layers.
        further: Results that are coarser than the trees' levels, the finest first. If there are
            any, the roots only link to the rows below them, and are no rows of the tree themselves.
        some: As `block_layouts.Linked.link` took it.
        on_progress: As `TreeRows` takes it.

    Raises:
        ManyChildrenError: A splat would have too many children.
    """
    roots = InMemory(concatenate([tree.layers[-1].load() for tree in trees]))
    levels = len(trees[0].layers) - 1
    up = layers_of([roots, *further], first=levels - 1)
    top = build(roots, up, tree_units_of(InMemory(some)), _moments_of(trees))
    layers, children = list(top.layers), list(top.children)
    bounds = _bounds(trees)
    below = np.concatenate([np.diff(each[-2]) for each in bounds]) if levels else None
    if further:
        assert below is not None, "there is a level below these roots"  # noqa: S101
        members = np.repeat(np.arange(layers[1].count), children[1])
        many = np.bincount(members, below[top.order].astype(np.float64)).astype(np.int64)
        refuse_many(many, levels - 1)
        layers, children = layers[1:], [many, *children[2:]]
    elif below is not None:
        children[0] = below[top.order]
    runs = [
        _Run(layer, partial(_part, counts), 0, layer.count)
        for layer, counts in zip(layers[::-1], children[::-1], strict=True)
    ]
    return TreeRows([*runs, *_below(trees, bounds, top.order)], on_progress)


def _moments_of(trees: Sequence[BlockTree]) -> Moments:
    """Return the moments of the roots of all trees, in order."""
    found = []
    for tree in trees:
        columns = {name: tree.roots[name] for name in COLUMNS}
        found.append(Moments.of(columns, tree.roots[_COUNTS]))
    return Moments.joined(found)


def _bounds(trees: Sequence[BlockTree]) -> list[list[I64]]:
    """Return (R + 1,) offsets, by block and layer, of the rows below each of the block's roots."""
    found = []
    for tree in trees:
        ends = [np.arange(tree.layers[-1].count + 1)]
        for layer, children in zip(tree.layers[:0:-1], tree.children[:0:-1], strict=True):
            counts = np.concatenate([[0], np.cumsum(children(0, layer.count))])
            ends.append(counts[ends[-1]])
        found.append(ends[::-1])
    return found


def _below(trees: Sequence[BlockTree], bounds: list[list[I64]], order: I64) -> list[_Run]:
    """Return the runs of the layers below the roots, the coarsest first, in the order of roots."""
    sizes = [tree.layers[-1].count for tree in trees]
    blocks = np.repeat(np.arange(len(trees)), sizes)[order]
    own = order - (np.cumsum(sizes) - sizes)[blocks]
    # Roots that are consecutive in the tree of a block too make one run.
    begins = np.flatnonzero((np.diff(blocks) != 0) | (np.diff(own) != 1)) + 1
    together = list(pairwise([0, *begins.tolist(), len(order)]))
    runs = []
    for layer in reversed(range(len(trees[0].layers) - 1)):
        for first, last in together:
            block, root = int(blocks[first]), int(own[first])
            ends, tree = bounds[block][layer], trees[block]
            start, stop = int(ends[root]), int(ends[root + last - first])
            runs.append(_Run(tree.layers[layer], tree.children[layer], start, stop))
    return runs


def _part(values: I64, start: int, stop: int) -> I64:
    return values[start:stop]

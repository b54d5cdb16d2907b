"""A k-d tree of cells that decides which chunk of a level a splat belongs to.

It is built from the centres of the finest level: each cell is split at the median along its longest
side, until none has more than a given number of centres. If so many centres share a coordinate that
one side would get fewer than another given number, a shorter side is split. The cells fill all of
space, so that they contain the other levels' splats too, wherever merging has moved them.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from nanogs._types import F64, I64, Bool, F

LEAF = -1


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """A k-d tree of M nodes in depth-first order, parents first; L of them are leaves.

    Attributes:
        axes: (M,) int64, the axis perpendicular to a node's splitting plane, or `LEAF`.
        planes: (M,) float64, position of the plane, scene units; points on it belong to its far
            side.
        children: (M, 2) int64, the nodes on the near and on the far side.
        leaves: (M, 2) int64, start and end of the range of a node's leaves. Leaves are numbered in
            depth-first order, so that neighbours mostly have near numbers.
    """

    axes: I64
    planes: F64
    children: I64
    leaves: I64

    @property
    def count(self) -> int:
        """Number of leaves."""
        return int(self.leaves[0, 1])

    def is_leaf(self, node: int) -> bool:
        """Return whether a node is a leaf."""
        return int(self.axes[node]) == LEAF

    def leaf_of(self, means: F) -> I64:
        """Return (N,) int64, the leaf that contains each centre.

        Args:
            means: (N, 3) finite, scene units.
        """
        nodes = np.zeros(len(means), np.int64)
        rows = np.arange(len(means))
        while True:
            rows = rows[self.axes[nodes[rows]] != LEAF]
            if not len(rows):
                found: I64 = self.leaves[nodes, 0]
                return found
            at = nodes[rows]
            far = means[rows, self.axes[at]] >= self.planes[at]
            nodes[rows] = self.children[at, far.astype(np.int64)]

    def cut(self, counts: I64, most: int, finer: frozenset[int]) -> list[int]:
        """Return the largest nodes with at most `most` splats of a level, in depth-first order.

        Args:
            counts: (L,) splats of the level in each leaf.
            most: Most splats of a node.
            finer: The nodes chosen for the finer level; none is divided, whatever it holds.
        """
        before = np.concatenate([[0], np.cumsum(counts)])
        found, waiting = [], [0]
        while waiting:
            node = waiting.pop()
            first, end = self.leaves[node]
            if node in finer or before[end] - before[first] <= most:
                found.append(node)
            else:
                waiting += reversed(self.children[node].tolist())
        return found

    def all_leaves(self) -> frozenset[int]:
        """Return the nodes that are leaves."""
        return frozenset(np.flatnonzero(self.axes == LEAF).tolist())


def divide(means: F, most: int, least: int = 1) -> Cells:
    """Divide space into cells of at least `least` and at most `most` centres each.

    Args:
        means: (N, 3) finite centres, N at least 1, scene units.
        most: Most centres in a cell, at least 1. Centres that coincide stay together, even if they
            are more.
        least: Least centres in a cell, at most half of `most + 1`. Cells have fewer if there are
            fewer in all, or if a cell must be divided but no plane leaves as many on both sides,
            because most of its centres share their coordinates with others.
    """
    nodes: list[_Node] = []
    leaf = 0
    waiting: list[tuple[F, _Node | None]] = [(means, None)]
    while waiting:
        points, parent = waiting.pop()
        node = _Node(leaf)
        if parent is not None:
            parent.children.append(len(nodes))
        nodes.append(node)
        sides = _split(points, least) if len(points) > most else None
        if sides is None:
            leaf += 1
            continue
        node.axis, node.plane, far = sides
        waiting += [(points[far], node), (points[~far], node)]
    return _packed(nodes)


class _Node:
    """A node during the construction of the tree; `first` is the number of its first leaf."""

    def __init__(self, first: int) -> None:
        self.first, self.axis, self.plane = first, LEAF, 0.0
        self.children: list[int] = []


def _split(points: F, least: int) -> tuple[int, float, Bool] | None:
    """Find a plane that splits the points; None if all coincide.

    It is on the longest axis for which both sides get `least` points or more; if there is none, it
    is the plane with the most points on its smaller side.

    Returns:
        Axis and position of the plane, and a (N,) bool mask of the points on its far side.
    """
    sides = points.max(axis=0) - points.min(axis=0)
    best: tuple[int, int, float, Bool] | None = None
    for axis in np.argsort(-sides, kind="stable").tolist():
        for plane in _planes(points[:, axis]):
            far = points[:, axis] >= plane
            behind = int(far.sum())
            fewer = min(behind, len(points) - behind)
            if fewer > (best[0] if best else 0):
                best = fewer, axis, plane, far
            if fewer >= least:
                return axis, plane, far
    return best[1:] if best else None


def _planes(values: F) -> Iterator[float]:
    """Yield the positions that divide values most evenly: the median, and the next value above."""
    median = np.partition(values, len(values) // 2)[len(values) // 2]
    if median > values.min():
        yield float(median)
    if len(above := values[values > median]):
        yield float(above.min())


def _packed(nodes: list[_Node]) -> Cells:
    ends = list(_ends(nodes))
    return Cells(
        axes=np.array([node.axis for node in nodes]),
        planes=np.array([node.plane for node in nodes]),
        children=np.array([node.children or [LEAF, LEAF] for node in nodes]),
        leaves=np.array([(node.first, end) for node, end in zip(nodes, ends, strict=True)]),
    )


def _ends(nodes: list[_Node]) -> Iterator[int]:
    """Yield the end of each node's range of leaves, which is that of its last descendant."""
    ends = [0] * len(nodes)
    for number in range(len(nodes) - 1, -1, -1):
        node = nodes[number]
        ends[number] = ends[node.children[1]] if node.children else node.first + 1
    yield from ends

"""A binary tree of cells that divides space: which chunk of a level a splat belongs to.

The planes are laid through the centres of the finest level, at the median along the longest side,
until no cell has more than a given number of them. Where so many centres share a coordinate that
a side would have fewer than another given number, a shorter side is taken. The cells fill all of
space, so that the other levels' splats fall into them too, wherever merging has moved them.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from nanogs._types import F64, I64, Bool, F

LEAF = -1


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """M nodes of a tree in the order of a walk, parents first; L of them are leaves.

    Attributes:
        axes: (M,) int64, the axis that a node's plane is across, or `LEAF`.
        planes: (M,) float64, scene units; what lies on the plane is on its far side.
        children: (M, 2) int64, nodes before and behind the plane.
        leaves: (M, 2) int64, the first of a node's leaves and the one after its last. Leaves are
            numbered as the walk comes to them, so that neighbours mostly have near numbers.
    """

    axes: I64
    planes: F64
    children: I64
    leaves: I64

    @property
    def count(self) -> int:
        """The number of leaves."""
        return int(self.leaves[0, 1])

    def is_leaf(self, node: int) -> bool:
        """Whether a node is not divided."""
        return int(self.axes[node]) == LEAF

    def leaf_of(self, means: F) -> I64:
        """(N,) int64: the leaf that each centre lies in.

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
        """The largest cells of a level that do not hold too much, in the order of the walk.

        Args:
            counts: (L,) splats of the level in each leaf.
            most: Splats that a cell may hold.
            finer: The cells of the finer level; none is divided further, whatever it holds.
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
        """The nodes that are leaves."""
        return frozenset(np.flatnonzero(self.axes == LEAF).tolist())


def divide(means: F, most: int, least: int = 1) -> Cells:
    """Divide space so that no cell holds more than so many centres, nor fewer than so many.

    Args:
        means: (N, 3) finite centres, N at least 1, scene units.
        most: Centres in a cell, at least 1. Centres that coincide stay together, even if they are
            more.
        least: Centres in a cell, at most half of `most + 1`; unless there are fewer in all, or a
            cell must be divided where no plane leaves as many on both sides, since most of its
            centres share their coordinates with others.
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
    """A node while the tree is built."""

    def __init__(self, first: int) -> None:
        self.first, self.axis, self.plane = first, LEAF, 0.0
        self.children: list[int] = []


def _split(points: F, least: int) -> tuple[int, float, Bool] | None:
    """The axis and place of a plane, and (N,) bool, which points are behind; None if all coincide.

    There are points on both sides: at least so many on the longest axis that has such a plane, or
    as many as on any.
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
    """The value at the median, and the next one above it: no other divides more evenly."""
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
    """Find the leaf after each node's last: that of its last descendant."""
    ends = [0] * len(nodes)
    for number in range(len(nodes) - 1, -1, -1):
        node = nodes[number]
        ends[number] = ends[node.children[1]] if node.children else node.first + 1
    yield from ends

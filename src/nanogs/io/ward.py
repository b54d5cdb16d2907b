"""Agglomerative clustering of points by Ward's method, many merges per pass.

For the costs see `nanogs.kernels.ward`. Each point has a list of its cheapest merge partners in
nearby cells. The result of a merge costs no less to merge with any third point than the cheaper of
the two merged points did (Lance and Williams, 1967). So when all partners in a point's list are
gone, the cost of the last one is a lower bound for any other partner, and a new search is made only
if this bound is low enough.
"""

import numpy as np

from nanogs._types import F32, I32, I64
from nanogs.io.cells import by_label, pieces
from nanogs.kernels.closest import LANES
from nanogs.kernels.kmeans import weighted_means
from nanogs.kernels.ward import (
    NOBODY,
    cheapest,
    lay_out,
    merge_pairs,
    near_partners,
    own_costs,
)
from nanogs.progress import PartProgress

_PARTNERS = 6  # length of a point's list of partners
_SHARE = 0.2  # most merges in a pass, relative to the number of remaining points
_STALE = 0.7  # the table is rebuilt when fewer than this share of its points remain


def merge_points(
    points: F32, weights: F32, cells: I32, size: int, on_progress: PartProgress
) -> tuple[I32, I32]:
    """Merge points until `size` groups remain, with a small squared error.

    This ends: while there are more groups than `size`, and so more than cells, some cell holds two,
    which find each other. Every pass merges a pair, or finds a point without any partner nearby.

    Args:
        points: (N, D), within 2 of the origin, D a multiple of three, N more than `size`.
        weights: (N,) positive.
        cells: (N, P) the cells that each point searches for partners, its own cell first; the
            number of cells is less than `size`, or one.
        size: Number of groups.
        on_progress: Progress callback: merges done, and their total.

    Returns:
        (N,) the group of each point, from 0 on, and (size,) the cell of each group.
    """
    nodes = _Nodes(points, weights, cells)
    rows = changed = np.arange(len(points))
    merges = len(points) - size
    while len(rows) > size:
        on_progress(len(points) - len(rows), merges)
        nodes.prepare(rows)
        nodes.look(changed)
        changed = nodes.merge(rows, min(len(rows) - size, max(int(_SHARE * len(rows)), 1)))
        rows = rows[nodes.parents[rows] == rows]
    on_progress(merges, merges)
    return _numbered(nodes.parents, rows), nodes.home[rows]


def _numbered(parents: I32, rows: I64) -> I32:
    """Follow each point's parents to its root, and return the root's index in `rows`, (N,)."""
    while True:
        further = parents[parents]
        if np.array_equal(further, parents):
            return np.searchsorted(rows, parents).astype(np.int32)
        parents = further


def settle(points: F32, weights: F32, cells: I32, labels: I32, home: I32) -> I32:
    """Move each point to the group with the nearest mean, one step of k-means; return (N,) groups.

    No group becomes empty.

    Args:
        points: (N, D), as for `merge_points`.
        weights: (N,) positive.
        cells: (N, P) the cells that each point searches for a nearer mean.
        labels: (N,) the current group of each point, from 0 on.
        home: (K,) the cell of each group.
    """
    size, count = len(home), int(cells.max()) + 1
    means = np.empty((points.shape[1], size), np.float32)
    squares = np.empty(size, np.float32)
    weighted_means(points, weights, *by_label(labels, size), means, squares)
    pool = np.concatenate([means.T, points])
    lengths = np.concatenate([squares, _lengths(points)])
    alike = np.full(len(pool), 2, np.float32)  # Ward's cost of weights 2 and 2 is |a - b|²
    partners = np.empty((len(pool), 1), np.int32)
    costs = np.empty((len(pool), 1), np.float32)
    own_costs(labels, pool, alike, partners, costs)
    table = _Table(pool, lengths, alike, np.arange(size), home, count)
    for near in cells.T:
        starts, order = by_label(near, count)
        table.look(starts, order + size, partners, costs)
    settled = partners[size:, 0].copy()
    # A group that all points have left gets them back, so that the number of groups stays. This can
    # empty groups that only these points had moved to, so repeat; at worst all points are back.
    while (empty := np.bincount(settled, minlength=size) == 0).any():
        settled[empty[labels]] = labels[empty[labels]]
    return settled


class _Table:
    """Points sorted by cell and padded to vector lanes; see `nanogs.kernels.ward` for the layout.

    Args:
        points: (N, D).
        lengths: (N,) squared lengths of the points.
        weights: (N,) weights of the points.
        rows: (R,) indices of the points in the table, ascending.
        home: (R,) the cell of each of these.
        count: Number of cells.
    """

    def __init__(
        self, points: F32, lengths: F32, weights: F32, rows: I64, home: I32, count: int
    ) -> None:
        self.points, self.lengths, self.weights = points, lengths, weights
        starts, order = by_label(home, count)
        self.widths = -(-np.diff(starts) // LANES) * LANES
        ends = np.cumsum(self.widths)
        self.bounds = ends - self.widths
        columns = int(ends[-1])
        self.values = np.empty(columns * points.shape[1], np.float32)
        self.squares, self.masses = np.empty((2, columns), np.float32)
        self.holders = np.empty(columns, np.int32)
        self.places = np.empty(len(points), np.int64)
        lay_out(
            self.bounds, starts, rows[order], points, lengths, weights, self.values, self.squares,
            self.masses, self.holders, self.places,
        )  # fmt: skip

    def look(self, starts: I64, order: I64, partners: I32, costs: F32) -> None:
        """Search each cell for the cheapest partners of some points, and update their lists.

        Args:
            starts: (C + 1,) for each cell, the offset in `order` of the points that search it.
            order: Indices of these points, by cell.
            partners: (N, P) lists of partners, in and out.
            costs: (N, P) their costs, in and out.
        """
        near_partners(
            pieces(starts), order, self.points, self.lengths, self.weights, self.bounds,
            self.widths, self.values, self.squares, self.masses, self.holders, partners, costs,
        )  # fmt: skip


class _Nodes:
    """The points during merging, with each one's list of cheapest partners."""

    def __init__(self, points: F32, weights: F32, cells: I32) -> None:
        count = len(points)
        self.points, self.lengths = points.copy(), _lengths(points)
        self.weights = weights.copy()
        self.cells = cells
        self.home = np.ascontiguousarray(cells[:, 0])
        self.parents = np.arange(count, dtype=np.int32)
        self.partners = np.full((count, _PARTNERS), NOBODY)
        self.costs = np.full((count, _PARTNERS), np.inf, np.float32)
        self.changed, self.searched = np.zeros((2, count), np.int32)
        self._now = 0
        self._count = int(cells.max()) + 1
        self._laid = np.inf  # number of points that the table was built for

    def prepare(self, rows: I64) -> None:
        """Rebuild the table if far fewer points remain than it was built for."""
        if len(rows) < _STALE * self._laid:
            self._laid = len(rows)
            self.table = _Table(
                self.points, self.lengths, self.weights, rows, self.home[rows], self._count
            )

    def look(self, rows: I64) -> None:
        """Search the cheapest partners of some points anew."""
        self.partners[rows], self.costs[rows] = NOBODY, np.inf
        self.searched[rows] = self._now
        for near in self.cells.T:
            starts, order = by_label(near[rows], self._count)
            self.table.look(starts, rows[order], self.partners, self.costs)

    def merge(self, rows: I64, most: int) -> I64:
        """Merge up to `most` of the cheapest pairs of the remaining points, and return the merged.

        The merged point takes the index of the heavier of the two.
        """
        best, least = self._cheapest(rows)
        likely = np.arange(len(rows))
        if 2 * most < len(rows):  # twice as many, because both points may list the same pair
            likely = np.flatnonzero(least <= np.partition(least, 2 * most)[2 * most])
        lost = likely[(best[likely] == NOBODY) & (least[likely] < np.inf)]
        self.look(rows[lost])
        best[lost], least[lost] = self._cheapest(rows[lost])
        order = likely[np.argsort(least[likely], kind="stable")]
        self._now += 1
        merged, table = np.empty(most, np.int64), self.table
        count = merge_pairs(
            rows[order], best[order], most, self._now, self.points, self.lengths, self.weights,
            self.parents, self.changed, table.places, self.home, table.bounds, table.widths,
            table.values, table.squares, table.masses, table.holders, merged,
        )  # fmt: skip
        return merged[:count]

    def _cheapest(self, rows: I64) -> tuple[I32, F32]:
        """Return the cheapest remaining partner of each point and its cost; see the kernel."""
        best, least = np.empty(len(rows), np.int32), np.empty(len(rows), np.float32)
        cheapest(
            rows, self.parents, self.changed, self.searched, self.partners, self.costs, best, least
        )
        return best, least


def _lengths(points: F32) -> F32:
    """Compute the squared length of each point, (N,)."""
    lengths: F32 = np.einsum("ij,ij->i", points, points)
    return lengths

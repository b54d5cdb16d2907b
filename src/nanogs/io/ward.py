"""Groups of near points, by merging the two whose merge costs least, many at a time.

Ward's method, see `nanogs.kernels.ward`. A point knows its cheapest partners among those in cells
near it. What comes of a merge costs no less to merge with any other than the cheaper of the two did
(Lance and Williams, 1967). So where all the partners that a point knows are gone, the last of them
says what another costs at least, and others are looked for only when that is cheap enough.
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
from nanogs.progress import Parts

_PARTNERS = 6  # that a point knows
_SHARE = 0.2  # of the points that are left: at most so many merges before partners are looked for
_STALE = 0.7  # share of the columns of the table that are points, below which it is made anew


def merge_near(points: F32, weights: F32, cells: I32, size: int, tell: Parts) -> tuple[I32, I32]:
    """Groups of little squared error.

    Every pass merges a pair, or finds for some point that none is left near it: while there are
    more points than `size`, some cell has two, and these find each other.

    Args:
        points: (N, D), at most 2 from zero, D a multiple of three, N more than `size`.
        weights: (N,) positive.
        cells: (N, P) the cells in which each looks for partners, that in which it lies first; of
            all cells there are less than `size`, or one.
        size: How many groups.
        tell: Told of the merges done, of all.

    Returns:
        (N,) the group of each point, from 0 on, and (size,) the cell in which each group lies.
    """
    nodes = _Nodes(points, weights, cells)
    rows = changed = np.arange(len(points))
    merges = len(points) - size
    while len(rows) > size:
        tell(len(points) - len(rows), merges)
        nodes.prepare(rows)
        nodes.look(changed)
        changed = nodes.merge(rows, min(len(rows) - size, max(int(_SHARE * len(rows)), 1)))
        rows = rows[nodes.parents[rows] == rows]
    tell(merges, merges)
    return _numbered(nodes.parents, rows), nodes.home[rows]


def _numbered(parents: I32, rows: I64) -> I32:
    """The group of each point, by the one of these rows into which it was merged in the end."""
    while True:
        further = parents[parents]
        if np.array_equal(further, parents):
            return np.searchsorted(rows, parents).astype(np.int32)
        parents = further


def settle(points: F32, weights: F32, cells: I32, labels: I32, home: I32) -> I32:
    """(N,) the groups of points, each having gone to that whose mean is the nearest; none is empty.

    Args:
        points: (N, D), as for `merge_near`.
        weights: (N,) positive.
        cells: (N, P) the cells in which each looks for a nearer mean.
        labels: (N,) the group of each, from 0 on.
        home: (K,) the cell in which each group lies.
    """
    size, count = len(home), int(cells.max()) + 1
    means = np.empty((points.shape[1], size), np.float32)
    squares = np.empty(size, np.float32)
    weighted_means(points, weights, *by_label(labels, size), means, squares)
    pool = np.concatenate([means.T, points])
    lengths = np.concatenate([squares, _lengths(points)])
    alike = np.full(len(pool), 2, np.float32)  # 2 · 2 / (2 + 2) = 1
    partners = np.empty((len(pool), 1), np.int32)
    costs = np.empty((len(pool), 1), np.float32)
    own_costs(labels, pool, alike, partners, costs)
    table = _Table(pool, lengths, np.arange(size), home, count)
    for near in cells.T:
        starts, order = by_label(near, count)
        table.look(starts, order + size, alike, partners, costs)
    settled = partners[size:, 0].copy()
    # A group that all have left gets its points back, so that there are as many as asked for; so
    # may those that only these points had gone to, until at worst all are back.
    while (empty := np.bincount(settled, minlength=size) == 0).any():
        settled[empty[labels]] = labels[empty[labels]]
    return settled


class _Table:
    """Points side by side in cells; see `nanogs.kernels.ward`.

    Args:
        points: (N, D).
        lengths: (N,) squared.
        rows: (R,) which points are in it, ascending.
        home: (R,) the cell of each.
        count: Cells.
    """

    def __init__(self, points: F32, lengths: F32, rows: I64, home: I32, count: int) -> None:
        self.points, self.lengths = points, lengths
        starts, order = by_label(home, count)
        self.widths = -(-np.diff(starts) // LANES) * LANES
        ends = np.cumsum(self.widths)
        self.bounds = ends - self.widths
        columns = int(ends[-1])
        self.values = np.empty(columns * points.shape[1], np.float32)
        self.squares = np.empty(columns, np.float32)
        self.holders = np.empty(columns, np.int32)
        self.places = np.empty(len(points), np.int64)
        lay_out(
            self.bounds, starts, rows[order], points, lengths, self.values, self.squares,
            self.holders, self.places,
        )  # fmt: skip

    def look(self, starts: I64, order: I64, weights: F32, partners: I32, costs: F32) -> None:
        """Look in each cell for the cheapest partners of some points, beside those known.

        Args:
            starts: (C + 1,) where the points that look into each cell begin.
            order: These points.
            weights: (N,) of all.
            partners: (N, P) in and out.
            costs: (N, P) in and out.
        """
        rounding = np.float32((self.points.shape[1] + 8) * 2.0**-21)
        near_partners(
            pieces(starts), order, self.points, self.lengths, weights, self.bounds, self.widths,
            self.values, self.squares, self.holders, rounding, partners, costs,
        )  # fmt: skip


class _Nodes:
    """Points that are merged, and what they know of each other."""

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
        self._laid = np.inf  # points that the table was made for

    def prepare(self, rows: I64) -> None:
        """Make the table of the points that are left, where it is of many more."""
        if len(rows) < _STALE * self._laid:
            self._laid = len(rows)
            self.table = _Table(self.points, self.lengths, rows, self.home[rows], self._count)

    def look(self, rows: I64) -> None:
        """Find the cheapest partners of some points."""
        self.partners[rows], self.costs[rows] = NOBODY, np.inf
        self.searched[rows] = self._now
        for near in self.cells.T:
            starts, order = by_label(near[rows], self._count)
            self.table.look(starts, rows[order], self.weights, self.partners, self.costs)

    def merge(self, rows: I64, most: int) -> I64:
        """Merge the cheapest pairs of the points that are left, and return what they became."""
        best, least = self._cheapest(rows)
        likely = np.arange(len(rows))
        if 2 * most < len(rows):  # a pair may come twice
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
            table.values, table.squares, table.holders, merged,
        )  # fmt: skip
        return merged[:count]

    def _cheapest(self, rows: I64) -> tuple[I32, F32]:
        """(R,) the cheapest partner of each that is left, and its cost; see the kernel."""
        best, least = np.empty(len(rows), np.int32), np.empty(len(rows), np.float32)
        cheapest(
            rows, self.parents, self.changed, self.searched, self.partners, self.costs, best, least
        )
        return best, least


def _lengths(points: F32) -> F32:
    """(N,) squared."""
    lengths: F32 = np.einsum("ij,ij->i", points, points)
    return lengths

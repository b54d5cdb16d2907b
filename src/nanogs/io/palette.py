"""A palette of vectors: k-means with up to 64 K centres, the same for any number of threads."""

from dataclasses import dataclass

import numpy as np

from nanogs._types import F32, F64, I32, I64

ENTRIES_PER_CELL = 256
_SAMPLES_PER_CELL = 64
_POWER = 0.85  # D / (D + 2) for data of eleven dimensions; those of a scene spread in fewer
_CELL_ROUNDS = 6
_PROBES = (1, 1, 1, 1, 1, 1, 6, 6)  # cells that a point looks into, round by round


@dataclass(frozen=True, slots=True, eq=False)
class Palette:
    """Vectors in the order of their first use, and which of them stands for each point.

    Attributes:
        entries: (K, D) float32.
        labels: (N,) int32, rows of `entries`.
    """

    entries: F32
    labels: I32


def palette(points: F32, size: int, weights: F64 | None = None) -> Palette:
    """Find vectors that stand for the points with little squared error.

    Points that are equal are one point of more weight, so a model that came from a palette
    keeps it.

    Args:
        points: (N, D), finite, N at least 1.
        size: Most entries.
        weights: (N,) positive, how much a point's error counts; all alike by default.
    """
    distinct, inverse, counts = _distinct(points)
    if len(distinct) <= size:
        return _in_order_of_use(distinct, inverse.astype(np.int32))
    totals = counts if weights is None else np.bincount(inverse, weights)
    entries, labels = _cluster(distinct, (totals / totals.mean()).astype(np.float32), size)
    return _in_order_of_use(entries, labels[inverse])


def _in_order_of_use(entries: F32, labels: I32) -> Palette:
    """Unused entries go; neighbouring points then often have neighbouring labels."""
    used, first = np.unique(labels, return_index=True)
    order = used[np.argsort(first, kind="stable")]
    places = np.empty(len(entries), np.int32)
    places[order] = np.arange(len(order))
    return Palette(entries[order], places[labels])


def _distinct(points: F32) -> tuple[F32, I64, I64]:
    """Distinct rows, for each point its row among them, and how many points each stands for."""
    rows = np.ascontiguousarray(points + np.float32(0))  # -0 becomes 0
    keys = rows.view(np.dtype((np.void, rows.itemsize * rows.shape[1])))[:, 0]
    _, first, inverse, counts = np.unique(
        keys, return_index=True, return_inverse=True, return_counts=True
    )
    return rows[first], inverse, counts


class _Search:
    """Centres in columns, those of a cell side by side, and the kernels' scratch."""

    def __init__(self, points: F32, weights: F32, centres: F32, cells: I32, bounds: I64) -> None:
        self.points, self.weights = points, weights
        self.cells, self.bounds = cells, bounds
        self.columns = np.ascontiguousarray(centres.T)
        self.squares = (self.columns**2).sum(axis=0)
        self.labels = np.zeros(len(points), np.int32)
        self.errors = np.zeros(len(points), np.float32)

    def assign(self, probes: int) -> None:
        """The nearest centre of each point, as far as it looks."""
        from nanogs.kernels.kmeans import nearest_entries

        nearest_entries(
            self.points, self.cells, probes, self.bounds, self.columns, self.squares, self.labels,
            self.errors,
        )  # fmt: skip

    def move(self) -> None:
        """Centres to the means of their points; idle ones to the cell's points served worst."""
        from nanogs.kernels.kmeans import weighted_means

        starts, order = _by_label(self.labels, len(self.squares))
        idle = np.flatnonzero(np.diff(starts) == 0)
        if len(idle):
            self._reseed(idle)
        weighted_means(self.points, self.weights, starts, order, self.columns, self.squares)

    def _reseed(self, idle: I64) -> None:
        own = self.cells[:, 0]
        worst = np.lexsort((-self.errors * self.weights, own))
        cells = np.searchsorted(self.bounds, idle, side="right") - 1
        rank = np.arange(len(idle)) - np.searchsorted(cells, cells)
        first = np.searchsorted(own[worst], cells)
        self.columns[:, idle] = self.points[worst[first + rank]].T


def _cluster(points: F32, weights: F32, size: int) -> tuple[F32, I32]:
    count = max(1, size // ENTRIES_PER_CELL)
    cells, errors = _cells(points, count)
    starts, order = _by_label(cells[:, 0], count)
    spreads = np.bincount(cells[:, 0], errors * weights, minlength=count)
    shares = _shares(np.diff(starts), spreads.astype(np.float64), size)
    bounds = np.concatenate([[0], np.cumsum(shares)])
    seeds = points[_seeds(starts, order, shares)]
    search = _Search(points, weights, seeds, cells, bounds)
    for probes in _PROBES:
        search.assign(min(probes, count))
        search.move()
    search.assign(cells.shape[1])
    return np.ascontiguousarray(search.columns.T), search.labels


def _cells(points: F32, count: int) -> tuple[I32, F32]:
    """(N, P) the cells of each point, the nearest first; (N,) squared distance to its centre."""
    from nanogs.kernels.kmeans import nearest_cells

    sample = points[np.linspace(0, len(points) - 1, _SAMPLES_PER_CELL * count).astype(np.int64)]
    equal, one = np.ones(len(sample), np.float32), np.zeros((len(sample), 1), np.int32)
    seeds = sample[::_SAMPLES_PER_CELL]
    search = _Search(sample, equal, seeds, one, np.array([0, count]))
    for _ in range(_CELL_ROUNDS):
        search.assign(1)
        search.move()
    cells = np.empty((len(points), min(max(_PROBES), count)), np.int32)
    nearest_cells(points, search.columns, search.squares, cells)
    centres = np.ascontiguousarray(search.columns.T)
    own = _Search(points, equal, centres, cells, np.arange(count + 1))
    own.assign(1)
    return cells, own.errors


def _by_label(labels: I32, count: int) -> tuple[I64, I64]:
    from nanogs.kernels.kmeans import group

    starts, order = np.empty(count + 1, np.int64), np.empty(len(labels), np.int64)
    group(np.ascontiguousarray(labels), starts, order)
    return starts, order


def _shares(counts: I64, spreads: F64, size: int) -> I64:
    """Entries of each cell: at least one, no more than it has points, `size` in all.

    In between they follow the squared error about the cell's centre, to a power: with k entries
    error E falls to E k^(-2/D), so the sum is least for k in proportion to E^(D / (D + 2)).

    Args:
        counts: (C,) points, more than `size` in all.
        spreads: (C,) squared errors.
        size: Entries to share out.
    """
    wanted = spreads**_POWER + 1e-30
    shares = np.minimum(counts, 1)
    while (left := size - int(shares.sum())) > 0:
        wanted[shares == counts] = 0
        exact: F64 = wanted * (left / wanted.sum())
        more = np.minimum(exact.astype(np.int64), counts - shares)
        if not more.any():  # less than one each: those nearest to one more
            more[np.argsort(-exact, kind="stable")[:left]] = 1
            more = np.minimum(more, counts - shares)
        shares += more
    return shares


def _seeds(starts: I64, order: I64, shares: I64) -> I64:
    """Points of each cell, evenly spaced in its list."""
    seeds = [
        order[start + (np.arange(share) * count) // max(share, 1)]
        for start, count, share in zip(starts, np.diff(starts), shares, strict=False)
    ]
    return np.concatenate(seeds)

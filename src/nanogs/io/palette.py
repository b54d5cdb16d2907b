"""A palette of vectors: k-means with up to 64 K centres, the same for any number of threads."""

from dataclasses import dataclass

import numpy as np

from nanogs._types import F32, F64, I32, I64
from nanogs.progress import Parts, each, untold

ENTRIES_PER_CELL = 256
_SAMPLES_PER_CELL = 64
_CELL_ROUNDS = 6
_TWINS = 2  # entries that start from the same point
_PROBES = (1, 1, 1, 1, 1, 1, 6, 6)  # cells that a point looks into, round by round


@dataclass(frozen=True, slots=True, eq=False)
class Palette:
    """Vectors in the order of their first use, and which of them stands for each point.

    Attributes:
        entries: (K, D) float32.
        labels: (N,) int32, rows of `entries`.
        exact: Whether every point is one of the entries.
    """

    entries: F32
    labels: I32
    exact: bool


def palette(points: F32, size: int, weights: F64 | None = None, tell: Parts = untold) -> Palette:
    """Find vectors that stand for the points with little squared error.

    Points that are equal are one point of more weight, so a model that came from a palette
    keeps it.

    Args:
        points: (N, D), finite, N at least 1.
        size: Most entries.
        weights: (N,) positive, how much a point's error counts; all alike by default.
        tell: Told of the rounds, where entries have to be looked for.
    """
    distinct, inverse, counts = _distinct(points)
    if len(distinct) <= size:
        return _in_order_of_use(distinct, inverse.astype(np.int32), exact=True)
    totals = counts if weights is None else np.bincount(inverse, weights)
    entries, labels = _cluster(distinct, (totals / totals.mean()).astype(np.float32), size, tell)
    return _in_order_of_use(entries, labels[inverse], exact=False)


def _in_order_of_use(entries: F32, labels: I32, *, exact: bool) -> Palette:
    """Unused entries go; neighbouring points then often have neighbouring labels."""
    used, first = np.unique(labels, return_index=True)
    order = used[np.argsort(first, kind="stable")]
    places = np.empty(len(entries), np.int32)
    places[order] = np.arange(len(order))
    return Palette(entries[order], places[labels], exact)


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
        self._errors = np.zeros(len(points), np.float32)

    def assign(self, probes: int) -> None:
        """The nearest centre of each point, as far as it looks."""
        from nanogs.kernels.kmeans import nearest_entries

        nearest_entries(
            self.points, self.cells, probes, self.bounds, self.columns, self.squares, self.labels,
            self._errors,
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
        worst = np.lexsort((-self._errors * self.weights, own))
        cells = np.searchsorted(self.bounds, idle, side="right") - 1
        rank = np.arange(len(idle)) - np.searchsorted(cells, cells)
        first = np.searchsorted(own[worst], cells)
        self.columns[:, idle] = self.points[worst[first + rank]].T


def _cluster(points: F32, weights: F32, size: int, tell: Parts) -> tuple[F32, I32]:
    count = max(1, size // ENTRIES_PER_CELL)
    cells = _cells(points, count)
    starts, order = _by_label(cells[:, 0], count)
    shares = _shares(np.diff(starts), size)
    bounds = np.concatenate([[0], np.cumsum(shares)])
    seeds = points[_seeds(starts, order, shares)]
    search = _Search(points, weights, seeds, cells, bounds)
    for probes in each(_PROBES, tell):
        search.assign(min(probes, count))
        search.move()
    search.assign(cells.shape[1])
    return np.ascontiguousarray(search.columns.T), search.labels


def _cells(points: F32, count: int) -> I32:
    """(N, P): the cells of each point, the nearest first."""
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
    return cells


def _by_label(labels: I32, count: int) -> tuple[I64, I64]:
    from nanogs.kernels.kmeans import group

    starts, order = np.empty(count + 1, np.int64), np.empty(len(labels), np.int64)
    group(np.ascontiguousarray(labels), starts, order)
    return starts, order


def _shares(counts: I64, size: int) -> I64:
    """Entries of each cell: one, and the others in proportion to its points, but not more.

    Not in proportion to its error, which would be less in all: cells of large error are mostly
    those of splats inside things, which hardly anyone sees.
    """
    shares = np.minimum(counts, 1)
    left, others = size - int(shares.sum()), counts - shares
    exact: F64 = others * (left / others.sum())
    whole = exact.astype(np.int64)
    shares += whole
    shares[np.argsort(whole - exact, kind="stable")[: size - int(shares.sum())]] += 1
    return shares


def _seeds(starts: I64, order: I64, shares: I64) -> I64:
    """Points of each cell, evenly spaced in its list, each for two entries.

    One of the two stays idle, and goes to a point that the first round serves badly, a heavy one
    above all. Where weights differ much, as in scenes, that is the better start by far.
    """
    seeds = []
    for start, count, share in zip(starts, np.diff(starts), shares, strict=False):
        places = np.arange(share) // _TWINS * _TWINS
        seeds.append(order[start + places * count // max(share, 1)])
    return np.concatenate(seeds)

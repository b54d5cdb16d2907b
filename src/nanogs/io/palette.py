"""A palette of vectors: k-means with up to 64 K centres, the same for any number of threads."""

from dataclasses import dataclass

import numpy as np

from nanogs._types import F32, F64, I32, I64
from nanogs.progress import Parts, each, untold

ENTRIES_PER_CELL = 256
_SAMPLES_PER_CELL = 64
_CELL_ROUNDS = 6
_TWINS = 2  # entries that start from the same point
_MOST_MOVED = 0.5  # share of the entries beyond which all points look at all of their cells
_PIECE = 512  # points of a cell that a thread takes at once
_LINE = 16  # float32 in a line of the cache
_TINY = np.float32(2.0**-126)  # more than what underflow loses
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
        self.columns = _apart(centres.T)
        self.squares = (self.columns[:, : len(centres)] ** 2).sum(axis=0)
        self.labels = np.zeros(len(points), np.int32)
        self._lengths = np.einsum("ij,ij->i", points, points)
        self._least, self._second = np.empty((2, len(points)), np.float32)
        # Of the last round: which points it may not have settled, the cells that were looked into,
        # and the entries as they were.
        self._open = np.ones(len(points), bool)
        self._probes = 0
        self._before = np.zeros_like(self.columns)
        self._squares_before = np.zeros_like(self.squares)

    @property
    def centres(self) -> F32:
        """(K, D) float32, as they are now."""
        return np.ascontiguousarray(self.columns[:, : len(self.squares)].T)

    def assign(self, probes: int) -> None:
        """The nearest centre of each point, as far as it looks."""
        from nanogs.kernels.kmeans import nearest_entries

        count = len(self.squares)
        moved = (self.columns != self._before)[:, :count].any(axis=0)  # the same bits stay
        moved |= self.squares != self._squares_before
        anew = self._open | moved[self.labels]
        if moved.mean() > _MOST_MOVED or probes < self._probes:
            anew[:] = True
        self._least[anew] = self._second[anew] = np.inf
        every, some, others = np.arange(count), np.flatnonzero(moved), np.flatnonzero(~anew)
        for probe in range(probes):
            if probe < self._probes:  # an entry that stays is as near as it was
                self._look(probe, others, some)
                self._look(probe, np.flatnonzero(anew), every)
            else:
                self._look(probe, np.arange(len(self.points)), every)
        # For distances of as many terms this bounds what rounding does, in any order of them.
        apart = self._rounding * (10 * self.squares[self.labels] + 6 * self._lengths) + _TINY
        self._open = ~(self._second - self._least > apart)
        nearest_entries(
            np.flatnonzero(self._open), self.points, self.cells, probes, self.bounds, self.columns,
            self.squares, self.labels,
        )  # fmt: skip
        self._probes = probes
        self._before[:], self._squares_before[:] = self.columns, self.squares

    @property
    def _rounding(self) -> np.float32:
        return np.float32((self.points.shape[1] + 8) * 2.0**-24)

    def _look(self, probe: int, rows: I64, entries: I64) -> None:
        """Look for nearer entries in a cell of each of some points, among some of all entries."""
        from nanogs.kernels.kmeans import likely_entries

        starts, order = _by_label(self.cells[rows, probe], len(self.bounds) - 1)
        likely_entries(
            _pieces(starts), rows[order], self.points, np.searchsorted(entries, self.bounds),
            entries, self.columns, self.squares, 4 * self._rounding, self.labels, self._least,
            self._second,
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
        from nanogs.kernels.kmeans import squared_errors

        errors = np.empty(len(self.points), np.float32)
        squared_errors(self.points, self.columns, self.labels, errors)
        errors *= -self.weights
        starts, order = _by_label(self.cells[:, 0], len(self.bounds) - 1)
        cells = np.searchsorted(self.bounds, idle, side="right") - 1
        for cell, count in zip(*np.unique(cells, return_counts=True), strict=True):
            rows = order[starts[cell] : starts[cell + 1]]
            worst = rows[np.argsort(errors[rows], kind="stable")[:count]]
            self.columns[:, idle[cells == cell]] = self.points[worst].T


def _apart(columns: F32) -> F32:
    """(D, K or more): the same, rows an odd number of cache lines long.

    With rows of 2^18 bytes, the usual, parts of one entry would drive each other out of the cache.
    """
    lines = -(-columns.shape[1] // _LINE) | 1
    wide = np.zeros((len(columns), lines * _LINE), np.float32)
    wide[:, : columns.shape[1]] = columns
    return wide


def _pieces(starts: I64) -> I64:
    """(Q, 3): cells, and from where to where points of each are, a share of a thread at most."""
    counts = np.diff(starts)
    parts = -(-counts // _PIECE)
    cells = np.repeat(np.arange(len(counts)), parts)
    number = np.arange(len(cells)) - np.repeat(np.cumsum(parts) - parts, parts)
    first = starts[cells] + number * _PIECE
    return np.stack([cells, first, np.minimum(first + _PIECE, starts[cells + 1])], axis=1)


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
    return search.centres, search.labels


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
    nearest_cells(points, np.ascontiguousarray(search.centres.T), search.squares, cells)
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

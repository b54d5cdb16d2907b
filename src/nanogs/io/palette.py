"""Vector quantisation: a palette of few vectors for many points, found by agglomerative clustering.

The result is the same for any number of threads.
"""

from dataclasses import dataclass

import numpy as np

from nanogs import parallel
from nanogs._types import F32, F64, I32, I64, U64, Array
from nanogs.progress import PartProgress, ignore_progress
from nanogs.slices import slices
from nanogs.splats import pick

_CELL = 256  # approximate number of points per cell, unless that makes too many cells
_MOST_CELLS = 1024  # the distance of every point to the centre of every cell is computed
_NEAR = 2  # number of cells in which a point searches for merge partners
_ODD = np.uint64(0x9E3779B97F4A7C15)  # Knuth's multiplier, 2^64 over the golden ratio


@dataclass(frozen=True, slots=True, eq=False)
class Palette:
    """A palette, its entries ordered by first use, and the entry of each point.

    Attributes:
        entries: (K, D) float32.
        labels: (N,) int32, for each point the row of `entries`.
        exact: Whether every point equals its entry.
    """

    entries: F32
    labels: I32
    exact: bool


def palette(
    points: F32, size: int, weights: F64 | None = None, on_progress: PartProgress = ignore_progress
) -> Palette:
    """Find a palette that approximates the points with a small squared error.

    Equal points are joined to one point of their total weight first, so a model that was read from
    a palette keeps it.

    Args:
        points: (N, D), finite, N at least 1.
        size: Largest number of entries.
        weights: (N,) positive weights of the squared errors; equal by default.
        on_progress: Progress callback, called with the merges done, if there are any.
    """
    distinct, inverse, counts = _distinct(points)
    if len(distinct) <= size:
        return Palette(distinct, inverse.astype(np.int32), exact=True)
    totals = counts if weights is None else np.bincount(inverse, weights)
    entries, labels = _cluster(
        distinct, (totals / totals.mean()).astype(np.float32), size, on_progress
    )
    return _in_order_of_use(entries, labels[inverse])


def _in_order_of_use(entries: F32, labels: I32) -> Palette:
    """Sort the entries by first use, so that neighbouring points often have near labels."""
    _, first = np.unique(labels, return_index=True)  # every entry is used
    order = np.argsort(first, kind="stable")
    places = np.empty(len(entries), np.int32)
    places[order] = np.arange(len(order))
    return Palette(entries[order], places[labels], exact=False)


def _distinct(points: F32) -> tuple[F32, I64, I64]:
    """Return the distinct rows in order of appearance, the row of each point, and their counts."""
    rows: F32 = np.empty(points.shape, np.float32)

    def add_zero(part: slice) -> None:
        np.add(points[part], np.float32(0), out=rows[part])  # -0 becomes 0, for equal bits

    parallel.for_each(slices(len(rows)), add_zero)
    first, places, counts = _groups(_keys(rows))
    if not _equal_rows(rows, first[places]):  # a hash collision
        whole = rows.view(np.dtype((np.void, rows.itemsize * rows.shape[1])))[:, 0]
        first, places, counts = _groups(whole)
    return pick(rows, first), places, counts


def _equal_rows(rows: F32, others: I64) -> bool:
    """Return whether each row equals the one of which it has the number."""
    parts = slices(len(rows))
    found = parallel.map_ordered(
        parts, lambda part: np.array_equal(pick(rows, others[part]), rows[part])
    )
    return all(found)


def _groups(keys: Array) -> tuple[I64, I64, I64]:
    """Group equal keys: first index of each group, ascending; group of each key; group sizes."""
    order = np.argsort(keys)
    ordered = keys[order]
    starts = np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1]]))
    counts = np.diff(starts, append=len(keys))
    first = np.minimum.reduceat(order, starts)
    as_they_come = np.argsort(first)
    numbers, places = np.empty(len(first), np.int64), np.empty(len(keys), np.int64)
    numbers[as_they_come] = np.arange(len(first))
    places[order] = np.repeat(numbers, counts)
    return first[as_they_come], places, counts[as_they_come]


def _keys(rows: F32) -> U64:
    """Hash each row to 64 bits, (N,): sorting hashes takes a tenth of the time of sorting rows."""
    bits, keys = rows.view(np.uint32), np.zeros(len(rows), np.uint64)

    def mix(part: slice) -> None:
        some = keys[part]
        for column in bits[part].T:
            some += column
            some *= _ODD
            some ^= some >> np.uint64(29)

    parallel.for_each(slices(len(keys)), mix)
    return keys


def _cluster(points: F32, weights: F32, size: int, on_progress: PartProgress) -> tuple[F32, I32]:
    """Cluster distinct points; return the entries (size, D) and the entry of each point (N,)."""
    from nanogs.io.cells import by_label, nearby_cells
    from nanogs.io.ward import merge_points, settle
    from nanogs.kernels.kmeans import weighted_means

    scaled = _scaled(points)
    count = max(1, min(len(points) // _CELL, size // 8, _MOST_CELLS))
    cells = nearby_cells(scaled, count, _NEAR)
    labels = settle(
        scaled, weights, cells, *merge_points(scaled, weights, cells, size, on_progress)
    )
    means = np.empty((points.shape[1], size), np.float32)
    weighted_means(points, weights, *by_label(labels, size), means, np.empty(size, np.float32))
    return np.ascontiguousarray(means.T), labels


def _scaled(points: F32) -> F32:
    """Scale points by a power of two, then centre them: at most 2, so that squares stay exact."""
    scaled: F32 = np.ldexp(points, -np.frexp(np.abs(points).max())[1])
    scaled -= scaled.mean(axis=0, dtype=np.float64).astype(np.float32)
    return scaled

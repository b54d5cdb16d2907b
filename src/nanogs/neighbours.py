"""Exact k-nearest-neighbour search on the threads in use, of any number: results are the same."""

import numba
import numpy as np

from nanogs import parallel
from nanogs._types import F64, I32, I64, Bool
from nanogs.kernels.knn import search_tree
from nanogs.kernels.knn_tree import build_tree
from nanogs.kernels.lanes import LANES
from nanogs.kernels.nearest import find_nearest
from nanogs.slices import SLICE_STEPS, slices

# Coordinates are scaled to 2^500, so that squares of differences, from 2^-1000 times that up, are
# within the range of float64.
_EXPONENT = 500


def nearest_neighbours(means: F64, k: int) -> I32:
    """Find the exact nearest neighbours of every row among the others.

    They are the first k by (squared distance in float64, row), with one exception: in a group of
    more than k rows with the same centre, all would have the same k partners. There the
    neighbours of a row are the next k rows of the group, cyclically.

    Args:
        means: (N, 3) finite, scene units.
        k: Number of neighbours; at most N - 1 are returned.

    Returns:
        (N, min(k, N - 1)) int32 rows, nearest first, never the row itself.
    """
    n = len(means)
    k = min(k, n - 1)
    neighbours = np.empty((n, max(k, 0)), dtype=np.int32)
    if k <= 0:
        return neighbours
    crowded = np.empty(n, dtype=bool)
    _search(_scaled(means), neighbours, crowded)
    if crowded.any():
        _uncrowd(_scaled(means), np.flatnonzero(crowded), neighbours)
    return neighbours


def nearest_to(places: F64, means: F64) -> tuple[F64, I32]:
    """Find the nearest centre to each query point: the first by (squared distance, row).

    Args:
        places: (Q, 3) query points, finite, scene units.
        means: (N, 3) finite, N at least 1, coordinates below 1e150.

    Returns:
        (Q,) float64 distances, scene units, and (Q,) int32 rows of `means`.
    """
    distances, nearest = np.empty(len(places)), np.empty(len(places), np.int32)
    points = np.ascontiguousarray(means.T).reshape(-1)
    rows, boxes = _tree(points)
    find_nearest(np.ascontiguousarray(places), points, rows, boxes, distances, nearest)
    return distances, nearest


def coincident_groups(means: F64) -> tuple[I64, I64]:
    """Group rows that have the same centre.

    Args:
        means: (N, 3) finite.

    Returns:
        (N,) int64 rows, those with the same centre adjacent and ascending; and (G + 1,) int64, the
        start of each of the G groups, and N.
    """
    order = np.lexsort(means.T)
    starts = (np.diff(means[order], axis=0) != 0).any(axis=1)
    return order, np.concatenate([[0], np.flatnonzero(starts) + 1, [len(means)]])


def _scaled(means: F64) -> F64:
    """Return (3, N) coordinates times a power of two, which keeps the order of distances."""
    ends: list[float] = []

    def measure(part: slice) -> None:
        ends.append(max(-float(means[part].min()), float(means[part].max())))

    parallel.for_each(slices(len(means), SLICE_STEPS), measure)
    if not np.isfinite(ends).all():  # kernels would read out of bounds
        raise ValueError("centres must be finite")
    exponent = _EXPONENT - int(np.frexp(max(ends))[1])
    scaled = np.empty((3, len(means)))

    def scale(part: slice) -> None:
        for axis in range(3):
            np.ldexp(means[part, axis], exponent, out=scaled[axis, part])

    parallel.for_each(slices(len(means), SLICE_STEPS), scale)
    return scaled


def _search(scaled: F64, neighbours: I32, crowded: Bool) -> None:
    """Fill the neighbours by a search in a tree; reorders the scaled centres in place."""
    points = scaled.reshape(-1)
    rows, boxes = _tree(points)
    search_tree(points, rows, boxes, neighbours, crowded)


def _tree(points: F64) -> tuple[I32, F64]:
    """Sort (3 N,) points into the leaves of a tree, in place; return rows and boxes of nodes."""
    rows = np.arange(len(points) // 3, dtype=np.int32)
    leaves = -(-len(rows) // LANES)
    boxes = np.empty((2 << (leaves - 1).bit_length(), 6))
    build_tree(points, rows, boxes, (numba.get_num_threads() - 1).bit_length())
    return rows, boxes


def _uncrowd(scaled: F64, rows: I64, neighbours: I32) -> None:
    """Fill the neighbours of rows for which k others are at distance zero."""
    k = neighbours.shape[1]
    order, bounds = coincident_groups(scaled[:, rows].T)
    sizes = np.diff(bounds)
    group = np.repeat(np.arange(len(sizes)), sizes)
    place = np.arange(len(order)) - bounds[group]
    large = sizes[group] > k
    for step in range(1, k + 1):
        following = (place + step) % sizes[group] + bounds[group]
        neighbours[rows[order[large]], step - 1] = rows[order[following[large]]]
    # The other rows are not coincident: squares of their distances underflow. float32 input cannot
    # cause that.
    for row in rows[order[~large]]:
        offsets = scaled - scaled[:, row, None]
        squares = offsets[0] ** 2 + offsets[1] ** 2 + offsets[2] ** 2
        squares[row] = np.inf
        neighbours[row] = np.argsort(squares, kind="stable")[:k]

"""Partitioning points into cells: Voronoi cells of centres that k-means finds on a sample.

Lloyd, "Least squares quantization in PCM", 1982. Searching for neighbours only in the nearest cells
is the inverted file of Jegou, Douze, Schmid, "Product quantization for nearest neighbor search",
2011, section IV.
"""

import numpy as np

from nanogs._types import F32, I32, I64
from nanogs.kernels.closest import LANES
from nanogs.kernels.grouping import group_members
from nanogs.kernels.kmeans import nearest_cells, weighted_means

_SAMPLES = 64  # sampled points per cell, from which the centres are computed
_ROUNDS = 6
_PIECE = 512  # points of a cell that one thread processes at a time


def nearby_cells(points: F32, count: int, near: int) -> I32:
    """Partition points into cells and return the nearest cells of each, (N, P), nearest first.

    Args:
        points: (N, D), D a multiple of three.
        count: Number of cells, at most N.
        near: Number of cells for each point, one or two; P is the smaller of this and `count`.
    """
    sample = points[np.linspace(0, len(points) - 1, _SAMPLES * count).astype(np.int64)]
    width = -(-count // LANES) * LANES
    centres = np.zeros((points.shape[1], width), np.float32)
    centres[:, :count] = sample[::_SAMPLES].T
    squares, equal = np.square(centres).sum(axis=0), np.ones(len(sample), np.float32)
    squares[count:] = np.inf  # columns without a centre
    own = np.empty((len(sample), 1), np.int32)
    for _ in range(_ROUNDS):
        nearest_cells(sample, centres, squares, own)
        starts, order = by_label(own[:, 0], count)
        weighted_means(sample, equal, starts, order, centres, squares[:count])
    cells = np.empty((len(points), min(near, count)), np.int32)
    nearest_cells(points, centres, squares, cells)
    return cells


def by_label(labels: I32, count: int) -> tuple[I64, I64]:
    """Return (count + 1,) offsets of the labels 0 to `count` - 1, and (N,) points by label."""
    starts, order = np.zeros(count + 1, np.int64), np.empty(len(labels), np.int64)
    group_members(np.ascontiguousarray(labels), starts, order)
    return starts, order


def pieces(starts: I64) -> I64:
    """Split cells into pieces of work for threads: (Q, 3) cell, first offset and end offset."""
    counts = np.diff(starts)
    parts = -(-counts // _PIECE)
    cells = np.repeat(np.arange(len(counts)), parts)
    number = np.arange(len(cells)) - np.repeat(np.cumsum(parts) - parts, parts)
    first = starts[cells] + number * _PIECE
    return np.stack([cells, first, np.minimum(first + _PIECE, starts[cells + 1])], axis=1)

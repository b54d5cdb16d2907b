"""Cells of points: those nearest to one of few centres, found by k-means among some of them.

Lloyd, "Least squares quantization in PCM", 1982; looking for neighbours in cells alone is that of
an inverted file, Jegou, Douze, Schmid, "Product quantization for nearest neighbor search", 2011,
section IV.
"""

import numpy as np

from nanogs._types import F32, I32, I64
from nanogs.kernels.kmeans import group, nearest_cells, weighted_means

_SAMPLES = 64  # of a cell, by which its centre is found
_ROUNDS = 6
_PIECE = 512  # points of a cell that a thread takes at once


def nearby_cells(points: F32, count: int, near: int) -> I32:
    """(N, P): the nearest of some cells of each point, the nearest first.

    Args:
        points: (N, D), D a multiple of three.
        count: Cells, at most N.
        near: P at most.
    """
    sample = points[np.linspace(0, len(points) - 1, _SAMPLES * count).astype(np.int64)]
    centres = np.ascontiguousarray(sample[::_SAMPLES].T)
    squares, equal = np.square(centres).sum(axis=0), np.ones(len(sample), np.float32)
    own = np.empty((len(sample), 1), np.int32)
    for _ in range(_ROUNDS):
        nearest_cells(sample, centres, squares, own)
        starts, order = by_label(own[:, 0], count)
        weighted_means(sample, equal, starts, order, centres, squares)
    cells = np.empty((len(points), min(near, count)), np.int32)
    nearest_cells(points, centres, squares, cells)
    return cells


def by_label(labels: I32, count: int) -> tuple[I64, I64]:
    """Where the points of each label, from 0 to before a count, begin in a list, and the list."""
    starts, order = np.empty(count + 1, np.int64), np.empty(len(labels), np.int64)
    group(np.ascontiguousarray(labels), starts, order)
    return starts, order


def pieces(starts: I64) -> I64:
    """(Q, 3): cells, and from where to where points of each are, a share of a thread at most."""
    counts = np.diff(starts)
    parts = -(-counts // _PIECE)
    cells = np.repeat(np.arange(len(counts)), parts)
    number = np.arange(len(cells)) - np.repeat(np.cumsum(parts) - parts, parts)
    first = starts[cells] + number * _PIECE
    return np.stack([cells, first, np.minimum(first + _PIECE, starts[cells + 1])], axis=1)

"""Kernels of k-means: the nearest centres of points, and the means of the points of each.

Source: Lloyd, "Least squares quantization in PCM", 1982. The point's own square, which is the same
for all centres, is left out of distances. Ties go to the earlier centre. The number D of dimensions
is a multiple of three, because there are three channels.
"""

import math

import numpy as np

from nanogs._types import F32, I32, I64
from nanogs.kernels.policy import inline, parallel_kernel

_ROWS = 64  # least number of points of a range
TWO = np.float32(2)


@inline
def _distances(point: F32, columns: F32, squares: F32, start: int, stop: int, out: F32) -> None:
    """Compute |c|² - 2 x.c for the centres [start, stop), which are the columns."""
    # Three rows per pass, and slices that begin at zero: LLVM vectorises loops of this form.
    count = stop - start
    own = squares[start:stop]
    for c in range(count):
        out[c] = own[c]
    for d in range(0, len(point), 3):
        x, y, z = point[d] * TWO, point[d + 1] * TWO, point[d + 2] * TWO
        first = columns[d, start:stop]
        second = columns[d + 1, start:stop]
        third = columns[d + 2, start:stop]
        for c in range(count):
            out[c] -= x * first[c] + y * second[c] + z * third[c]


@parallel_kernel("points", least=_ROWS)
def nearest_cells(
    start: int, stop: int, points: F32, columns: F32, squares: F32, cells: I32
) -> None:
    """Find the nearest centres of each point, the nearest first.

    points: (N, D); columns: (D, C) the centres; squares: (C,) their squared lengths; cells:
    (N, P) out, P up to C.
    """
    count = columns.shape[1]
    wanted = cells.shape[1]
    distances = np.empty(count, np.float32)
    kept = np.empty(wanted, np.float32)
    for i in range(start, stop):
        _distances(points[i], columns, squares, 0, count, distances)
        kept[:] = math.inf
        cells[i, :] = 0
        for c in range(count):
            if distances[c] < kept[wanted - 1]:
                place = wanted - 1
                while place > 0 and distances[c] < kept[place - 1]:
                    kept[place] = kept[place - 1]
                    cells[i, place] = cells[i, place - 1]
                    place -= 1
                kept[place] = distances[c]
                cells[i, place] = c


@parallel_kernel("squares", least=_ROWS)
def weighted_means(
    start: int,
    stop: int,
    points: F32,
    weights: F32,
    starts: I64,
    order: I64,
    columns: F32,
    squares: F32,
) -> None:
    """Move each centre to the mean of its points; one without points stays.

    points: (N, D); weights: (N,) positive; starts, order: of `group_members`; columns: (D, K or
    more) in and out; squares: (K,) out.
    """
    dimensions = points.shape[1]
    sums = np.empty(dimensions)
    for k in range(start, stop):
        if starts[k + 1] > starts[k]:
            total = 0.0
            for d in range(dimensions):
                sums[d] = 0.0
            for place in range(starts[k], starts[k + 1]):
                i = order[place]
                total += weights[i]
                for d in range(dimensions):
                    sums[d] += weights[i] * points[i, d]
            for d in range(dimensions):
                columns[d, k] = sums[d] / total
        square = np.float32(0)
        for d in range(dimensions):
            square += columns[d, k] * columns[d, k]
        squares[k] = square

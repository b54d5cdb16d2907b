"""Kernels of k-means: the nearest centres of points, and the means of the points of each.

Source: Lloyd, "Least squares quantization in PCM", 1982. The point's own square, which is the same
for all centres, is left out of distances. Ties go to the earlier centre. The number D of dimensions
is a multiple of three, because there are three channels.
"""

import math

import numpy as np

from nanogs._types import F32, I32, I64
from nanogs.kernels.closest import LANES, TOGETHER, closest, rounding
from nanogs.kernels.policy import inline, parallel_kernel

_ROWS = 64  # least number of points of a range
EMPTY = np.float32(math.inf)  # the square of a column without a centre
TWO = np.float32(2)


@inline
def _distances(point: F32, columns: F32, squares: F32, out: F32) -> None:
    """Compute |c|² - 2 x.c for all centres, which are the columns."""
    # Three rows per pass, and slices that begin at zero: LLVM vectorises loops of this form.
    for c in range(len(out)):
        out[c] = squares[c]
    for d in range(0, len(point), 3):
        x, y, z = point[d] * TWO, point[d + 1] * TWO, point[d + 2] * TWO
        first, second, third = columns[d], columns[d + 1], columns[d + 2]
        for c in range(len(out)):
            out[c] -= x * first[c] + y * second[c] + z * third[c]


@inline
def _take_all(distances: F32, kept: F32, cells: I32) -> None:
    """List the nearest centres by their distances; kept: (P,) scratch; cells: (P,) out."""
    last = len(cells) - 1
    kept[:] = math.inf
    cells[:] = 0
    for c in range(len(distances)):
        if distances[c] < kept[last]:
            place = last
            while place > 0 and distances[c] < kept[place - 1]:
                kept[place], cells[place] = kept[place - 1], cells[place - 1]
                place -= 1
            kept[place], cells[place] = distances[c], c


@inline
def _take_clear(
    lowest: F32, second: F32, tiles: I32, length: np.float32, error: np.float32, cells: I32
) -> bool:
    """List the nearest one or two centres, and return whether no other one may be as near.

    lowest, second, tiles: (16,) of `closest`; length: the point's square; error: its `rounding`;
    cells: (1 or 2,) out.
    """
    a, b, third, nearest, next_nearest = EMPTY, EMPTY, EMPTY, 0, 0
    for lane in range(LANES):
        distance = lowest[lane]
        if distance < a:
            a, b, third, nearest, next_nearest = distance, a, b, lane, nearest
        elif distance < b:
            b, third, next_nearest = distance, b, lane
        elif distance < third:
            third = distance
    cells[0] = tiles[nearest] * LANES + nearest
    if len(cells) == 1:
        return bool(min(b, second[nearest]) - a > error * (5 * length + 2 * a))
    cells[1] = tiles[next_nearest] * LANES + next_nearest
    # A centre at the distance r has a square of at most 2 (|x|² + r²).
    doubt = error * (5 * length + 2 * b)
    rival = min(third, second[nearest], second[next_nearest])
    return bool(b - a > doubt and rival - b > doubt)


@parallel_kernel("points", least=_ROWS)
def nearest_cells(
    start: int, stop: int, points: F32, columns: F32, squares: F32, cells: I32
) -> None:
    """Find the nearest one or two centres of each point, the nearest first.

    If others are as near but for rounding, all distances are computed without vectors, so that the
    result is the same with and without them.

    points: (N, D); columns: (D, W) the centres, W a multiple of 16; squares: (W,) their squared
    lengths, infinite for columns without a centre; cells: (N, 1 or 2) out.
    """
    count, dimensions = columns.shape[1], points.shape[1]
    distances = np.empty(count, np.float32)
    kept = np.empty(cells.shape[1], np.float32)
    factors = np.empty((TOGETHER, dimensions), np.float32)
    lowest = np.empty((TOGETHER, LANES), np.float32)
    second = np.empty((TOGETHER, LANES), np.float32)
    tiles = np.empty((TOGETHER, LANES), np.int32)
    error = rounding(dimensions)
    for at in range(start, stop, TOGETHER):
        for j in range(TOGETHER):
            for d in range(dimensions):
                factors[j, d] = points[min(at + j, stop - 1), d] * -TWO
        closest(factors, columns, squares, count // LANES, lowest, second, tiles)
        for j in range(min(TOGETHER, stop - at)):
            i = at + j
            length = np.float32(0)
            for d in range(dimensions):
                length += points[i, d] * points[i, d]
            if not _take_clear(lowest[j], second[j], tiles[j], length, error, cells[i]):
                _distances(points[i], columns, squares, distances)
                _take_all(distances, kept, cells[i])


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

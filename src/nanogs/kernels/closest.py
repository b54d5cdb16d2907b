"""Nearest columns of a matrix, 4 points and 16 columns at a time; `simd/closest.py` has vectors."""

import numpy as np

from nanogs._types import F32, I32
from nanogs.kernels.policy import exact_inline, simd_or_plain

LANES = 16
TOGETHER = 4


@exact_inline
def rounding(dimensions: int) -> np.float32:
    """Bound the rounding error of a sum of `closest`, relative to the squares of both points."""
    return np.float32((dimensions + 8) * 2.0**-21)


@simd_or_plain
def closest(
    factors: F32, columns: F32, squares: F32, tiles: int, least: F32, second: F32, places: I32
) -> None:
    """Find the least and the second least square + factors . column in each lane of the columns.

    With factors -2 x and squares |c|² this is the squared distance from x to c, less |x|². Lane l,
    from 0 to 15, has the columns l, 16 + l, 32 + l and so on, one of each tile of 16 columns.

    Args:
        factors: (4, D), a row for each point, D a multiple of three.
        columns: (D, W), W a multiple of 16.
        squares: (W,) added to the products.
        tiles: Number of tiles to search, from 1 to W / 16.
        least: (4, 16) out, the least sums.
        second: (4, 16) out, the second least; infinite if there is only one tile.
        places: (4, 16) out, the tile of the least; 0 if all are infinite.
    """
    count = tiles * LANES
    sums = np.empty(count, np.float32)
    least[:] = np.inf
    second[:] = np.inf
    places[:] = 0
    for point in range(TOGETHER):
        for c in range(count):
            sums[c] = squares[c]
        for d in range(0, len(columns), 3):
            x, y, z = factors[point, d], factors[point, d + 1], factors[point, d + 2]
            for c in range(count):
                sums[c] += x * columns[d, c] + y * columns[d + 1, c] + z * columns[d + 2, c]
        for c in range(count):
            lane = c % LANES
            if sums[c] < least[point, lane]:
                second[point, lane] = least[point, lane]
                least[point, lane], places[point, lane] = sums[c], c // LANES
            elif sums[c] < second[point, lane]:
                second[point, lane] = sums[c]

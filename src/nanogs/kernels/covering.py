"""Kernel that counts the splats that cover each pixel (overdraw).

The columns of `geometry` are described in `nanogs.kernels.project`.
"""

import math

import numpy as np

from nanogs._types import F64, I32, I64
from nanogs.kernels.blocks import TILE
from nanogs.kernels.policy import exact_parallel_kernel
from nanogs.kernels.project import SLACK


@exact_parallel_kernel("starts", least=8)
def cover_tiles(
    start: int, stop: int, geometry: F64, starts: I64, entries: I32, counts: I32
) -> None:
    """Add to each pixel the number of splats with an alpha of 1/255 or more there, in any order.

    In a row of pixels, a splat covers those between the two points where the ellipse of alpha 1/255
    crosses the row.

    Args:
        start: First tile of the range.
        stop: The tile after its last.
        geometry: (N, 8) rows of projected splats.
        starts: (T + 1,) from `listing.list_tiles`.
        entries: (E,) from `listing.list_tiles`.
        counts: (H, W) in and out.
    """
    height, width = counts.shape
    tiles_x = (width + TILE - 1) // TILE
    steps = np.empty((TILE, TILE + 1), np.int32)  # the count of a pixel less that of its left one
    for tile in range(start, min(stop, len(starts) - 1)):
        x0, y0 = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        across, down = min(TILE, width - x0), min(TILE, height - y0)
        steps[:] = 0
        for e in range(starts[tile], starts[tile + 1]):
            row = geometry[entries[e]]
            u, v, sigma, slope, inv_yy = row[0] - x0, row[1] - y0, 1.0 / row[2], row[3], row[4]
            reach, rise = row[5] - SLACK, row[7]
            top, bottom = max(v - rise - 0.5, 0.0), min(v + rise - 0.5, down - 1.0)
            if not top <= bottom:  # tested before rounding, which fails for too large numbers
                continue
            for y in range(math.ceil(top), math.floor(bottom) + 1):
                dy = y + 0.5 - v
                rest = reach - dy * dy * inv_yy
                if not rest >= 0.0:
                    continue
                middle, half = u + slope * dy - 0.5, math.sqrt(rest) * sigma
                low, high = max(middle - half, 0.0), min(middle + half, across - 1.0)
                if low <= high:
                    first, end = math.ceil(low), math.floor(high) + 1
                    if first < end:
                        steps[y, first] += 1
                        steps[y, end] -= 1
        for y in range(down):
            count = 0
            for x in range(across):
                count += steps[y, x]
                counts[y0 + y, x0 + x] += count

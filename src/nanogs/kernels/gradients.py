"""Gradient and curvature for a splat from blocks of 4 x 4 pixels; see `backward.py`.

`simd/gradients.py` has the same in vectors.
"""

import numpy as np

from nanogs._types import F32
from nanogs.kernels.blocks import LANES, PIXELS_X, PIXELS_Y, UNIT, Single, shade_pixel
from nanogs.kernels.policy import inline, simd_or_plain

CHANNELS = 4
SATURATED = 98.9  # ratio of T alpha to the T that is left; above it, alpha is clamped to 0.99
GRADIENTS = [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)]  # powers of p and q, of gradients
CURVATURE_POWERS = [(a, b) for a in range(5) for b in range(5 - a)]  # of curvatures
SUMS = 4 + len(GRADIENTS) + len(CURVATURE_POWERS)
SCALES = np.array(
    [1.0] * 4 + [UNIT ** (a + b) for a, b in GRADIENTS + CURVATURE_POWERS], np.float32
)
_SATURATED, _ZERO = np.float32(SATURATED), np.float32(0.0)


@inline
def _add_moments(
    sums: F32, lane: int, gradient: Single, curvature: Single, p: Single, q: Single
) -> None:
    """Add gradient and curvature times powers of p and q to sums: (25, 16)."""
    sums[4, lane] += gradient
    sums[5, lane] += gradient * p
    sums[6, lane] += gradient * q
    sums[7, lane] += gradient * p * p
    sums[8, lane] += gradient * p * q
    sums[9, lane] += gradient * q * q
    at, column = 10, curvature
    for a in range(5):
        moment = column
        for _ in range(5 - a):
            sums[at, lane] += moment
            moment *= q
            at += 1
        column *= p


@inline
def _write_sums(sums: F32, partial: F32, e: int) -> None:
    """Reduce each row of (25, 16) to its sum, and write them, scaled, into row e of `partial`.

    The rows are overwritten.
    """
    for k in range(SUMS):
        width = LANES // 2
        while width > 0:
            for lane in range(width):
                sums[k, lane] = sums[k, 2 * lane] + sums[k, 2 * lane + 1]
            width //= 2
        partial[e, k] = sums[k, 0] * SCALES[k]


@simd_or_plain
def gradient_blocks(
    mark: int, j: int, shapes: F32, values: F32, transmittances: F32, behind: F32, residual: F32,
    curvature_weights: F32, partial: F32, e: int,
) -> None:  # fmt: skip
    """Sum gradient and curvature for a splat over the pixels of a tile.

    Args:
        mark: Bit mask of the blocks that the splat may reach.
        j: The splat's row in the batch.
        shapes: (BATCH, 8) see `blocks`.
        values: (BATCH, 4) the features that were blended.
        transmittances: (16, 16) transmittances of the tile's blocks, in and out.
        behind: (4, 16, 16) in, sum of the contributions of this splat and those behind it to the
            pixels; out, of those behind it alone.
        residual: (4, 16, 16) residuals of the pixels, times their weight in the sum of squares.
        curvature_weights: (16, 16) that weight, times the pixel's alpha.
        partial: (E, 25) out, in row e, see `backward.gradient_tiles`.
        e: The row.
    """
    sums, shades = np.zeros((SUMS, LANES), np.float32), np.empty((3, LANES), np.float32)
    for block in range(LANES):
        if int(mark) >> block & 1 == 0:
            continue
        for lane in range(LANES):
            x, y, light = PIXELS_X[block, lane], PIXELS_Y[block, lane], transmittances[block, lane]
            weight, transmittances[block, lane], p, q = shade_pixel(shapes, j, x, y, light)
            shades[0, lane], shades[1, lane], shades[2, lane] = weight, p, q
        for lane in range(LANES):
            weight, after = shades[0, lane], abs(transmittances[block, lane])
            inverse = np.float32(1.0) / after
            gradient, curvature, shared = _ZERO, _ZERO, weight * curvature_weights[block, lane]
            for c in range(CHANNELS):
                back = behind[c, block, lane] - weight * values[j, c]
                behind[c, block, lane] = back
                change = values[j, c] - back * inverse
                gradient += change * residual[c, block, lane]
                curvature += change * change
            for c in range(3):
                sums[c, lane] += weight * residual[c, block, lane]
            sums[3, lane] += shared
            if weight < _SATURATED * after:
                gradient, curvature = weight * gradient, shared * curvature
                _add_moments(sums, lane, gradient, curvature, shades[1, lane], shades[2, lane])
    _write_sums(sums, partial, e)

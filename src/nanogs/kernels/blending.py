"""Blend splats into a block of 4 x 4 pixels; see `blocks.py`, and `simd/blending.py`."""

import numpy as np

from nanogs._types import F32
from nanogs.kernels.blocks import BATCH, LANES, PIXELS_X, PIXELS_Y, Single, shade_pixel
from nanogs.kernels.policy import simd_or_plain


@simd_or_plain
def blend_block(
    mark: int, block: int, shapes: F32, values: F32, transmittances: F32, weights: F32, planes: F32
) -> None:
    """Blend splats into a block, in their order, and store their weights; see `shade_pixel`.

    Args:
        mark: Bit mask of the splats to blend.
        block: 0 to 15.
        shapes: (BATCH, 8) shapes of the splats.
        values: (BATCH, 3 or more) features; the first three are blended.
        transmittances: (16, 16) transmittances of the tile's blocks, in and out.
        weights: (BATCH, 16) out, weights T alpha of these splats.
        planes: (3 or more, 16, 16) sums for the tile's blocks, in and out.
    """
    for j in range(BATCH):
        if int(mark) >> j & 1 == 0:
            continue
        for lane in range(LANES):
            x, y, light = PIXELS_X[block, lane], PIXELS_Y[block, lane], transmittances[block, lane]
            weight, transmittances[block, lane], _, _ = shade_pixel(shapes, j, x, y, light)
            weights[j, lane] = weight
            for c in range(3):
                planes[c, block, lane] += values[j, c] * weight


@simd_or_plain
def add_block(mark: int, block: int, weights: F32, values: F32, c: int, planes: F32) -> None:
    """Blend one more feature, number `c`, into a block, with the weights from `blend_block`.

    mark: bit mask of the splats; weights: (BATCH, 16); values: (BATCH, more than c); planes:
    (more than c, 16, 16), in and out.
    """
    for j in range(BATCH):
        if int(mark) >> j & 1 == 1:
            for lane in range(LANES):
                planes[c, block, lane] += values[j, c] * weights[j, lane]


@simd_or_plain
def probe_block(mark: int, block: int, weights: F32, probes: F32, p: int, sums: F32) -> None:
    """Add each splat's weights in a block, times probe `p` of the pixels, to `sums`, by pixel.

    mark: bit mask of the splats; weights: (BATCH, 16); probes: (P, 16, 16); sums: (P, BATCH, 16),
    in and out.
    """
    for j in range(BATCH):
        if int(mark) >> j & 1 == 1:
            for lane in range(LANES):
                sums[p, j, lane] += weights[j, lane] * probes[p, block, lane]


@simd_or_plain
def total(sums: F32, p: int, j: int) -> Single:
    """Return the sum of row j of table p, which is overwritten; sums: (P, BATCH, 16)."""
    width = LANES // 2
    while width > 0:
        for lane in range(width):
            sums[p, j, lane] += sums[p, j, lane + width]
        width //= 2
    return np.float32(sums[p, j, 0])

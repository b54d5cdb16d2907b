"""Splats in the blocks of a tile, each of 4 x 4 pixels that are shaded together.

Blending loops over the blocks of a tile, and in each block over its splats, so that the
transmittances and colours of its pixels stay in registers. The 16 numbers of a block are
contiguous, row by row, and a tile has 4 x 4 blocks, row by row. See also `simd/blocks.py`.

With (x, y) from the middle of the tile to a pixel, the alpha of a splat there is exp(-16 s), where

    s = (start + across x + along y)² + (height + rise y)² + faint:

the exponent of `nanogs.kernels.project` over 16, because the exponential is computed as a 16th
power. These six coefficients are called the splat's shape in the tile.
"""

import math
from typing import TypeAlias

import numpy as np

from nanogs._types import F32, U32, Array
from nanogs.kernels.policy import inline, simd_or_plain

Single: TypeAlias = np.float32

TILE = 16  # pixels along each side of a tile
SIDE = 4  # pixels along each side of a block
LANES = SIDE * SIDE  # pixels of a block, and blocks of a tile
BATCH = 32  # splats that are processed together, each one bit of a mask
START, ACROSS, ALONG, HEIGHT, RISE, FAINT = range(6)
SHAPE = 8  # columns of a table of shapes; the last two are not used
_LINE = 16  # four-byte numbers in a line of the cache
ALL_BLOCKS = 0xFFFF  # bit mask of all blocks of a tile
FIELDS = (0xA5A5, 0x5A5A)  # bit masks of the two colours of a chessboard of blocks

MAX_ALPHA = 0.99
MIN_TRANSMITTANCE = 1e-4
UNIT = math.sqrt(32.0)  # ratio of p and q in `nanogs.kernels.backward` to the roots of the squares
FAINTEST = math.log(255.0) / 16.0  # the s of alpha 1/255
MARGIN = 1e-4  # added to the largest s when testing blocks, so that rounding never loses a pixel

# exp(-16 s) = P(s)^16 for s in [0, 3/8]: least squares with P(0) = 1, relative error below 2e-6.
POLYNOMIAL = (
    1.0,
    -0.999999749030319,
    0.4999909362769371,
    -0.1665583204458221,
    0.041092303836772995,
    -0.006918978553628526,
)

_PLACES = np.arange(LANES)
COLUMNS, ROWS = (_PLACES % SIDE).astype(np.float32), (_PLACES // SIDE).astype(np.float32)
MIDDLE = (TILE - 1) / 2  # from the first pixel of a tile to its middle


# The constants above as float32, because float64 constants would promote float32 arithmetic.
_HALF, _ZERO = np.float32((SIDE - 1) / 2), np.float32(0.0)
_FAINTEST, _REACHED = np.float32(FAINTEST), np.float32(FAINTEST + MARGIN)
_MAX_ALPHA, _MIN_TRANSMITTANCE = np.float32(MAX_ALPHA), np.float32(MIN_TRANSMITTANCE)
_C0, _C1, _C2, _C3, _C4, _C5 = (np.float32(coefficient) for coefficient in POLYNOMIAL)
_MIDDLES_X, _MIDDLES_Y = (SIDE * at + _HALF - np.float32(MIDDLE) for at in (COLUMNS, ROWS))
PIXELS_X: F32 = (SIDE * COLUMNS[:, None] + COLUMNS - MIDDLE).astype(np.float32)
PIXELS_Y: F32 = (SIDE * ROWS[:, None] + ROWS - MIDDLE).astype(np.float32)
"""(16, 16) float32: y offset of each pixel of each block from the middle of its tile."""


@simd_or_plain
def mark_blocks(shapes: F32, j: int, marks: U32) -> int:
    """Find the blocks that a splat may reach, and set bit j of their marks.

    The test is conservative: the least value of each square over the block is found separately, and
    their sum is never more than the least sum.

    Args:
        shapes: (BATCH, 8) shapes of the splats.
        j: The splat's row in the batch, 0 to 31.
        marks: (16,) bit mask of splats for each block, in and out.

    Returns:
        Bit mask of these blocks.
    """
    across, along, rise = shapes[j, ACROSS], shapes[j, ALONG], shapes[j, RISE]
    wide = abs(across) + abs(along)
    found = 0
    for block in range(LANES):
        x, y = _MIDDLES_X[block], _MIDDLES_Y[block]
        p = abs(shapes[j, START] + across * x + along * y) - _HALF * wide
        q = abs(shapes[j, HEIGHT] + rise * y) - _HALF * rise
        p = _ZERO if p < _ZERO else p  # noqa: FURB136 - keeps NaN, which reaches nothing
        q = _ZERO if q < _ZERO else q  # noqa: FURB136
        if shapes[j, FAINT] + p * p + q * q <= _REACHED:
            marks[block] |= np.uint32(1 << j)
            found |= 1 << block
    return found


@inline
def shade_pixel(
    shapes: F32, j: int, x: Single, y: Single, before: Single
) -> tuple[Single, Single, Single, Single]:
    """Compute the weight of splat j in a pixel, and the transmittance behind it.

    A pixel whose transmittance would fall below MIN_TRANSMITTANCE is full: it keeps the
    transmittance with a negative sign, which makes every later weight zero without a branch.

    Args:
        shapes: (BATCH, 8) shapes of the splats.
        j: The splat's row in the batch.
        x: Offset of the pixel from the middle of the tile to the right, pixels.
        y: The same downwards.
        before: The pixel's transmittance T.

    Returns:
        The weight T alpha, T behind the splat, and the roots of the two squares of s.
    """
    p = shapes[j, START] + shapes[j, ACROSS] * x + shapes[j, ALONG] * y
    q = shapes[j, HEIGHT] + shapes[j, RISE] * y
    s = shapes[j, FAINT] + p * p + q * q
    if not s <= _FAINTEST:
        return _ZERO, before if before >= _MIN_TRANSMITTANCE else -abs(before), p, q
    e = _C0 + s * (_C1 + s * (_C2 + s * (_C3 + s * (_C4 + s * _C5))))
    e *= e
    e *= e
    e *= e
    e *= e
    weight = before * min(e, _MAX_ALPHA)
    after = before - weight
    if after < _MIN_TRANSMITTANCE:
        return _ZERO, -abs(before), p, q
    return weight, after, p, q


@simd_or_plain
def open_blocks(transmittances: F32) -> int:
    """Return a bit mask of the blocks with a pixel that is not full; transmittances: (16, 16)."""
    found = 0
    for block in range(LANES):
        for lane in range(LANES):
            if transmittances[block, lane] > _ZERO:
                found |= 1 << block
    return found


@simd_or_plain
def prefetch(array: Array, row: int, column: int) -> None:
    """Prefetch 64 bytes of a row of a two-dimensional array, from a column on, into the cache.

    An array of three dimensions is treated as one of two, with the second one's number of columns.
    """


@inline
def prefetch_row(table: Array, row: int) -> None:
    """Prefetch a whole row of a two-dimensional array of four-byte numbers."""
    for column in range(0, table.shape[1], _LINE):
        prefetch(table, row, column)

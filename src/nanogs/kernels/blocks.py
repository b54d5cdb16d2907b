"""The blocks of 4 x 4 pixels of a tile, and splats in them, 16 at a time; also `simd/blocks.py`.

Blending takes the blocks of a tile one after the other, and in each its splats, so that the
transmittances and colours of its pixels stay in registers. The numbers of a block lie side by
side, row by row, and a tile has 4 x 4 blocks, row by row.

With (x, y) from the middle of the tile to a pixel, the alpha of a splat there is exp(-16 s), where

    s = (start + across x + along y)² + (height + rise y)² + faint:

the exponent of `nanogs.kernels.project` over 16, as this is how the exponential is taken. These
six numbers are the splat's shape in the tile.
"""

import math
from typing import TypeAlias

import numpy as np

from nanogs._types import F32, U32, Array
from nanogs.kernels.policy import inline, two_ways

Single: TypeAlias = np.float32

TILE = 16  # pixels along each side of a tile
SIDE = 4  # and of a block
LANES = SIDE * SIDE  # pixels of a block, and blocks of a tile
BATCH = 32  # splats that are looked at together, one bit of a number for each
START, ACROSS, ALONG, HEIGHT, RISE, FAINT = range(6)
SHAPE = 8
ALL_BLOCKS = 0xFFFF  # of a tile, as the bits of a number
FIELDS = (0xA5A5, 0x5A5A)  # one colour of a chessboard, and the other

MAX_ALPHA = 0.99
MIN_TRANSMITTANCE = 1e-4
UNIT = math.sqrt(32.0)  # p and q of `nanogs.kernels.project` over those whose squares make s
FAINTEST = math.log(255.0) / 16.0  # the s of alpha 1/255
MARGIN = 1e-4  # of s when blocks are told apart, so that rounding never loses a pixel

# exp(-16 s) = P(s)^16 for s in [0, 3/8]: least squares over P(0) = 1, relative error below 2e-6.
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
MIDDLE = (TILE - 1) / 2  # of a tile, from its first pixel


# The numbers above as they are taken beside float32, which nothing of float64 must widen.
_HALF, _ZERO = np.float32((SIDE - 1) / 2), np.float32(0.0)
_FAINTEST, _REACHED = np.float32(FAINTEST), np.float32(FAINTEST + MARGIN)
_MAX_ALPHA, _MIN_TRANSMITTANCE = np.float32(MAX_ALPHA), np.float32(MIN_TRANSMITTANCE)
_C0, _C1, _C2, _C3, _C4, _C5 = (np.float32(coefficient) for coefficient in POLYNOMIAL)
_MIDDLES_X, _MIDDLES_Y = (SIDE * at + _HALF - np.float32(MIDDLE) for at in (COLUMNS, ROWS))
PIXELS_X: F32 = (SIDE * COLUMNS[:, None] + COLUMNS - MIDDLE).astype(np.float32)
PIXELS_Y: F32 = (SIDE * ROWS[:, None] + ROWS - MIDDLE).astype(np.float32)
"""(16, 16) float32: from the middle of a tile to each pixel of each block."""


@two_ways
def mark_blocks(shapes: F32, j: int, marks: U32) -> int:
    """Set bit j of the mark of each block that the splat may reach.

    Whether it does is asked of the sum of the least squares over the block, each on its own: that
    is never more than the least sum.

    Args:
        shapes: (BATCH, 8) of the splats.
        j: The splat, 0 to 31.
        marks: (16,) of the blocks, in and out.

    Returns:
        A number whose bits are these blocks.
    """
    across, along, rise = shapes[j, ACROSS], shapes[j, ALONG], shapes[j, RISE]
    wide = abs(across) + abs(along)
    found = 0
    for block in range(LANES):
        x, y = _MIDDLES_X[block], _MIDDLES_Y[block]
        p = abs(shapes[j, START] + across * x + along * y) - _HALF * wide
        q = abs(shapes[j, HEIGHT] + rise * y) - _HALF * rise
        p = _ZERO if p < _ZERO else p  # noqa: FURB136 - NaN stays, and reaches nothing
        q = _ZERO if q < _ZERO else q  # noqa: FURB136
        if shapes[j, FAINT] + p * p + q * q <= _REACHED:
            marks[block] |= np.uint32(1 << j)
            found |= 1 << block
    return found


@inline
def shade_pixel(
    shapes: F32, j: int, x: Single, y: Single, before: Single
) -> tuple[Single, Single, Single, Single]:
    """Take the light of splat j from a pixel.

    A pixel that is full keeps its transmittance with a negative sign, which makes every later
    weight zero without a branch.

    Args:
        shapes: (BATCH, 8) of the splats.
        j: The splat.
        x: From the middle of the tile to the right, pixels.
        y: And downwards.
        before: The pixel's transmittance T.

    Returns:
        The weight T alpha, T after it, and the roots of the two squares of s.
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


@two_ways
def open_blocks(left: F32) -> int:
    """A number whose bits are the blocks with a pixel that still takes light; left: (16, 16)."""
    found = 0
    for block in range(LANES):
        for lane in range(LANES):
            if left[block, lane] > _ZERO:
                found |= 1 << block
    return found


@two_ways
def prefetch(array: Array, row: int) -> None:
    """Ask for the first 64 bytes of a row of a two-dimensional array; changes nothing.

    An array of three dimensions counts as one of two, of as many columns as its second one.
    """

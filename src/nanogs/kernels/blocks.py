"""The blocks of 4 x 4 pixels of a tile, and splats in them, 16 at a time; see `vectors.py`.

Blending takes the blocks of a tile one after the other, and in each its splats, so that the
transmittances and colours of its pixels stay in registers. The numbers of a block lie side by
side, row by row, and a tile has 4 x 4 blocks, row by row.

With (x, y) from the middle of the tile to a pixel, the alpha of a splat there is exp(-16 s), where

    s = (start + across x + along y)² + (height + rise y)² + faint:

the exponent of `nanogs.kernels.project` over 16, as this is how the exponential is taken. These
six numbers are the splat's shape in the tile.
"""
# ruff: noqa: ANN401, ARG001 - Numba asks for these signatures, and llvmlite has no types

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import types

from nanogs._types import F32, U32, Array
from nanogs.kernels import vectors as vec
from nanogs.kernels.vectors import compiled

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
    middle = np.float32((SIDE - 1) / 2)
    x, y = (SIDE * at + middle - np.float32(MIDDLE) for at in (COLUMNS, ROWS))
    start, across, along, height, rise, faint = shapes[j, :6]
    with np.errstate(over="ignore", invalid="ignore"):
        p = abs(start + across * x + along * y) - middle * (abs(across) + abs(along))
        q = abs(height + rise * y) - middle * rise
        s = np.maximum(p, 0) ** 2 + np.maximum(q, 0) ** 2 + faint
    reached = s <= np.float32(FAINTEST + MARGIN)
    marks[reached] |= np.uint32(1 << j)
    return sum(1 << int(block) for block in np.flatnonzero(reached))


def shade_block(shape: F32, block: int, left: F32) -> tuple[F32, F32, F32]:
    """Take the light of a splat from a block; only as Python.

    A pixel that is full keeps its transmittance with a negative sign, which makes every later
    weight zero without a branch.

    Args:
        shape: (8,)
        block: 0 to 15.
        left: (16, 16) transmittances T of the tile's blocks, in and out.

    Returns:
        (16,) weights T alpha, and the roots of the two squares of s.
    """
    single = np.float32
    x = single(block % SIDE * SIDE - MIDDLE) + COLUMNS
    y = single(block // SIDE * SIDE - MIDDLE) + ROWS
    start, across, along, height, rise, faint = shape[:6]
    with np.errstate(over="ignore", invalid="ignore"):
        p, q = start + across * x + along * y, height + rise * y
        s = p * p + q * q + faint
        e = np.full(LANES, POLYNOMIAL[-1], single)
        for coefficient in reversed(POLYNOMIAL[:-1]):
            e = single(coefficient) + s * e
        alpha = np.minimum(e**16, single(MAX_ALPHA))
    alpha[~(s <= single(FAINTEST))] = 0.0
    before = left[block].copy()
    after = before - before * alpha
    full = after < single(MIN_TRANSMITTANCE)
    left[block] = np.where(full, -abs(before), after)
    return np.where(full, single(0.0), before * alpha), p, q


def open_blocks(left: F32) -> int:
    """A number whose bits are the blocks with a pixel that still takes light; left: (16, 16)."""
    return sum(int((left[block] > 0).any()) << block for block in range(LANES))


def prefetch(array: Array, row: int) -> None:
    """Ask for the first 64 bytes of a row of a two-dimensional array; changes nothing."""


REALS, _WORDS = vec.reals(LANES), vec.words(LANES)


def pixels_of(builder: Any, block: Any) -> tuple[Any, Any]:
    """Where the pixels of a block are, from the middle of the tile; block: an int64."""
    size, real = vec.index(SIDE), ir.FloatType()
    columns, rows = (ir.Constant(REALS, (at - MIDDLE).tolist()) for at in (COLUMNS, ROWS))
    x = builder.sitofp(builder.mul(builder.urem(block, size), size), real)
    y = builder.sitofp(builder.mul(builder.udiv(block, size), size), real)
    x, y = vec.splat(builder, x, REALS), vec.splat(builder, y, REALS)
    return vec.add(builder, x, columns), vec.add(builder, y, rows)


def alpha_of(builder: Any, shape: list[Any], x: Any, y: Any) -> tuple[Any, Any, Any, Any]:
    """The alpha of a block's pixels, where it is 1/255 or more, and the roots of both squares."""
    start, across, along, height, rise, faint = shape
    p = vec.with_products(builder, start, (across, x), (along, y))
    q = vec.with_products(builder, height, (rise, y))
    s = vec.with_products(builder, faint, (p, p), (q, q))
    e = vec.fill(REALS, POLYNOMIAL[-1])
    for coefficient in reversed(POLYNOMIAL[:-1]):
        e = vec.add(builder, vec.fill(REALS, coefficient), vec.mul(builder, s, e))
    for _ in range(4):
        e = vec.mul(builder, e, e)
    alpha = vec.lesser(builder, e, vec.fill(REALS, MAX_ALPHA))
    return alpha, builder.fcmp_ordered("<=", s, vec.fill(REALS, FAINTEST)), p, q


def light_through(builder: Any, alpha: Any, seen: Any, before: Any) -> tuple[Any, Any]:
    """Weights T alpha, and the transmittances after."""
    zero = vec.fill(REALS, 0.0)
    weight = builder.select(seen, vec.mul(builder, before, alpha), zero)
    after = vec.sub(builder, before, weight)
    full = builder.fcmp_ordered("<", after, vec.fill(REALS, MIN_TRANSMITTANCE))
    sign = builder.or_(builder.bitcast(before, _WORDS), vec.fill(_WORDS, 0x80000000))
    after = builder.select(full, builder.bitcast(sign, REALS), after)
    return builder.select(full, zero, weight), after


@compiled(mark_blocks)
def _mark_blocks(typing: Any, shapes: Any, j: Any, marks: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        table = vec.Table(context, builder, shapes, args[0], REALS)
        start, across, along, height, rise, faint = (
            table.spread(args[1], vec.index(k)) for k in range(6)
        )
        middle = (SIDE - 1) / 2
        x, y = (
            ir.Constant(REALS, (SIDE * at + middle - MIDDLE).tolist()) for at in (COLUMNS, ROWS)
        )
        half, zero = vec.fill(REALS, middle), vec.fill(REALS, 0.0)
        wide = vec.add(builder, vec.magnitude(builder, across), vec.magnitude(builder, along))
        p = vec.magnitude(builder, vec.with_products(builder, start, (across, x), (along, y)))
        q = vec.magnitude(builder, vec.with_products(builder, height, (rise, y)))
        p = vec.greater(builder, zero, vec.sub(builder, p, vec.mul(builder, half, wide)))
        q = vec.greater(builder, zero, vec.sub(builder, q, vec.mul(builder, half, rise)))
        s = vec.with_products(builder, faint, (p, p), (q, q))
        reached = builder.fcmp_ordered("<=", s, vec.fill(REALS, FAINTEST + MARGIN))
        bit = builder.shl(ir.Constant(vec.WORD, 1), builder.trunc(args[1], vec.WORD))
        bit = builder.select(reached, vec.splat(builder, bit, _WORDS), vec.fill(_WORDS, 0))
        before = vec.read(context, builder, marks, args[2], vec.index(0), _WORDS)
        vec.write(context, builder, marks, args[2], vec.index(0), builder.or_(before, bit))
        return vec.bits(builder, reached)

    return types.int64(shapes, types.int64, marks), generate


@compiled(open_blocks)
def _open_blocks(typing: Any, left: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        light = vec.Table(context, builder, left, args[0], REALS)
        found = vec.index(0)
        for block in range(LANES):
            mask = builder.fcmp_ordered(">", light.load(vec.index(block)), vec.fill(REALS, 0.0))
            some = builder.icmp_unsigned("!=", vec.bits(builder, mask), vec.index(0))
            bit = builder.shl(builder.zext(some, vec.INDEX), vec.index(block))
            found = builder.or_(found, bit)
        return found

    return types.int64(left), generate


@compiled(prefetch)
def _prefetch(typing: Any, array: Any, row: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        table = context.make_array(array)(context, builder, args[0])
        offset = builder.mul(args[1], builder.extract_value(table.shape, 1))
        byte, word = ir.IntType(8).as_pointer(), ir.IntType(32)
        where = builder.bitcast(builder.gep(table.data, [offset]), byte)
        kind = ir.FunctionType(ir.VoidType(), [byte, word, word, word])
        function = vec.declared(builder, "llvm.prefetch.p0i8", kind)
        to_read, near, data = (ir.Constant(word, value) for value in (0, 3, 1))
        builder.call(function, [where, to_read, near, data])
        return context.get_dummy_value()

    return types.void(array, types.int64), generate

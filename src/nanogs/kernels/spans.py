"""Which pixels of a tile a splat reaches, 8 rows at a time; see `vectors.py`."""
# ruff: noqa: ANN401, ARG001 - Numba asks for these signatures, and llvmlite has no types

from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import types

from nanogs._types import F32, I32, U8, U32, Array
from nanogs.kernels import vectors as vec
from nanogs.kernels.vectors import compiled

PIXELS = 8
TILE = 16  # pixels along each side of a tile
ROWS = TILE + 1  # of what is held of a tile: the last takes what must not change a pixel
SPLAT = 32  # places for the rows of a splat
BATCH = 16  # splats whose rows have places
SECOND = SPLAT * BATCH  # added to a row's place, for its second run of pixels

# For each set of 8 rows, one bit a row: the rows that are in it, then anything.
ROWS_OF = np.array(
    [(*(r for r in range(8) if bits >> r & 1), *range(8))[:8] for bits in range(256)]
)
ROWS_OF = ROWS_OF.astype(np.uint8)


def span_rows(
    u: float, v: float, inv_w: float, slope: float, inv_yy: float, reach: float, first: int,
    open_rows: I32, bases: F32, squares: F32, starts: I32, at: int, pieces: U32, n: int,
    rows_of: U8,
) -> int:  # fmt: skip
    """List the runs of 8 pixels that a splat reaches in 8 rows of a tile, from row `first` on.

    Args:
        u: Centre, in pixels right of the tile's first.
        v: And below it.
        inv_w: Of the splat, with the next three, see `nanogs.kernels.project`.
        slope: See there.
        inv_yy: See there.
        reach: See there.
        first: The first of the rows, 0 to 8.
        open_rows: (16,) 0 where a row takes no more light.
        bases: The p of each row's first pixel is written from flat place `at` on.
        squares: The q² of each row, likewise.
        starts: Likewise, where 8 pixels of each row begin that hold all it reaches; 0 if it reaches
            further, and then there is a second run from pixel 8 on.
        at: The place.
        pieces: From place n on are written the places of the rows that it reaches, and then, plus
            `SECOND`, of those with a second run; after them anything.
        n: How many there were.
        rows_of: `ROWS_OF`.

    Returns:
        How many there are now.

    The caller sets, once, what is never written here: `starts` from SECOND on to PIXELS, and the
    numbers of the spare row, 16, of each splat to a start of 0 and a square that gives no light.
    """
    dy = first + np.arange(PIXELS) - v
    q = dy * dy * inv_yy
    centre = u + slope * dy
    half = np.sqrt(np.maximum(reach - q, 0.0)) / inv_w
    low = np.ceil(np.clip(centre - half, 0.0, TILE).astype(np.float32)).astype(np.int32)
    high = np.floor(np.clip(centre + half, -1.0, TILE - 1.0).astype(np.float32)).astype(np.int32)
    wide = high - low >= PIXELS
    reached = (reach - q >= 0.0) & (high >= low) & (open_rows[first : first + PIXELS] != 0)
    bases.reshape(-1)[at : at + PIXELS] = -inv_w * centre
    squares.reshape(-1)[at : at + PIXELS] = q
    starts[at : at + PIXELS] = np.where(wide, 0, np.minimum(low, PIXELS))
    for rows, second in ((reached, 0), (reached & wide, SECOND)):
        bits = np.packbits(rows, bitorder="little")[0]
        pieces[n : n + PIXELS] = at + second + rows_of[bits].astype(np.int32)
        n += int(np.count_nonzero(rows))
    return n


def any_open(left: F32, open_rows: I32) -> int:
    """Above 0 where a pixel of the tile still takes light; open_rows: (16,) out, the same of each.

    left: (16, 16) or more rows, transmittances, those of full pixels not above 0.
    """
    open_rows[:] = (left[:TILE] > 0).any(axis=1)
    return int(open_rows.any())


def prefetch(array: Array, row: int) -> None:
    """Ask for the first 64 bytes of a row of a two-dimensional array; changes nothing."""


_REALS, _WORDS, _DOUBLES = vec.reals(PIXELS), vec.words(PIXELS), vec.doubles(PIXELS)


def _reach(builder: Any, u: Any, v: Any, shape: Any, first: Any) -> Any:
    """q², the centre and the half width of a splat in 8 rows, and in which it has a width."""
    inv_w, slope, inv_yy, reach = shape
    start = vec.splat(builder, builder.sitofp(first, ir.DoubleType()), _DOUBLES)
    dy = vec.sub(builder, vec.add(builder, start, vec.counting(_DOUBLES)), v)
    q = vec.mul(builder, vec.mul(builder, dy, dy), inv_yy)
    centre = vec.add(builder, u, vec.mul(builder, slope, dy))
    rest, zero = vec.sub(builder, reach, q), vec.fill(_DOUBLES, 0.0)
    inside = builder.fcmp_ordered(">=", rest, zero)
    root = builder.fptrunc(builder.select(inside, rest, zero), _REALS)
    root = vec.call(builder, "sqrt", root)  # half the digits will do: bounds have slack
    half = vec.div(builder, root, builder.fptrunc(inv_w, _REALS))
    return q, centre, builder.fpext(half, _DOUBLES), inside


def _columns(builder: Any, centre: Any, half: Any) -> tuple[Any, Any]:
    """The first and the last pixel within reach in each row, 16 and -1 at most and at least."""

    def held(value: Any, low: float, high: float) -> Any:
        value = vec.greater(builder, value, vec.fill(_DOUBLES, low))
        value = vec.lesser(builder, value, vec.fill(_DOUBLES, high))
        return builder.fptrunc(value, _REALS)

    low = vec.call(builder, "ceil", held(vec.sub(builder, centre, half), 0.0, TILE))
    high = vec.call(builder, "floor", held(vec.add(builder, centre, half), -1.0, TILE - 1.0))
    return builder.fptosi(low, _WORDS), builder.fptosi(high, _WORDS)


@compiled(span_rows)
def _span_rows(
    typing: Any, u: Any, v: Any, inv_w: Any, slope: Any, inv_yy: Any, reach: Any, first: Any,
    open_rows: Any, bases: Any, squares: Any, starts: Any, at: Any, pieces: Any, n: Any,
    rows_of: Any,
) -> Any:  # fmt: skip
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        u, v, *shape = (vec.splat(builder, arg, _DOUBLES) for arg in args[:6])
        at, n = args[11], args[13]
        q, centre, half, inside = _reach(builder, u, v, shape, args[6])
        low, high = _columns(builder, centre, half)
        width, zero = vec.fill(_WORDS, PIXELS), vec.fill(_WORDS, 0)
        wide = builder.icmp_signed(">=", builder.sub(high, low), width)
        light = vec.read(context, builder, open_rows, args[7], args[6], _WORDS)
        reached = builder.and_(inside, builder.icmp_signed("<=", low, high))
        reached = builder.and_(reached, builder.icmp_signed("!=", light, zero))
        base = vec.mul(builder, vec.sub(builder, vec.fill(_DOUBLES, 0.0), shape[0]), centre)
        vec.write(context, builder, bases, args[8], at, builder.fptrunc(base, _REALS))
        vec.write(context, builder, squares, args[9], at, builder.fptrunc(q, _REALS))
        low = builder.select(builder.icmp_signed("<", low, width), low, width)
        vec.write(context, builder, starts, args[10], at, builder.select(wide, zero, low))
        for mask, second in ((reached, 0), (builder.and_(reached, wide), SECOND)):
            bits = vec.bits(builder, mask)
            row = builder.mul(bits, vec.index(PIXELS))
            kind = ir.VectorType(ir.IntType(8), PIXELS)
            listed = vec.read(context, builder, rows_of, args[14], row, kind)
            offset = builder.trunc(builder.add(at, vec.index(second)), ir.IntType(32))
            listed = builder.add(builder.zext(listed, _WORDS), vec.splat(builder, offset, _WORDS))
            vec.write(context, builder, pieces, args[12], n, listed)
            n = builder.add(n, builder.ctpop(bits))
        return n

    real, place = types.float64, types.int64
    signature = types.int64(
        real, real, real, real, real, real, place, open_rows, bases, squares, starts, place,
        pieces, place, rows_of,
    )  # fmt: skip
    return signature, generate


@compiled(any_open)
def _any_open(typing: Any, left: Any, open_rows: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        out = context.make_array(open_rows)(context, builder, args[1]).data
        kind, every = vec.reals(TILE), vec.index(0)
        for row in range(TILE):
            light = vec.read(context, builder, left, args[0], vec.index(row * TILE), kind)
            bits = vec.bits(builder, builder.fcmp_ordered(">", light, vec.fill(kind, 0.0)))
            every = builder.or_(every, bits)
            place = builder.gep(out, [vec.index(row)])
            builder.store(builder.trunc(bits, ir.IntType(32)), place)
        return every

    return types.int64(left, open_rows), generate


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

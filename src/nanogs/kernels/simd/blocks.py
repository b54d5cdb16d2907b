"""Vector versions of functions of `nanogs.kernels.blocks`, which documents them."""
# ruff: noqa: ANN401, ARG001, D103 - Numba asks for these signatures, and llvmlite has no types

from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from nanogs.kernels.blocks import (
    COLUMNS,
    FAINTEST,
    LANES,
    MARGIN,
    MAX_ALPHA,
    MIDDLE,
    MIN_TRANSMITTANCE,
    POLYNOMIAL,
    ROWS,
    SIDE,
)
from nanogs.kernels.simd import vectors as vec

REALS, _WORDS = vec.reals(LANES), vec.words(LANES)


def pixels_of(builder: Any, block: Any) -> tuple[Any, Any]:
    """Return the offsets of a block's pixels from the middle of the tile; block: an int64."""
    size, real = vec.index(SIDE), ir.FloatType()
    columns, rows = (ir.Constant(REALS, (at - MIDDLE).tolist()) for at in (COLUMNS, ROWS))
    x = builder.sitofp(builder.mul(builder.urem(block, size), size), real)
    y = builder.sitofp(builder.mul(builder.udiv(block, size), size), real)
    x, y = vec.splat(builder, x, REALS), vec.splat(builder, y, REALS)
    return vec.add(builder, x, columns), vec.add(builder, y, rows)


def alpha_of(builder: Any, shape: list[Any], x: Any, y: Any) -> tuple[Any, Any, Any, Any]:
    """Return alpha of a block's pixels, a mask of 1/255 or more, and the roots of both squares."""
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
    """Return the weights T alpha, and the transmittances behind the splat."""
    zero = vec.fill(REALS, 0.0)
    weight = builder.select(seen, vec.mul(builder, before, alpha), zero)
    after = vec.sub(builder, before, weight)
    full = builder.fcmp_ordered("<", after, vec.fill(REALS, MIN_TRANSMITTANCE))
    sign = builder.or_(builder.bitcast(before, _WORDS), vec.fill(_WORDS, 0x80000000))
    after = builder.select(full, builder.bitcast(sign, REALS), after)
    return builder.select(full, zero, weight), after


@intrinsic
def mark_blocks(typing: Any, shapes: Any, j: Any, marks: Any) -> Any:
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


@intrinsic
def open_blocks(typing: Any, transmittances: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        light = vec.Table(context, builder, transmittances, args[0], REALS)
        found = vec.index(0)
        for block in range(LANES):
            mask = builder.fcmp_ordered(">", light.load(vec.index(block)), vec.fill(REALS, 0.0))
            some = builder.icmp_unsigned("!=", vec.bits(builder, mask), vec.index(0))
            bit = builder.shl(builder.zext(some, vec.INDEX), vec.index(block))
            found = builder.or_(found, bit)
        return found

    return types.int64(transmittances), generate


@intrinsic
def prefetch(typing: Any, array: Any, row: Any, column: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        table = context.make_array(array)(context, builder, args[0])
        offset = builder.mul(args[1], builder.extract_value(table.shape, 1))
        offset = builder.add(offset, args[2])
        byte, word = ir.IntType(8).as_pointer(), ir.IntType(32)
        where = builder.bitcast(builder.gep(table.data, [offset]), byte)
        kind = ir.FunctionType(ir.VoidType(), [byte, word, word, word])
        function = vec.declared(builder, "llvm.prefetch.p0i8", kind)
        to_read, near, data = (ir.Constant(word, value) for value in (0, 3, 1))
        builder.call(function, [where, to_read, near, data])
        return context.get_dummy_value()

    return types.void(array, types.int64, types.int64), generate

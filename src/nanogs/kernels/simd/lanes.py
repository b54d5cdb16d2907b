"""Vector versions of the functions of `nanogs.kernels.lanes`, which documents them."""
# ruff: noqa: ANN401, ARG001, D103 - Numba asks for these signatures, and llvmlite has no types

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from nanogs.kernels.lanes import LANES
from nanogs.kernels.simd import vectors as vec

_KEYS = vec.words(LANES)
_REALS = vec.doubles(LANES)
_BITS = ir.VectorType(vec.INDEX, LANES)


def _lesser(builder: Any, a: Any, b: Any) -> Any:
    return builder.select(builder.icmp_signed("<", a, b), a, b)


def _greater(builder: Any, a: Any, b: Any) -> Any:
    return builder.select(builder.icmp_signed(">", a, b), a, b)


def _keys_of(builder: Any, x: Any, y: Any, z: Any) -> Any:
    """Return keys of x x + y y + z z, computed exactly in this order."""
    total = builder.fadd(builder.fmul(x, x), builder.fmul(y, y))
    total = builder.fadd(total, builder.fmul(z, z))
    return builder.trunc(builder.lshr(builder.bitcast(total, _BITS), vec.fill(_BITS, 32)), _KEYS)


@intrinsic
def distance_keys(typing: Any, points: Any, x: Any, y: Any, z: Any, keys: Any, at: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        offsets = []
        for axis in range(3):
            c = vec.read(context, builder, points, args[0], vec.index(axis * LANES), _REALS)
            offsets.append(builder.fsub(c, vec.splat(builder, args[1 + axis], _REALS)))
        vec.write(context, builder, keys, args[4], args[5], _keys_of(builder, *offsets))
        return context.get_dummy_value()

    return types.void(points, x, y, z, keys, types.int64), generate


@intrinsic
def box_keys(typing: Any, points: Any, boxes: Any, node: Any, keys: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        offsets, zero = [], vec.fill(_REALS, 0.0)
        for axis in range(3):
            c = vec.read(context, builder, points, args[0], vec.index(axis * LANES), _REALS)
            low, high = (
                vec.item(context, builder, boxes, args[1], args[2], vec.index(side + axis))
                for side in (0, 3)
            )
            below = builder.fsub(vec.splat(builder, low, _REALS), c)
            above = builder.fsub(c, vec.splat(builder, high, _REALS))
            offsets.append(vec.greater(builder, vec.greater(builder, below, above), zero))
        vec.write(context, builder, keys, args[3], vec.index(0), _keys_of(builder, *offsets))
        return context.get_dummy_value()

    return types.void(points, boxes, types.int64, keys), generate


@intrinsic
def within(typing: Any, keys: Any, at: Any, bounds: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        key = vec.read(context, builder, keys, args[0], args[1], _KEYS)
        bound = vec.read(context, builder, bounds, args[2], vec.index(0), _KEYS)
        return vec.bits(builder, builder.icmp_signed("<=", key, bound))

    return types.int64(keys, types.int64, bounds), generate


@intrinsic
def lowest_bit(typing: Any, mask: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.int64), generate


@intrinsic
def insert(typing: Any, lists: Any, keys: Any, at: Any, k: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        key = vec.read(context, builder, keys, args[1], args[2], _KEYS)
        last = builder.mul(builder.sub(args[3], vec.index(1)), vec.index(LANES))

        def row(offset: Any) -> Any:
            return vec.read(context, builder, lists, args[0], offset, _KEYS)

        def store(offset: Any, value: Any) -> None:
            vec.write(context, builder, lists, args[0], offset, value)

        with cgutils.for_range_slice(
            builder, vec.index(0), last, vec.index(LANES), intp=vec.INDEX
        ) as (offset, _):
            after = _greater(builder, row(builder.add(offset, vec.index(LANES))), key)
            store(offset, _lesser(builder, row(offset), after))
        store(last, _lesser(builder, row(last), key))
        return context.get_dummy_value()

    return types.void(lists, keys, types.int64, types.int64), generate

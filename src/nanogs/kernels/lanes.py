"""Vector instructions across 16 lanes, which Numba's loops do not reach.

Numba runs LLVM without the vectoriser of straight-line code, and its loops over 16 elements are
unrolled before the loop vectoriser sees them. So each operation here is written twice: as plain
Python, which says what it does and runs with `NUMBA_DISABLE_JIT=1`, and as LLVM's vector type of
16 elements, which is portable: the compiler cuts it into the registers that the machine has.

A key is the upper half of the bits of a float64 that is not negative. Keys sort like the numbers.
"""
# ruff: noqa: ANN401, ARG001 - Numba asks for these signatures, and llvmlite has no types

from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic, overload

from nanogs._types import F64, I32

LANES = 16
_INT = ir.IntType(64)
_KEYS = ir.VectorType(ir.IntType(32), LANES)
_REALS = ir.VectorType(ir.DoubleType(), LANES)
_BITS = ir.VectorType(_INT, LANES)


# The typing context, first in each signature, is not for the caller: mypy cannot know.
_vector: Any = intrinsic


def distance_keys(points: F64, x: float, y: float, z: float, keys: I32, at: int) -> None:
    """Keys of the squared distances of 16 points and one.

    points: (48,) 16 x, 16 y, 16 z; keys: filled from place `at`.
    """
    dx, dy, dz = points[:16] - x, points[16:32] - y, points[32:48] - z
    keys[at : at + LANES] = (dx * dx + dy * dy + dz * dz).view(np.int64) >> 32


def box_keys(points: F64, boxes: F64, node: int, keys: I32) -> None:
    """Keys of the squared distances of 16 points and a box. points: (48,); keys: (16,) or more."""
    low, high = boxes[node, :3, None], boxes[node, 3:, None]
    c = points.reshape(3, LANES)
    dx, dy, dz = np.maximum(np.maximum(low - c, c - high), 0.0)
    keys[:LANES] = (dx * dx + dy * dy + dz * dz).view(np.int64) >> 32


def within(keys: I32, at: int, bounds: I32) -> int:
    """Bit l is set where keys[at + l] <= bounds[l], l from 0 to 15."""
    return sum(int(keys[at + lane] <= bounds[lane]) << lane for lane in range(LANES))


def lowest_bit(mask: int) -> int:
    """Place of the lowest bit set, of one at least."""
    return (int(mask) & -int(mask)).bit_length() - 1


def insert(lists: I32, keys: I32, at: int, k: int) -> None:
    """Put keys[at + l] into list l, which loses its largest, for the 16 lists.

    lists: (16 k,), list l in places l, 16 + l, ..., descending.
    """
    key = keys[at : at + LANES]
    table = lists.reshape(k, LANES)
    table[:-1] = np.minimum(table[:-1], np.maximum(table[1:], key))
    table[-1] = np.minimum(table[-1], key)


def _place(context: Any, builder: Any, array_type: Any, array: Any, offset: Any, kind: Any) -> Any:
    """Pointer to a vector that starts at a flat offset of a contiguous array."""
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [offset]), kind.as_pointer())


def _constant(value: int) -> Any:
    return ir.Constant(_INT, value)


def _load(context: Any, builder: Any, array_type: Any, array: Any, offset: Any, kind: Any) -> Any:
    place = _place(context, builder, array_type, array, offset, kind)
    return builder.load(place, align=kind.element.get_abi_size(context.target_data))


def _store_keys(
    context: Any, builder: Any, array_type: Any, array: Any, at: Any, keys: Any
) -> None:
    builder.store(keys, _place(context, builder, array_type, array, at, _KEYS), align=4)


def _splat(builder: Any, value: Any, kind: Any) -> Any:
    """The same value in every lane."""
    empty = ir.Constant(kind, ir.Undefined)
    first = builder.insert_element(empty, value, ir.Constant(ir.IntType(32), 0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    return builder.shuffle_vector(first, empty, zeros)


def _lesser(builder: Any, a: Any, b: Any) -> Any:
    return builder.select(builder.icmp_signed("<", a, b), a, b)


def _greater(builder: Any, a: Any, b: Any) -> Any:
    return builder.select(builder.icmp_signed(">", a, b), a, b)


def _keys_of(builder: Any, x: Any, y: Any, z: Any) -> Any:
    """Keys of x x + y y + z z."""
    total = builder.fadd(builder.fmul(x, x), builder.fmul(y, y))
    total = builder.fadd(total, builder.fmul(z, z))
    shift = ir.Constant(_BITS, [32] * LANES)
    return builder.trunc(builder.lshr(builder.bitcast(total, _BITS), shift), _KEYS)


@_vector
def _distance_keys(typing: Any, points: Any, x: Any, y: Any, z: Any, keys: Any, at: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        offsets = []
        for axis in range(3):
            c = _load(context, builder, points, args[0], _constant(axis * LANES), _REALS)
            offsets.append(builder.fsub(c, _splat(builder, args[1 + axis], _REALS)))
        _store_keys(context, builder, keys, args[4], args[5], _keys_of(builder, *offsets))
        return context.get_dummy_value()

    return types.void(points, x, y, z, keys, types.int64), generate


@_vector
def _box_keys(typing: Any, points: Any, boxes: Any, node: Any, keys: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(boxes)(context, builder, args[1]).data
        start = builder.mul(args[2], _constant(6))
        offsets = []
        zero = ir.Constant(_REALS, [0.0] * LANES)
        for axis in range(3):
            c = _load(context, builder, points, args[0], _constant(axis * LANES), _REALS)
            low, high = (
                _splat(
                    builder,
                    builder.load(builder.gep(data, [builder.add(start, _constant(place))])),
                    _REALS,
                )
                for place in (axis, 3 + axis)
            )
            below, above = builder.fsub(low, c), builder.fsub(c, high)
            gap = builder.select(builder.fcmp_ordered(">", below, above), below, above)
            offsets.append(builder.select(builder.fcmp_ordered(">", gap, zero), gap, zero))
        _store_keys(context, builder, keys, args[3], _constant(0), _keys_of(builder, *offsets))
        return context.get_dummy_value()

    return types.void(points, boxes, types.int64, keys), generate


@_vector
def _within(typing: Any, keys: Any, at: Any, bounds: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        key = _load(context, builder, keys, args[0], args[1], _KEYS)
        bound = _load(context, builder, bounds, args[2], _constant(0), _KEYS)
        mask = builder.icmp_signed("<=", key, bound)
        return builder.zext(builder.bitcast(mask, ir.IntType(LANES)), _INT)

    return types.int64(keys, types.int64, bounds), generate


@_vector
def _lowest_bit(typing: Any, mask: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.int64), generate


@_vector
def _insert(typing: Any, lists: Any, keys: Any, at: Any, k: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        key = _load(context, builder, keys, args[1], args[2], _KEYS)
        last = builder.mul(builder.sub(args[3], _constant(1)), _constant(LANES))

        def row(offset: Any) -> Any:
            return _load(context, builder, lists, args[0], offset, _KEYS)

        with cgutils.for_range_slice(builder, _constant(0), last, _constant(LANES), intp=_INT) as (
            offset,
            _,
        ):
            after = _greater(builder, row(builder.add(offset, _constant(LANES))), key)
            _store_keys(
                context, builder, lists, args[0], offset, _lesser(builder, row(offset), after)
            )
        _store_keys(context, builder, lists, args[0], last, _lesser(builder, row(last), key))
        return context.get_dummy_value()

    return types.void(lists, keys, types.int64, types.int64), generate


@overload(distance_keys)
def _compiled_distance_keys(points: Any, x: Any, y: Any, z: Any, keys: Any, at: Any) -> Any:
    def body(points: Any, x: Any, y: Any, z: Any, keys: Any, at: Any) -> None:
        _distance_keys(points, x, y, z, keys, at)

    return body


@overload(box_keys)
def _compiled_box_keys(points: Any, boxes: Any, node: Any, keys: Any) -> Any:
    def body(points: Any, boxes: Any, node: Any, keys: Any) -> None:
        _box_keys(points, boxes, node, keys)

    return body


@overload(within)
def _compiled_within(keys: Any, at: Any, bounds: Any) -> Any:
    def body(keys: Any, at: Any, bounds: Any) -> Any:
        return _within(keys, at, bounds)

    return body


@overload(lowest_bit)
def _compiled_lowest_bit(mask: Any) -> Any:
    def body(mask: Any) -> Any:
        return _lowest_bit(mask)

    return body


@overload(insert)
def _compiled_insert(lists: Any, keys: Any, at: Any, k: Any) -> Any:
    def body(lists: Any, keys: Any, at: Any, k: Any) -> None:
        _insert(lists, keys, at, k)

    return body

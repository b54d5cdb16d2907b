"""Helpers for LLVM's vector types, which the compiler splits into the machine's registers."""
# ruff: noqa: ANN401 - llvmlite has no types

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils

from nanogs.kernels.policy import FASTMATH

INDEX, WORD = ir.IntType(64), ir.IntType(32)
FAST = sorted(FASTMATH)  # a list, because llvmlite takes no set


def reals(count: int) -> Any:
    """Return the type of a vector of float32."""
    return ir.VectorType(ir.FloatType(), count)


def doubles(count: int) -> Any:
    """Return the type of a vector of float64."""
    return ir.VectorType(ir.DoubleType(), count)


def words(count: int) -> Any:
    """Return the type of a vector of int32."""
    return ir.VectorType(WORD, count)


def index(value: int) -> Any:
    """Return an int64 constant."""
    return ir.Constant(INDEX, value)


def fill(kind: Any, value: float) -> Any:
    """Return a vector that repeats a constant."""
    if kind.element == ir.FloatType():
        value = float(np.float32(value))
    return ir.Constant(kind, [value] * kind.count)


def splat(builder: Any, value: Any, kind: Any) -> Any:
    """Return a vector that repeats a value."""
    empty = ir.Constant(kind, ir.Undefined)
    first = builder.insert_element(empty, value, ir.Constant(WORD, 0))
    return builder.shuffle_vector(first, empty, fill(words(kind.count), 0))


def shuffled(builder: Any, a: Any, b: Any, lanes: range) -> Any:
    """Return a vector of the given lanes of two vectors, which are numbered through."""
    return builder.shuffle_vector(a, b, ir.Constant(words(len(lanes)), list(lanes)))


def place(context: Any, builder: Any, kind: Any, array: Any, at: Any, vector: Any) -> Any:
    """Return a pointer to a vector at a flat index of a contiguous array of Numba type `kind`."""
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [at]), vector.as_pointer())


def read(context: Any, builder: Any, kind: Any, array: Any, at: Any, vector: Any) -> Any:
    """Load the vector at a flat index of an array; see `place`."""
    where = place(context, builder, kind, array, at, vector)
    return builder.load(where, align=vector.element.get_abi_size(context.target_data))


def write(context: Any, builder: Any, kind: Any, array: Any, at: Any, value: Any) -> None:
    """Store a vector at a flat index of an array; see `place`."""
    where = place(context, builder, kind, array, at, value.type)
    builder.store(value, where, align=value.type.element.get_abi_size(context.target_data))


def item(context: Any, builder: Any, kind: Any, array: Any, *at: Any) -> Any:
    """Load a number of a contiguous array of one or two axes."""
    table = context.make_array(kind)(context, builder, array)
    offset = at[0]
    if len(at) > 1:
        offset = builder.add(builder.mul(offset, builder.extract_value(table.shape, 1)), at[1])
    return builder.load(builder.gep(table.data, [offset]))


def add(builder: Any, a: Any, b: Any) -> Any:
    """Return a + b, with the fast-math flags of the kernels, as in all arithmetic here."""
    return builder.fadd(a, b, flags=FAST)


def sub(builder: Any, a: Any, b: Any) -> Any:
    """Return a - b."""
    return builder.fsub(a, b, flags=FAST)


def mul(builder: Any, a: Any, b: Any) -> Any:
    """Return a b."""
    return builder.fmul(a, b, flags=FAST)


def div(builder: Any, a: Any, b: Any) -> Any:
    """Return a / b."""
    return builder.fdiv(a, b, flags=FAST)


def lesser(builder: Any, a: Any, b: Any) -> Any:
    """Return the lanewise minimum; b's lane if either is NaN."""
    return builder.select(builder.fcmp_ordered("<", a, b), a, b)


def greater(builder: Any, a: Any, b: Any) -> Any:
    """Return the lanewise maximum; b's lane if either is NaN."""
    return builder.select(builder.fcmp_ordered(">", a, b), a, b)


def magnitude(builder: Any, value: Any) -> Any:
    """Return |value|."""
    kind = words(value.type.count)
    positive = builder.and_(builder.bitcast(value, kind), fill(kind, 0x7FFFFFFF))
    return builder.bitcast(positive, value.type)


def with_products(builder: Any, total: Any, *factors: tuple[Any, Any]) -> Any:
    """Return the total plus the product of each pair of factors."""
    for a, b in factors:
        total = add(builder, total, mul(builder, a, b))
    return total


def declared(builder: Any, name: str, kind: Any) -> Any:
    """Return one of LLVM's intrinsic functions, declared in the module."""
    return cgutils.get_or_insert_function(builder.module, kind, name)  # type: ignore[no-untyped-call]


def bits(builder: Any, mask: Any) -> Any:
    """Return the lanes of a mask as bits of an int64, the first lane as the lowest."""
    return builder.zext(builder.bitcast(mask, ir.IntType(mask.type.count)), INDEX)


class Table:
    """A contiguous array of float32, read and written in rows that are vectors."""

    def __init__(self, context: Any, builder: Any, kind: Any, array: Any, row: Any) -> None:
        self.builder = builder
        self.array = context.make_array(kind)(context, builder, array)
        self.kind = row

    def at(self, *indices: Any) -> Any:
        """Return the address of a number."""
        offset = indices[0]
        for axis, one in enumerate(indices[1:], 1):
            stride = self.builder.extract_value(self.array.shape, axis)
            offset = self.builder.add(self.builder.mul(offset, stride), one)
        return self.builder.gep(self.array.data, [offset])

    def spread(self, *indices: Any) -> Any:
        """Return a vector that repeats one number of the array."""
        return splat(self.builder, self.builder.load(self.at(*indices)), self.kind)

    def _row(self, *indices: Any) -> Any:
        return self.builder.bitcast(self.at(*indices, index(0)), self.kind.as_pointer())

    def load(self, *indices: Any) -> Any:
        """Load a row."""
        return self.builder.load(self._row(*indices), align=4)

    def store(self, value: Any, *indices: Any) -> None:
        """Store a row."""
        self.builder.store(value, self._row(*indices), align=4)


def each_bit(builder: Any, mark: Any, values: list[Any], body: Callable[..., list[Any]]) -> Any:
    """Build a loop over the set bits of an int32, the lowest first, and return the final values.

    The body takes the bit's index and the values, and returns the new values. These stay in
    registers, whereas loops of Numba's `cgutils` carry values through memory.
    """
    before = builder.block
    loop, after = (builder.append_basic_block(name) for name in ("each", "after"))
    zero, one = ir.Constant(WORD, 0), ir.Constant(WORD, 1)
    builder.cbranch(builder.icmp_unsigned("!=", mark, zero), loop, after)
    builder.position_at_end(loop)
    rest = builder.phi(WORD)
    carried = [builder.phi(value.type) for value in values]
    place = builder.cttz(rest, ir.Constant(ir.IntType(1), 1))
    found = body(builder.zext(place, INDEX), *carried)
    next_rest = builder.and_(rest, builder.sub(rest, one))
    end = builder.block
    builder.cbranch(builder.icmp_unsigned("!=", next_rest, zero), loop, after)
    for phi, first, later in zip(
        [rest, *carried], [mark, *values], [next_rest, *found], strict=True
    ):
        phi.add_incoming(first, before)
        phi.add_incoming(later, end)
    builder.position_at_end(after)
    results = []
    for first, later in zip(values, found, strict=True):
        result = builder.phi(first.type)
        result.add_incoming(first, before)
        result.add_incoming(later, end)
        results.append(result)
    return results


def each_index(builder: Any, count: Any, values: list[Any], body: Callable[..., list[Any]]) -> Any:
    """Build a loop over the int64 in [0, count), count above 0, and return the final values.

    The body takes the number and the values, and returns the new values, in registers as in
    `each_bit`.
    """
    before = builder.block
    loop, after = (builder.append_basic_block(name) for name in ("turn", "turned"))
    builder.branch(loop)
    builder.position_at_end(loop)
    number = builder.phi(INDEX)
    carried = [builder.phi(value.type) for value in values]
    found = body(number, *carried)
    following = builder.add(number, index(1))
    end = builder.block
    builder.cbranch(builder.icmp_signed("<", following, count), loop, after)
    for phi, first, later in zip(
        [number, *carried], [index(0), *values], [following, *found], strict=True
    ):
        phi.add_incoming(first, before)
        phi.add_incoming(later, end)
    builder.position_at_end(after)
    return found


def sums(builder: Any, vectors: list[Any]) -> Any:
    """Return a vector whose lanes are the sums of the given vectors, as many as it has lanes."""
    count = len(vectors)
    while len(vectors) > 1:
        halves = []
        for a, b in zip(vectors[::2], vectors[1::2], strict=True):
            even, odd = (shuffled(builder, a, b, range(k, 2 * count, 2)) for k in (0, 1))
            halves.append(add(builder, even, odd))
        vectors = halves
    return vectors[0]

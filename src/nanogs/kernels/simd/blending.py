"""Vector versions of the functions of `nanogs.kernels.blending`, which documents them."""
# ruff: noqa: ANN401, ARG001, D103 - Numba asks for these signatures, and llvmlite has no types

from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from nanogs.kernels.simd import vectors as vec
from nanogs.kernels.simd.blocks import REALS, alpha_of, light_through, pixels_of


@intrinsic
def blend_block(
    typing: Any, mark: Any, block: Any, shapes: Any, values: Any, transmittances: Any, weights: Any,
    planes: Any,
) -> Any:  # fmt: skip
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        mark, block = args[:2]
        shape_table, value_table, light, weight_table, plane_table = (
            vec.Table(context, builder, kind, array, REALS)
            for kind, array in zip(signature.args[2:], args[2:], strict=True)
        )
        x, y = pixels_of(builder, block)

        def step(j: Any, before: Any, *sums: Any) -> list[Any]:
            shape = [shape_table.spread(j, vec.index(k)) for k in range(6)]
            alpha, seen, *_ = alpha_of(builder, shape, x, y)
            weight, after = light_through(builder, alpha, seen, before)
            weight_table.store(weight, j)
            colours = (value_table.spread(j, vec.index(c)) for c in range(3))
            return [after, *(
                vec.add(builder, total, vec.mul(builder, colour, weight))
                for total, colour in zip(sums, colours, strict=True)
            )]  # fmt: skip

        first = [light.load(block), *(plane_table.load(vec.index(c), block) for c in range(3))]
        after, *sums = vec.each_bit(builder, mark, first, step)
        light.store(after, block)
        for c in range(3):
            plane_table.store(sums[c], vec.index(c), block)
        return context.get_dummy_value()

    signature = types.void(
        types.uint32, types.int64, shapes, values, transmittances, weights, planes
    )
    return signature, generate


@intrinsic
def add_block(
    typing: Any, mark: Any, block: Any, weights: Any, values: Any, c: Any, planes: Any
) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        weight_table = vec.Table(context, builder, weights, args[2], REALS)
        value_table = vec.Table(context, builder, values, args[3], REALS)
        plane_table = vec.Table(context, builder, planes, args[5], REALS)

        def step(j: Any, total: Any) -> list[Any]:
            product = vec.mul(builder, value_table.spread(j, args[4]), weight_table.load(j))
            return [vec.add(builder, total, product)]

        (total,) = vec.each_bit(builder, args[0], [plane_table.load(args[4], args[1])], step)
        plane_table.store(total, args[4], args[1])
        return context.get_dummy_value()

    place = types.int64
    return types.void(types.uint32, place, weights, values, place, planes), generate


@intrinsic
def probe_block(
    typing: Any, mark: Any, block: Any, weights: Any, probes: Any, p: Any, sums: Any
) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        weight_table = vec.Table(context, builder, weights, args[2], REALS)
        sum_table = vec.Table(context, builder, sums, args[5], REALS)
        probe = vec.Table(context, builder, probes, args[3], REALS).load(args[4], args[1])

        def step(j: Any) -> list[Any]:
            product = vec.mul(builder, weight_table.load(j), probe)
            sum_table.store(vec.add(builder, sum_table.load(args[4], j), product), args[4], j)
            return []

        vec.each_bit(builder, args[0], [], step)
        return context.get_dummy_value()

    place = types.int64
    return types.void(types.uint32, place, weights, probes, place, sums), generate


@intrinsic
def total(typing: Any, sums: Any, p: Any, j: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        row = vec.Table(context, builder, sums, args[0], REALS).load(args[1], args[2])
        while row.type.count > 1:
            half = row.type.count // 2
            low, high = (vec.shuffled(builder, row, row, range(k, k + half)) for k in (0, half))
            row = vec.add(builder, low, high)
        return builder.extract_element(row, ir.Constant(vec.WORD, 0))

    return types.float32(sums, types.int64, types.int64), generate

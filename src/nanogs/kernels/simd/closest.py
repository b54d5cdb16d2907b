"""Vector version of `nanogs.kernels.closest`, which documents it."""
# ruff: noqa: ANN401, ARG001, D103 - Numba asks for these signatures, and llvmlite has no types

import math
from typing import Any

from numba.core import types
from numba.extending import intrinsic

from nanogs.kernels.closest import LANES, TOGETHER
from nanogs.kernels.simd import vectors as vec

_REALS, _WORDS = vec.reals(LANES), vec.words(LANES)
_STEP = 3  # dimensions per iteration of the inner loop


@intrinsic
def closest(
    typing: Any, factors: Any, columns: Any, squares: Any, tiles: Any, least: Any, second: Any,
    places: Any,
) -> Any:  # fmt: skip
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        factor_table = vec.Table(context, builder, factors, args[0], _REALS)
        shape = context.make_array(columns)(context, builder, args[1]).shape
        dimensions, width = (builder.extract_value(shape, axis) for axis in range(2))
        turns = builder.udiv(dimensions, vec.index(_STEP))

        def look(tile: Any, *before: Any) -> list[Any]:
            start = builder.mul(tile, vec.index(LANES))

            def add(turn: Any, *sums: Any) -> list[Any]:
                totals = list(sums)
                for step in range(_STEP):
                    d = builder.add(builder.mul(turn, vec.index(_STEP)), vec.index(step))
                    at = builder.add(builder.mul(d, width), start)
                    column = vec.read(context, builder, columns, args[1], at, _REALS)
                    for point in range(TOGETHER):
                        factor = factor_table.spread(vec.index(point), d)
                        totals[point] = vec.with_products(builder, totals[point], (factor, column))
                return totals

            square = vec.read(context, builder, squares, args[2], start, _REALS)
            totals = vec.each_index(builder, turns, [square] * TOGETHER, add)
            number = vec.splat(builder, builder.trunc(tile, vec.WORD), _WORDS)
            found = []
            for point, total in enumerate(totals):
                lowest, next_lowest, place = before[3 * point : 3 * point + 3]
                lower = builder.fcmp_ordered("<", total, lowest)
                found += [
                    builder.select(lower, total, lowest),
                    vec.lesser(builder, builder.select(lower, lowest, total), next_lowest),
                    builder.select(lower, number, place),
                ]
            return found

        far, none = vec.fill(_REALS, math.inf), vec.fill(_WORDS, 0)
        found = vec.each_index(builder, args[3], [far, far, none] * TOGETHER, look)
        for number, value in enumerate(found):
            point, out = divmod(number, 3)
            kind, array = signature.args[4 + out], args[4 + out]
            vec.write(context, builder, kind, array, vec.index(point * LANES), value)
        return context.get_dummy_value()

    signature = types.void(factors, columns, squares, types.int64, least, second, places)
    return signature, generate

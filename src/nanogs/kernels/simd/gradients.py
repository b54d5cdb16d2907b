"""Vector version of `nanogs.kernels.gradients`, which documents it."""
# ruff: noqa: ANN401, ARG001, D103 - Numba asks for these signatures, and llvmlite has no types

from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from nanogs.kernels.blocks import LANES
from nanogs.kernels.gradients import CHANNELS, CURVATURE_POWERS, GRADIENTS, SATURATED, SCALES, SUMS
from nanogs.kernels.simd import vectors as vec
from nanogs.kernels.simd.blocks import REALS, alpha_of, light_through, pixels_of


def _moments(builder: Any, value: Any, p: Any, q: Any, powers: list[tuple[int, int]]) -> list[Any]:
    """Return the value times p^a q^b for each pair of powers (a, b)."""
    found: dict[tuple[int, int], Any] = {(0, 0): value}
    for a, b in powers:
        if (a, b) not in found:
            lower, factor = ((a, b - 1), q) if b else ((a - 1, b), p)
            found[a, b] = vec.mul(builder, found[lower], factor)
    return [found[power] for power in powers]


def _write_sums(builder: Any, sums: list[Any], out: Any, e: Any) -> None:
    """Write the scaled sum of each of 25 vectors into a row: 16 as a vector, 9 one by one."""
    zeros = [vec.fill(REALS, 0.0)] * (2 * LANES - SUMS)
    first, second = (
        vec.mul(builder, vec.sums(builder, vectors), ir.Constant(REALS, scales))
        for vectors, scales in (
            (sums[:LANES], SCALES[:LANES].tolist()),
            (sums[LANES:] + zeros, SCALES[LANES:].tolist() + [0.0] * len(zeros)),
        )
    )
    out.store(first, e)
    rest = SUMS - LANES
    for k in range(rest):
        lane = builder.extract_element(second, ir.Constant(vec.WORD, k))
        builder.store(lane, out.at(e, vec.index(LANES + k)))


@intrinsic
def gradient_blocks(
    typing: Any, mark: Any, j: Any, shapes: Any, values: Any, transmittances: Any, behind: Any,
    residual: Any, curvature_weights: Any, partial: Any, e: Any,
) -> Any:  # fmt: skip
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        mark, j, e = builder.trunc(args[0], vec.WORD), args[1], args[9]
        shape_table, value_table, light, rear, residuals, curvature_weight, out = (
            vec.Table(context, builder, kind, array, REALS)
            for kind, array in zip(signature.args[2:9], args[2:9], strict=True)
        )
        channels = [vec.index(c) for c in range(CHANNELS)]
        shape = [shape_table.spread(j, vec.index(k)) for k in range(6)]
        colours = [value_table.spread(j, c) for c in channels]
        zero = vec.fill(REALS, 0.0)

        def step(block: Any, *sums: Any) -> list[Any]:
            x, y = pixels_of(builder, block)
            alpha, seen, p, q = alpha_of(builder, shape, x, y)
            weight, after = light_through(builder, alpha, seen, light.load(block))
            light.store(after, block)
            after = vec.magnitude(builder, after)
            inverse = vec.div(builder, vec.fill(REALS, 1.0), after)
            changes, errors = [], []
            for c, colour in zip(channels, colours, strict=True):
                back = vec.sub(builder, rear.load(c, block), vec.mul(builder, weight, colour))
                rear.store(back, c, block)
                changes.append(vec.sub(builder, colour, vec.mul(builder, back, inverse)))
                errors.append(residuals.load(c, block))
            shared = vec.mul(builder, weight, curvature_weight.load(block))
            bound = vec.mul(builder, vec.fill(REALS, SATURATED), after)
            free = builder.fcmp_ordered("<", weight, bound)
            gradient = vec.with_products(builder, zero, *zip(changes, errors, strict=True))
            curvature = vec.with_products(builder, zero, *zip(changes, changes, strict=True))
            gradient = builder.select(free, vec.mul(builder, weight, gradient), zero)
            curvature = builder.select(free, vec.mul(builder, shared, curvature), zero)
            terms = [vec.mul(builder, weight, error) for error in errors[:3]] + [shared]
            terms += _moments(builder, gradient, p, q, GRADIENTS) + _moments(
                builder, curvature, p, q, CURVATURE_POWERS
            )
            return [vec.add(builder, *pair) for pair in zip(sums, terms, strict=True)]

        sums = vec.each_bit(builder, mark, [zero] * SUMS, step)
        _write_sums(builder, sums, out, e)
        return context.get_dummy_value()

    place = types.int64
    signature = types.void(
        place,
        place,
        shapes,
        values,
        transmittances,
        behind,
        residual,
        curvature_weights,
        partial,
        place,
    )
    return signature, generate

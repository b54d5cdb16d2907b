"""How a block of 4 x 4 pixels pulls at a splat; see `backward.py`, `blocks.py` and `vectors.py`."""
# ruff: noqa: ANN401, ARG001 - Numba asks for these signatures, and llvmlite has no types

from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import types

from nanogs._types import F32
from nanogs.kernels import vectors as vec
from nanogs.kernels.blocks import (
    LANES,
    REALS,
    UNIT,
    alpha_of,
    light_through,
    pixels_of,
    shade_block,
)
from nanogs.kernels.vectors import compiled

CHANNELS = 4
SATURATED = 98.9  # T alpha over what is left of T: beyond it alpha is held at 0.99
PULLS = [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)]  # powers of p and q
BENDS = [(a, b) for a in range(5) for b in range(5 - a)]
SUMS = 4 + len(PULLS) + len(BENDS)


def pull_blocks(
    mark: int, j: int, shapes: F32, values: F32, left: F32, behind: F32, wanted: F32, trust: F32,
    partial: F32, e: int,
) -> None:  # fmt: skip
    """Sums over the pixels of a tile that say how they pull at a splat.

    Args:
        mark: Its set bits are the blocks that the splat may reach.
        j: The splat.
        shapes: (BATCH, 8) see `blocks`.
        values: (BATCH, 4) what was blended.
        left: (16, 16) transmittances of the tile's blocks, in and out.
        behind: (4, 16, 16) what splats from this one on blended; out, what those after it did.
        wanted: (4, 16, 16) wanted change of the pixels, times their precision.
        trust: (16, 16) their precision times their alpha.
        partial: (E, 25) out, in row e, see `backward.pull_tiles`.
        e: The row.
    """
    sums = np.zeros((SUMS, LANES), np.float32)
    for block in range(LANES):
        if int(mark) >> block & 1 == 0:
            continue
        weight, p, q = shade_block(shapes[j], block, left)
        after = abs(left[block])
        colour = values[j, :CHANNELS, None]
        behind[:, block] -= weight * colour
        change = colour - behind[:, block] / after
        free = weight < np.float32(SATURATED) * after
        shared = weight * trust[block]
        pull = np.where(free, weight * (change * wanted[:, block]).sum(axis=0), 0)
        bend = np.where(free, shared * (change * change).sum(axis=0), 0)
        sums[:3] += weight * wanted[:3, block]
        sums[3] += shared
        sums[4:10] += [pull * p**a * q**b for a, b in PULLS]
        sums[10:] += [bend * p**a * q**b for a, b in BENDS]
    partial[e, :SUMS] = sums.sum(axis=1) * SCALES


SCALES = np.array([1.0] * 4 + [UNIT ** (a + b) for a, b in PULLS + BENDS], np.float32)


def _moments(builder: Any, value: Any, p: Any, q: Any, powers: list[tuple[int, int]]) -> list[Any]:
    """The value times p^a q^b."""
    found: dict[tuple[int, int], Any] = {(0, 0): value}
    for a, b in powers:
        if (a, b) not in found:
            lower, factor = ((a, b - 1), q) if b else ((a - 1, b), p)
            found[a, b] = vec.mul(builder, found[lower], factor)
    return [found[power] for power in powers]


def _write_sums(builder: Any, sums: list[Any], out: Any, e: Any) -> None:
    """Write the sum of each of 25 vectors into a row: 16, 8 and one."""
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


@compiled(pull_blocks)
def _pull_blocks(
    typing: Any, mark: Any, j: Any, shapes: Any, values: Any, left: Any, behind: Any, wanted: Any,
    trust: Any, partial: Any, e: Any,
) -> Any:  # fmt: skip
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        mark, j, e = builder.trunc(args[0], vec.WORD), args[1], args[9]
        shape_table, value_table, light, rear, wants, trusts, out = (
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
            changes, wanted = [], []
            for c, colour in zip(channels, colours, strict=True):
                back = vec.sub(builder, rear.load(c, block), vec.mul(builder, weight, colour))
                rear.store(back, c, block)
                changes.append(vec.sub(builder, colour, vec.mul(builder, back, inverse)))
                wanted.append(wants.load(c, block))
            shared = vec.mul(builder, weight, trusts.load(block))
            bound = vec.mul(builder, vec.fill(REALS, SATURATED), after)
            free = builder.fcmp_ordered("<", weight, bound)
            pull = vec.with_products(builder, zero, *zip(changes, wanted, strict=True))
            bend = vec.with_products(builder, zero, *zip(changes, changes, strict=True))
            pull = builder.select(free, vec.mul(builder, weight, pull), zero)
            bend = builder.select(free, vec.mul(builder, shared, bend), zero)
            terms = [vec.mul(builder, weight, want) for want in wanted[:3]] + [shared]
            terms += _moments(builder, pull, p, q, PULLS) + _moments(builder, bend, p, q, BENDS)
            return [vec.add(builder, *pair) for pair in zip(sums, terms, strict=True)]

        sums = vec.each_bit(builder, mark, [zero] * SUMS, step)
        _write_sums(builder, sums, out, e)
        return context.get_dummy_value()

    place = types.int64
    signature = types.void(
        place, place, shapes, values, left, behind, wanted, trust, partial, place
    )
    return signature, generate

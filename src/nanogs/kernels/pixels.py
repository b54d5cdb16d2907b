"""Blending on 8 pixels of a row, or twice 8, at a time; see `vectors.py`."""
# ruff: noqa: ANN401, ARG001 - Numba asks for these signatures, and llvmlite has no types

from typing import Any, TypeAlias

import numpy as np
from llvmlite import ir
from numba.core import types

from nanogs._types import F32, I32, U32
from nanogs.kernels import vectors as vec
from nanogs.kernels.spans import PIXELS, ROWS, SECOND, SPLAT, TILE
from nanogs.kernels.vectors import compiled

Single: TypeAlias = np.float32

MIN_ALPHA = 1.0 / 255.0
MAX_ALPHA = 0.99
MIN_TRANSMITTANCE = 1e-4

# exp(x) = P(x/16)^16 on [-6, 0]: least squares over P(0) = 1, relative error below 2e-6.
POLYNOMIAL = (
    1.0,
    0.999999749030319,
    0.4999909362769371,
    0.1665583204458221,
    0.041092303836772995,
    0.006918978553628526,
)


def blend_pixels(
    base: Single, slope: Single, q: Single, opacity: Single, first: int, left: F32, at: int,
    weights: F32, to: int,
) -> None:  # fmt: skip
    """Weights T alpha of one splat on 8 pixels, alpha = opacity exp(-(p² + q) / 2).

    A pixel that is full keeps its transmittance with a negative sign, which makes every later
    weight zero without a branch.
    base and slope: p = base + slope x, x from `first` on; left: transmittances, those from flat
    place `at` are updated; weights: filled from place `to`.
    """
    single = np.float32
    with np.errstate(over="ignore"):
        p = base + slope * (np.arange(PIXELS) + first).astype(single)
        y = np.maximum(single(-6.0), single(-0.5) * (p * p + q)) * single(0.0625)
    e = np.zeros(PIXELS, single)
    for coefficient in reversed(POLYNOMIAL):
        e = single(coefficient) + y * e
    alpha = np.minimum(single(MAX_ALPHA), opacity * e**16)
    alpha[alpha < single(MIN_ALPHA)] = 0.0
    flat = left.reshape(-1)
    before = flat[at : at + PIXELS].copy()
    after = before * (single(1.0) - alpha)
    full = after < single(MIN_TRANSMITTANCE)
    weights[to : to + PIXELS] = np.where(full, single(0.0), before * alpha)
    flat[at : at + PIXELS] = np.where(full, -abs(before), after)


def blend_pair(
    pieces: U32, k: int, bases: F32, squares: F32, starts: I32, slopes: F32, opacities: F32,
    left: F32, weights: F32,
) -> None:  # fmt: skip
    """Blend two runs of 8 pixels, which must not share any, of one splat; see `blend_pixels`.

    Args:
        pieces: The places of the runs' rows, at k and k + 1; see `span_rows`.
        k: Even.
        bases: See `span_rows`, with the next two.
        squares: See there.
        starts: See there.
        slopes: (n,) 1 / standard deviation of x given y, 1/pixels.
        opacities: (n,)
        left: (17, 16) transmittances.
        weights: Filled from place 8 k.
    """
    for piece in pieces[k : k + 2]:
        place = piece % SECOND
        first, splat = starts[piece], place // SPLAT
        at = place % SPLAT * TILE + first
        base, q = bases[place], squares[place]
        blend_pixels(base, slopes[splat], q, opacities[splat], first, left, at, weights, k * PIXELS)
        k += 1


def blend_pair_three(
    pieces: U32, k: int, bases: F32, squares: F32, starts: I32, slopes: F32, opacities: F32,
    left: F32, weights: F32, values: F32, planes: F32,
) -> None:  # fmt: skip
    """As `blend_pair`, and add the weights times the splat's colours to three planes.

    values: (n, 3 or more); planes: (3, 17, 16).
    """
    blend_pair(pieces, k, bases, squares, starts, slopes, opacities, left, weights)
    for piece in pieces[k : k + 2]:
        place = piece % SECOND
        at = place % SPLAT * TILE + starts[piece]
        for c in range(3):
            add_scaled(values, place // SPLAT, c, weights, k * PIXELS, planes, at)
        k += 1


def add_scaled(values: F32, j: int, c: int, weights: F32, at: int, planes: F32, to: int) -> None:
    """Add 8 weights, from place `at` on, times values[j, c] to plane c from place `to` on.

    planes: (C, 17, 16).
    """
    planes[c].reshape(-1)[to : to + PIXELS] += values[j, c] * weights[at : at + PIXELS]


def add_products(weights: F32, at: int, probes: F32, there: int, sums: F32, to: int) -> None:
    """Add 8 weights, from place `at` on, times as many probes to as many sums; flat places."""
    products = weights[at : at + PIXELS] * probes.reshape(-1)[there : there + PIXELS]
    sums.reshape(-1)[to : to + PIXELS] += products


_REALS, _PAIR = vec.reals(PIXELS), vec.reals(2 * PIXELS)
_LOW, _HIGH = range(PIXELS), range(PIXELS, 2 * PIXELS)


def _falloff(builder: Any, base: Any, slope: Any, q: Any, opacity: Any, x: Any) -> Any:
    """Alpha of the pixels at x, 0 below 1/255."""
    kind = x.type
    p = vec.add(builder, base, vec.mul(builder, slope, x))
    y = vec.add(builder, vec.mul(builder, p, p), q)
    y = vec.mul(builder, y, vec.fill(kind, -0.5 / 16))
    y = vec.greater(builder, y, vec.fill(kind, -6.0 / 16))
    e = vec.fill(kind, POLYNOMIAL[-1])
    for coefficient in reversed(POLYNOMIAL[:-1]):
        e = vec.add(builder, vec.fill(kind, coefficient), vec.mul(builder, y, e))
    for _ in range(4):
        e = vec.mul(builder, e, e)
    alpha = vec.lesser(builder, vec.mul(builder, opacity, e), vec.fill(kind, MAX_ALPHA))
    seen = builder.fcmp_ordered(">=", alpha, vec.fill(kind, MIN_ALPHA))
    return builder.select(seen, alpha, vec.fill(kind, 0.0))


def _light(builder: Any, alpha: Any, before: Any) -> tuple[Any, Any]:
    """Weights T alpha, and the transmittances after."""
    kind = alpha.type
    after = vec.mul(builder, before, vec.sub(builder, vec.fill(kind, 1.0), alpha))
    full = builder.fcmp_ordered("<", after, vec.fill(kind, MIN_TRANSMITTANCE))
    words = vec.words(kind.count)
    sign = builder.or_(builder.bitcast(before, words), vec.fill(words, 0x80000000))
    weight = builder.select(full, vec.fill(kind, 0.0), vec.mul(builder, before, alpha))
    return weight, builder.select(full, builder.bitcast(sign, kind), after)


def _columns(builder: Any, first: Any) -> Any:
    start = vec.splat(builder, builder.sitofp(first, ir.FloatType()), _REALS)
    return vec.add(builder, start, vec.counting(_REALS))


def _add_to(context: Any, builder: Any, kind: Any, array: Any, at: Any, a: Any, b: Any) -> None:
    """Add a b to the vector at a flat place of an array."""
    before = vec.read(context, builder, kind, array, at, _REALS)
    total = vec.add(builder, before, vec.mul(builder, a, b))
    vec.write(context, builder, kind, array, at, total)


@compiled(blend_pixels)
def _blend_pixels(
    typing: Any, base: Any, slope: Any, q: Any, opacity: Any, first: Any, left: Any, at: Any,
    weights: Any, to: Any,
) -> Any:  # fmt: skip
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        base, slope, q, opacity = (vec.splat(builder, arg, _REALS) for arg in args[:4])
        alpha = _falloff(builder, base, slope, q, opacity, _columns(builder, args[4]))
        before = vec.read(context, builder, left, args[5], args[6], _REALS)
        weight, after = _light(builder, alpha, before)
        vec.write(context, builder, left, args[5], args[6], after)
        vec.write(context, builder, weights, args[7], args[8], weight)
        return context.get_dummy_value()

    real, place = types.float32, types.int64
    signature = types.void(real, real, real, real, place, left, place, weights, place)
    return signature, generate


def _pair(context: Any, builder: Any, signature: Any, args: Any) -> tuple[Any, Any, Any]:
    """What `blend_pair` does: the weights of each run, their flat places, and the splat."""
    kinds = signature.args

    def load(which: int, at: Any) -> Any:
        return vec.item(context, builder, kinds[which], args[which], at)

    def both(values: Any) -> Any:
        return vec.shuffled(builder, values[0], values[1], range(2 * PIXELS))

    def spread(which: int, at: Any, kind: Any = _REALS) -> Any:
        return vec.splat(builder, load(which, at), kind)

    pieces = [builder.zext(load(0, builder.add(args[1], vec.index(k))), vec.INDEX) for k in (0, 1)]
    places = [builder.and_(piece, vec.index(SECOND - 1)) for piece in pieces]
    splat = builder.lshr(places[0], vec.index(SPLAT.bit_length() - 1))
    firsts = [builder.sext(load(4, piece), vec.INDEX) for piece in pieces]
    rows = [builder.and_(place, vec.index(SPLAT - 1)) for place in places]
    ats = [
        builder.add(builder.mul(row, vec.index(TILE)), first)
        for row, first in zip(rows, firsts, strict=True)
    ]
    base, q = (both([spread(which, place) for place in places]) for which in (2, 3))
    slope, opacity = (spread(which, splat, _PAIR) for which in (5, 6))
    x = both([_columns(builder, first) for first in firsts])
    alpha = _falloff(builder, base, slope, q, opacity, x)
    before = both([vec.read(context, builder, kinds[7], args[7], at, _REALS) for at in ats])
    weight, after = _light(builder, alpha, before)
    for at, lanes in zip(ats, (_LOW, _HIGH), strict=True):
        half = vec.shuffled(builder, after, after, lanes)
        vec.write(context, builder, kinds[7], args[7], at, half)
    to = builder.mul(args[1], vec.index(PIXELS))
    vec.write(context, builder, kinds[8], args[8], to, weight)
    halves = [vec.shuffled(builder, weight, weight, lanes) for lanes in (_LOW, _HIGH)]
    return halves, ats, splat


@compiled(blend_pair)
def _blend_pair(
    typing: Any, pieces: Any, k: Any, bases: Any, squares: Any, starts: Any, slopes: Any,
    opacities: Any, left: Any, weights: Any,
) -> Any:  # fmt: skip
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        _pair(context, builder, signature, args)
        return context.get_dummy_value()

    place = types.int64
    signature = types.void(pieces, place, bases, squares, starts, slopes, opacities, left, weights)
    return signature, generate


@compiled(blend_pair_three)
def _blend_pair_three(
    typing: Any, pieces: Any, k: Any, bases: Any, squares: Any, starts: Any, slopes: Any,
    opacities: Any, left: Any, weights: Any, values: Any, planes: Any,
) -> Any:  # fmt: skip
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        halves, ats, splat = _pair(context, builder, signature, args)
        for c in range(3):
            value = vec.item(context, builder, values, args[9], splat, vec.index(c))
            value = vec.splat(builder, value, _REALS)
            for half, at in zip(halves, ats, strict=True):
                there = builder.add(at, vec.index(c * ROWS * TILE))
                _add_to(context, builder, planes, args[10], there, value, half)
        return context.get_dummy_value()

    place = types.int64
    signature = types.void(
        pieces, place, bases, squares, starts, slopes, opacities, left, weights, values, planes
    )
    return signature, generate


@compiled(add_scaled)
def _add_scaled(
    typing: Any, values: Any, j: Any, c: Any, weights: Any, at: Any, planes: Any, to: Any
) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        value = vec.item(context, builder, values, *args[:3])
        weight = vec.read(context, builder, weights, args[3], args[4], _REALS)
        there = builder.add(args[6], builder.mul(args[2], vec.index(ROWS * TILE)))
        value = vec.splat(builder, value, _REALS)
        _add_to(context, builder, planes, args[5], there, value, weight)
        return context.get_dummy_value()

    place = types.int64
    return types.void(values, place, place, weights, place, planes, place), generate


@compiled(add_products)
def _add_products(
    typing: Any, weights: Any, at: Any, probes: Any, there: Any, sums: Any, to: Any
) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        weight = vec.read(context, builder, weights, args[0], args[1], _REALS)
        probed = vec.read(context, builder, probes, args[2], args[3], _REALS)
        _add_to(context, builder, sums, args[4], args[5], probed, weight)
        return context.get_dummy_value()

    place = types.int64
    return types.void(weights, place, probes, place, sums, place), generate

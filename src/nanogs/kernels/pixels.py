"""Vector instructions across 8 pixels of a row, which Numba's loops do not reach; see `lanes.py`.

Each operation is written twice: as plain Python, which says what it does, and as LLVM's vector
type of 8 float32.
"""
# ruff: noqa: ANN401, ARG001 - Numba asks for these signatures, and llvmlite has no types

from typing import Any, TypeAlias

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic, overload

from nanogs._types import F32

Single: TypeAlias = np.float32

PIXELS = 8
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


def add_scaled(value: Single, weights: F32, plane: F32, at: int) -> None:
    """Add the weights (8,) times a value to the plane from flat place `at` on."""
    plane.reshape(-1)[at : at + PIXELS] += value * weights


def add_products(weights: F32, probe: F32, at: int, sums: F32, to: int) -> None:
    """Add the weights (8,) times the probe from place `at` on to the sums from place `to` on."""
    sums.reshape(-1)[to : to + PIXELS] += weights * probe.reshape(-1)[at : at + PIXELS]


_REALS = ir.VectorType(ir.FloatType(), PIXELS)
_BITS = ir.VectorType(ir.IntType(32), PIXELS)
_FAST = ("contract", "nsz", "arcp", "reassoc")

# The typing context, first in each signature, is not for the caller: mypy cannot know.
_vector: Any = intrinsic


def _all(value: float) -> Any:
    return ir.Constant(_REALS, [float(np.float32(value))] * PIXELS)


def _splat(builder: Any, value: Any) -> Any:
    """The same value for every pixel."""
    empty = ir.Constant(_REALS, ir.Undefined)
    first = builder.insert_element(empty, value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(first, empty, ir.Constant(_BITS, [0] * PIXELS))


def _place(context: Any, builder: Any, array_type: Any, array: Any, at: Any) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [at]), _REALS.as_pointer())


def _add(builder: Any, a: Any, b: Any) -> Any:
    return builder.fadd(a, b, flags=_FAST)


def _mul(builder: Any, a: Any, b: Any) -> Any:
    return builder.fmul(a, b, flags=_FAST)


def _alpha(builder: Any, base: Any, slope: Any, q: Any, opacity: Any, first: Any) -> Any:
    """Alpha of the pixels, 0 below 1/255."""
    start = _splat(builder, builder.sitofp(first, ir.FloatType()))
    x = _add(builder, start, ir.Constant(_REALS, [float(i) for i in range(PIXELS)]))
    p = _add(builder, _splat(builder, base), _mul(builder, _splat(builder, slope), x))
    y = _add(builder, _mul(builder, p, p), _splat(builder, q))
    y = _mul(builder, y, _all(-0.5))
    y = builder.select(builder.fcmp_ordered(">", y, _all(-6.0)), y, _all(-6.0))
    y = _mul(builder, y, _all(0.0625))
    e = _all(POLYNOMIAL[-1])
    for coefficient in reversed(POLYNOMIAL[:-1]):
        e = _add(builder, _all(coefficient), _mul(builder, y, e))
    for _ in range(4):
        e = _mul(builder, e, e)
    alpha = _mul(builder, _splat(builder, opacity), e)
    alpha = builder.select(
        builder.fcmp_ordered("<", alpha, _all(MAX_ALPHA)), alpha, _all(MAX_ALPHA)
    )
    return builder.select(builder.fcmp_ordered(">=", alpha, _all(MIN_ALPHA)), alpha, _all(0.0))


@_vector
def _blend_pixels(
    typing: Any, base: Any, slope: Any, q: Any, opacity: Any, first: Any, left: Any, at: Any,
    weights: Any, to: Any,
) -> Any:  # fmt: skip
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        alpha = _alpha(builder, *args[:5])
        place = _place(context, builder, left, args[5], args[6])
        before = builder.load(place, align=4)
        after = _mul(builder, before, builder.fsub(_all(1.0), alpha, flags=_FAST))
        full = builder.fcmp_ordered("<", after, _all(MIN_TRANSMITTANCE))
        weight = builder.select(full, _all(0.0), _mul(builder, before, alpha))
        sign = ir.Constant(_BITS, [0x80000000] * PIXELS)
        closed = builder.bitcast(builder.or_(builder.bitcast(before, _BITS), sign), _REALS)
        builder.store(builder.select(full, closed, after), place, align=4)
        builder.store(weight, _place(context, builder, weights, args[7], args[8]), align=4)
        return context.get_dummy_value()

    real, place = types.float32, types.int64
    signature = types.void(real, real, real, real, place, left, place, weights, place)
    return signature, generate


@_vector
def _add_scaled(typing: Any, value: Any, weights: Any, plane: Any, at: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        zero = ir.Constant(ir.IntType(64), 0)
        weight = builder.load(_place(context, builder, weights, args[1], zero), align=4)
        place = _place(context, builder, plane, args[2], args[3])
        more = _mul(builder, _splat(builder, args[0]), weight)
        builder.store(_add(builder, builder.load(place, align=4), more), place, align=4)
        return context.get_dummy_value()

    return types.void(types.float32, weights, plane, types.int64), generate


@_vector
def _add_products(typing: Any, weights: Any, probe: Any, at: Any, sums: Any, to: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        zero = ir.Constant(ir.IntType(64), 0)
        weight = builder.load(_place(context, builder, weights, args[0], zero), align=4)
        probed = builder.load(_place(context, builder, probe, args[1], args[2]), align=4)
        place = _place(context, builder, sums, args[3], args[4])
        more = _mul(builder, weight, probed)
        builder.store(_add(builder, builder.load(place, align=4), more), place, align=4)
        return context.get_dummy_value()

    return types.void(weights, probe, types.int64, sums, types.int64), generate


@overload(blend_pixels)
def _compiled_blend_pixels(
    base: Any, slope: Any, q: Any, opacity: Any, first: Any, left: Any, at: Any,
    weights: Any, to: Any,
) -> Any:  # fmt: skip
    def body(
        base: Any, slope: Any, q: Any, opacity: Any, first: Any, left: Any, at: Any,
        weights: Any, to: Any,
    ) -> None:  # fmt: skip
        _blend_pixels(base, slope, q, opacity, first, left, at, weights, to)

    return body


@overload(add_scaled)
def _compiled_add_scaled(value: Any, weights: Any, plane: Any, at: Any) -> Any:
    def body(value: Any, weights: Any, plane: Any, at: Any) -> None:
        _add_scaled(value, weights, plane, at)

    return body


@overload(add_products)
def _compiled_add_products(weights: Any, probe: Any, at: Any, sums: Any, to: Any) -> Any:
    def body(weights: Any, probe: Any, at: Any, sums: Any, to: Any) -> None:
        _add_products(weights, probe, at, sums, to)

    return body

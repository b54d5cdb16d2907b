"""Integrals over the light that layers of Gaussians block, in NumPy."""

import numpy as np

from nanogs._types import F64

_SPLIT = 4.0  # from here on the continued fraction needs few terms
_TERMS = 32  # of the series up to the split: the remainder is below 1e-17 of it
_DEPTH = 24  # of the fraction from the split on: E1 is below 0.004 there and may be less exact
_FIRST = np.arange(1, _TERMS + 1, dtype=np.float64)
_COEFFICIENTS = np.cumsum(1 / _FIRST) / np.cumprod(_FIRST)

_FEW = 12.0  # layers; for fewer, quadrature of so many nodes is exact for whole numbers of them
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(6)
_NODES, _WEIGHTS = (_NODES + 1) / 2, _WEIGHTS / 2  # from 0 to 1


def exponential_integral(u: F64) -> F64:
    """Compute (N,) float64 Ein(u), the integral of (1 - exp(-t)) / t from 0 to u, for (N,) u >= 0.

    Up to 4 it is exp(-u) Σ H_k u^k / k! (Abramowitz and Stegun 5.1.11, after Kummer), whose terms
    are all positive, so that nothing cancels; from there on E1(u) + ln u + 0.5772, with E1 as a
    continued fraction (5.1.22).
    """
    found, few = np.empty_like(u), u < _SPLIT
    found[few], found[~few] = _ein_by_series(u[few]), _ein_by_fraction(u[~few])
    return found


def _ein_by_series(u: F64) -> F64:
    series = np.zeros_like(u)
    for coefficient in _COEFFICIENTS[::-1]:
        series += coefficient
        series *= u
    series *= np.exp(-u)
    return series


def _ein_by_fraction(u: F64) -> F64:
    below = np.zeros_like(u)
    for k in range(_DEPTH, 0, -1):
        below = k / (1.0 + k / (u + below))
    tail: F64 = np.exp(-u) / (u + below) + np.log(u) + np.euler_gamma
    return tail


def layers_integral(u: F64, n: F64) -> F64:
    """Compute (N,) float64, the integral of (1 - (1 - u g / n)^n) / g over g from 0 to 1.

    For n = 1 it is u, for n = 2 it is u - u² / 8, and for infinite n Ein(u). For few layers it is
    computed by quadrature, which is exact for whole n; for more, the terms of (1 - x / n)^n =
    exp(-x) (1 - x² / (2 n) - ...) beyond the second are below 1e-3.

    Args:
        u: (N,) 0 or more.
        n: (N,) numbers of layers, at least 1 and at least u.
    """
    found = np.empty_like(u)
    few = n < _FEW
    many = u[~few]
    rest = np.minimum(many, 700.0)  # exp(-700) is 0 beside 1, and nothing overflows
    found[~few] = exponential_integral(many) + (1 - (1 + rest) * np.exp(-rest)) / (2 * n[~few])
    u, n, total = u[few], n[few], np.zeros(np.count_nonzero(few))
    for node, weight in zip(_NODES.tolist(), _WEIGHTS.tolist(), strict=True):
        total -= weight / node * np.expm1(n * np.log1p(-u / n * node))
    found[few] = total
    return found

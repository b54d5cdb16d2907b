"""The entire exponential integral, in NumPy."""

import numpy as np

from nanogs._types import F64

_SPLIT = 4.0  # from here on the continued fraction needs few terms
_TERMS = 32  # of the series up to the split: the remainder is below 1e-17 of it
_DEPTH = 24  # of the fraction from the split on: E1 is below 0.004 there and may be less exact
_FIRST = np.arange(1, _TERMS + 1, dtype=np.float64)
_COEFFICIENTS = np.cumsum(1 / _FIRST) / np.cumprod(_FIRST)


def exponential_integral(u: F64) -> F64:
    """Compute (N,) float64 Ein(u), the integral of (1 - exp(-t)) / t from 0 to u, for (N,) u >= 0.

    Up to 4 it is exp(-u) Σ H_k u^k / k! (Abramowitz and Stegun 5.1.11, after Kummer), whose terms
    are all positive, so that nothing cancels; from there on E1(u) + ln u + 0.5772, with E1 as a
    continued fraction (5.1.22).
    """
    few, many = np.minimum(u, _SPLIT), np.maximum(u, _SPLIT)
    series = np.zeros_like(few)
    for coefficient in _COEFFICIENTS[::-1]:
        series += coefficient
        series *= few
    series *= np.exp(-few)
    below = np.zeros_like(many)
    for k in range(_DEPTH, 0, -1):
        below = k / (1.0 + k / (many + below))
    tail = np.exp(-many) / (many + below) + np.log(many) + np.euler_gamma
    return np.where(u < _SPLIT, series, tail)

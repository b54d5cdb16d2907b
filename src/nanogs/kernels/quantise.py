"""Kernels of scalar quantisation: optimal codebooks, and the nearest entries of values."""

import math

import numpy as np

from nanogs._types import F32, F64, I64, U8
from nanogs.kernels.policy import inline, kernel, parallel_kernel

_BITS = 8  # of a code


@inline
def _cost(w: F64, wx: F64, wxx: F64, first: int, stop: int) -> float:
    """Squared error of the bins [first, stop) about their mean, from prefix sums."""
    weight = w[stop] - w[first]
    if weight <= 0.0:
        return 0.0
    x = wx[stop] - wx[first]
    error: float = wxx[stop] - wxx[first] - x * x / weight
    return error


@inline
def _push(stack: I64, depth: int, low: int, high: int, least: int, most: int) -> int:
    # One number at a time: assigning a tuple to a row takes two seconds to compile.
    stack[depth, 0], stack[depth, 1], stack[depth, 2], stack[depth, 3] = low, high, least, most
    return depth + 1


@kernel
def optimal_cuts(centres: F64, weights: F64, cuts: I64) -> None:
    """Cut sorted bins into runs of least squared error: k-means in one dimension, but exact.

    Source: Grønlund et al., "Fast exact k-means, k-medians and Bregman divergence clustering in
    1D", 2017: the best last cut ascends with the number of bins, so that each row of the table is
    filled by divide and conquer.

    centres: (H,) ascending; weights: (H,) positive; cuts: (K + 1,) out, from 0 to H, K up to H.
    """
    bins, runs = len(centres), len(cuts) - 1
    w, wx, wxx = np.zeros(bins + 1), np.zeros(bins + 1), np.zeros(bins + 1)
    # Of centres relative to the middle one, and summed from there in both directions: a centre far
    # away would leave only rounding errors of the sums beyond it.
    origin = bins // 2
    for b in range(origin, bins):
        x = centres[b] - centres[origin]
        w[b + 1] = w[b] + weights[b]
        wx[b + 1] = wx[b] + weights[b] * x
        wxx[b + 1] = wxx[b] + weights[b] * x * x
    for b in range(origin - 1, -1, -1):
        x = centres[b] - centres[origin]
        w[b] = w[b + 1] - weights[b]
        wx[b] = wx[b + 1] - weights[b] * x
        wxx[b] = wxx[b + 1] - weights[b] * x * x
    before, after = np.empty(bins + 1), np.empty(bins + 1)
    last = np.zeros((runs + 1, bins + 1), dtype=np.int32)
    before[0] = math.inf
    for stop in range(1, bins + 1):
        before[stop] = _cost(w, wx, wxx, 0, stop)
    stack = np.empty((64, 4), dtype=np.int64)
    for run in range(2, runs + 1):
        after[:] = math.inf
        depth = _push(stack, 0, run, bins, run - 1, bins - 1)
        while depth:
            depth -= 1
            low, high = stack[depth, 0], stack[depth, 1]
            least, most = stack[depth, 2], stack[depth, 3]
            middle = (low + high) // 2
            best, chosen = math.inf, least
            for cut in range(least, min(most, middle - 1) + 1):
                cost = before[cut] + _cost(w, wx, wxx, cut, middle)
                if cost < best:
                    best, chosen = cost, cut
            after[middle], last[run, middle] = best, chosen
            if low < middle:
                depth = _push(stack, depth, low, middle - 1, least, chosen)
            if middle < high:
                depth = _push(stack, depth, middle + 1, high, chosen, most)
        before, after = after, before
    cuts[runs] = bins
    for run in range(runs, 0, -1):
        cuts[run - 1] = last[run, cuts[run]]
    cuts[0] = 0


@parallel_kernel("values", least=16384)
def count_lower(start: int, stop: int, values: F32, bounds: F64, codes: U8) -> None:
    """Count the bounds below each value, by bisection without branches.

    values: (N,) not NaN; bounds: (255,) ascending, the unused last ones infinite; codes: (N,) out.
    """
    for i in range(start, stop):
        value, below = np.float64(values[i]), 0
        for bit in range(_BITS):
            step = 1 << (_BITS - 1 - bit)
            below += step if bounds[below + step - 1] < value else 0
        codes[i] = below

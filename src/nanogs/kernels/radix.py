"""Sort 64-bit keys by their upper halves, on all threads."""

import numba
import numpy as np

from nanogs._types import I64, U64
from nanogs.kernels.policy import parallel_kernel

DIGITS, VALUES = 3, 2048  # of 11 bits each
_LEAST = 1 << 14  # least number of keys of a run


@parallel_kernel("counts", least=1)
def count_digits(start: int, stop: int, keys: U64, bounds: I64, digit: int, counts: I64) -> None:
    """Count the values of a digit in each run of keys.

    Args:
        start: First run of the range.
        stop: The run after its last.
        keys: (E,).
        bounds: (runs + 1,) where each run begins in `keys`.
        digit: Index of the digit, from 0 for the lowest of the upper half.
        counts: (runs, VALUES) out.
    """
    shift = np.uint64(32 + 11 * digit)
    for run in range(start, stop):
        counts[run] = 0
        for e in range(bounds[run], bounds[run + 1]):
            counts[run, (keys[e] >> shift) & np.uint64(VALUES - 1)] += 1


@parallel_kernel("places", least=1)
def move_keys(
    start: int, stop: int, keys: U64, bounds: I64, digit: int, places: I64, moved: U64
) -> None:
    """Move each run of keys to the places of their digits, keys of equal digits in order.

    Args:
        start: First run of the range.
        stop: The run after its last.
        keys: (E,).
        bounds: (runs + 1,) where each run begins.
        digit: Index of the digit, from 0 for the lowest of the upper half.
        places: (runs, VALUES) in, where the keys of each value begin; out, where they end.
        moved: (E,) out.
    """
    shift = np.uint64(32 + 11 * digit)
    for run in range(start, stop):
        for e in range(bounds[run], bounds[run + 1]):
            value = (keys[e] >> shift) & np.uint64(VALUES - 1)
            moved[places[run, value]] = keys[e]
            places[run, value] += 1


def radix_sort(keys: U64, other: U64) -> U64:
    """Sort by the upper 32 bits, in three stable passes from the lowest digit (Knuth 5.2.5).

    Args:
        keys: (E,) whose lower halves ascend, so that ties are in their order. Overwritten.
        other: (E,) scratch.

    Returns:
        `keys` or `other`, whichever holds the result, which is the same for any number of runs.
    """
    runs = max(1, min(2 * int(numba.get_num_threads()), len(keys) // _LEAST))
    bounds = len(keys) * np.arange(runs + 1) // runs
    for digit in range(DIGITS):
        counts = np.empty((runs, VALUES), np.int64)
        count_digits(keys, bounds, digit, counts)
        ends = np.cumsum(counts.T).reshape(VALUES, runs)
        move_keys(keys, bounds, digit, np.ascontiguousarray(ends.T) - counts, other)
        keys, other = other, keys
    return keys


def sorted_rows(keys: U64) -> I64:
    """(E,) int64, the lower halves of keys in the order of `radix_sort`; `keys` is overwritten."""
    found = radix_sort(keys, np.empty_like(keys))
    found &= np.uint64(0xFFFFFFFF)
    return found.view(np.int64)

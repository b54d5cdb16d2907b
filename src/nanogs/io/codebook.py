"""Codebooks: few values that stand for many, and the index of the nearest for each."""

import numpy as np

from nanogs._types import F32, F64, U8, Array

SIZE = 256
# Bins of equal width over the range. Rare values matter for the picture, a few large splats above
# all, so a bin counts by a power of the number of values in it.
BINS = 4096
RARITY = 0.5
NOTHING = 20.0  # a log-scale that much below the least stands for -inf: 2e-9 of the smallest


def codebook(values: F32, power: float = RARITY) -> F32:
    """(256,) ascending: the values to quantise to, for the least weighted squared error.

    Args:
        values: (N,) or any other shape; -inf gets an entry of its own below all others.
        power: 1 for the least squared error, less to give rare values more weight.
    """
    finite = values[np.isfinite(values)].astype(np.float64)
    lowest = finite.min() if len(finite) else 0.0
    nothing = [lowest - NOTHING] if len(finite) < values.size else []
    entries = _entries(finite, SIZE - len(nothing), power) if len(finite) else np.empty(0)
    book = np.concatenate([nothing, entries])
    # Unused entries repeat the last.
    return np.pad(book, (0, SIZE - len(book)), mode="edge").astype(np.float32)


def nearest(values: F32, book: F32) -> U8:
    """Index of the nearest entry for each value, in the same shape; ties go to the lower one.

    Args:
        values: Of any shape; -inf goes to the first entry.
        book: (256,) ascending.
    """
    middles = (book[1:].astype(np.float64) + book[:-1]) / 2
    return np.searchsorted(middles, values.ravel()).astype(np.uint8).reshape(values.shape)


def _entries(values: F64, most: int, power: float) -> F64:
    """At most so many values to quantise finite ones to."""
    distinct = np.unique(values) if values.size <= 1 << 16 else _some_distinct(values, most)
    if len(distinct) <= most:
        return distinct
    low, high = values.min(), values.max()
    bins = np.minimum((values - low) * (BINS / (high - low)), BINS - 1).astype(np.int64)
    counts = np.bincount(bins, minlength=BINS)
    sums = np.bincount(bins, values - low, minlength=BINS)
    used = counts > 0
    centres = low + sums[used] / counts[used]
    weights = counts[used].astype(np.float64) ** power
    if len(centres) <= most:
        return centres
    return _means_of_runs(centres, weights, most)


def _some_distinct(values: F64, most: int) -> F64:
    """The distinct values if they are at most so many, or else merely too many of them."""
    some = np.unique(values[: 1 << 14])
    return np.unique(values) if len(some) <= most else some


def _means_of_runs(centres: F64, weights: F64, count: int) -> F64:
    from nanogs.kernels.quantise import optimal_cuts

    cuts = np.empty(count + 1, np.int64)
    optimal_cuts(centres, weights, cuts)
    totals: Array = np.add.reduceat(weights, cuts[:-1])
    return np.add.reduceat(weights * centres, cuts[:-1]) / totals

"""Codebooks: few values that stand for many, and the index of the nearest for each."""

import numpy as np

from nanogs import spread
from nanogs._types import F32, F64, U8
from nanogs.io.sog.meta import CODES
from nanogs.slices import slices

BINS = 4096  # about, since an outlier leaves few evenly spaced ones to the others
# Rare values matter for the picture, a few large splats above all: a bin weighs by a power of the
# density of values in it.
RARITY = 0.5
NOTHING = 20.0  # a log-scale that much below the least stands for -inf: 2e-9 of the smallest


def codebook(values: F32, size: int = CODES, power: float = RARITY) -> F32:
    """(256,) ascending: the values to quantise to, for the least weighted squared error.

    Args:
        values: (N,) or any other shape; -inf gets an entry of its own below all others.
        size: How many of the entries differ, at least 2; the fewer, the better codes are packed.
        power: 1 for the least squared error, less to give rare values more weight.
    """
    finite = values[np.isfinite(values)].astype(np.float64)
    lowest = finite.min() if len(finite) else 0.0
    nothing = [lowest - NOTHING] if len(finite) < values.size else []
    entries = _entries(finite, size - len(nothing), power) if len(finite) else np.empty(0)
    book = np.concatenate([nothing, entries])
    # Unused entries repeat the last.
    return np.pad(book, (0, CODES - len(book)), mode="edge").astype(np.float32)


def nearest(values: F32, book: F32) -> U8:
    """Index of the nearest entry for each value, in the same shape; ties go to the lower one.

    Args:
        values: Of any shape; -inf goes to the first entry.
        book: (256,) ascending; of entries that repeat the last, none is chosen.
    """
    book = book[: np.searchsorted(book, book[-1]) + 1]
    middles = (book[1:].astype(np.float64) + book[:-1]) / 2
    flat = values.reshape(-1)
    indices = np.empty(len(flat), np.uint8)

    def find(part: slice) -> None:
        indices[part] = np.searchsorted(middles, flat[part])

    spread.each(slices(len(flat)), find)
    return indices.reshape(values.shape)


def _entries(values: F64, most: int, power: float) -> F64:
    """Choose the values, at most so many, that finite ones are quantised to."""
    values = np.sort(values)
    changes = np.flatnonzero(values[1:] != values[:-1]) + 1
    if len(changes) < most:
        distinct: F64 = values[np.concatenate([[0], changes])]
        return distinct
    edges = _edges(values)
    starts = np.searchsorted(values, edges[:-1])
    counts = np.diff(starts, append=len(values))
    used = counts > 0
    centres: F64 = np.add.reduceat(values, starts[used]) / counts[used]
    if len(centres) <= most:
        return centres
    tail = len(values) // 100
    # Bins about a value that is there many times are narrow, and must not weigh nothing.
    narrow = (values[-1 - tail] - values[tail]) / BINS
    widths = np.maximum(np.diff(edges), narrow)[used]
    return _means_of_runs(centres, counts[used] ** power * widths ** (1 - power), most)


def _edges(values: F64) -> F64:
    """Edges of bins for sorted values: half of them evenly spaced, half by rank."""
    even = np.linspace(values[0], values[-1], BINS // 2 + 1)
    ranks = np.linspace(0, len(values) - 1, BINS // 2 + 1).astype(np.int64)
    return np.unique(np.concatenate([even, values[ranks]]))


def _means_of_runs(centres: F64, weights: F64, count: int) -> F64:
    from nanogs.kernels.quantise import optimal_cuts

    cuts = np.empty(count + 1, np.int64)
    optimal_cuts(centres, weights, cuts)
    means: F64 = np.add.reduceat(weights * centres, cuts[:-1])
    return means / np.add.reduceat(weights, cuts[:-1])

"""Scalar quantisation: computing a codebook of few values, and the nearest entry for each value."""

import numpy as np

from nanogs._types import F32, F64, U8
from nanogs.io.sog.meta import CODES

# Approximate number of bins; many, because with an outlier few of the evenly spaced ones are left
# for all other values.
BINS = 4096
# Rare values, such as those of a few large splats, matter for the picture: a bin is weighted by
# this power of the density of values in it.
RARITY = 0.5
NOTHING = 20.0  # -inf is stored as the smallest log-scale minus this: 2e-9 of the smallest scale


def codebook(values: F32, size: int = CODES, power: float = RARITY) -> F32:
    """Compute a codebook, (256,) ascending, with the smallest weighted squared error.

    Args:
        values: (N,) or any other shape; -inf gets an entry of its own below all others.
        size: Number of distinct entries, at least 2; fewer make the codes compress better.
        power: 1 for the smallest plain squared error, less to give rare values more weight.
    """
    finite = np.sort(values[np.isfinite(values)]).astype(np.float64)  # float32 is sorted faster
    lowest = finite[0] if len(finite) else 0.0
    nothing = [lowest - NOTHING] if len(finite) < values.size else []
    entries = _entries(finite, size - len(nothing), power) if len(finite) else np.empty(0)
    book = np.concatenate([nothing, entries])
    # Unused entries repeat the last.
    return np.pad(book, (0, CODES - len(book)), mode="edge").astype(np.float32)


def nearest(values: F32, book: F32) -> U8:
    """Find the index of the nearest entry for each value, in the same shape; the lower of a tie.

    Args:
        values: Of any shape; -inf gets the first entry.
        book: (256,) ascending; entries that repeat the last value are never chosen.
    """
    from nanogs.kernels.quantise import count_lower

    book = book[: np.searchsorted(book, book[-1]) + 1]
    middles = np.full(CODES - 1, np.inf)
    middles[: len(book) - 1] = (book[1:].astype(np.float64) + book[:-1]) / 2
    indices = np.empty(values.size, np.uint8)
    count_lower(np.ascontiguousarray(values).reshape(-1), middles, indices)
    return indices.reshape(values.shape)


def json_values(values: F32) -> list[float]:
    """Convert to numbers with only the digits of float32; repeated, unused entries become 0.

    This saves thousands of bytes of JSON, which matters for small files.
    """
    used = np.diff(values, prepend=np.float32(np.nan)) != 0
    return [float(str(v)) if own else 0 for v, own in zip(values, used, strict=True)]


def _entries(values: F64, most: int, power: float) -> F64:
    """Choose at most `most` entries for finite values, ascending."""
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
    # Bins around a value that occurs many times are narrow; their weight must not become zero.
    narrow = (values[-1 - tail] - values[tail]) / BINS
    widths = np.maximum(np.diff(edges), narrow)[used]
    return _means_of_runs(centres, counts[used] ** power * widths ** (1 - power), most)


def _edges(values: F64) -> F64:
    """Compute the edges of bins for sorted values: half of them evenly spaced, half by rank."""
    even = np.linspace(values[0], values[-1], BINS // 2 + 1)
    ranks = np.linspace(0, len(values) - 1, BINS // 2 + 1).astype(np.int64)
    return np.unique(np.concatenate([even, values[ranks]]))


def _means_of_runs(centres: F64, weights: F64, count: int) -> F64:
    from nanogs.kernels.quantise import optimal_cuts

    cuts = np.empty(count + 1, np.int64)
    optimal_cuts(centres, weights, cuts)
    means: F64 = np.add.reduceat(weights * centres, cuts[:-1])
    return means / np.add.reduceat(weights, cuts[:-1])

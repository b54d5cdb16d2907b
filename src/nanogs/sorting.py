"""Sorting on all threads: the order that NumPy's stable sort gives, for any number of threads."""

import numba
import numpy as np

from nanogs import spread
from nanogs._types import I64, U64, Bool

_LEAST = 1 << 15  # keys that are worth a part of their own
_SAMPLE = 4096  # keys of which the parts' bounds are chosen


def stable_order(keys: U64) -> I64:
    """(N,) int64: rows in ascending order of their keys, ties by row.

    Each part has the keys between two bounds. Its rows ascend, so that parts which are stable make
    a whole that is. NumPy sorts faster where it need not be stable: equal keys, seldom many, are
    put right afterwards.

    Args:
        keys: (N,) uint64.
    """
    parts = min(2 * int(numba.get_num_threads()), len(keys) // _LEAST)
    if parts < 2 or numba.get_num_threads() == 1:
        return _order(keys)
    sample = np.sort(keys[:: len(keys) // _SAMPLE + 1])
    bounds = sample[len(sample) * np.arange(1, parts) // parts]

    def order(part: int) -> I64:
        rows = np.flatnonzero(_between(keys, bounds, part))
        ordered: I64 = rows.take(_order(keys.take(rows)))
        return ordered

    return np.concatenate(spread.results(range(parts), order))


def _between(keys: U64, bounds: U64, part: int) -> Bool:
    """(N,) bool: the keys of a part, from the bound before it up to but not the one after it."""
    found: Bool = np.ones(len(keys), bool) if part == 0 else keys >= bounds[part - 1]
    if part < len(bounds):
        found &= keys < bounds[part]
    return found


def _order(keys: U64) -> I64:
    """(N,) int64: as `stable_order`, on one thread."""
    order = np.argsort(keys)
    ascending = keys.take(order)
    equal = ascending[1:] == ascending[:-1]
    if equal.any():
        places = np.flatnonzero(np.append(equal, False) | np.append(False, equal))
        rows = order[places]
        order[places] = rows[np.lexsort((rows, ascending[places]))]
    return order

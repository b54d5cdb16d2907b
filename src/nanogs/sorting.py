"""Multi-threaded stable sort; the result equals NumPy's, for any number of threads."""

import numba
import numpy as np

from nanogs import parallel
from nanogs._types import I64, U64, Bool

_LEAST = 1 << 15  # least number of keys in a part
_SAMPLE = 4096  # keys sampled to choose the bounds of the parts


def stable_order(keys: U64) -> I64:
    """Return the (N,) int64 rows in ascending order of their keys, ties by row.

    The keys are divided into parts between sampled bounds, and each part is sorted by one thread.
    The rows of a part are collected in ascending order, so that stable parts make a stable whole.
    NumPy's unstable sort is faster, so the order of equal keys, which are few, is corrected
    afterwards.

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

    return np.concatenate(parallel.map_ordered(range(parts), order))


def _between(keys: U64, bounds: U64, part: int) -> Bool:
    """Return the (N,) bool mask of a part's keys, from its lower bound to its upper, exclusive."""
    found: Bool = np.ones(len(keys), bool) if part == 0 else keys >= bounds[part - 1]
    if part < len(bounds):
        found &= keys < bounds[part]
    return found


def _order(keys: U64) -> I64:
    """Sort on one thread; see `stable_order`."""
    order = np.argsort(keys)
    ascending = keys.take(order)
    equal = ascending[1:] == ascending[:-1]
    if equal.any():
        places = np.flatnonzero(np.append(equal, False) | np.append(False, equal))
        rows = order[places]
        order[places] = rows[np.lexsort((rows, ascending[places]))]
    return order

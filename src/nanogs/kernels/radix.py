"""Sort 64-bit keys by their upper halves."""

import numpy as np

from nanogs._types import U64
from nanogs.kernels.policy import kernel


@kernel
def radix_sort(keys: U64, other: U64) -> bool:
    """Sort by the upper 32 bits, in three stable passes from the lowest digit (Knuth 5.2.5).

    keys: (E,), whose lower halves ascend: they break ties; other: (E,) scratch. Returns whether
    the result is in `other`.
    """
    counts = np.zeros((3, 2048), dtype=np.int64)
    for key in keys:
        for digit in range(3):
            counts[digit, (key >> np.uint64(32 + 11 * digit)) & np.uint64(2047)] += 1
    source, target = keys, other
    moved = False
    for digit in range(3):
        shift = np.uint64(32 + 11 * digit)
        total = 0
        for value in range(2048):
            count = counts[digit, value]
            counts[digit, value] = total
            total += count
        for key in source:
            value = (key >> shift) & np.uint64(2047)
            target[counts[digit, value]] = key
            counts[digit, value] += 1
        source, target = target, source
        moved = not moved
    return moved

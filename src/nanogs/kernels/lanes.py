"""Distances and lists of neighbours for 16 queries; `simd/lanes.py` has the same in vectors.

A key is the upper half of the bits of a non-negative float64, as int32. Keys sort like the numbers.
"""

import numpy as np

from nanogs._types import F64, I32
from nanogs.kernels.policy import exact_simd_or_plain

LANES = 16


@exact_simd_or_plain
def distance_keys(points: F64, x: float, y: float, z: float, keys: I32, at: int) -> None:
    """Compute keys of the squared distances from 16 points to one.

    points: (48,) 16 x, 16 y, 16 z; keys: filled from place `at`.
    """
    for lane in range(LANES):
        dx, dy, dz = points[lane] - x, points[LANES + lane] - y, points[2 * LANES + lane] - z
        keys[at + lane] = np.float64(dx * dx + dy * dy + dz * dz).view(np.int64) >> 32


@exact_simd_or_plain
def box_keys(points: F64, boxes: F64, node: int, keys: I32) -> None:
    """Compute keys of the squared distances from 16 points to the box of a node.

    points: (48,); keys: (16,) or more, filled.
    """
    for lane in range(LANES):
        square = 0.0
        for axis in range(3):
            c = points[axis * LANES + lane]
            below, above = boxes[node, axis] - c, c - boxes[node, 3 + axis]
            offset = max(below, above, 0.0)
            square += offset * offset
        keys[lane] = np.float64(square).view(np.int64) >> 32


@exact_simd_or_plain
def within(keys: I32, at: int, bounds: I32) -> int:
    """Return a bit mask: bit l is set if keys[at + l] <= bounds[l], l from 0 to 15."""
    mask = 0
    for lane in range(LANES):
        mask |= int(keys[at + lane] <= bounds[lane]) << lane
    return mask


@exact_simd_or_plain
def lowest_bit(mask: int) -> int:
    """Return the index of the lowest bit set in a mask that is not 0."""
    place = 0
    while mask >> place & 1 == 0:
        place += 1
    return place


@exact_simd_or_plain
def insert(lists: I32, keys: I32, at: int, k: int) -> None:
    """Insert keys[at + l] into list l and drop that list's largest key, for all 16 lists.

    lists: (16 k,), list l in places l, 16 + l, ..., descending.
    """
    last = (k - 1) * LANES
    for place in range(last):
        after = max(lists[place + LANES], keys[at + place % LANES])
        lists[place] = min(lists[place], after)
    for lane in range(LANES):
        lists[last + lane] = min(lists[last + lane], keys[at + lane])

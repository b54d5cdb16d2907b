"""A balanced kd-tree over runs of 16 points, in place (Bentley 1975, boxes as in Samet 2006).

Node 1 is the root and covers all leaves; node i that covers leaves [first, last) has the children
2 i over [first, middle) and 2 i + 1 over [middle, last), middle = (first + last) // 2. Leaf l holds
points [16 l, 16 l + 16) of the reordered arrays. Every node has the tight box of its points, so
that a few points far away cost only the nodes that hold them.
"""

import numba
import numpy as np

from nanogs._types import F64, I32
from nanogs.kernels.lanes import LANES
from nanogs.kernels.policy import exact_inline, exact_parallel_kernel


@exact_inline
def _swap(points: F64, rows: I32, i: int, j: int) -> None:
    n = len(rows)
    points[i], points[j] = points[j], points[i]
    points[n + i], points[n + j] = points[n + j], points[n + i]
    points[2 * n + i], points[2 * n + j] = points[2 * n + j], points[2 * n + i]
    rows[i], rows[j] = rows[j], rows[i]


@exact_inline
def _middle_of(a: float, b: float, c: float) -> float:
    low, high = min(a, b), max(a, b)
    return max(low, min(high, c))


@exact_inline
def _pivot(points: F64, low: int, high: int) -> float:
    """Median of three, or of three medians of three, spread over [low, high]."""
    middle = (low + high) // 2
    step = (high - low) // 8
    if step < 16:
        return _middle_of(points[low], points[middle], points[high])
    return _middle_of(
        _middle_of(points[low], points[low + step], points[low + 2 * step]),
        _middle_of(points[middle - step], points[middle], points[middle + step]),
        _middle_of(points[high - 2 * step], points[high - step], points[high]),
    )


@exact_inline
def _select(points: F64, rows: I32, axis: int, low: int, high: int, middle: int) -> None:
    """Reorder points [low, high) by one coordinate around the one in the middle (Hoare's find)."""
    base = axis * len(rows)
    high -= 1
    while low < high:
        pivot = _pivot(points, base + low, base + high)
        i, j = low, high
        while i <= j:
            while points[base + i] < pivot:
                i += 1
            while points[base + j] > pivot:
                j -= 1
            if i <= j:
                _swap(points, rows, i, j)
                i += 1
                j -= 1
        if middle <= j:
            high = j
        elif middle >= i:
            low = i
        else:
            return


@exact_inline
def _bound(points: F64, low: int, high: int, boxes: F64, node: int, axis: int) -> float:
    """Write the node's interval on one axis; returns its length."""
    least = most = points[low]
    for i in range(low + 1, high):
        least = min(least, points[i])
        most = max(most, points[i])
    boxes[node, axis] = least
    boxes[node, 3 + axis] = most
    return float(most - least)


@exact_inline
def _split(points: F64, rows: I32, boxes: F64, node: int, first: int, last: int) -> None:
    """Box of a node, and its points reordered into those of its two children."""
    n = len(rows)
    low, high = first * LANES, min(last * LANES, n)
    widest, axis = 0.0, -1
    for candidate in range(3):
        start = candidate * n
        width = _bound(points, start + low, start + high, boxes, node, candidate)
        if width > widest:
            widest, axis = width, candidate
    if last - first > 1 and axis >= 0:
        _select(points, rows, axis, low, high, (first + last) // 2 * LANES)


@exact_inline
def _leaves_below(node: int, leaves: int) -> tuple[int, int]:
    """First and last leaf of a node, or (0, 0) where a node above it is a leaf already."""
    first, last, level = 0, leaves, 0
    while node >> level > 1:
        level += 1
    for bit in range(level - 1, -1, -1):
        if last - first < 2:
            return 0, 0
        middle = (first + last) // 2
        if node >> bit & 1:
            first = middle
        else:
            last = middle
    return first, last


@exact_inline
def _split_all(points: F64, rows: I32, boxes: F64, node: int, first: int, last: int) -> None:
    """Split a node and all nodes below it."""
    nodes = np.empty(64, dtype=np.int64)
    firsts = np.empty(64, dtype=np.int64)
    lasts = np.empty(64, dtype=np.int64)
    nodes[0], firsts[0], lasts[0] = node, first, last
    waiting = 1
    while waiting > 0:
        waiting -= 1
        node, first, last = nodes[waiting], firsts[waiting], lasts[waiting]
        _split(points, rows, boxes, node, first, last)
        if last - first > 1:
            middle = (first + last) // 2
            nodes[waiting], firsts[waiting], lasts[waiting] = 2 * node + 1, middle, last
            waiting += 1
            nodes[waiting], firsts[waiting], lasts[waiting] = 2 * node, first, middle
            waiting += 1


@exact_parallel_kernel
def build_tree(points: F64, rows: I32, boxes: F64, top: int) -> None:
    """Sort points into leaves; fill the boxes of all nodes.

    points: (3 N,) all x, all y, all z, reordered; rows: (N,) int32, reordered alike; boxes:
    (nodes, 6) lowest x, y, z and highest x, y, z, filled; top: levels split one node after the
    other, before the 2^top subtrees below them are split in parallel. It changes no result.
    """
    leaves = (len(rows) + LANES - 1) // LANES
    for node in range(1, 1 << top):
        first, last = _leaves_below(node, leaves)
        if last > first:
            _split(points, rows, boxes, node, first, last)
    for node in numba.prange(1 << top, 2 << top):
        first, last = _leaves_below(node, leaves)
        if last > first:
            _split_all(points, rows, boxes, node, first, last)

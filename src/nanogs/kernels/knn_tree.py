"""A balanced kd-tree over runs of 16 points, in place (Bentley 1975, boxes as in Samet 2006).

Node 1 is the root and covers all leaves; node i that covers leaves [first, last) has the children
2 i over [first, middle) and 2 i + 1 over [middle, last), middle = (first + last) // 2. Leaf l holds
points [16 l, 16 l + 16) of the reordered arrays. Every node has the tight bounding box of its
points, so that a few points far away affect only the nodes that hold them.
"""

import numpy as np

from nanogs._types import F64, I32, I64
from nanogs.kernels.lanes import LANES
from nanogs.kernels.policy import exact_inline, exact_parallel_kernel

DEEPEST = 64  # size of a search's stack for 2^31 points: one node per level, and a few
_SAMPLE = 31  # size of the sample that a pivot is chosen from, if many points are split


@exact_inline
def squared_length(x: float, y: float, z: float) -> float:
    """Return the squared length, computed as in `lanes.py`: equal pairs give equal numbers."""
    return x * x + y * y + z * z


@exact_inline
def push(stack: I64, waiting: int, node: int, first: int, last: int) -> int:
    """Push a node and its leaves [first, last) on a stack; return the number that wait there."""
    stack[3 * waiting] = node
    stack[3 * waiting + 1] = first
    stack[3 * waiting + 2] = last
    return waiting + 1


@exact_inline
def _swap(points: F64, rows: I32, i: int, j: int) -> None:
    n = len(rows)
    points[i], points[j] = points[j], points[i]
    points[n + i], points[n + j] = points[n + j], points[n + i]
    points[2 * n + i], points[2 * n + j] = points[2 * n + j], points[2 * n + i]
    rows[i], rows[j] = rows[j], rows[i]


@exact_inline
def _pivot(points: F64, low: int, high: int, middle: int, sample: F64) -> float:
    """Return a pivot that is likely a little beyond the value that belongs at `middle`.

    In a sorted sample of [low, high], it is the value at the rank of `middle`, moved by one rank
    towards the sample's median: the part that has to be searched is then likely the smaller one
    (Floyd and Rivest 1975).
    """
    span = high - low
    size = 3 if span < 64 else (7 if span < 1024 else _SAMPLE)
    for i in range(size):
        value = points[low + span * i // (size - 1)]
        hole = i
        while hole > 0 and sample[hole - 1] > value:
            sample[hole] = sample[hole - 1]
            hole -= 1
        sample[hole] = value
    rank = ((middle - low) * (size - 1) + span // 2) // span
    half = (size - 1) // 2
    if rank < half:
        rank += 1
    elif rank > half:
        rank -= 1
    return float(sample[rank])


@exact_inline
def _select(
    points: F64, rows: I32, axis: int, low: int, high: int, middle: int, sample: F64
) -> None:
    """Partition points [low, high) by one coordinate around that at `middle` (quickselect)."""
    base = axis * len(rows)
    high -= 1
    while low < high:
        pivot = _pivot(points, base + low, base + high, base + middle, sample)
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
def _bound(points: F64, n: int, low: int, high: int, boxes: F64, node: int) -> None:
    """Compute the bounding box of points [low, high).

    All axes are in one loop, because successive minima of one axis depend on each other.
    """
    x0 = x1 = points[low]
    y0 = y1 = points[n + low]
    z0 = z1 = points[2 * n + low]
    for i in range(low + 1, high):
        x, y, z = points[i], points[n + i], points[2 * n + i]
        x0, y0, z0 = min(x0, x), min(y0, y), min(z0, z)
        x1, y1, z1 = max(x1, x), max(y1, y), max(z1, z)
    boxes[node, 0], boxes[node, 1], boxes[node, 2] = x0, y0, z0
    boxes[node, 3], boxes[node, 4], boxes[node, 5] = x1, y1, z1


@exact_inline
def _split(
    points: F64, rows: I32, boxes: F64, node: int, first: int, last: int, sample: F64
) -> None:
    """Compute a node's box, and partition its points into those of its two children."""
    low, high = first * LANES, min(last * LANES, len(rows))
    _bound(points, len(rows), low, high, boxes, node)
    widest, axis = 0.0, -1
    for candidate in range(3):
        width = boxes[node, 3 + candidate] - boxes[node, candidate]
        if width > widest:
            widest, axis = width, candidate
    if last - first > 1 and axis >= 0:
        _select(points, rows, axis, low, high, (first + last) // 2 * LANES, sample)


@exact_inline
def _leaves_below(node: int, leaves: int) -> tuple[int, int]:
    """Return the leaves [first, last) of a node, or (0, 0) if a node above it is a leaf already."""
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
def _split_all(
    points: F64, rows: I32, boxes: F64, node: int, first: int, last: int, below: bool,
    sample: F64, stack: I64,
) -> None:  # fmt: skip
    """Split a node and, if `below`, all nodes below it.

    sample: (_SAMPLE,) and stack: (3 DEEPEST,) scratch.
    """
    waiting = push(stack, 0, node, first, last)
    while waiting > 0:
        waiting -= 1
        node, first, last = stack[3 * waiting], stack[3 * waiting + 1], stack[3 * waiting + 2]
        _split(points, rows, boxes, node, first, last, sample)
        if below and last - first > 1:
            middle = (first + last) // 2
            waiting = push(stack, waiting, 2 * node + 1, middle, last)
            waiting = push(stack, waiting, 2 * node, first, middle)


@exact_parallel_kernel("nodes", least=1)
def _split_nodes(
    start: int, stop: int, points: F64, rows: I32, boxes: F64, nodes: I64, below: bool
) -> None:
    """Split nodes of one level and, if `below`, all nodes below them."""
    leaves = (len(rows) + LANES - 1) // LANES
    sample, stack = np.empty(_SAMPLE), np.empty(3 * DEEPEST, np.int64)
    for place in range(start, stop):
        first, last = _leaves_below(nodes[place], leaves)
        if last > first:
            _split_all(points, rows, boxes, nodes[place], first, last, below, sample, stack)


def build_tree(points: F64, rows: I32, boxes: F64, top: int) -> None:
    """Build the tree: sort points into leaves and compute the boxes of all nodes.

    points: (3 N,) all x, all y, all z, reordered; rows: (N,) int32, reordered alike; boxes:
    (nodes, 6) lowest x, y, z and highest x, y, z, filled; top: number of levels that are split one
    after another, a thread for each node, before the 2^top subtrees below them. It changes no
    result.
    """
    for level in range(top + 1):
        nodes = np.arange(1 << level, 2 << level)
        _split_nodes(points, rows, boxes, nodes, level == top)

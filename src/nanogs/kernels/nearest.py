"""Nearest neighbours of query positions among the points of a tree."""

import math

import numpy as np

from nanogs._types import F64, I32
from nanogs.kernels.knn_tree import DEEPEST, push, squared_length
from nanogs.kernels.lanes import LANES
from nanogs.kernels.policy import exact_inline, exact_parallel_kernel


@exact_inline
def _to_box(x: float, y: float, z: float, boxes: F64, node: int) -> float:
    """Squared distance between a position and the box of a node."""
    return squared_length(
        max(0.0, boxes[node, 0] - x, x - boxes[node, 3]),
        max(0.0, boxes[node, 1] - y, y - boxes[node, 4]),
        max(0.0, boxes[node, 2] - z, z - boxes[node, 5]),
    )


@exact_parallel_kernel("places")
def find_nearest(
    start: int, stop: int,
    places: F64, points: F64, rows: I32, boxes: F64, distances: F64, nearest: I32,
) -> None:  # fmt: skip
    """Find the nearest point to each position, by (squared distance, row), and its distance.

    places: (Q, 3) positions; points (3 N,), rows (N,), boxes: from `build_tree`; distances,
    nearest: (Q,) out.
    """
    n = len(rows)
    stack = np.empty(3 * DEEPEST, dtype=np.int64)
    gaps = np.empty(DEEPEST)
    for place in range(start, stop):
        x, y, z = places[place, 0], places[place, 1], places[place, 2]
        least, found, waiting = np.inf, -1, 1
        stack[0], stack[1], stack[2], gaps[0] = 1, 0, (n + LANES - 1) // LANES, 0.0
        while waiting > 0:
            waiting -= 1
            node, first, last = stack[3 * waiting], stack[3 * waiting + 1], stack[3 * waiting + 2]
            if gaps[waiting] > least:
                continue
            if last - first > 1:
                middle = (first + last) // 2
                left = _to_box(x, y, z, boxes, 2 * node)
                right = _to_box(x, y, z, boxes, 2 * node + 1)
                for side in (left > right, left <= right):  # the nearer one on top
                    gaps[waiting] = left if side else right
                    if side:
                        waiting = push(stack, waiting, 2 * node, first, middle)
                    else:
                        waiting = push(stack, waiting, 2 * node + 1, middle, last)
                continue
            for p in range(first * LANES, min(n, last * LANES)):
                square = squared_length(x - points[p], y - points[n + p], z - points[2 * n + p])
                if square < least or (square == least and rows[p] < found):
                    least, found = square, rows[p]
        distances[place], nearest[place] = math.sqrt(least), found

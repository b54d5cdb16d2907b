"""Kernels of the scale of a scene around points, and of how near viewers are to them."""

import math

from nanogs._types import F64
from nanogs.kernels.policy import parallel_kernel


@parallel_kernel("out")
def least_distances(start: int, stop: int, points: F64, anchors: F64, radii: F64, out: F64) -> None:
    """Compute the least sqrt(r² + d²) over all anchors, with radius r and distance d of each.

    points: (N, 3); anchors: (A, 3), A >= 1, and radii: (A,), scene units; out: (N,).
    """
    for i in range(start, stop):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        least = math.inf
        for a in range(len(anchors)):
            dx, dy, dz = x - anchors[a, 0], y - anchors[a, 1], z - anchors[a, 2]
            least = min(least, radii[a] * radii[a] + dx * dx + dy * dy + dz * dz)
        out[i] = math.sqrt(least)


@parallel_kernel("out")
def nearness(start: int, stop: int, points: F64, places: F64, square: float, out: F64) -> None:
    """Compute the mean of 1 / (1 + d² / square) over all places, with d the distance to each.

    points: (N, 3); places: (V, 3), V >= 1, positions of viewers, scene units; square: above 0, a
    squared distance; out: (N,).
    """
    for i in range(start, stop):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        total = 0.0
        for v in range(len(places)):
            dx, dy, dz = x - places[v, 0], y - places[v, 1], z - places[v, 2]
            total += square / (square + dx * dx + dy * dy + dz * dz)
        out[i] = total / len(places)

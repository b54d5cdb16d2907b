"""How far the surroundings of a point reach, from those of a few others."""

import math

from nanogs._types import F64
from nanogs.kernels.policy import parallel_kernel


@parallel_kernel("out")
def reach(start: int, stop: int, points: F64, anchors: F64, radii: F64, out: F64) -> None:
    """The least sqrt(r² + d²) over all anchors, for radius r and distance d of each.

    points: (N, 3); anchors: (A, 3), A >= 1, and radii: (A,), scene units; out: (N,).
    """
    for i in range(start, stop):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        least = math.inf
        for a in range(len(anchors)):
            dx, dy, dz = x - anchors[a, 0], y - anchors[a, 1], z - anchors[a, 2]
            least = min(least, radii[a] * radii[a] + dx * dx + dy * dy + dz * dz)
        out[i] = math.sqrt(least)

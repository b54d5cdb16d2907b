"""Test whether a splat has others on all sides, so that it can grow without leaving the surface."""

import math

from nanogs._types import F32, F64, I32
from nanogs.kernels.nodes import symmetric
from nanogs.kernels.policy import inline, parallel_kernel
from nanogs.kernels.quaternion import rotation_matrix, row3
from nanogs.kernels.symmetric3 import adjugate_product, determinant

AWAY = 3.5  # standard deviations to either side where alpha is summed; a splat ends beyond 3
THICK = 0.3  # others are thickened by this share of the middle deviation: surfaces are curved
ENOUGH = 0.4  # sum of the others' alphas there that counts as fully covered


@inline
def _alpha(
    x: float, y: float, z: float, thick: float,
    rows: I32, own: int, means: F64, covariances: F64, alphas: F64,
) -> float:  # fmt: skip
    """Sum the alphas of splats but `own` at a point, each thickened by the variance `thick`."""
    total = 0.0
    for other in rows:
        if other == own:
            continue
        xx, xy, xz, yy, yz, zz = symmetric(covariances, other)
        matrix = (xx + thick, xy, xz, yy + thick, yz, zz + thick)
        volume = determinant(matrix)
        if volume > 0.0:
            offset = x - means[other, 0], y - means[other, 1], z - means[other, 2]
            total += alphas[other] * math.exp(-0.5 * adjugate_product(matrix, offset) / volume)
    return total


@parallel_kernel("shares")
def covered_sides(
    start: int, stop: int, groups: I32, scales: F32, quats: F32, neighbours: I32,
    means: F64, covariances: F64, alphas: F64, shares: F64,
) -> None:  # fmt: skip
    """Compute the coverage by its neighbours of each splat's least covered side.

    The four sides are both ends of the two longer axes. `shares` is the sum of the neighbours'
    alphas there over `ENOUGH`, at most 1.
    groups: (R,) rows of the splats; scales (R, 3), scene units, and quats (R, 4), wxyz unit, of
    these; neighbours: (G, k) rows; means (G, 3), covariances (G, 6) and alphas (G,) of all; shares:
    (R,) out.
    """
    for row in range(start, stop):
        own = groups[row]
        (a, b, c), (d, e, f), (g, h, i) = rotation_matrix(quats[row])
        first, second, third = row3(scales, row)
        shortest, longest = min(first, second, third), max(first, second, third)
        thick = THICK * (first + second + third - shortest - longest)
        least, left_out = ENOUGH, False
        for x, y, z, scale in ((a, d, g, first), (b, e, h, second), (c, f, i, third)):
            if scale == shortest and not left_out:
                left_out = True
                continue
            for away in (-AWAY * scale, AWAY * scale):
                found = _alpha(
                    means[own, 0] + away * x, means[own, 1] + away * y, means[own, 2] + away * z,
                    thick * thick, neighbours[own], own, means, covariances, alphas,
                )  # fmt: skip
                least = min(least, found)
        shares[row] = least / ENOUGH

"""Growth of groups of splats on flat sheets, so that no light passes between the merged splats."""

import math

from nanogs._types import F64, I32, I64
from nanogs.kernels.nodes import symmetric
from nanogs.kernels.policy import inline, parallel_kernel
from nanogs.kernels.symmetric3 import Symmetric3, adjugate_product, eigen

FEWEST = 4  # least number of means to test for a plane
FLATNESS = 0.04  # thickness of a sheet over its width
NARROWEST = 0.1  # least width of a sheet over its length
DENSE = 3.6  # layers of Gaussians that let no light through


@inline
def _growth(means: Symmetric3, whole: Symmetric3) -> float:
    """Compute the growth of one group from the covariance of its means and that of the whole."""
    (a, b, c), (first, second, third) = eigen(means)
    low, high = min(a, b, c), max(a, b, c)
    middle = a + b + c - low - high
    if not middle > NARROWEST * NARROWEST * high:
        return 0.0
    axis = 0 if a == low else (1 if b == low else 2)
    across = adjugate_product(whole, (first[axis], second[axis], third[axis]))
    flat = math.exp(-max(low, 0.0) / (middle * FLATNESS * FLATNESS))
    # A rectangle with standard deviations s1 and s2 has the area 12 s1 s2; a Gaussian covers 2 pi
    # times the product of its own.
    layers = 2.0 * math.pi * math.sqrt(max(across, 0.0)) / (12.0 * math.sqrt(middle * high))
    return flat * math.sqrt(DENSE / max(layers, 1e-3))


@parallel_kernel("growths")
def sheet_growths(
    start: int, stop: int,
    starts: I64, members: I32, weights: F64, means: F64,
    totals: F64, centres: F64, covariances: F64, growths: F64,
) -> None:  # fmt: skip
    """Compute the factor by which the axes of each group on a sheet must grow to let no light by.

    exp(-(s3 / s2)² / FLATNESS²) sqrt(DENSE / layers) for standard deviations s1 >= s2 >= s3 of the
    members' means about the group's, with layers the area of the Gaussian over that of the group's
    piece of the sheet; 0 for fewer than four means and for those on a line.
    starts (G + 1,) and members (N,): from `group_members`; weights: (N,); means: (N, 3); totals
    (G,), centres (G, 3), covariances (G, 6): from `gather_moments`; growths: (G,) out.
    """
    for group in range(start, stop):
        first, end = starts[group], starts[group + 1]
        growths[group] = 0.0
        if end - first < FEWEST:
            continue
        xx = xy = xz = yy = yz = zz = 0.0
        for place in range(first, end):
            row = members[place]
            share = weights[row] / totals[group]
            x = means[row, 0] - centres[group, 0]
            y = means[row, 1] - centres[group, 1]
            z = means[row, 2] - centres[group, 2]
            xx, xy, xz = xx + share * x * x, xy + share * x * y, xz + share * x * z
            yy, yz, zz = yy + share * y * y, yz + share * y * z, zz + share * z * z
        growths[group] = _growth((xx, xy, xz, yy, yz, zz), symmetric(covariances, group))

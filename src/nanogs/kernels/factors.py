"""Factors of covariances, from stored rotations and scales."""

import math

import numpy as np

from nanogs._types import F32
from nanogs.kernels.policy import exact_parallel_kernel


@exact_parallel_kernel("quats")
def factor_rows(start: int, stop: int, quats: F32, scales: F32, factors: F32) -> None:
    """Compute R diag(s) of each splat in single precision, as `activations` does in NumPy.

    Args:
        start: First splat of the range.
        stop: The splat after its last.
        quats: (N, 4) of any length, wxyz; zero is the identity, infinite values give NaN.
        scales: (N, 3) standard deviations, scene units.
        factors: (N, 3, 3) out, scene units.
    """
    one, two = np.float32(1.0), np.float32(2.0)
    for i in range(start, stop):
        w, x, y, z = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
        largest = max(abs(w), abs(x), abs(y), abs(z))
        if largest == 0.0:
            w, largest = one, one
        w, x, y, z = w / largest, x / largest, y / largest, z / largest
        length = np.float32(math.sqrt((w * w + x * x) + (y * y + z * z)))
        w, x, y, z = w / length, x / length, y / length, z / length
        a, b, c = scales[i, 0], scales[i, 1], scales[i, 2]
        factors[i, 0, 0] = (one - two * (y * y + z * z)) * a
        factors[i, 0, 1] = two * (x * y - w * z) * b
        factors[i, 0, 2] = two * (x * z + w * y) * c
        factors[i, 1, 0] = two * (x * y + w * z) * a
        factors[i, 1, 1] = (one - two * (x * x + z * z)) * b
        factors[i, 1, 2] = two * (y * z - w * x) * c
        factors[i, 2, 0] = two * (x * z - w * y) * a
        factors[i, 2, 1] = two * (y * z + w * x) * b
        factors[i, 2, 2] = (one - two * (x * x + y * y)) * c

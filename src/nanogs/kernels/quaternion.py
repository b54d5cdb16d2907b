"""Unit quaternions (wxyz) to rotation matrices and back, one at a time."""

import math

import numpy as np

from nanogs._types import F32, F
from nanogs.kernels.policy import inline

Row3 = tuple[float, float, float]
Matrix3 = tuple[Row3, Row3, Row3]


@inline
def row3(array: F32, row: int) -> Row3:
    """Return a row of an (N, 3) array in float64, which products of thin splats need."""
    return np.float64(array[row, 0]), np.float64(array[row, 1]), np.float64(array[row, 2])


@inline
def rotation_matrix(quat: F) -> Matrix3:
    """Rows of the rotation matrix of a (4,) unit quaternion, wxyz; its columns are the axes."""
    w, x = np.float64(quat[0]), np.float64(quat[1])
    y, z = np.float64(quat[2]), np.float64(quat[3])
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


@inline
def unit_quaternion(rows: Matrix3) -> tuple[float, float, float, float]:
    """Unit quaternion of a rotation matrix, wxyz with w >= 0 (Shepperd 1978).

    Of four formulas, the one with the largest divisor is used, which is never near zero.
    """
    (a, b, c), (d, e, f), (g, h, i) = rows
    trace = a + e + i
    if trace >= max(a, e, i):
        q = (1.0 + trace, h - f, c - g, d - b)
    elif a >= e and a >= i:
        q = (h - f, 1.0 + a - e - i, b + d, c + g)
    elif e >= i:
        q = (c - g, b + d, 1.0 - a + e - i, f + h)
    else:
        q = (d - b, c + g, f + h, 1.0 - a - e + i)
    w, x, y, z = q
    scale = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    if w < 0.0:
        scale = -scale
    return w * scale, x * scale, y * scale, z * scale

"""Symmetric 3x3 matrices as six numbers, in the order xx, xy, xz, yy, yz, zz."""

import math

from nanogs.kernels.policy import inline
from nanogs.kernels.quaternion import Matrix3, Row3

Symmetric3 = tuple[float, float, float, float, float, float]

MOST_DEVIATION = 3.4e38  # the exponential of its logarithm is still finite in float32

# Cyclic Jacobi on 3x3 converges quadratically, in five or six sweeps; the bound is never reached.
_MAX_SWEEPS = 20
_OFF_DIAGONAL = 1e-32  # squared, relative to the largest entry: below float64's resolution
# Relative rounding errors of a product of entries that cancel.
_ROUNDING = 1e-16
_UNRESOLVED = 1e-14


@inline
def covariance(rows: Matrix3, vx: float, vy: float, vz: float) -> Symmetric3:
    """R diag(v) R^T for a rotation and the variances along its columns."""
    (a, b, c), (d, e, f), (g, h, i) = rows
    return (
        a * a * vx + b * b * vy + c * c * vz,
        a * d * vx + b * e * vy + c * f * vz,
        a * g * vx + b * h * vy + c * i * vz,
        d * d * vx + e * e * vy + f * f * vz,
        d * g * vx + e * h * vy + f * i * vz,
        g * g * vx + h * h * vy + i * i * vz,
    )


@inline
def mix(p: float, s: Symmetric3, q: float, t: Symmetric3, pq: float, d: Row3) -> Symmetric3:
    """Covariance of a mixture of two: p S + q T + pq d d^T, d the difference of the means."""
    x, y, z = d
    return (
        p * s[0] + q * t[0] + pq * x * x,
        p * s[1] + q * t[1] + pq * x * y,
        p * s[2] + q * t[2] + pq * x * z,
        p * s[3] + q * t[3] + pq * y * y,
        p * s[4] + q * t[4] + pq * y * z,
        p * s[5] + q * t[5] + pq * z * z,
    )


@inline
def log_det(s: Symmetric3, floor: float) -> float:
    """Logarithm of the determinant of a matrix whose eigenvalues are all at least `floor`.

    The pivots of an LDL^T factorisation are at least the smallest eigenvalue; clamping them to
    `floor` only undoes rounding.
    """
    d0 = max(s[0], floor)
    l1 = s[1] / d0
    l2 = s[2] / d0
    d1 = max(s[3] - l1 * s[1], floor)
    u = s[4] - l1 * s[2]
    d2 = max(s[5] - l2 * s[2] - u * u / d1, floor)
    return math.log(d0) + math.log(d1) + math.log(d2)


@inline
def determinant(s: Symmetric3) -> float:
    """The determinant, by cofactors."""
    xx, xy, xz, yy, yz, zz = s
    return (
        xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    )  # fmt: skip


@inline
def adjugate(s: Symmetric3) -> Symmetric3:
    """The adjugate: the matrix of cofactors, also symmetric."""
    xx, xy, xz, yy, yz, zz = s
    return (
        yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy,
        xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy,
    )  # fmt: skip


@inline
def adjugate_product(s: Symmetric3, d: Row3) -> float:
    """d^T adj(S) d: for a unit vector, the determinant of a covariance as seen along it."""
    xx, xy, xz, yy, yz, zz = adjugate(s)
    x, y, z = d
    return x * x * xx + y * y * yy + z * z * zz + 2.0 * (x * y * xy + x * z * xz + y * z * yz)


@inline
def resolved(s: Symmetric3) -> bool:
    """Return whether the determinant of a covariance is larger than its rounding error.

    It is not if splats far apart were merged: the long axis then hides the short ones.
    """
    return determinant(s) > _UNRESOLVED * s[0] * s[3] * s[5]


@inline
def log_determinant(s: Symmetric3) -> float:
    """Logarithm of the determinant of a covariance whose diagonal is above 0; always finite.

    If the determinant is lost to rounding, so are the pivots of an LDL^T factorisation; each is
    then at least the rounding error of its diagonal entry.
    """
    if resolved(s):
        return math.log(determinant(s))
    slope = s[1] / s[0]
    d1 = max(s[3] - slope * s[1], _ROUNDING * s[3])
    u = s[4] - slope * s[2]
    d2 = max(s[5] - s[2] / s[0] * s[2] - u / d1 * u, _ROUNDING * s[5])
    return math.log(s[0]) + math.log(d1) + math.log(d2)


@inline
def deviation(variance: float, largest: float) -> float:
    """Square root of an eigenvalue, clamped so that float32 can hold it and its logarithm.

    Rounding can make the small eigenvalues of a long covariance zero or negative, so that no
    variance is taken as less than the rounding error of the largest.
    """
    return min(math.sqrt(max(variance, _ROUNDING * largest)), MOST_DEVIATION)


@inline
def _rotate(p: float, q: float, r: float) -> tuple[float, float]:
    """Cosine and sine of the Jacobi rotation that annihilates q in ((p, q), (q, r)).

    Equal diagonals turn by 45 degrees: the sign of zero is taken as +1 (Golub & Van Loan, 8.5).
    """
    if q == 0.0:
        return 1.0, 0.0
    theta = (r - p) / (2.0 * q)
    t = 1.0 / (abs(theta) + math.sqrt(theta * theta + 1.0))
    if theta < 0.0:
        t = -t
    cosine = 1.0 / math.sqrt(t * t + 1.0)
    return cosine, t * cosine


@inline
def eigen(s: Symmetric3) -> tuple[tuple[float, float, float], Matrix3]:
    """Eigenvalues and a rotation whose columns are the eigenvectors, by cyclic Jacobi.

    Works on the matrix divided by its largest entry, so that the unit of length does not matter.
    """
    largest = max(abs(s[0]), abs(s[1]), abs(s[2]), abs(s[3]), abs(s[4]), abs(s[5]))
    if largest == 0.0:
        return (0.0, 0.0, 0.0), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    xx, xy, xz = s[0] / largest, s[1] / largest, s[2] / largest
    yy, yz, zz = s[3] / largest, s[4] / largest, s[5] / largest
    a, b, c = 1.0, 0.0, 0.0
    d, e, f = 0.0, 1.0, 0.0
    g, h, i = 0.0, 0.0, 1.0
    for _ in range(_MAX_SWEEPS):
        if xy * xy + xz * xz + yz * yz <= _OFF_DIAGONAL:
            break
        co, si = _rotate(xx, xy, yy)
        xx, yy = xx - si / co * xy, yy + si / co * xy
        xy, xz, yz = 0.0, co * xz - si * yz, si * xz + co * yz
        a, b, d, e, g, h = (
            co * a - si * b, si * a + co * b, co * d - si * e,
            si * d + co * e, co * g - si * h, si * g + co * h,
        )  # fmt: skip
        co, si = _rotate(xx, xz, zz)
        xx, zz = xx - si / co * xz, zz + si / co * xz
        xz, xy, yz = 0.0, co * xy - si * yz, si * xy + co * yz
        a, c, d, f, g, i = (
            co * a - si * c, si * a + co * c, co * d - si * f,
            si * d + co * f, co * g - si * i, si * g + co * i,
        )  # fmt: skip
        co, si = _rotate(yy, yz, zz)
        yy, zz = yy - si / co * yz, zz + si / co * yz
        yz, xy, xz = 0.0, co * xy - si * xz, si * xy + co * xz
        b, c, e, f, h, i = (
            co * b - si * c, si * b + co * c, co * e - si * f,
            si * e + co * f, co * h - si * i, si * h + co * i,
        )  # fmt: skip
    return (xx * largest, yy * largest, zz * largest), ((a, b, c), (d, e, f), (g, h, i))


@inline
def shortest_last(
    variances: tuple[float, float, float], axes: Matrix3
) -> tuple[tuple[float, float, float], Matrix3]:
    """Reorder what `eigen` returns so that the smallest variance is last, and its axis the third.

    The rasteriser of 2DGS takes the third axis of a splat as the normal of its plane. The order is
    cyclic, so that the axes remain those of a rotation.
    """
    (u, v, w), ((a, b, c), (d, e, f), (g, h, i)) = variances, axes
    if u < v and u < w:
        return (v, w, u), ((b, c, a), (e, f, d), (h, i, g))
    if v < w:
        return (w, u, v), ((c, a, b), (f, d, e), (i, g, h))
    return variances, axes

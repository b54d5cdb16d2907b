"""The published cost of replacing two splats by one (arXiv 2603.16103)."""

import math

import numpy as np

from nanogs._types import F32, F64, I32
from nanogs.kernels.lazy_features import feature
from nanogs.kernels.mass import mass_fraction
from nanogs.kernels.policy import inline, parallel_kernel
from nanogs.kernels.quaternion import Matrix3, Row3, rotation_matrix, row3
from nanogs.kernels.symmetric3 import covariance, log_det, mix

LOG_2PI = math.log(2.0 * math.pi)


@inline
def _log_density(rows: Matrix3, v: Row3, log_det_v: float, d: Row3) -> float:
    """Log N(mean + d) of a normal with covariance R diag(v) R^T."""
    (a, b, c), (e, f, g), (h, i, j) = rows
    x, y, z = d
    px = a * x + e * y + h * z
    py = b * x + f * y + i * z
    pz = c * x + g * y + j * z
    return -0.5 * (3.0 * LOG_2PI + log_det_v + px * px / v[0] + py * py / v[1] + pz * pz / v[2])


@inline
def _log_add(a: float, b: float) -> float:
    """log(exp a + exp b), with either or both -inf."""
    high = max(a, b)
    if high == -math.inf:
        return high
    return high + math.log1p(math.exp(min(a, b) - high))


@inline
def _log(value: float) -> float:
    return math.log(value) if value > 0.0 else -math.inf


@inline
def _expected_log_mixture(
    rows: Matrix3, v: Row3, log_det_v: float, log_share: float,
    other: Matrix3, u: Row3, log_det_u: float, log_other_share: float,
    offset: Row3, normals: F64,
) -> float:  # fmt: skip
    """Monte Carlo mean of log p(x), p the mixture and x drawn from the first component.

    offset: from the other component's mean to the first one's.
    """
    (a, b, c), (d, e, f), (g, h, i) = rows
    sx, sy, sz = math.sqrt(v[0]), math.sqrt(v[1]), math.sqrt(v[2])
    total = 0.0
    for draw in range(len(normals)):
        zx, zy, zz = normals[draw, 0], normals[draw, 1], normals[draw, 2]
        own = -0.5 * (3.0 * LOG_2PI + log_det_v + zx * zx + zy * zy + zz * zz)
        zx, zy, zz = zx * sx, zy * sy, zz * sz
        x = offset[0] + a * zx + b * zy + c * zz
        y = offset[1] + d * zx + e * zy + f * zz
        z = offset[2] + g * zx + h * zy + i * zz
        theirs = _log_density(other, u, log_det_u, (x, y, z))
        total += _log_add(log_share + own, log_other_share + theirs)
    return total / len(normals)


@parallel_kernel("pairs")
def published_costs(
    start: int, stop: int,
    pairs: I32, means: F64, scales: F32, quats: F32, log_masses: F64,
    features: F32, rows: I32, second_rows: I32, shares: F64,
    normals: F64, jitter: float, lambda_geo: float, lambda_app: float, out: F32,
) -> None:  # fmt: skip
    """C = lambda_geo KL(pi N_i + (1 - pi) N_j || N_m) + lambda_app |f_i - f_j|^2 for each pair.

    pairs: (E, 2); means, scales: (N, 3); quats: (N, 4) wxyz unit; log_masses: (N,);
    features: (F, C), rows, second_rows and shares: see `lazy_features.py`; normals: (S, 3)
    standard normal draws; jitter: added to every variance, squared scene units; out: (E,).
    """
    for edge in range(start, stop):
        i, j = pairs[edge, 0], pairs[edge, 1]
        ri = rotation_matrix(quats[i])
        rj = rotation_matrix(quats[j])
        six, siy, siz = row3(scales, i)
        sjx, sjy, sjz = row3(scales, j)
        vi = (six * six + jitter, siy * siy + jitter, siz * siz + jitter)
        vj = (sjx * sjx + jitter, sjy * sjy + jitter, sjz * sjz + jitter)
        di = math.log(vi[0]) + math.log(vi[1]) + math.log(vi[2])
        dj = math.log(vj[0]) + math.log(vj[1]) + math.log(vj[2])
        pi = mass_fraction(log_masses[i], log_masses[j])
        pj = 1.0 - pi
        x = means[i, 0] - means[j, 0]
        y = means[i, 1] - means[j, 1]
        z = means[i, 2] - means[j, 2]
        merged = mix(
            pi, covariance(ri, vi[0], vi[1], vi[2]), pj, covariance(rj, vj[0], vj[1], vj[2]),
            pi * pj, (x, y, z),
        )  # fmt: skip
        # E_p[-log q] has a closed form, because q has the mixture's own mean and covariance; it is
        # jittered like every other covariance.
        xx, xy, xz, yy, yz, zz = merged
        single = (xx + jitter, xy, xz, yy + jitter, yz, zz + jitter)
        kl = 0.5 * (3.0 * LOG_2PI + log_det(single, jitter) + 3.0)
        li, lj = _log(pi), _log(pj)
        if pi > 0.0:
            kl += pi * _expected_log_mixture(ri, vi, di, li, rj, vj, dj, lj, (x, y, z), normals)
        if pj > 0.0:
            kl += pj * _expected_log_mixture(rj, vj, dj, lj, ri, vi, di, li, (-x, -y, -z), normals)
        distance = np.float64(0.0)
        for c in range(features.shape[1]):
            difference = feature(features, rows, second_rows, shares, i, c) - feature(
                features, rows, second_rows, shares, j, c
            )
            distance += difference * difference
        out[edge] = lambda_geo * kl + lambda_app * distance

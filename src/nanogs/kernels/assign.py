"""Assign splats to clusters: the classification step of hard EM, and moves of single splats.

Source of the moves: Hartigan, "Clustering Algorithms", 1975, section 4.2, for k-means.
"""

import math

import numpy as np

from nanogs._types import F32, F64, I32, I64, Bool
from nanogs.kernels.blocks import prefetch_row
from nanogs.kernels.lazy_features import AHEAD
from nanogs.kernels.nodes import symmetric
from nanogs.kernels.policy import inline, kernel, parallel_kernel
from nanogs.kernels.symmetric3 import Symmetric3, adjugate, log_determinant, mix, resolved

_ALL = 1e-6  # share of a cluster's weight below which what a splat leaves is lost to rounding
_LEAST = 1e-6  # least variance over the sum of all three, as of the flattest splats


@inline
def _inverse(s: Symmetric3) -> tuple[Symmetric3, float]:
    """Compute inverse and log determinant of a covariance, by cofactors.

    If its short axes are lost to rounding, a small share of the trace is added to the diagonal.
    """
    xx, xy, xz, yy, yz, zz = s
    if not resolved(s):
        least = _LEAST * (xx + yy + zz)
        xx, yy, zz = xx + least, yy + least, zz + least
    a, b, c, d, e, f = adjugate((xx, xy, xz, yy, yz, zz))
    determinant = xx * a + xy * b + xz * c
    r = 1.0 / determinant
    return (a * r, b * r, c * r, d * r, e * r, f * r), math.log(determinant)


@inline
def _blurred(s: Symmetric3, deviation: float) -> Symmetric3:
    """Add the square of a deviation in all directions."""
    variance = np.float64(deviation) * np.float64(deviation)
    xx, xy, xz, yy, yz, zz = s
    return xx + variance, xy, xz, yy + variance, yz, zz + variance


@inline
def _apart(features: F32, row: int, colours: F32, cluster: int) -> float:
    """Return |f - f_c|² of a splat and a cluster."""
    total = 0.0
    for channel in range(features.shape[1]):
        difference = features[row, channel] - colours[cluster, channel]
        total += difference * difference
    return total


@parallel_kernel("covariances")
def invert_covariances(
    start: int, stop: int, covariances: F64, inverses: F64, log_dets: F64
) -> None:
    """Compute inverses and log determinants; covariances, inverses: (G, 6); log_dets: (G,)."""
    for g in range(start, stop):
        inverse, log_dets[g] = _inverse(symmetric(covariances, g))
        for entry in range(6):
            inverses[g, entry] = inverse[entry]


@parallel_kernel("labels", each=32)
def assign_nearest(
    start: int, stop: int,
    labels: I32, candidates: I32,
    means: F64, covariances: F64, blurs: F32, features: F32, rows: I32,
    centres: F64, inverses: F64, log_dets: F64, colours: F32, lambda_app: float,
    out: I32, distances: F64,
) -> None:  # fmt: skip
    """Assign every splat to the best cluster among its own and that one's neighbours.

    The best has the least ½ [(mu - mu_c)^T S (mu - mu_c) + tr(S Sigma) + log |Sigma_c|]
    + lambda |f - f_c|², with S = Sigma_c^-1: the splat's expected negative log likelihood under the
    cluster; ties go to the earlier candidate.
    labels: (N,); candidates: (G, k) clusters; means: (N, 3); covariances: (N, 6); blurs: (N,)
    deviations that blur them; features: (F, C); rows: (N,) of the features; centres: (G, 3);
    inverses: (G, 6); log_dets: (G,); colours: (G, C); out: (N,) new labels; distances: (N,) out,
    the least values, less ½ [3 + log |Sigma|]: the Kullback-Leibler divergence + lambda
    |f - f_c|², 0 or more in any unit.
    """
    for i in range(start, stop):
        prefetch_row(features, rows[min(i + AHEAD, len(rows) - 1)])
        sigma = _blurred(symmetric(covariances, i), blurs[i])
        xx, xy, xz, yy, yz, zz = sigma
        own = labels[i]
        best, chosen = math.inf, own
        for place in range(-1, candidates.shape[1]):
            g = own if place < 0 else candidates[own, place]
            x = means[i, 0] - centres[g, 0]
            y = means[i, 1] - centres[g, 1]
            z = means[i, 2] - centres[g, 2]
            a, b, c, d, e, f = symmetric(inverses, g)
            spread = a * (xx + x * x) + d * (yy + y * y) + f * (zz + z * z)
            spread += 2.0 * (b * (xy + x * y) + c * (xz + x * z) + e * (yz + y * z))
            total = 0.5 * (spread + log_dets[g])
            if total < best:
                total += lambda_app * _apart(features, rows[i], colours, g)
            if total < best:
                best, chosen = total, g
        out[i], distances[i] = chosen, best - 0.5 * (3.0 + log_determinant(sigma))


@parallel_kernel("labels", each=32)
def best_moves(
    start: int, stop: int,
    labels: I32, sizes: I64, candidates: I32,
    weights: F64, means: F64, covariances: F64, blurs: F32, features: F32, rows: I32,
    totals: F64, centres: F64, spreads: F64, log_dets: F64, colours: F32, lambda_app: float,
    targets: I32, gains: F64,
) -> None:  # fmt: skip
    """Find the move of every splat to another cluster that lowers the error of all the most.

    The error is the sum over clusters of ½ [W log |Sigma_c| - sum w log |Sigma|] + lambda sum w
    |f - f_c|², as of the merge forest. Moments are those after the move: a splat of a small cluster
    has pulled them towards itself, which favours its own cluster.
    labels: (N,); sizes: (G,) number of members; candidates: (G, k) clusters; weights: (N,); means:
    (N, 3); covariances: (N, 6); blurs: (N,) deviations that blur them; features: (F, C); rows: (N,)
    of the features; totals: (G,) weights of the clusters; centres: (G, 3); spreads: (G, 6)
    covariances, blurred; log_dets: (G,); colours: (G, C); targets: (N,) out, the cluster
    to move to, or the own one; gains: (N,) out, by how much the error falls, 0 or more.
    """
    for i in range(start, stop):
        prefetch_row(features, rows[min(i + AHEAD, len(rows) - 1)])
        own = labels[i]
        targets[i], gains[i] = own, 0.0
        w, rest = weights[i], totals[own] - weights[i]
        if sizes[own] < 2 or not rest > _ALL * totals[own]:
            continue
        sigma = _blurred(symmetric(covariances, i), blurs[i])
        x = means[i, 0] - centres[own, 0]
        y = means[i, 1] - centres[own, 1]
        z = means[i, 2] - centres[own, 2]
        p, q = totals[own] / rest, w / rest
        left = mix(p, symmetric(spreads, own), -q, sigma, -p * q, (x, y, z))
        if not (left[0] > 0.0 and left[3] > 0.0 and left[5] > 0.0):
            continue
        single = w * log_determinant(sigma)
        change = totals[own] * log_dets[own] - rest * log_determinant(left) - single
        stay = 0.5 * change + lambda_app * w * p * _apart(features, rows[i], colours, own)
        best = stay
        for place in range(candidates.shape[1]):
            g = candidates[own, place]
            if g == own:
                continue
            total = totals[g] + w
            p, q = totals[g] / total, w / total
            x = means[i, 0] - centres[g, 0]
            y = means[i, 1] - centres[g, 1]
            z = means[i, 2] - centres[g, 2]
            joined = mix(p, symmetric(spreads, g), q, sigma, p * q, (x, y, z))
            cost = 0.5 * (total * log_determinant(joined) - totals[g] * log_dets[g] - single)
            if cost < best:
                cost += lambda_app * w * p * _apart(features, rows[i], colours, g)
            if cost < best:
                best, targets[i] = cost, g
        gains[i] = stay - best


@kernel
def make_moves(order: I64, targets: I32, taken: Bool, labels: I32) -> int:
    """Move splats in the given order, but no two that have a cluster in common; return how many.

    order: rows of splats; targets: (N,) clusters; taken: (G,) False, changed; labels: (N,) changed.
    """
    made = 0
    for i in order:
        if not (taken[labels[i]] or taken[targets[i]]):
            taken[labels[i]] = taken[targets[i]] = True
            labels[i] = targets[i]
            made += 1
    return made

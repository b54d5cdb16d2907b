"""Stage 5, merge: execute a plan by mass-preserving moment matching (arXiv 2603.16103)."""

from dataclasses import replace

import numpy as np

from nanogs._types import F64
from nanogs.kernels.merge import merge_pairs
from nanogs.method.match import MergePlan
from nanogs.method.paper.gaussians import Gaussians


def merge(gaussians: Gaussians, plan: MergePlan, log_mass: F64) -> Gaussians:
    """Replace each pair of the plan by one splat, in the place of its first row.

    mu_m = (w_i mu_i + w_j mu_j) / W, Sigma_m = sum_k w_k (Sigma_k + d_k d_k^T) / W,
    alpha_m = 1 - (1 - alpha_i)(1 - alpha_j), f_m = (w_i f_i + w_j f_j) / W.

    Args:
        gaussians: N splats.
        plan: P disjoint pairs of rows.
        log_mass: (N,) float64, log(w) of each splat, from `log_masses`.

    Returns:
        N - P splats; the rows that the plan does not name are unchanged and in order.
    """
    first, second = plan.pairs[:, 0], plan.pairs[:, 1]
    stays = np.ones(len(gaussians), dtype=bool)
    stays[second] = False
    kept = np.flatnonzero(stays).astype(np.int32)
    rows = (np.cumsum(stays) - 1)[first]
    others, shares = kept.copy(), np.zeros((len(kept), 2))
    others[rows] = second
    shares[:, 0] = 1.0
    result = gaussians.take(kept)
    merge_pairs(
        plan.pairs,
        rows,
        log_mass,
        gaussians.means,
        gaussians.scales,
        gaussians.quats,
        gaussians.opacities,
        result.means,
        result.scales,
        result.quats,
        result.opacities,
        shares,
    )
    dominant = np.where(log_mass[second] > log_mass[first], second, first)
    result.sources[rows] = gaussians.sources[dominant]
    result.merged[rows] = True
    if not gaussians.merged.any():  # keep referring to the features of the model
        return replace(result, second_rows=gaussians.rows[others], shares=shares)
    return replace(
        result,
        features=gaussians.mean_features(kept, others, shares),
        rows=np.arange(len(kept), dtype=np.int32),
        second_rows=np.empty(0, np.int32),
        shares=np.empty((0, 2)),
    )

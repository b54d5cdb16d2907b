"""Stage 3, cost: the error of replacing a pair by one splat (arXiv 2603.16103)."""

import numpy as np

from nanogs import parallel
from nanogs._types import F32, F64, I32
from nanogs.kernels.cost import published_costs
from nanogs.method.paper.gaussians import Gaussians
from nanogs.method.paper.parameters import PaperParameters
from nanogs.slices import SLICE_PAIRS, slices

# The published jitter of the variances, squared scene units: keeps densities of flat splats finite.
JITTER = 1e-8


def log_masses(gaussians: Gaussians) -> F64:
    """Compute (N,) float64 log(alpha s1 s2 s3), the log of the mass up to a constant factor.

    It is -inf for a mass of zero.
    """
    with np.errstate(divide="ignore"):
        volumes: F64 = np.log(gaussians.scales, dtype=np.float64).sum(axis=1)
        return volumes + np.log(gaussians.opacities)


def pair_costs(gaussians: Gaussians, pairs: I32, log_mass: F64, parameters: PaperParameters) -> F32:
    """Compute the cost C = lambda_geo D_geo + lambda_app |f_i - f_j|^2 of each pair.

    D_geo is the Kullback-Leibler divergence from the pair, as a mixture, to the single Gaussian of
    the same mean and covariance, by Monte Carlo with the same draws for all pairs.

    Args:
        gaussians: N splats.
        pairs: (E, 2) rows.
        log_mass: (N,) from `log_masses`.
        parameters: samples, seed, lambda_geo and lambda_app are used.

    Returns:
        (E,) float32, dimensionless; small ones may be negative, because they are estimates.
    """
    normals = np.random.default_rng(parameters.seed).standard_normal((parameters.samples, 3))
    costs = np.empty(len(pairs), dtype=np.float32)

    def compute(part: slice) -> None:
        published_costs.here(
            np.ascontiguousarray(pairs[part]),
            gaussians.means,
            gaussians.scales,
            gaussians.quats,
            log_mass,
            gaussians.features,
            gaussians.rows,
            gaussians.second_rows,
            gaussians.shares,
            normals,
            JITTER,
            float(parameters.lambda_geo),
            float(parameters.lambda_app),
            costs[part],
        )

    parallel.for_each(slices(len(pairs), SLICE_PAIRS), compute)
    return costs

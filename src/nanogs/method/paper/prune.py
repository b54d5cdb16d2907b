"""Stage 1, prune: drop the faintest splats (arXiv 2603.16103)."""

from dataclasses import dataclass

import numpy as np

from nanogs._types import F64, I64


@dataclass(frozen=True, slots=True, eq=False)
class Pruning:
    """The result of pruning: the splats to keep.

    Attributes:
        keep: (M,) int64, rows in ascending order.
        threshold: Alpha below which splats are pruned, in [0, 1].
        limited: Whether the threshold alone would have left fewer than the target.
    """

    keep: I64
    threshold: float
    limited: bool


def prune(opacities: F64, tau: float, target: int) -> Pruning:
    """Keep splats with alpha >= min(tau, median alpha), but never fewer than the target.

    If the threshold would leave fewer, the most opaque splats are kept, ties by row.

    Args:
        opacities: (N,) alpha in [0, 1], no NaN.
        tau: Upper limit of the threshold, an alpha.
        target: Fewest splats to keep, at most N.
    """
    threshold = min(tau, float(np.median(opacities)))
    keep = np.flatnonzero(opacities >= threshold)
    if len(keep) >= target:
        return Pruning(keep, threshold, limited=False)
    most_opaque = np.argsort(-opacities, kind="stable")[:target]
    return Pruning(np.sort(most_opaque), threshold, limited=True)

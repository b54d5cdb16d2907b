"""Features that are not stored but computed when used: the weighted mean of two rows of a table.

The features of nodes that a first pass of merges makes would take nearly half the memory of the
model's own. Instead they are computed from these when needed, with the rounding to float32 that
storing them would bring.

Throughout, features: (F, C); rows: (N,) row of each of N splats; second_rows: (N,) second row of
each, or (0,) if each has only one; shares: (N, 2) weights of both, or (0, 2).
"""

import numpy as np

from nanogs._types import F32, F64, I32
from nanogs.kernels.policy import inline, parallel_kernel

# Rows of features are prefetched this many splats or pairs before they are read: they are in the
# order of the input, so far from each other.
AHEAD = 8


@inline
def mean_feature(
    features: F32, one: int, other: int, share: float, other_share: float, channel: int
) -> np.float32:
    """Return one channel of the weighted mean of two rows."""
    return np.float32(share * features[one, channel] + other_share * features[other, channel])


@inline
def feature(
    features: F32, rows: I32, second_rows: I32, shares: F64, splat: int, channel: int
) -> np.float32:  # fmt: skip
    """Return one channel of a splat's features."""
    if len(second_rows) == 0:
        return np.float32(features[rows[splat], channel])
    one, other = rows[splat], second_rows[splat]
    return mean_feature(features, one, other, shares[splat, 0], shares[splat, 1], channel)


@parallel_kernel("out")
def mean_features(
    start: int, stop: int,
    features: F32, rows: I32, second_rows: I32, shares: F64,
    firsts: I32, others: I32, weights: F64, out: F32,
) -> None:  # fmt: skip
    """Compute weighted means of the features of pairs of splats.

    firsts, others: (M,) the splats; weights: (M, 2); out: (M, C).
    """
    for i in range(start, stop):
        for c in range(features.shape[1]):
            first = feature(features, rows, second_rows, shares, firsts[i], c)
            other = feature(features, rows, second_rows, shares, others[i], c)
            out[i, c] = weights[i, 0] * first + weights[i, 1] * other

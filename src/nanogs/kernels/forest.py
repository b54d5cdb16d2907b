"""Kernels of the merge forest: the increase in error of each merge, and sums over subtrees.

Sources: Runnalls, "Kullback-Leibler approach to Gaussian mixture reduction", 2007 [R] for the
geometry; Ward, "Hierarchical grouping to optimize an objective function", 1963 [W] for the colour.
"""

import numpy as np

from nanogs._types import F32, F64, I32, Bool
from nanogs.kernels.blocks import prefetch_row
from nanogs.kernels.lazy_features import AHEAD, feature
from nanogs.kernels.nodes import symmetric
from nanogs.kernels.policy import kernel, parallel_kernel
from nanogs.kernels.symmetric3 import log_determinant, mix

LARGEST = float(np.finfo(np.float32).max)


@parallel_kernel("covariances")
def log_determinants(start: int, stop: int, covariances: F64, out: F64) -> None:
    """Compute log |Sigma| of every covariance; covariances: (N, 6); out: (N,)."""
    for i in range(start, stop):
        out[i] = log_determinant(symmetric(covariances, i))


@parallel_kernel("pairs")
def merge_increments(
    start: int, stop: int,
    pairs: I32, weights: F64, means: F64, covariances: F64, log_dets: F64,
    features: F32, rows: I32, second_rows: I32, shares: F64, out: F32,
) -> None:  # fmt: skip
    """For each pair, write the increase in colour and geometry error that merging it would cause.

    Colour: w_i w_j / (w_i + w_j) |f_i - f_j|² [W]. Geometry: (w_i + w_j) ½ (log |Sigma_m|
    - pi log |Sigma_i| - (1 - pi) log |Sigma_j|), pi = w_i / (w_i + w_j): the upper bound on the
    divergence of [R], eq. 21. Both add up over a subtree. Neither is NaN or infinite.
    pairs: (E, 2); weights: (N,) above 0; means: (N, 3); covariances: (N, 6); log_dets: (N,);
    features, rows, second_rows and shares: see `lazy_features.py`; out: (E, 2), colour, geometry.
    """
    for edge in range(start, stop):
        ahead = min(edge + AHEAD, len(pairs) - 1)
        prefetch_row(features, rows[pairs[ahead, 0]])
        prefetch_row(features, rows[pairs[ahead, 1]])
        i, j = pairs[edge, 0], pairs[edge, 1]
        total = weights[i] + weights[j]
        pi = weights[i] / total
        pj = 1.0 - pi
        x = means[i, 0] - means[j, 0]
        y = means[i, 1] - means[j, 1]
        z = means[i, 2] - means[j, 2]
        merged = mix(
            pi, symmetric(covariances, i), pj, symmetric(covariances, j), pi * pj, (x, y, z)
        )
        distance = np.float32(0.0)
        for c in range(features.shape[1]):
            difference = feature(features, rows, second_rows, shares, i, c) - feature(
                features, rows, second_rows, shares, j, c
            )
            distance += difference * difference
        # Colours may differ by more than the square root of the largest float32, and the weights of
        # immense splats may exceed it.
        out[edge, 0] = min(total * pi * pj * min(np.float64(distance), LARGEST), LARGEST)
        growth = log_determinant(merged) - pi * log_dets[i] - pj * log_dets[j]
        out[edge, 1] = min(total * 0.5 * growth, LARGEST)


@kernel
def subtree_sums(children: I32, increments: F64, sums: F64) -> None:
    """Sum the increments of every merge and all merges below it.

    children: (M, 2) nodes, a splat's row below N, N + merge above, children before parents;
    increments: (M,); sums: (N + M,) zeros, filled.
    """
    first = len(sums) - len(children)
    for m in range(len(children)):
        sums[first + m] = increments[m] + sums[children[m, 0]] + sums[children[m, 1]]


@kernel
def label_nodes(children: I32, labels: I32) -> None:
    """Give every merge the label of its children if they have the same one, or else -1.

    children: (M, 2) nodes, children before parents; labels: (N + M,), the first N given, changed.
    """
    first = len(labels) - len(children)
    for m in range(len(children)):
        label = labels[children[m, 0]]
        labels[first + m] = label if labels[children[m, 1]] == label else -1


@kernel
def raise_to_children(children: I32, scores: F64) -> None:
    """Raise every node's score to at least its children's; scores: (N + M,), in place."""
    first = len(scores) - len(children)
    for m in range(len(children)):
        below = max(scores[children[m, 0]], scores[children[m, 1]])
        scores[first + m] = max(scores[first + m], below)


@kernel
def root_of_each(children: I32, merged: Bool, roots: I32) -> None:
    """Find the highest node above every splat that is reached by chosen merges alone.

    children: (M, 2); merged: (M,) chosen merges; all merges below a chosen one must be chosen, too;
    roots: (N + M,) each node's own index, changed: the first N are the result.
    """
    first = len(roots) - len(children)
    for m in range(len(children) - 1, -1, -1):
        if merged[m]:
            roots[children[m, 0]] = roots[first + m]
            roots[children[m, 1]] = roots[first + m]


@kernel
def number_groups(roots: I32, numbers: I32, labels: I32) -> None:
    """Number the roots from 0 in the order of their first splats.

    roots: (N,) from `root_of_each`; numbers: (N + M,) all -1, changed; labels: (N,) out.
    """
    count = 0
    for i in range(len(roots)):
        if numbers[roots[i]] < 0:
            numbers[roots[i]] = count
            count += 1
        labels[i] = numbers[roots[i]]

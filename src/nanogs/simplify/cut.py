"""The error-guided cut: which merges of a forest are done for a count."""

import numpy as np

from nanogs._types import F64, I32
from nanogs.kernels.forest import raise_to_children, root_of_each, subtree_sums
from nanogs.simplify.tree import Forest

# A unit of geometry (weight times nats) against one of squared colour.
LAMBDA_GEO = 0.1


def merge_scores(forest: Forest, balance: float) -> F64:
    """(M,) float64: how late each merge is to be done; none comes before those below it.

    (1 - balance) level + balance log2(E / median E), E the sum over the merges below of the
    colour's increment and LAMBDA_GEO times the geometry's. Balance 0 makes groups of equal size,
    balance 1 groups of equal error.

    Args:
        forest: The merges.
        balance: In [0, 1].
    """
    increments = forest.increments[:, 0] + LAMBDA_GEO * forest.increments[:, 1].astype(np.float64)
    # Rounding can leave the increment of two equal splats a hair below zero.
    sums = np.zeros(forest.splats + len(forest.children))
    subtree_sums(forest.children, np.maximum(increments, 0.0), sums)
    errors = np.maximum(sums[forest.splats :], np.finfo(np.float64).tiny)
    scores = np.full(len(sums), -np.inf)
    scores[forest.splats :] = (1 - balance) * forest.levels
    scores[forest.splats :] += balance * np.log2(errors / np.median(errors))
    raise_to_children(forest.children, scores)
    return scores[forest.splats :]


def cut(forest: Forest, target: int, balance: float) -> I32:
    """Group the splats: the merges of lowest score are done, exactly as many as are needed.

    Args:
        forest: The merges.
        target: Groups wanted, from `forest.fewest` to the number of splats.
        balance: As `merge_scores` takes it.

    Returns:
        (N,) int32: each splat's group in [0, target), numbered by their first splats.
    """
    if len(forest.children) == 0:
        return np.arange(forest.splats, dtype=np.int32)
    # A parent's score is no lower and its number higher: a stable order keeps children first.
    order = np.argsort(merge_scores(forest, balance), kind="stable")
    done = np.zeros(len(order), dtype=bool)
    done[order[: forest.splats - target]] = True
    roots = np.arange(forest.splats + len(order), dtype=np.int32)
    root_of_each(forest.children, done, roots)
    return _numbered(roots[: forest.splats])


def _numbered(roots: I32) -> I32:
    """Roots as numbers from 0 in the order of their first appearance."""
    _, first, inverse = np.unique(roots, return_index=True, return_inverse=True)
    numbers = np.empty(len(first), dtype=np.int32)
    numbers[np.argsort(first)] = np.arange(len(first), dtype=np.int32)
    labels: I32 = numbers[inverse]
    return labels

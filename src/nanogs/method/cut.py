"""The error-guided cut: select the merges of a forest that give a requested count."""

import numpy as np

from nanogs import parallel
from nanogs._types import F64, I32, Bool, F
from nanogs.kernels.forest import (
    number_groups,
    raise_to_children,
    root_of_each,
    subtree_sums,
)
from nanogs.method.forest import Forest
from nanogs.slices import SLICE_STEPS, slices

# Weight of the geometry error (weight times nats) relative to the squared colour error.
LAMBDA_GEO = 0.1


def merge_scores(forest: Forest, balance: float, typical: float | None = None) -> F64:
    """Compute the (M,) float64 scores of the merges; those of lowest score are done first.

    The score is (1 - balance) level + balance log2(E / median E), where E is the error of the node:
    the sum, over all merges of its subtree, of the colour increment and LAMBDA_GEO times the
    geometry increment. No score is below those of the merges under it. Balance 0 makes groups of
    equal size, balance 1 groups of equal error.

    Args:
        forest: The merges.
        balance: In [0, 1].
        typical: Value in place of the median, so that scores of several forests are comparable.
    """
    first = forest.splats
    increments = np.empty(len(forest.children))

    def weigh(part: slice) -> None:
        some = LAMBDA_GEO * forest.increments[part, 1].astype(np.float64)
        some += forest.increments[part, 0]
        # Rounding can make the increment of two equal splats slightly negative.
        np.maximum(some, 0.0, out=increments[part])

    parallel.for_each(slices(len(increments), SLICE_STEPS), weigh)
    sums = np.zeros(first + len(forest.children))
    subtree_sums(forest.children, increments, sums)
    errors = np.maximum(sums[first:], np.finfo(np.float64).tiny, out=increments)
    middle = np.log2(np.median(errors) if typical is None else typical)
    scores = sums  # reuses the memory
    scores[:first] = -np.inf
    above = scores[first:]

    def score(part: slice) -> None:
        # A difference of logarithms: the ratio overflows if most merges cost nothing.
        logs = np.log2(errors[part])
        logs -= middle
        above[part] = (1 - balance) * forest.levels[part]
        above[part] += np.multiply(balance, logs, out=logs)

    parallel.for_each(slices(len(above), SLICE_STEPS), score)
    raise_to_children(forest.children, scores)  # rounding in log2 may have swapped two errors
    return above


def cut(forest: Forest, target: int, balance: float) -> I32:
    """Group the splats by doing the merges of lowest score, exactly as many as are needed.

    Args:
        forest: The merges.
        target: Number of groups, from `Forest.fewest` to the number of splats.
        balance: See `merge_scores`.

    Returns:
        (N,) int32: each splat's group in [0, target), numbered by their first splats.
    """
    if len(forest.children) == 0:
        return np.arange(forest.splats, dtype=np.int32)
    return label_groups(forest.splats, forest.children, merge_scores(forest, balance), target)


def label_groups(splats: int, children: I32, scores: F, target: int) -> I32:
    """Label the groups that the merges of lowest score make; ties go to the earlier merge.

    Args:
        splats: N.
        children: (M, 2) int32, the two nodes of each merge, children before parents.
        scores: (M,) score of each merge, not below those of the merges under it.
        target: Number of groups, from N - M to N.

    Returns:
        (N,) int32 labels; see `cut`.
    """
    done = _lowest(scores, splats - target)
    roots = np.arange(splats + len(done), dtype=np.int32)
    root_of_each(children, done, roots)
    labels, numbers = np.empty(splats, np.int32), np.full(len(roots), -1, np.int32)
    number_groups(roots[:splats], numbers, labels)
    return labels


def _lowest(scores: F, wanted: int) -> Bool:
    """Return a mask of the `wanted` merges of lowest score, ties by number.

    It never holds a merge without those below it: a parent's score is not below its children's, and
    its number is higher.
    """
    if wanted == 0:
        return np.zeros(len(scores), dtype=bool)
    highest = np.partition(scores, wanted - 1)[wanted - 1]
    done: Bool = scores < highest
    ties = np.flatnonzero(scores == highest)  # children before parents
    done[ties[: wanted - np.count_nonzero(done)]] = True
    return done

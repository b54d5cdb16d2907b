"""The error-guided cut: which merges of a forest are done for a count."""

import numpy as np

from nanogs import spread
from nanogs._types import F64, I32, Bool, F
from nanogs.kernels.forest import (
    number_groups,
    raise_to_children,
    root_of_each,
    subtree_sums,
)
from nanogs.method.forest import Forest
from nanogs.slices import SLICE_STEPS, slices

# A unit of geometry (weight times nats) against one of squared colour.
LAMBDA_GEO = 0.1


def merge_scores(forest: Forest, balance: float, typical: float | None = None) -> F64:
    """(M,) float64: how late each merge is to be done; none comes before those below it.

    (1 - balance) level + balance log2(E / median E), E the sum over the merges below of the
    colour's increment and LAMBDA_GEO times the geometry's. Balance 0 makes groups of equal size,
    balance 1 groups of equal error.

    Args:
        forest: The merges.
        balance: In [0, 1].
        typical: What takes the place of the median, so that scores of several forests compare.
    """
    first = forest.splats
    increments = np.empty(len(forest.children))

    def weigh(part: slice) -> None:
        some = LAMBDA_GEO * forest.increments[part, 1].astype(np.float64)
        some += forest.increments[part, 0]
        # Rounding can leave the increment of two equal splats a hair below zero.
        np.maximum(some, 0.0, out=increments[part])

    spread.each(slices(len(increments), SLICE_STEPS), weigh)
    sums = np.zeros(first + len(forest.children))
    subtree_sums(forest.children, increments, sums)
    errors = np.maximum(sums[first:], np.finfo(np.float64).tiny, out=increments)
    middle = np.log2(np.median(errors) if typical is None else typical)
    scores = sums  # in the same memory
    scores[:first] = -np.inf
    above = scores[first:]

    def score(part: slice) -> None:
        # A difference and not a ratio: that overflows where most merges cost nothing.
        logs = np.log2(errors[part])
        logs -= middle
        above[part] = (1 - balance) * forest.levels[part]
        above[part] += np.multiply(balance, logs, out=logs)

    spread.each(slices(len(above), SLICE_STEPS), score)
    raise_to_children(forest.children, scores)  # log2 may round two errors the wrong way
    return above


def cut(forest: Forest, target: int, balance: float) -> I32:
    """Group the splats: the merges of lowest score are done, exactly as many as are needed.

    Args:
        forest: The merges.
        target: Groups wanted, from `Forest.fewest` to the number of splats.
        balance: As `merge_scores` takes it.

    Returns:
        (N,) int32: each splat's group in [0, target), numbered by their first splats.
    """
    if len(forest.children) == 0:
        return np.arange(forest.splats, dtype=np.int32)
    return label_groups(forest.splats, forest.children, merge_scores(forest, balance), target)


def label_groups(splats: int, children: I32, scores: F, target: int) -> I32:
    """The groups that the merges of lowest score leave; ties go to the earlier merge.

    Args:
        splats: N.
        children: (M, 2) int32, of each merge, children before parents.
        scores: (M,) of each merge, none below those of the merges below it.
        target: Groups wanted, from N - M to N.

    Returns:
        As `cut` does.
    """
    done = _lowest(scores, splats - target)
    roots = np.arange(splats + len(done), dtype=np.int32)
    root_of_each(children, done, roots)
    labels, numbers = np.empty(splats, np.int32), np.full(len(roots), -1, np.int32)
    number_groups(roots[:splats], numbers, labels)
    return labels


def _lowest(scores: F, wanted: int) -> Bool:
    """Which merges are the `wanted` lowest; a parent's score is no lower and its number higher."""
    if wanted == 0:
        return np.zeros(len(scores), dtype=bool)
    highest = np.partition(scores, wanted - 1)[wanted - 1]
    done: Bool = scores < highest
    ties = np.flatnonzero(scores == highest)  # children before parents
    done[ties[: wanted - np.count_nonzero(done)]] = True
    return done

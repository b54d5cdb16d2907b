"""Correction of the errors that the forest predicts, by those that the groups of a cut show."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nanogs._types import F64, I32, F
from nanogs.kernels.forest import label_nodes, raise_to_children, subtree_sums

# Groups that views hardly show tell little, and groups of nearly equal splats have nearly no
# predicted error: both get the mean of all groups as well, with the weight of this quantile.
TYPICAL = 0.3
LEAST = -200.0  # score of merges of equal splats, which cost nothing: a ratio to it is finite
LIT = 0.01  # light of a group, relative to all for their weights, from which views tell its error


@dataclass(frozen=True, slots=True, eq=False)
class Ordering:
    """The merges of a forest, and the scores by which a cut selects them.

    Attributes:
        children: (M, 2) int32, the two nodes of each merge; see `nanogs.method.forest.Forest`.
        scores: (M,) the binary logarithm of each merge's error; never below those of the merges
            under it.
        weights: (N,) float64, weights of the splats.
    """

    children: I32
    scores: F
    weights: F64


@dataclass(frozen=True, slots=True, eq=False)
class GroupErrors:
    """The errors of the groups of a cut, as views of its result show them.

    Attributes:
        squared: (G,) float64, sum over the pixels of each group's T alpha times the squared error.
        light: (G,) float64, sum of its T alpha.
    """

    squared: F64
    light: F64


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """Scores by corrected errors.

    Attributes:
        scores: (M,) float64, as those of an `Ordering`. They are not corrected if views show no
            group or no error, if no group has several members, or if the errors are not finite.
        sums: (4,) float64, over all groups: the squared errors that they show, their light, their
            predicted errors and their weights; zeros if the scores are not corrected.
    """

    scores: F64
    sums: F64


def correct_errors(ordering: Ordering, labels: I32, errors: GroupErrors) -> Correction:
    """Correct the predicted errors of all merges by those that groups show.

    The error of a group over its light, divided by its predicted error over its weight, says how
    much larger its error is than predicted. The predicted error of each node is multiplied by the
    weighted mean of this ratio over its splats, so that a cut makes groups of about equal measured
    error.
    Groups that views hardly show have the ratio of all groups together.

    Args:
        ordering: The forest, and the predicted errors.
        labels: (N,) the group of each splat in a cut of this forest, in [0, G).
        errors: The errors of these groups.
    """
    scores = np.maximum(ordering.scores.astype(np.float64), LEAST)
    ordering = replace(ordering, scores=scores)
    weights = np.bincount(labels, ordering.weights).astype(np.float64, copy=False)
    predicted = _predicted(ordering, labels, len(weights))
    sums = np.array([each.sum() for each in (errors.squared, errors.light, predicted, weights)])
    if not (np.isfinite(sums).all() and sums.all()):
        return Correction(scores, np.zeros(4))
    ratios = _typical_mean(errors.squared, errors.light) / _typical_mean(predicted, weights)
    lit = errors.light / errors.light.sum() >= LIT * weights / weights.sum()
    ratios[~lit] = 2.0 ** usual_change(sums[None])
    changes = np.log2(_means(ordering, ratios[labels]))
    nodes = np.concatenate([np.full(len(labels), -np.inf), scores + changes])
    raise_to_children(ordering.children, nodes)
    return Correction(nodes[len(labels) :], sums)


def usual_change(sums: F64) -> float:
    """Return by how much the scores of forests rise on average when they are corrected.

    Args:
        sums: (B, 4), `Correction.sums` of all forests.
    """
    squared, light, predicted, weight = sums.sum(axis=0)
    return float(np.log2(squared / light * weight / predicted)) if squared else 0.0


def unseen_changes(corrections: Sequence[F64]) -> F64:
    """Return (B,) by how much scores must rise that could not be corrected, 0 for the others.

    They could not be compared with the scores of the other forests, which change with each
    correction.

    Args:
        corrections: (B, 4) `Correction.sums` of all forests, of each correction in turn.
    """
    changes = np.zeros(len(corrections[0]))
    for sums in corrections:
        changes = np.where(sums.any(axis=1), 0.0, changes + usual_change(sums))
    return changes


def _predicted(ordering: Ordering, labels: I32, groups: int) -> F64:
    """Return (G,) the predicted error of each group, that of its last merge; 0 without a merge."""
    of_nodes = np.empty(len(labels) + len(ordering.children), np.int32)
    of_nodes[: len(labels)] = labels
    label_nodes(ordering.children, of_nodes)
    of_merges = of_nodes[len(labels) :]
    whole = of_merges >= 0
    highest = np.full(groups, -np.inf)
    np.maximum.at(highest, of_merges[whole], ordering.scores[whole])  # scores rise towards the root
    predicted: F64 = np.exp2(highest)
    return predicted


def _typical_mean(sums: F64, weights: F64) -> F64:
    """Divide sums by weights, to both of which a typical weight of the mean of all is added."""
    typical = float(np.quantile(weights[weights > 0], TYPICAL))
    mean = sums.sum() / weights.sum()
    means: F64 = (sums + mean * typical) / (weights + typical)
    return means


def _means(ordering: Ordering, values: F64) -> F64:
    """Return (M,) the weighted mean over the splats of every merge of (N,) values of the splats."""
    count, zeros = len(values), np.zeros(len(ordering.children))
    sums = np.zeros((2, count + len(zeros)))
    np.multiply(ordering.weights, values, out=sums[0, :count])
    sums[1, :count] = ordering.weights
    for each in sums:
        subtree_sums(ordering.children, zeros, each)
    means: F64 = sums[0, count:] / sums[1, count:]
    return means

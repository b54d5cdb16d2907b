"""Harmonics that many splats share, as files with a palette hold them, and their fit.

A palette that is found for a finished model takes away what the fit has gained. Here the palette is
found first, and every step moves an entry by what all of its splats ask for, weighed by how much of
them is seen; base colours and shapes, which are each splat's own, make good what a shared entry
cannot show.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from nanogs._types import F32, F64, I32, I64
from nanogs.fit.groups import Group
from nanogs.fit.parameters import RefitParameters
from nanogs.fit.rounds import Outcome, fit
from nanogs.fit.targets import Fitting
from nanogs.io.cells import by_label
from nanogs.io.palette import palette
from nanogs.kernels.kmeans import weighted_means
from nanogs.progress import Parts
from nanogs.splats import Splats


class Sets(NamedTuple):
    """Sets of higher harmonics that splats are to share.

    Attributes:
        most: How many there are at most.
        weights: (N,) float64, positive, how much an error of each splat's colour counts.
    """

    most: int
    weights: F64


@dataclass(frozen=True, slots=True, eq=False)
class Shared:
    """Which splats share their higher harmonics.

    Attributes:
        labels: (N,) int32, the entry of each splat, from 0 on; each entry has some.
        starts: (K + 1,) int64, where the splats of each entry begin in `order`.
        order: (N,) int64, splats by their entry.
        weights: (N,) float32, positive, how much a splat counts for its entry.
    """

    labels: I32
    starts: I64
    order: I64
    weights: F32

    @classmethod
    def of(cls, labels: I32, entries: int, weights: F64) -> "Shared":
        """Splats by the entry that they have."""
        return cls(labels, *by_label(labels, entries), weights.astype(np.float32))

    def level(self, sh: F32) -> None:
        """Give all splats of an entry the mean of their higher harmonics, (N, K, 3), in place."""
        points = sh[:, 1:].reshape(len(sh), -1)  # a copy
        means = np.zeros((points.shape[1], len(self.starts) - 1), np.float32)
        squares = np.empty(means.shape[1], np.float32)
        weighted_means(points, self.weights, self.starts, self.order, means, squares)
        sh[:, 1:] = means.T[self.labels].reshape(len(sh), -1, 3)


def fit_shared(
    small: Splats,
    sets: Sets,
    fitting: Fitting,
    deciding: Sequence[Group],
    parameters: RefitParameters,
    tell: Parts,
) -> tuple[Splats, Outcome]:
    """Let splats share their higher harmonics, and fit the model that this leaves.

    Args:
        small: N splats with harmonics.
        sets: Of harmonics that they share.
        fitting: Views to fit to.
        deciding: Views that decide what is kept.
        parameters: Of the fit.
        tell: Told of the steps made, and of how many there may be.

    Returns:
        The fitted model, of so many sets of higher harmonics at most, and what happened.
    """
    found = palette(small.sh[:, 1:].reshape(len(small), -1), sets.most, sets.weights)
    shared = Shared.of(found.labels, len(found.entries), sets.weights)
    begun = _with(small, found.entries[found.labels])
    fitted, outcome = fit(begun, fitting, deciding, parameters, tell, shared)
    # Rows that no view has moved kept what their entry was at the beginning.
    moved = np.flatnonzero((fitted.sh[:, 1:] != begun.sh[:, 1:]).any(axis=(1, 2)))
    last = found.entries.copy()
    last[found.labels[moved]] = fitted.sh[moved, 1:].reshape(-1, last.shape[1])
    return _with(fitted, last[found.labels]), outcome


def _with(splats: Splats, harmonics: F32) -> Splats:
    """The model with other higher harmonics, (N, 3 * (K - 1))."""
    sh = splats.sh.copy()
    sh[:, 1:] = harmonics.reshape(len(splats), -1, 3)
    return replace(splats, sh=sh)

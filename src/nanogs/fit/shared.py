"""The fit of models whose splats share their higher harmonics, as files with a palette store them.

Building the palette after a fit would undo what the fit has improved. Here the palette is built
first, and every step moves an entry by the weighted mean of the steps of all its splats; base
colours and shapes, which are each splat's own, compensate for what a shared entry cannot show.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nanogs._types import F32, F64, I32, I64
from nanogs.fit.groups import ViewGroup
from nanogs.fit.parameters import RefitParameters
from nanogs.fit.rounds import Fitted, fit
from nanogs.fit.targets import Fitting
from nanogs.io.cells import by_label
from nanogs.io.palette import palette
from nanogs.io.precision import visibility
from nanogs.kernels.kmeans import weighted_means
from nanogs.progress import PartProgress
from nanogs.raster.camera import pick_evenly
from nanogs.raster.rendering import concatenated, prepare
from nanogs.splats import Splats
from nanogs.views.light import light_in, visibility_of, visible_weights

# Number of views by which colours are weighted, and their pixels along the longer side. They do not
# show everything: a splat hidden in all of them has this share of the weight of a visible one.
GLANCES, GLANCE = 12, 256
HIDDEN = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class SharedHarmonics:
    """Which splats share their higher harmonics: the palette entry of each.

    Attributes:
        labels: (N,) int32, the palette entry of each splat, from 0; no entry is without splats.
        starts: (K + 1,) int64, where the splats of each entry begin in `order`.
        order: (N,) int64, rows of the splats, sorted by entry.
        weights: (N,) float32, positive, weight of a splat in the mean of its entry.
    """

    labels: I32
    starts: I64
    order: I64
    weights: F32

    @classmethod
    def of(cls, labels: I32, entries: int, weights: F64) -> "SharedHarmonics":
        """Sort splats by their palette entry."""
        return cls(labels, *by_label(labels, entries), weights.astype(np.float32))

    def average(self, sh: F32) -> None:
        """Replace the higher harmonics of the splats of each entry by their mean, in place.

        Args:
            sh: (N, K, 3), all coefficients of each splat.
        """
        points = sh[:, 1:].reshape(len(sh), -1)  # a copy
        means = np.zeros((points.shape[1], len(self.starts) - 1), np.float32)
        squares = np.empty(means.shape[1], np.float32)
        weighted_means(points, self.weights, self.starts, self.order, means, squares)
        sh[:, 1:] = means.T[self.labels].reshape(len(sh), -1, 3)

    def spread(self, fitted: Splats, begun: Splats) -> Splats:
        """Return a fitted model in which all splats of an entry have its fitted harmonics.

        Those that no step moved still have the entry of before the fit.

        Args:
            fitted: The model after the fit.
            begun: The model before it, in which splats share their harmonics.
        """
        moved = np.flatnonzero((fitted.sh[:, 1:] != begun.sh[:, 1:]).any(axis=(1, 2)))
        entries = begun.sh[self.order[self.starts[:-1]], 1:]  # a copy
        entries[self.labels[moved]] = fitted.sh[moved, 1:]
        return _with(fitted, entries[self.labels])


def weights_of_colours(splats: Splats, fitting: Fitting) -> F64:
    """Return (N,) the weight of an error of each splat's colour, less if views hardly show it.

    Args:
        splats: N splats.
        fitting: The views, and the surroundings that are rendered with the splats.
    """
    cameras = [view.camera for view in pick_evenly(fitting.kept, GLANCES)]
    small = [each if each.whole else each.reduced(GLANCE) for each in cameras]
    light = light_in(concatenated(prepare(splats), fitting.surroundings), small)
    visible, _ = visibility_of(light, None)
    return visible_weights(visibility(splats), visible[: len(splats)], HIDDEN)


def fit_shared(
    small: Splats,
    entries: int,
    fitting: Fitting,
    deciding: Sequence[ViewGroup],
    parameters: RefitParameters,
    on_progress: PartProgress,
) -> Fitted:
    """Build a palette of higher harmonics, apply it to a model, and fit the result.

    Args:
        small: N splats with harmonics.
        entries: Largest number of sets of higher harmonics that the splats are to share.
        fitting: Views to fit to.
        deciding: Validation views, which decide how much of each round is kept.
        parameters: Parameters of the fit.
        on_progress: Progress callback: number of steps made, and their largest possible number.

    Returns:
        The result of `fit`, with no more sets of higher harmonics than asked for.
    """
    weights = weights_of_colours(small, fitting)
    found = palette(small.sh[:, 1:].reshape(len(small), -1), entries, weights)
    shared = SharedHarmonics.of(found.labels, len(found.entries), weights)
    begun = _with(small, found.entries[found.labels])
    return fit(begun, fitting, deciding, parameters, on_progress, shared)


def _with(splats: Splats, harmonics: F32) -> Splats:
    """Return the model with its higher harmonics replaced, by (N, K - 1, 3) in any shape."""
    sh = splats.sh.copy()
    sh[:, 1:] = harmonics.reshape(len(splats), -1, 3)
    return replace(splats, sh=sh)

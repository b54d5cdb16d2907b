"""How far from each splat viewers are likely to stand, and what a pixel is there."""

from dataclasses import dataclass

import numpy as np

from nanogs import spread
from nanogs._types import F64
from nanogs.kernels.project import DILATION
from nanogs.kernels.surroundings import nearness, reach
from nanogs.splats import RenderMode
from nanogs.views.occupancy import quantiles

# Share of all alpha that lies within a splat's surroundings; less than half, so that a second copy
# of the scene far away does not widen them.
SHARE = 0.25
USUAL = 0.1  # quantile of the anchors' radii that stands for the least of them
ANCHORS = 64  # splats whose surroundings are measured; others have them from the nearest ones
NEAR = 2.5  # times the least radius: up to there viewers may stand beside any splat
FARTHEST = 16.0  # times the usual radius; a stray's pixel must not outweigh all splats together
MOST_VIEWERS = 64  # of those that a user's cameras tell, evenly chosen
# Times the usual distance from the nearest viewer: what is nearer than that counts little more.
APART = 0.3
_SAMPLE = 4096  # splats looked at; a stride thins larger models


@dataclass(frozen=True, slots=True, eq=False)
class Dilation:
    """Where viewers are likely to stand, and the size that rasterisers add to splats there.

    Attributes:
        anchors: (A, 3) float64, some centres, scene units from the origin of the run.
        radii: (A,) float64, scene units around them within which a quarter of the alpha lies.
        per_radius: Standard deviation that is added, over the radius.
    """

    anchors: F64
    radii: F64
    per_radius: float

    def at(self, means: F64) -> F64:
        """(N,) float64: the standard deviation added at each of (N, 3) float64 centres."""
        return self.added(self.distances(means))

    def distances(self, means: F64) -> F64:
        """(N,) float64: how far viewers stand from (N, 3) float64 centres, scene units."""
        found = np.empty(len(means))
        reach(np.ascontiguousarray(means), self.anchors, self.radii, found)
        return found

    def added(self, distances: F64) -> F64:
        """(N,) float64: the standard deviation added to what is so far from viewers."""
        found = np.minimum(distances, FARTHEST * np.median(self.radii))
        found *= self.per_radius
        return found

    def nearness(self, means: F64) -> F64:
        """(N,) float64 in (0, 1]: how large screens show what is at (N, 3) float64 centres."""
        return self.nearness_at(self.distances(means))

    def nearness_at(self, distances: F64) -> F64:
        """(N,) float64 in (0, 1]: how large screens show what is so far from viewers.

        Viewers stand where most splats are. Up to `NEAR` times the radius there, which is as far
        as a room or an object reaches, they stand beside everything: 1. What lies beyond, such as
        hills and sky, is looked at from there, and falls with the square of its distance.
        """
        near = NEAR * float(np.quantile(self.radii, USUAL))
        if near == 0:
            return np.ones(len(distances))
        found = np.maximum(distances, near)
        np.divide(near, found, out=found)
        return np.square(found, out=found)

    @property
    def least(self) -> float:
        """The least of the anchors' above 0, scene units; 0 where there is none."""
        some = self.per_radius * self.radii
        return float(some[some > 0].min()) if (some > 0).any() else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Viewers:
    """Where viewers stand, as a user's cameras tell.

    Attributes:
        places: (V, 3) float64, V >= 1, scene units from the origin of the run.
        apart: Distance within which a splat counts hardly more for being nearer, scene units.
    """

    places: F64
    apart: float

    def nearness(self, means: F64) -> F64:
        """(N,) float64 in (0, 1]: how large screens show what is at (N, 3) float64 centres.

        The mean over viewers of 1 / (1 + (distance / apart)²).
        """
        if self.apart == 0:
            return np.ones(len(means))
        found = np.empty(len(means))
        nearness(np.ascontiguousarray(means), self.places, self.apart**2, found)
        return found


def viewers(places: F64, means: F64) -> Viewers:
    """Viewers at the places of cameras.

    Args:
        places: (V, 3) float64, V >= 1, scene units from the origin of the run.
        means: (N, 3) float64, N >= 1, splats of the model, in the same units.
    """
    some = means[:: len(means) // _SAMPLE + 1]
    nearest = np.min([np.linalg.norm(some - place, axis=1) for place in places], axis=0)
    return Viewers(np.ascontiguousarray(places), APART * float(np.quantile(nearest, 0.25)))


def dilation(means: F64, alphas: F64, mode: RenderMode, pixels: float) -> Dilation:
    """Find what a rasteriser adds to splats where a model is looked at as a whole.

    That is where a splat's surroundings, the ball about it that holds a quarter of the alpha, are
    `pixels` across: about as far away as viewers stand, whatever else the model holds elsewhere.
    For a MIP model it is 0: the rasteriser takes from the opacity what it adds to the size.

    Args:
        means: (N, 3) float64, N >= 1, scene units.
        alphas: (N,) float64 in [0, 1].
        mode: The rasteriser the model was trained for.
        pixels: Across the surroundings' diameter.
    """
    step = len(means) // _SAMPLE + 1
    anchors = np.ascontiguousarray(means[:: (len(means) - 1) // ANCHORS + 1])
    means, alphas = means[::step], alphas[::step]
    weights = alphas if alphas.sum() > 0 else np.ones(len(means))
    radii = np.array(spread.results(anchors, lambda anchor: _radius(anchor, means, weights)))
    per_radius = 0.0 if mode is RenderMode.MIP else float(np.sqrt(DILATION)) * 2 / pixels
    return Dilation(anchors, radii, per_radius)


def _radius(point: F64, means: F64, weights: F64) -> float:
    """Distance from a point within which the share of the weight lies."""
    return quantiles(np.linalg.norm(means - point, axis=1), weights, SHARE)[0]

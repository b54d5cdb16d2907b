"""Likely distance of viewers from each splat, and the size of a pixel at that distance."""

from dataclasses import dataclass

import numpy as np

from nanogs import parallel
from nanogs._types import F32, F64
from nanogs.kernels.viewer_distances import least_distances, nearness
from nanogs.raster.camera import DILATION
from nanogs.splats import RenderMode
from nanogs.views.occupancy import quantiles

# Share of all alpha within a splat's surroundings, the ball around it by whose radius the distance
# of viewers is estimated. Less than half, so that a second copy of the scene far away does not
# widen it.
SHARE = 0.25
USUAL = 0.1  # quantile of the anchors' radii that is used as a robust minimum
ANCHORS = 64  # splats whose radius is measured; that of others follows from the nearest anchors
NEAR = 2.5  # distance over the least radius, up to which viewers may stand beside any splat
FARTHEST = 16.0  # largest distance over the median radius, so that no stray outweighs all splats
BLUR = 0.5  # share of the dilation by which shapes are blurred before they are compared
MOST_VIEWERS = 64  # of a user's cameras at most this number are used, evenly chosen
# Softening distance of `Viewers` over the typical distance from the nearest viewer.
APART = 0.3
_SAMPLE = 4096  # number of splats examined; larger models are sampled by a stride


@dataclass(frozen=True, slots=True, eq=False)
class Dilation:
    """Estimate of viewers' distances from the model, and of the rasteriser's dilation there.

    Attributes:
        anchors: (A, 3) float64, some splats' centres, scene units from the origin of the run.
        radii: (A,) float64, radius around each that holds a quarter of the alpha, scene units.
        per_radius: Standard deviation of the dilation over the distance of the viewer.
    """

    anchors: F64
    radii: F64
    per_radius: float

    def at(self, means: F64) -> F64:
        """Return the (N,) float64 standard deviation of the dilation at (N, 3) float64 centres."""
        return self.added(self.distances(means))

    def blurs(self, means: F64) -> F32:
        """Return the (N,) float32 blur of shapes at (N, 3) float64 centres when they are compared.

        It is a standard deviation. What is smaller than a pixel cannot be told apart, but a viewer
        may come nearer: half of the dilation is taken, that of a view from half the distance.
        """
        return self.blurs_at(self.distances(means))

    def blurs_at(self, distances: F64) -> F32:
        """Return the (N,) float32 blur of shapes at distances from viewers; see `blurs`."""
        return (self.added(distances) * BLUR).astype(np.float32)

    def distances(self, means: F64) -> F64:
        """Return the (N,) float64 likely distance of viewers from (N, 3) float64 centres.

        It is the least sqrt(r² + d²) over the anchors, for their radius r and distance d, scene
        units.
        """
        found = np.empty(len(means))
        least_distances(np.ascontiguousarray(means), self.anchors, self.radii, found)
        return found

    def added(self, distances: F64) -> F64:
        """Return the (N,) float64 standard deviation of the dilation at distances from viewers."""
        found = np.minimum(distances, FARTHEST * np.median(self.radii))
        found *= self.per_radius
        return found

    def nearness(self, means: F64) -> F64:
        """Return the (N,) float64 relative size on screen, in (0, 1], at (N, 3) float64 centres."""
        return self.nearness_at(self.distances(means))

    def nearness_at(self, distances: F64) -> F64:
        """Return the (N,) float64 relative size on screen, in (0, 1], at distances from viewers.

        Viewers are assumed where most splats are. Up to `NEAR` times the least radius, which is the
        extent of a room or an object, they may come close to everything: 1. Farther splats, such as
        hills and sky, are seen from there, and their size falls with the square of the distance.
        """
        near = NEAR * float(np.quantile(self.radii, USUAL))
        if near == 0:
            return np.ones(len(distances))
        found = np.maximum(distances, near)
        np.divide(near, found, out=found)
        return np.square(found, out=found)

    @property
    def least(self) -> float:
        """The least dilation above 0 over the anchors, scene units; 0 if there is none."""
        some = self.per_radius * self.radii
        return float(some[some > 0].min()) if (some > 0).any() else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Viewers:
    """Positions of viewers, taken from a user's cameras.

    Attributes:
        places: (V, 3) float64, V >= 1, scene units from the origin of the run.
        apart: Softening distance, scene units: within it a splat hardly counts more if it is
            nearer.
    """

    places: F64
    apart: float

    def nearness(self, means: F64) -> F64:
        """Return the (N,) float64 relative size on screen, in (0, 1], at (N, 3) float64 centres.

        It is the mean over viewers of 1 / (1 + (distance / apart)²).
        """
        if self.apart == 0:
            return np.ones(len(means))
        found = np.empty(len(means))
        nearness(np.ascontiguousarray(means), self.places, self.apart**2, found)
        return found


def viewers_at(places: F64, means: F64) -> Viewers:
    """Make viewers from the positions of cameras.

    Args:
        places: (V, 3) float64, V >= 1, scene units from the origin of the run.
        means: (N, 3) float64, N >= 1, centres of the model's splats, in the same units.
    """
    some = means[:: len(means) // _SAMPLE + 1]
    nearest = np.min([np.linalg.norm(some - place, axis=1) for place in places], axis=0)
    return Viewers(np.ascontiguousarray(places), APART * float(np.quantile(nearest, 0.25)))


def estimate_dilation(means: F64, alphas: F64, mode: RenderMode, pixels: float) -> Dilation:
    """Estimate the dilation by the rasteriser in a view of the model as a whole.

    In that view a splat's surroundings, the ball around it that holds a quarter of the alpha, are
    `pixels` across: about the distance of viewers, independent of distant parts of the model. For a
    MIP model the dilation is 0, because the rasteriser compensates it in the opacity.

    Args:
        means: (N, 3) float64, N >= 1, scene units.
        alphas: (N,) float64 in [0, 1].
        mode: The rasteriser the model was trained for.
        pixels: Diameter of the surroundings in pixels.
    """
    step = len(means) // _SAMPLE + 1
    anchors = np.ascontiguousarray(means[:: (len(means) - 1) // ANCHORS + 1])
    means, alphas = means[::step], alphas[::step]
    weights = alphas if alphas.sum() > 0 else np.ones(len(means))
    radii = np.array(parallel.map_ordered(anchors, lambda anchor: _radius(anchor, means, weights)))
    per_radius = 0.0 if mode is RenderMode.MIP else float(np.sqrt(DILATION)) * 2 / pixels
    return Dilation(anchors, radii, per_radius)


def _radius(point: F64, means: F64, weights: F64) -> float:
    """Return the radius around a point that holds the share of the weight."""
    return quantiles(np.linalg.norm(means - point, axis=1), weights, SHARE)[0]

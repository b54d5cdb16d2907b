"""The light of splats summed over views, their visibility, and weights that depend on it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nanogs._types import F64, U8, Bool
from nanogs.raster.camera import Camera
from nanogs.raster.light import LightSums, light_in_view
from nanogs.raster.rendering import PreparedSplats

SHOWN = 0.01  # visibility from which a splat counts as shown


@dataclass(frozen=True, slots=True, eq=False)
class SplatContributions:
    """The light of N splats, summed over views, with and without occlusion.

    Attributes:
        contributions: (N,) float64, sum of transmittance x alpha over all pixels.
        unoccluded: (N,) float64, about the same without other splats in front.
        times: (N,) uint8, number of views that show each, more than one as 2.
        views: Number of views.
        pixels: Number of pixels of all views.
    """

    contributions: F64
    unoccluded: F64
    times: U8
    views: int
    pixels: int

    def shares(self) -> F64:
        """Return (N,) float64 visibilities in [0, 1], `contributions` over `unoccluded`.

        They are 0 outside all views.
        """
        shares, whole = np.zeros(len(self.contributions)), self.unoccluded
        np.divide(self.contributions, whole, out=shares, where=whole > 0)
        return np.minimum(shares, 1.0, out=shares)


def light_in(prepared: PreparedSplats, cameras: Sequence[Camera]) -> SplatContributions:
    """Sum up the light of each splat in some views, whose pictures are not needed."""
    light = LightSums(len(prepared))
    for camera in cameras:
        light.add(light_in_view(prepared, camera), SHOWN)
    return contributions_of(light, cameras)


def contributions_of(light: LightSums, cameras: Sequence[Camera]) -> SplatContributions:
    """Return the sums of the light in the views of some cameras."""
    pixels = sum(camera.width * camera.height for camera in cameras)
    return SplatContributions(
        light.contributions(), light.unoccluded(), light.times(), len(cameras), pixels
    )


def visibility_of(
    looked: SplatContributions, around: SplatContributions | None
) -> tuple[F64, Bool]:
    """Compute the visibility of splats, and which are outside all views.

    Args:
        looked: Light in the views of the model; a splat outside all of them counts as visible.
        around: Light in views from all around, which can only increase visibilities; or None.

    Returns:
        (N,) float64 visibilities in [0, 1], and (N,) bool, True outside all views.
    """
    visible, missed = looked.shares(), looked.unoccluded == 0
    visible[missed] = 1.0
    if around is not None:
        np.maximum(visible, around.shares(), out=visible)
        missed &= around.unoccluded == 0
    return visible, missed


def visible_weights(weights: F64, visible: F64, hidden: float) -> F64:
    """Return the (N,) float64 weights of splats, reduced by occlusion.

    Args:
        weights: (N,) of the splats as if nothing were in front of them.
        visible: (N,) visibilities in [0, 1].
        hidden: Weight of a splat that is not visible at all, relative to a fully visible one.
    """
    reduced: F64 = weights * (hidden + (1 - hidden) * visible)
    return reduced

"""Visibility of splats in views of the original, and weights that depend on it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nanogs._types import F64, U8, Bool
from nanogs.raster.camera import Camera
from nanogs.raster.light import LightSums, light_in_view
from nanogs.raster.rendering import PreparedSplats

LUMA = np.array([0.299, 0.587, 0.114], np.float32)  # ITU-R BT.601; grey takes a third of the work
SHOWN = 0.01  # visibility from which a splat counts as shown
NEW = 0.01  # share of light seen by only one view, above which the views are taken as incomplete
DECIDING = 6  # one view in six is held out, to choose a candidate and to accept a fit


@dataclass(frozen=True, slots=True, eq=False)
class SplatContributions:
    """The light of N splats, summed over views: contributions, with and without occlusion.

    Attributes:
        seen: (N,) float64, sum of transmittance x alpha over all pixels.
        whole: (N,) float64, about the same without other splats in front.
        times: (N,) uint8, number of views that show each, more than one as 2.
        views: Number of views.
        pixels: Number of pixels of all views.
    """

    seen: F64
    whole: F64
    times: U8
    views: int
    pixels: int

    def shares(self) -> F64:
        """Return (N,) float64 visibilities in [0, 1]: `seen` over `whole`; 0 outside all views."""
        shares = np.zeros(len(self.seen))
        np.divide(self.seen, self.whole, out=shares, where=self.whole > 0)
        return np.minimum(shares, 1.0, out=shares)


@dataclass(frozen=True, slots=True)
class MissedLight:
    """Statistics that estimate how much of a model the views have missed.

    The share of new light in further views is about the share of these views' light that is seen by
    one view alone (Good, "The population frequencies of species and the estimation of population
    parameters", 1953).

    Attributes:
        once: Light of splats that only one view shows, in units of whole pictures.
        light: Light of all splats, in the same units.
        unseen: Unoccluded light of splats that are inside views but shown by none.
    """

    once: float = 0.0
    light: float = 0.0
    unseen: float = 0.0

    def __add__(self, other: "MissedLight") -> "MissedLight":
        """Add the statistics of two parts of a scene."""
        return MissedLight(
            self.once + other.once, self.light + other.light, self.unseen + other.unseen
        )

    def hidden(self, least: float) -> float:
        """Return the weight of an unseen splat relative to a fully visible one, in (0, 1].

        It is the share of their light that further views of the same kind would show of unseen
        splats, on average. If such views would show little that is new, unseen splats are taken as
        hidden and the weight is `least`.

        Args:
            least: The least weight.
        """
        if self.once <= NEW * self.light or self.unseen <= 0:
            return least
        return max(least, min(self.once / self.unseen, 1.0))


def missed_light_of(looked: SplatContributions, count: int) -> MissedLight:
    """Compute the statistics of missed light for the first `count` splats.

    Args:
        looked: Light in the views of the model. Views from all around it are not counted: from
            afar they show something of everything, but little of what is seen inside it.
        count: Number of splats.
    """
    picture = looked.pixels / max(looked.views, 1) or 1.0
    times = looked.times[:count]
    seen, whole = looked.seen[:count] / picture, looked.whole[:count] / picture
    return MissedLight(
        float(seen[times == 1].sum()), float(seen.sum()), float(whole[times == 0].sum())
    )


def light_in(prepared: PreparedSplats, cameras: Sequence[Camera]) -> SplatContributions:
    """Sum up the light of each splat in some views, whose pictures are not needed."""
    light = LightSums(len(prepared))
    for camera in cameras:
        light.add(light_in_view(prepared, camera), SHOWN)
    return contributions_of(light, cameras)


def contributions_of(light: LightSums, cameras: Sequence[Camera]) -> SplatContributions:
    """Return the sums of the light in the views of some cameras."""
    pixels = sum(camera.width * camera.height for camera in cameras)
    return SplatContributions(light.seen(), light.whole(), light.times(), len(cameras), pixels)


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
    visible, missed = looked.shares(), looked.whole == 0
    visible[missed] = 1.0
    if around is not None:
        np.maximum(visible, around.shares(), out=visible)
        missed &= around.whole == 0
    return visible, missed


def visible_weights(prominences: F64, visible: F64, hidden: float) -> F64:
    """Compute the (N,) float64 weights of splats: prominence, reduced by occlusion.

    Args:
        prominences: (N,) from `nodes.prominence`.
        visible: (N,) visibilities in [0, 1].
        hidden: Weight of a splat that is not visible at all, relative to a fully visible one.
    """
    weights: F64 = prominences * (hidden + (1 - hidden) * visible)
    return weights


def shown_share(prominences: F64, visible: F64, missed: Bool) -> float:
    """Compute the share of all prominence, in [0, 1], of splats that the views show.

    Args:
        prominences: (N,) from `nodes.prominence`.
        visible: (N,) visibilities in [0, 1].
        missed: (N,) bool, splats outside all views.
    """
    total = float(prominences.sum())
    return shown_prominence(prominences, visible, missed) / total if total > 0 else 0.0


def shown_prominence(prominences: F64, visible: F64, missed: Bool) -> float:
    """Sum the prominence of the splats that the views show; arguments as for `shown_share`."""
    return float(prominences[(visible >= SHOWN) & ~missed].sum())

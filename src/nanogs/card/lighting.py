"""Sums of the light of splats over views, on a device."""

from typing import TYPE_CHECKING

import warp as wp

if TYPE_CHECKING:
    from nanogs.card.engine import Engine, View


class CardSums:
    """The light of N splats summed over views; see `nanogs.raster.light.LightSums`.

    Attributes:
        contributions: (N,) float64 on the device, sum of the views' contributions.
        unoccluded: (N,) float64 on the device, sum of the views' unoccluded light.
        times: (N,) uint8 on the device, number of views that show each, more than one as 2.
    """

    def __init__(self, engine: "Engine", count: int) -> None:
        self._engine = engine
        self.contributions, self.unoccluded, self.times = (
            wp.zeros(count, dtype=kind, device=engine.device)
            for kind in (wp.float64, wp.float64, wp.uint8)
        )

    def add(self, view: "View", shown: float) -> None:
        """Add a view, which counts as showing a splat from a share `shown` of its light."""
        self._engine.launch(
            add_light, view.count, view.sums_of_weights(), view.sums_unoccluded(), shown,
            self.contributions, self.unoccluded, self.times,
        )  # fmt: skip


@wp.kernel(enable_backward=False)
def add_light(
    contributions: wp.array[wp.float32],
    unoccluded: wp.array[wp.float64],
    shown: wp.float64,
    seen: wp.array[wp.float64],
    whole: wp.array[wp.float64],
    times: wp.array[wp.uint8],
) -> None:
    """Add the light of a view to each splat's sums.

    contributions, unoccluded: (N,) of the view; shown: share from which a view counts as showing a
    splat; seen, whole, times: (N,) sums, changed in place.
    """
    i = wp.tid()
    light = wp.float64(contributions[i])
    seen[i] += light
    whole[i] += unoccluded[i]
    if light > shown * unoccluded[i] and times[i] < wp.uint8(2):
        times[i] += wp.uint8(1)

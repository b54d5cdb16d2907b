"""The views on which a result's draw cost is compared with the original's."""

from collections.abc import Sequence
from dataclasses import dataclass

from nanogs.costs import DrawCost
from nanogs.errors import ModelError
from nanogs.progress import PartProgress, ignore_progress
from nanogs.protocol import PIXELS, VIEWS, Protocol
from nanogs.raster.camera import Camera
from nanogs.source import Source
from nanogs.splats import Splats
from nanogs.views.cameras import cameras_for
from nanogs.views.covering import cost_on


@dataclass(frozen=True, slots=True, eq=False)
class DrawViews:
    """The views of `nanogs compare` at its defaults, and the original's draw cost on them.

    Attributes:
        cameras: The views.
        protocol: Their kind, number and size.
        original: Draw cost of the original.
    """

    cameras: Sequence[Camera]
    protocol: Protocol
    original: DrawCost

    def cost(self, model: Splats | Source) -> DrawCost:
        """Measure the draw cost of another model on the same views.

        Raises:
            FormatError: The source cannot be read.
        """
        return cost_on(model, self.cameras, self.protocol)

    def share(self, model: Splats | Source) -> float:
        """Return another model's draw cost (splats per pixel) as a share of the original's."""
        return self.cost(model).share_of(self.original)


def draw_views(original: Splats | Source, on_progress: PartProgress = ignore_progress) -> DrawViews:
    """Measure the draw cost of the original, once for any number of models.

    Args:
        original: The model.
        on_progress: Receives the progress in rows.

    Raises:
        FormatError: The source cannot be read.
        ModelError: Nothing of it is visible.
    """
    try:
        cameras = cameras_for(
            original, "auto", count=VIEWS, width=PIXELS, height=PIXELS, split="test"
        )
    except ModelError as error:
        raise ModelError(f"The draw cost cannot be measured: {error}") from None
    protocol = Protocol()
    cost = cost_on(original, cameras, protocol, on_progress)
    if not cost.splats_a_pixel:
        raise ModelError(
            "The draw cost cannot be measured, because no automatic view shows any splat."
        )
    return DrawViews(cameras, protocol, cost)

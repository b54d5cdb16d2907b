"""The light of each splat in a view, and sums of it over views, on the device in use."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from nanogs import parallel
from nanogs._types import F64, U8
from nanogs.card.device import engine_in_use
from nanogs.raster.camera import Camera
from nanogs.raster.checks import background_of
from nanogs.raster.rendering import (
    BLACK,
    PreparedSplats,
    Rendering,
    picture_of,
    render,
    view_on,
)
from nanogs.slices import SLICE_STEPS, slices

if TYPE_CHECKING:
    from nanogs.card.engine import View
    from nanogs.card.lighting import CardSums


@dataclass(frozen=True, slots=True, eq=False)
class HostLight:
    """The light of N splats in one view; `nanogs.card.engine.View` has the same methods.

    Attributes:
        seen: The contributions.
        whole: The unoccluded light.
    """

    seen: F64
    whole: F64

    def contributions(self) -> F64:
        """Return (N,) float64, sum of transmittance x alpha over all pixels."""
        return self.seen

    def unoccluded(self) -> F64:
        """Return (N,) float64, about the same without other splats in front."""
        return self.whole

    def total(self, count: int) -> float:
        """Return the sum of the contributions of the first `count` splats."""
        return float(self.seen[:count].sum())


SplatLight: TypeAlias = "HostLight | View"  # the light of splats, on the device that rendered it


def render_with_light(
    prepared: PreparedSplats, camera: Camera, *, depth: bool = False
) -> tuple[Rendering, SplatLight]:
    """Render a picture and the light of each splat; the arguments are those of `render`.

    The light stays on the device in use; the picture's own `contributions` may be None.
    """
    engine = engine_in_use()
    if engine is not None:
        view = view_on(engine, prepared, camera)
        return picture_of(view, prepared, background_of(BLACK, depth=depth)), view
    picture = render(prepared, camera, contributions=True, depth=depth)
    return picture, _light_of(picture)


def light_in_view(prepared: PreparedSplats, camera: Camera) -> SplatLight:
    """Compute the light of each splat in a view, of which no picture is needed."""
    engine = engine_in_use()
    if engine is not None:
        return view_on(engine, prepared, camera, sh_degree=0)
    return _light_of(render(prepared, camera, contributions=True, sh_degree=0))


def _light_of(picture: Rendering) -> HostLight:
    assert picture.contributions is not None  # noqa: S101 - asked for
    assert picture.unoccluded is not None  # noqa: S101 - comes with them
    return HostLight(picture.contributions, picture.unoccluded)


class LightSums:
    """The light of N splats summed over views, on the device in use at the beginning."""

    def __init__(self, count: int) -> None:
        engine = engine_in_use()
        self._on_card: CardSums | None = None if engine is None else engine.sums(count)
        held = count if engine is None else 0
        self._contributions, self._unoccluded = np.zeros(held), np.zeros(held)
        self._times = np.zeros(held, np.uint8)

    def add(self, view: SplatLight, shown: float) -> None:
        """Add a view that was rendered on this device.

        It counts as showing a splat from a share `shown` of its unoccluded light.
        """
        if not isinstance(view, HostLight):
            self._sums_on_card().add(view, shown)
            return
        contributions, unoccluded = view.contributions(), view.unoccluded()

        def include(rows: slice) -> None:
            self._contributions[rows] += contributions[rows]
            self._unoccluded[rows] += unoccluded[rows]
            self._times[rows] += contributions[rows] > shown * unoccluded[rows]
            np.minimum(self._times[rows], 2, out=self._times[rows])

        parallel.for_each(slices(len(contributions), SLICE_STEPS), include)

    def _sums_on_card(self) -> "CardSums":
        assert self._on_card is not None  # noqa: S101 - the device has not changed
        return self._on_card

    def contributions(self) -> F64:
        """Return (N,) float64, the sum of the views' contributions."""
        on_card = self._on_card
        return self._contributions if on_card is None else on_card.contributions.numpy()

    def unoccluded(self) -> F64:
        """Return (N,) float64, the sum of the views' unoccluded light."""
        return self._unoccluded if self._on_card is None else self._on_card.unoccluded.numpy()

    def times(self) -> U8:
        """Return (N,) uint8, the number of views that show each, more than one as 2."""
        return self._times if self._on_card is None else self._on_card.times.numpy()

"""The steps of a refit on a graphics card; the splats stay in its memory between steps."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from nanogs._types import F32, I32
from nanogs.card.device import engine_in_use
from nanogs.fit.descent import Descent
from nanogs.fit.parameters import RefitParameters
from nanogs.fit.state import State
from nanogs.fit.targets import ALPHA, WHITE, Fitting, picture_on
from nanogs.kernels.advance import MOST_DETERMINED
from nanogs.raster.rendering import camera_arrays, uploaded, view_on
from nanogs.splats import Splats

if TYPE_CHECKING:
    import warp as wp

    from nanogs.card.advancing import FittedSplats
    from nanogs.card.engine import Engine
    from nanogs.card.fitting import FittedModel
    from nanogs.fit.shared import SharedHarmonics
    from nanogs.raster.camera import Camera


class CardDescent(Descent):
    """A `Descent` whose splats are on a device, which also computes the steps."""

    _moving: "FittedModel"
    _summed: "FittedSplats | None" = None  # the mean of states
    _added = 0  # states in it

    def __init__(
        self,
        engine: "Engine",
        splats: Splats,
        views: Fitting,
        parameters: RefitParameters,
        shared: "SharedHarmonics | None" = None,
    ) -> None:
        self._engine = engine
        super().__init__(splats, views, parameters, shared)

    @property
    def state(self) -> State:
        """The current parameters, copied from the device."""
        return State(*self._moving.columns())

    def begin(self, state: State) -> None:
        """Continue from a state, which is copied to the device; see `Descent.begin`."""
        from nanogs.card.fitting import FittedModel, StepParameters

        if self._count:  # of the steps, this alone is kept, and it is on the device
            self._displacements[:, MOST_DETERMINED] = self._moving.determined()
        super().begin(state)
        model, begun = self._active.model, self._state
        self._moving = FittedModel(
            uploaded(self._engine, model),
            [begun.means, begun.log_scales, begun.quats, begun.logits, begun.touched],
            self._displacements,
            self._initial_sh,
            self._active.axes,
            self._active.scales,
            StepParameters(
                damping=self.parameters.damping,
                floor=self.parameters.floor,
                memory=len(self.views),
                limits=self._limits,
                bands=self._bands,
                single=model.means.dtype == np.float32,
            ),
        )

    def add_to_mean(self) -> None:
        """Add the current state to the mean of states, which is on the device."""
        self._added += 1
        if self._summed is None:
            self._summed = self._moving.begin_mean()
        else:
            self._moving.add_to_mean(self._summed, 1 / self._added)

    def mean(self) -> State:
        """Return the mean of the states that were added, copied from the device."""
        assert self._summed is not None  # noqa: S101 - callers have added a state
        mean = State(*self._moving.columns(self._summed))
        lengths = np.linalg.norm(mean.quats, axis=1, keepdims=True)
        return replace(mean, quats=mean.quats / lengths)

    def _accumulated(self) -> tuple[I32, F32, F32]:
        return self._moving.accumulated()

    def _average_shared(self, shared: "SharedHarmonics") -> None:
        sh = self._moving.coefficients()
        shared.average(sh)
        self._moving.recolour(sh)

    def _follow_view(self, index: int, wanted: int, rate: float) -> float:
        degree, shares = self._active.model.sh_degree, (WHITE, ALPHA)
        camera, image = self._target(index, wanted)
        return self._moving.step(camera_arrays(camera), degree, image, shares, wanted, rate)

    def _target(self, index: int, wanted: int) -> "tuple[Camera, wp.array]":
        """Return a view's camera and its image on the device, where views not kept are rendered."""
        found = self.views.to_render(index)
        if found is not None:
            return found[1], view_on(self._engine, *found).in_bytes(wanted)
        target = self.views.kept[index]
        return target.camera, picture_on(self._engine, target)


def descent_for(
    splats: Splats,
    views: Fitting,
    parameters: RefitParameters,
    shared: "SharedHarmonics | None" = None,
) -> Descent:
    """Create the `Descent` for the device in use; the arguments are those of `Descent`."""
    engine = engine_in_use()
    if engine is None:
        return Descent(splats, views, parameters, shared)
    return CardDescent(engine, splats, views, parameters, shared)

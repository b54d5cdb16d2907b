"""Steps of a refit: damped Newton steps, splat by splat, on one view at a time.

Each step follows the pull of one view and is scaled by curvatures averaged over the views in which
the splat was seen. As every splat of the view takes its whole step at the same time, the curvatures
are those of a separable surrogate (see `nanogs.kernels.backward`).
"""

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from nanogs._types import F64, Bool
from nanogs.fit.parameters import RefitParameters
from nanogs.fit.state import HIGHEST_LOGIT, LOWEST_LOGIT, MeanState, State, activate, start, ways_of
from nanogs.fit.targets import Fitting, Target, pull
from nanogs.kernels.advance import advance_splats
from nanogs.kernels.blocks import ALL_BLOCKS, FIELDS
from nanogs.kernels.chain import PACKED
from nanogs.kernels.damped import SIZES
from nanogs.raster.rendering import seen_by, together
from nanogs.splats import RenderMode, Splats

if TYPE_CHECKING:
    from nanogs.fit.shared import Shared

# Largest steps: centres in standard deviations, log-scales, turns in radians, logit of the opacity.
LIMITS = (0.5, 0.5, 0.5, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3, 0.5)
WARM_UP = 4  # steps until the rate is reached: the first curvatures come from few views
SLOWEST = 0.3  # of the rate, at the end of the schedule, where states are averaged
FITTED = ("centres", "scales", "rotations", "opacities", "colours")


class Descent:
    """Moves a state, view by view.

    Args:
        splats: The input; ridges pull back to its colours.
        views: The views to fit to, each in its turn; a view is drawn when its turn comes.
        parameters: Steps, damping, floor, ridges and seed; see `RefitParameters`.
        shared: Which splats share their higher harmonics; by default each has its own.
    """

    def __init__(
        self,
        splats: Splats,
        views: Fitting,
        parameters: RefitParameters,
        shared: "Shared | None" = None,
    ) -> None:
        self.splats = splats
        self.shared = shared
        self.views = views
        self.parameters = parameters
        self.finite: Bool = splats.finite()
        self._given = np.ascontiguousarray(splats.sh)
        self._bands = _bands(splats.sh_degree, parameters)
        self._limits = np.array([*LIMITS, LOWEST_LOGIT, HIGHEST_LOGIT])
        self._random = np.random.default_rng(parameters.seed)
        self._queue: list[int] = []
        self._turns = 0  # how often all views have come
        self.begin(start(splats))

    @property
    def state(self) -> State:
        """The splats as they are now; further steps move the same arrays."""
        return self._state

    def begin(self, state: State) -> None:
        """Go on from a state, which stays as it is, with no memory of any view."""
        n = len(self.splats)
        self._state = state.copy()
        self._active = activate(self._state, self.splats, self.finite)
        if self.views.surroundings is not None:
            model = together(self._active.model, self.views.surroundings)
            self._active = replace(self._active, model=model)
            self._state = replace(self._state, sh=model.sh[:n])  # one array for both, as it was
        self._seen = np.zeros(n, np.int32)
        self._blocks = np.zeros((n, PACKED), np.float32)
        self._weights = np.zeros(n, np.float32)
        self._ways = ways_of(state, self.splats)
        self._count = 0

    def averaging(self) -> "Averaging":
        """A mean of states of this descent, which adds the present one whenever it is told to."""
        return MeanOf(self)

    def rest(self) -> None:
        """Free the memory that only steps need; before further steps, call `begin`."""
        del self._state, self._active, self._seen, self._blocks, self._weights, self._ways

    def step(self, rate: float, share: float) -> float:
        """Move the state by one step.

        Args:
            rate: Length of the first steps.
            share: How much of the schedule is over, in [0, 1].

        Returns:
            The mean squared error of the step's view before it.
        """
        self._count += 1
        rate *= min(1.0, self._count / WARM_UP)
        rate *= SLOWEST + (1 - SLOWEST) * 0.5 * (1 + math.cos(math.pi * share))
        error = self._follow(*self._next(), rate)
        if self.shared is not None:
            self._level(self.shared)
        return error

    def _level(self, shared: "Shared") -> None:
        """Give the splats of each entry of a palette the same harmonics."""
        shared.level(self._state.sh)

    def _next(self) -> tuple[Target, int]:
        """A view, and the blocks of its tiles that the step follows."""
        if not self._queue:
            self._queue = self._random.permutation(len(self.views)).tolist()
            self._turns += 1
        index = self._queue.pop()
        wanted = FIELDS[(index + self._turns) % 2] if self.parameters.halves else ALL_BLOCKS
        target = self.views.take(index, wanted)
        return target, wanted if target.blocks == ALL_BLOCKS else target.blocks

    def _follow(self, target: Target, wanted: int, rate: float) -> float:
        """Move what a view shows in some blocks, and return their error before that."""
        state, active, model = self._state, self._active, self._active.model
        view = pull(model, target, wanted)
        advance_splats(
            np.flatnonzero(view.view.boxes[: len(self.splats)]),  # HIDDEN is 0; no surroundings
            view.view.geometry,
            view.view.features,
            view.totals,
            *seen_by(target.camera),
            model.render_mode is RenderMode.MIP,
            model.sh_degree,
            rate,
            self.parameters.damping,
            self.parameters.floor,
            len(self.views),
            SIZES,
            self._limits,
            self._bands,
            self._given,
            state.means,
            state.log_scales,
            state.quats,
            state.logits,
            state.sh,
            state.touched,
            model.means,
            active.axes,
            active.scales,
            model.factors,
            model.opacities,
            model.reaches,
            model.keep,
            self._seen,
            self._blocks,
            self._weights,
            self._ways,
        )
        return view.error


class Averaging(Protocol):
    """The mean of states that a descent passes through."""

    def add(self) -> None:
        """Add the state as it is now."""

    def state(self) -> State:
        """The mean, with unit quaternions; of at least one state."""


class MeanOf:
    """The mean of states of a descent; see `Averaging`."""

    def __init__(self, descent: Descent) -> None:
        self._descent, self._mean = descent, MeanState()

    def add(self) -> None:
        """Add the state as it is now."""
        self._mean.add(self._descent.state)

    def state(self) -> State:
        """The mean, with unit quaternions; of at least one state."""
        return self._mean.state()


def _bands(degree: int, parameters: RefitParameters) -> F64:
    """(K, 2) curvature and ridge of the coefficients of a splat of weight 1.

    All coefficients move at once, so each takes a share p of the change of colour and the curvature
    Y² / p: half of it for the base colour, equal parts of the other half for the other bands, and
    within a band shares as Y², whose sum over the band is (2 l + 1) / 4 pi in every direction.
    """
    shares = [1.0] if degree == 0 else [0.5] + [0.5 / degree] * degree
    sizes = [2 * band + 1 for band in range(degree + 1)]
    curvature = np.repeat([size / share for size, share in zip(sizes, shares, strict=True)], sizes)
    ridge = np.repeat([parameters.ridge] + [parameters.band_ridge] * degree, sizes)
    return np.stack([curvature, ridge], axis=1) / (4 * math.pi)

"""The steps of a refit: a damped Newton step for each splat, on one view at a time.

Each step uses the gradient of one view's squared error, and curvatures averaged over the views in
which the splat was seen. Because all splats of the view take their whole steps at the same time,
the curvatures are those of a separable surrogate (see `nanogs.kernels.backward`).
"""

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from nanogs._types import F32, F64, I32, Bool
from nanogs.activations import SH_C0
from nanogs.fit.parameters import RefitParameters
from nanogs.fit.state import (
    HIGHEST_LOGIT,
    LOWEST_LOGIT,
    MeanState,
    State,
    activate,
    displacements_of,
    start,
)
from nanogs.fit.targets import Fitting, Target, compute_gradients
from nanogs.io.rate_distortion import Curvatures
from nanogs.kernels.advance import DISPLACEMENT, MOST_DETERMINED, advance_splats
from nanogs.kernels.blocks import ALL_BLOCKS, FIELDS
from nanogs.kernels.chain import CENTRE, DIAGONAL, OPACITY, PACKED, TURN
from nanogs.kernels.damped import SIZES
from nanogs.raster.rendering import camera_arrays, concatenated
from nanogs.splats import RenderMode, Splats

if TYPE_CHECKING:
    from nanogs.fit.shared import SharedHarmonics

# Largest step of each parameter: centre in standard deviations, log-scales, rotation in radians,
# logit of the opacity.
LIMITS = (0.5, 0.5, 0.5, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3, 0.5)
WARM_UP = 4  # steps until the full learning rate: the first curvatures come from few views
SLOWEST = 0.3  # share of the learning rate at the end of the schedule, where states are averaged
# Factors of the curvatures of centres, opacities and colours beside those of shapes, which also
# count what other views would show: the growth of the error through rounding each kind of value,
# measured.
_CENTRES, _OPACITIES, _COLOURS = np.float32(2), np.float32(2), np.float32(3)
TYPICAL = 2  # views, beside those of the steps, in which a splat is taken to be typical
FITTED = ("centres", "scales", "rotations", "opacities", "colours")


class Descent:
    """Fits the parameters of splats to views: each step follows the gradient of one view.

    Args:
        splats: The model to start from; ridges pull colours back to its colours.
        views: The views to fit to, in random order; those not kept are rendered when needed.
        parameters: Steps, damping, floor, ridges and seed; see `RefitParameters`.
        shared: Which splats share their higher harmonics; by default each has its own.
    """

    def __init__(
        self,
        splats: Splats,
        views: Fitting,
        parameters: RefitParameters,
        shared: "SharedHarmonics | None" = None,
    ) -> None:
        self.splats = splats
        self.shared = shared
        self.views = views
        self.parameters = parameters
        self.finite: Bool = splats.finite()
        self._initial_sh = np.ascontiguousarray(splats.sh)
        self._bands = _bands(splats.sh_degree, parameters)
        self._limits = np.array([*LIMITS, LOWEST_LOGIT, HIGHEST_LOGIT])
        self._random = np.random.default_rng(parameters.seed)
        self._queue: list[int] = []
        self._turns = 0  # passes over all views begun so far
        self._count = 0  # steps since `begin`
        self._mean = MeanState()
        self._displacements = np.zeros((len(splats), DISPLACEMENT), np.float32)
        self.begin(start(splats))

    @property
    def state(self) -> State:
        """The current parameters; later steps change the same arrays."""
        return self._state

    def begin(self, state: State) -> None:
        """Continue from a copy of a state, and forget the curvatures of all views.

        How well the views so far have determined each splat stays known.
        """
        n, determined = len(self.splats), self._displacements[:, MOST_DETERMINED]
        self._state = state.copy()
        self._active = activate(self._state, self.splats, self.finite)
        if self.views.surroundings is not None:
            model = concatenated(self._active.model, self.views.surroundings)
            self._active = replace(self._active, model=model)
            # State and model share one array of coefficients, as they do without surroundings.
            self._state = replace(self._state, sh=model.sh[:n])
        # Number of views in which each splat was seen since `begin`. Means over these views: of the
        # Gauss-Newton Hessian of its shape (see `kernels.chain`), and of its colour's curvature.
        self._seen = np.zeros(n, np.int32)
        self._hessians = np.zeros((n, PACKED), np.float32)
        self._weights = np.zeros(n, np.float32)
        self._displacements = displacements_of(state, self.splats)
        self._displacements[:, MOST_DETERMINED] = determined
        self._count = 0

    def add_to_mean(self) -> None:
        """Add the current state to the mean of states."""
        self._mean.add(self.state)

    def mean(self) -> State:
        """Return the mean of the states that were added, one at least; see `MeanState`."""
        return self._mean.state()

    def curvatures(self) -> Curvatures:
        """Return how fast the views' mean squared error grows with changes of each splat.

        The views are those of the steps, and a few more in which each splat is typical: one that
        hardly shows in these may do so in others.
        """
        seen, hessians, weights = self._accumulated()
        found = np.column_stack([hessians[:, DIAGONAL[CENTRE:]], weights])
        typical = np.median(found[seen > 0], axis=0) if seen.any() else np.zeros(found.shape[1])
        sums = seen[:, None] * found + TYPICAL * typical
        mean = (sums / (self._count + TYPICAL)).astype(np.float32)
        # Without the typical splat: to move a tiny one by a standard deviation shows less.
        centres = seen[:, None] * hessians[:, DIAGONAL[:CENTRE]] / max(self._count, 1)
        return Curvatures(
            centres=_CENTRES * centres.astype(np.float32),
            log_scales=mean[:, : TURN - CENTRE],
            rotations=mean[:, TURN - CENTRE : OPACITY - CENTRE],
            logits=_OPACITIES * mean[:, OPACITY - CENTRE],
            colours=_COLOURS * np.float32(SH_C0**2) * mean[:, -1],
        )

    def _accumulated(self) -> tuple[I32, F32, F32]:
        """Return (N,) numbers of views, (N, PACKED) Hessians and (N,) curvatures of colours."""
        return self._seen, self._hessians, self._weights

    def release(self) -> None:
        """Free the memory that only steps need, after the last one."""
        del self._state, self._active, self._seen
        del self._hessians, self._weights, self._displacements

    def step(self, rate: float, share: float) -> float:
        """Take one step, on the next view.

        Args:
            rate: Learning rate at the start of the schedule.
            share: Fraction of the schedule that is done, in [0, 1].

        Returns:
            The mean squared error of the step's view before the step.
        """
        self._count += 1
        rate *= min(1.0, self._count / WARM_UP)
        rate *= SLOWEST + (1 - SLOWEST) * 0.5 * (1 + math.cos(math.pi * share))
        error = self._follow_view(*self._next(), rate)
        if self.shared is not None:
            self._average_shared(self.shared)
        return error

    def _average_shared(self, shared: "SharedHarmonics") -> None:
        """Replace the harmonics of all splats of a palette entry by their mean."""
        shared.average(self._state.sh)

    def _next(self) -> tuple[int, int]:
        """Return the next view's index, and a bit mask of the blocks of each tile that it uses."""
        if not self._queue:
            self._queue = self._random.permutation(len(self.views)).tolist()
            self._turns += 1
        index = self._queue.pop()
        wanted = FIELDS[(index + self._turns) % 2] if self.parameters.halves else ALL_BLOCKS
        if self.views.to_render(index) is None and self.views.kept[index].blocks != ALL_BLOCKS:
            wanted = self.views.kept[index].blocks
        return index, wanted

    def _follow_view(self, index: int, wanted: int, rate: float) -> float:
        """Take a step on some blocks of a view, and return their mean squared error before it."""
        return self._follow_target(self.views.take(index, wanted), wanted, rate)

    def _follow_target(self, target: Target, wanted: int, rate: float) -> float:
        """Take a step on some blocks of a view that is rendered; see `_follow_view`."""
        state, active, model = self._state, self._active, self._active.model
        view = compute_gradients(model, target, wanted)
        advance_splats(
            # The rows that are drawn (HIDDEN is 0), without those of the surroundings.
            np.flatnonzero(view.view.boxes[: len(self.splats)]),
            view.view.geometry,
            view.view.features,
            view.totals,
            *camera_arrays(target.camera),
            model.render_mode is RenderMode.MIP,
            model.sh_degree,
            rate,
            self.parameters.damping,
            self.parameters.floor,
            len(self.views),
            SIZES,
            self._limits,
            self._bands,
            self._initial_sh,
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
            self._hessians,
            self._weights,
            self._displacements,
        )
        return view.error


def _bands(degree: int, parameters: RefitParameters) -> F64:
    """Compute (K, 2) curvature and ridge of each harmonic coefficient of a splat of weight 1.

    All coefficients move at once, so each is given a share p of the change of colour and the
    curvature Y² / p: the base colour gets half, the other bands equal parts of the other half, and
    within a band shares are proportional to Y², whose sum is (2 l + 1) / 4 pi in every direction.
    """
    shares = [1.0] if degree == 0 else [0.5] + [0.5 / degree] * degree
    sizes = [2 * band + 1 for band in range(degree + 1)]
    curvature = np.repeat([size / share for size, share in zip(sizes, shares, strict=True)], sizes)
    ridge = np.repeat([parameters.ridge] + [parameters.band_ridge] * degree, sizes)
    return np.stack([curvature, ridge], axis=1) / (4 * math.pi)

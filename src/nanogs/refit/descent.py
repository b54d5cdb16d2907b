"""Steps of a refit: damped Newton steps, splat by splat, on a few views at a time.

Each step follows the pulls of a few views, averaged with those of earlier steps, and is scaled by
curvatures averaged over about one pass through all views. As every splat takes its whole step at
the same time, the curvatures are those of a separable surrogate (see `nanogs.kernels.backward`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nanogs._types import F64, Bool
from nanogs.kernels import chain
from nanogs.refit.parameters import RefitParameters
from nanogs.refit.state import Active, State, activate
from nanogs.refit.targets import Pull, Target, pull
from nanogs.splats import RenderMode, Splats

# Largest steps: centres in standard deviations, log-scales, turns in radians, logit of the opacity.
LIMITS = (0.5, 0.5, 0.5, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3, 0.5)
WARM_UP = 8  # steps until the rate is reached: the first curvatures come from few views
SLOWEST = 0.05  # of the rate, at the end of the schedule
FITTED = ("centres", "scales", "rotations", "opacities", "colours")


@dataclass(frozen=True, slots=True, eq=False)
class Sums:
    """Pulls and curvatures, of one step or averaged.

    Attributes:
        pulls: (N, 10) float64, on the parameters of shape.
        blocks: (N, 55) float64, their curvatures, lower triangles.
        colour_pulls: (N, K, 3) float64.
        colour_weights: (N,) float64.
    """

    pulls: F64
    blocks: F64
    colour_pulls: F64
    colour_weights: F64

    @classmethod
    def zeros(cls, splats: Splats) -> "Sums":
        """Sums of no view."""
        n, k = splats.sh.shape[:2]
        return cls(
            np.zeros((n, chain.SHAPE)),
            np.zeros((n, chain.PACKED)),
            np.zeros((n, k, 3)),
            np.zeros(n),
        )

    def average(self, new: "Sums", momentum: float, memory: float) -> None:
        """Let the averages forget a little and take in a step's sums."""
        for mine, fresh, keep in (
            (self.pulls, new.pulls, momentum),
            (self.colour_pulls, new.colour_pulls, momentum),
            (self.blocks, new.blocks, memory),
            (self.colour_weights, new.colour_weights, memory),
        ):
            np.multiply(mine, keep, out=mine)
            np.add(mine, (1 - keep) * fresh, out=mine)


class Descent:
    """Takes steps from one state to the next.

    Args:
        splats: The input; ridges pull back to its colours.
        targets: The views to fit to.
        parameters: See there.
    """

    def __init__(
        self, splats: Splats, targets: Sequence[Target], parameters: RefitParameters
    ) -> None:
        self.splats = splats
        self.targets = targets
        self.parameters = parameters
        self.finite: Bool = splats.finite()
        self._bands = _bands(splats.sh_degree, parameters)
        self.batch = min(parameters.batch, len(targets))
        self._random = np.random.default_rng(parameters.seed)
        self._queue: list[int] = []
        self.forget()

    def forget(self) -> None:
        """Start the averages anew, as after a return to an earlier state."""
        self._mean = Sums.zeros(self.splats)
        self._count = 0

    def step(self, state: State, rate: float, share: float) -> tuple[State, float]:
        """One step.

        Args:
            state: Where to start.
            rate: Length of the first steps.
            share: How much of the schedule is over, in [0, 1].

        Returns:
            The next state, and the mean squared error of the step's views before it.
        """
        active = activate(state, self.splats, self.finite)
        fresh = Sums.zeros(self.splats)
        error = 0.0
        for _ in range(self.batch):
            target = self._next()
            view = pull(active.model, target)
            self._chain(active, target, view, fresh)
            error += view.error / self.batch
        memory = 1 - self.batch / len(self.targets)
        momentum = self.parameters.momentum
        self._mean.average(fresh, momentum, memory)
        self._count += 1
        rate *= min(1.0, self._count / WARM_UP)
        rate *= SLOWEST + (1 - SLOWEST) * 0.5 * (1 + math.cos(math.pi * share))
        unbias = 1 - momentum**self._count, 1 - memory**self._count
        return state.moved(rate * self._shapes(unbias), rate * self._colours(state, unbias)), error

    def _next(self) -> Target:
        if not self._queue:
            self._queue = self._random.permutation(len(self.targets)).tolist()
        return self.targets[self._queue.pop()]

    def _chain(self, active: Active, target: Target, view: Pull, sums: Sums) -> None:
        """Add a view's sums in the terms of the parameters."""
        camera, model, order = target.camera, active.model, view.view.order
        lens = (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
        chain.chain_shapes(
            order,
            view.view.geometry,
            view.totals,
            model.means,
            active.axes,
            active.scales,
            model.opacities,
            np.ascontiguousarray(camera.world_to_camera[:3, :3], np.float64),
            camera.position,
            np.array(lens, np.float64),
            model.render_mode is RenderMode.MIP,
            sums.pulls,
            sums.blocks,
        )
        chain.chain_colours(
            order,
            view.view.features,
            view.totals,
            model.means,
            camera.position,
            model.sh_degree,
            sums.colour_pulls,
            sums.colour_weights,
        )

    def _shapes(self, unbias: tuple[float, float]) -> F64:
        """(N, 10) float64 steps of the parameters of shape."""
        steps = np.empty_like(self._mean.pulls)
        chain.damped_steps(
            self._mean.pulls / unbias[0],
            self._mean.blocks / unbias[1],
            self.parameters.damping,
            self.parameters.floor,
            np.array(LIMITS),
            steps,
        )
        return steps

    def _colours(self, state: State, unbias: tuple[float, float]) -> F64:
        """(N, K, 3) float64 steps of the coefficients, with their pull back to the input's."""
        weights = (self._mean.colour_weights / unbias[1])[:, None, None]
        curvature, ridge = self._bands
        pulls = self._mean.colour_pulls / unbias[0]
        pulls = pulls - ridge * weights * (state.sh - self.splats.sh)
        steps = np.zeros_like(pulls)
        np.divide(pulls, (curvature + ridge) * weights, out=steps, where=weights > 0)
        return steps


def _bands(degree: int, parameters: RefitParameters) -> tuple[F64, F64]:
    """(K, 1) curvatures and (K, 1) ridges of the coefficients of a splat of weight 1.

    All coefficients move at once, so each takes a share p of the change of colour and the curvature
    Y² / p: half of it for the base colour, equal parts of the other half for the other bands, and
    within a band shares as Y², whose sum over the band is (2 l + 1) / 4 pi in every direction.
    """
    shares = [1.0] if degree == 0 else [0.5] + [0.5 / degree] * degree
    sizes = [2 * band + 1 for band in range(degree + 1)]
    curvature = np.repeat([size / share for size, share in zip(sizes, shares, strict=True)], sizes)
    ridge = np.repeat([parameters.ridge] + [parameters.band_ridge] * degree, sizes)
    return curvature[:, None] / (4 * math.pi), ridge[:, None] / (4 * math.pi)

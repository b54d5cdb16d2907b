"""A model on a device that a fit moves there, step by step."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from nanogs._types import F32, F64, U8, Bool
from nanogs.card.advancing import Moving, Rules, advance_splats, average
from nanogs.card.engine import Model
from nanogs.kernels.chain import PACKED


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pace:
    """How far steps go; see `nanogs.kernels.advance.advance_splats`, whose arguments these are.

    Attributes:
        damping: As there.
        floor: As there.
        memory: As there.
        limits: (12,).
        bands: (K, 2).
        single: Whether centres are drawn as float32.
    """

    damping: float
    floor: float
    memory: int
    limits: F64
    bands: F64
    single: bool


class MovingModel:
    """N splats on their way, and what else is drawn with them, on a device.

    Args:
        model: What is drawn: the splats first; it is moved in place.
        columns: means, log_scales, quats, logits and touched of `fit.state.State`.
        ways: (N, WAY) of `nanogs.kernels.advance`.
        given: (N, K, 3) coefficients that ridges pull back to.
        axes: (N, 3, 3) rotation matrices.
        scales: (N, 3) scene units.
        pace: How far steps go.
    """

    def __init__(
        self,
        model: Model,
        columns: Sequence[F64 | Bool],
        ways: F32,
        given: F32,
        axes: F32,
        scales: F32,
        pace: Pace,
    ) -> None:
        put, n = model.engine.put, len(given)
        self._model, self._count = model, n
        moving = Moving()
        moving.means, moving.log_scales, moving.quats, moving.logits, moving.touched = (
            put(column) for column in columns
        )
        moving.given, moving.axes, moving.scales = put(given), put(axes), put(scales)
        moving.sh, moving.centres, moving.factors = model.sh, model.means, model.factors
        moving.opacities, moving.reaches = model.opacities, model.reaches
        moving.keep = model.keep
        moving.seen = put(np.zeros(n, np.int32))
        moving.blocks = put(np.zeros((n, PACKED), np.float32))
        moving.weights = put(np.zeros(n, np.float32))
        moving.ways = put(ways)
        rules = Rules()
        rules.damping, rules.floor, rules.memory = pace.damping, pace.floor, pace.memory
        rules.limits, rules.bands, rules.single = put(pace.limits), put(pace.bands), pace.single
        self._moving, self._rules = moving, rules

    def step(
        self,
        camera: tuple[F64, F64, F64],
        degree: int,
        goal: U8,
        shares: tuple[float, float],
        wanted: int,
        rate: float,
    ) -> float:
        """Follow one view, and return its mean squared error before that.

        Args:
            camera: Rotation, position and intrinsics, as `project_splats` takes them.
            degree: Of the harmonics.
            goal: (H, W, 4) what the view should show.
            shares: Of white, and of alpha; see `nanogs.kernels.backward.weigh_pixels`.
            wanted: Its set bits are the blocks of every tile whose pixels pull.
            rate: Length of the step.
        """
        view = self._model.view(*camera, degree)
        features = view.tinted(*shares)
        image, _ = view.blend(features, np.zeros(4, np.float32), wanted)
        residual, precision, error = view.weigh(image, goal, *shares, wanted)
        totals = view.pulls(features, image, residual, precision, wanted)
        self._rules.rate = rate
        self._model.engine.launch(
            advance_splats, self._count, view.geometry, view.features, totals, view.rotation,
            view.position, view.lens, self._model.mip, degree, self._rules, self._moving,
        )  # fmt: skip
        return error

    def columns(self, of: "Moving | None" = None) -> tuple[F64, F64, F64, F64, F32, Bool]:
        """Means, log_scales, quats, logits, sh and touched, as `fit.state.State` has them.

        Args:
            of: The mean states from `begin_mean` in place of the splats as they are.
        """
        held, n = of or self._moving, self._count
        return (
            held.means.numpy(), held.log_scales.numpy(), held.quats.numpy(), held.logits.numpy(),
            held.sh.numpy()[:n], self._moving.touched.numpy(),
        )  # fmt: skip

    def begin_mean(self) -> Moving:
        """The splats as they are, to become mean states."""
        mean = Moving()
        for name in ("means", "log_scales", "quats", "logits", "sh"):
            setattr(mean, name, wp.clone(getattr(self._moving, name)))
        return mean

    def add_to_mean(self, mean: Moving, share: float) -> None:
        """Bring mean states nearer to the splats as they are, by a share of the way."""
        self._model.engine.launch(average, self._count, share, self._moving, mean)

    def recolour(self, sh: F32) -> None:
        """Give the splats other coefficients, (N, K, 3)."""
        colours = self._model.engine.put(sh)
        wp.copy(self._moving.sh, colours, count=colours.size)

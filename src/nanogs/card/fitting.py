"""A model on a device whose parameters are fitted there."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from nanogs._types import F32, F64, I32, Bool
from nanogs.card.advancing import FittedSplats, StepConstants, advance_splats, average
from nanogs.card.engine import DeviceSplats
from nanogs.kernels.advance import MOST_DETERMINED
from nanogs.kernels.chain import PACKED


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StepParameters:
    """Parameters of the steps; see the arguments of `nanogs.kernels.advance.advance_splats`.

    Attributes:
        damping: The same argument there.
        floor: The same argument there.
        memory: The same argument there.
        limits: (12,), the same argument there.
        bands: (K, 2), the same argument there.
        single: Whether centres are rounded to float32 before they are drawn.
    """

    damping: float
    floor: float
    memory: int
    limits: F64
    bands: F64
    single: bool


class FittedModel:
    """N splats that are fitted on a device, and splats that are drawn with them but do not move.

    Args:
        model: The model that is drawn: first the N splats, which are changed in place.
        columns: means, log_scales, quats, logits and touched of `fit.state.State`.
        displacements: (N, DISPLACEMENT) of `nanogs.kernels.advance`.
        initial_sh: (N, K, 3) coefficients that ridges pull back to.
        axes: (N, 3, 3) rotation matrices.
        scales: (N, 3) scene units.
        parameters: Of the steps.
    """

    def __init__(
        self,
        model: DeviceSplats,
        columns: Sequence[F64 | Bool],
        displacements: F32,
        initial_sh: F32,
        axes: F32,
        scales: F32,
        parameters: StepParameters,
    ) -> None:
        put, n = model.engine.put, len(initial_sh)
        self._model, self._count = model, n
        moving = FittedSplats()
        moving.means, moving.log_scales, moving.quats, moving.logits, moving.touched = (
            put(column) for column in columns
        )
        moving.initial_sh, moving.axes, moving.scales = put(initial_sh), put(axes), put(scales)
        moving.sh, moving.centres, moving.factors = model.sh, model.means, model.factors
        moving.opacities, moving.reaches = model.opacities, model.reaches
        moving.keep = model.keep
        moving.seen = put(np.zeros(n, np.int32))
        moving.hessians = put(np.zeros((n, PACKED), np.float32))
        moving.weights = put(np.zeros(n, np.float32))
        moving.displacements = put(displacements)
        rules = StepConstants()
        rules.damping, rules.floor = parameters.damping, parameters.floor
        rules.memory, rules.single = parameters.memory, parameters.single
        rules.limits, rules.bands = put(parameters.limits), put(parameters.bands)
        self._moving, self._rules = moving, rules

    def step(
        self,
        camera: tuple[F64, F64, F64],
        degree: int,
        target: wp.array,
        shares: tuple[float, float],
        wanted: int,
        rate: float,
    ) -> float:
        """Take one step on one view, and return the view's mean squared error before it.

        Args:
            camera: Rotation, position and intrinsics, as `project_splats` takes them.
            degree: Spherical-harmonic degree.
            target: (H, W, 4) uint8 on the device, target image of the view.
            shares: `white` and `alpha_scale` of `nanogs.kernels.backward.weigh_pixels`.
            wanted: Bit mask of the blocks of each tile whose pixels count.
            rate: Learning rate.
        """
        view = self._model.view(*camera, degree)
        features = view.tinted(*shares)
        image, _ = view.blend(features, np.zeros(4, np.float32), wanted)
        residual, curvature_weights, error = view.weigh(image, target, *shares, wanted)
        totals = view.gradients(features, image, residual, curvature_weights, wanted)
        self._rules.rate = rate
        self._model.engine.launch(
            advance_splats, self._count, view.geometry, view.features, totals, view.rotation,
            view.position, view.intrinsics, self._model.mip, degree, self._rules, self._moving,
        )  # fmt: skip
        return error

    def columns(self, of: "FittedSplats | None" = None) -> tuple[F64, F64, F64, F64, F32, Bool]:
        """Copy the arrays of a `fit.state.State`, in its order, from the device.

        Args:
            of: The running mean from `begin_mean`; by default the current parameters.
        """
        held, n = of or self._moving, self._count
        return (
            held.means.numpy(), held.log_scales.numpy(), held.quats.numpy(), held.logits.numpy(),
            held.sh.numpy()[:n], self._moving.touched.numpy(),
        )  # fmt: skip

    def begin_mean(self) -> FittedSplats:
        """Start a running mean with a copy of the current parameters."""
        mean = FittedSplats()
        for name in ("means", "log_scales", "quats", "logits", "sh"):
            setattr(mean, name, wp.clone(getattr(self._moving, name)))
        return mean

    def add_to_mean(self, mean: FittedSplats, share: float) -> None:
        """Move a running mean towards the current parameters, by a share of the way."""
        self._model.engine.launch(average, self._count, share, self._moving, mean)

    def determined(self) -> F32:
        """Copy the (N,) last column of the displacements from the device."""
        found: F32 = self._moving.displacements.numpy()[: self._count, MOST_DETERMINED]
        return found

    def accumulated(self) -> tuple[I32, F32, F32]:
        """Copy what steps have found of each splat from the device.

        Returns:
            (N,) in how many views it was seen, (N, PACKED) mean curvatures of its shape, and (N,)
            of its colour.
        """
        moving = self._moving
        return moving.seen.numpy(), moving.hessians.numpy(), moving.weights.numpy()

    def coefficients(self) -> F32:
        """Copy the splats' spherical-harmonic coefficients, (N, K, 3), from the device."""
        sh: F32 = self._moving.sh.numpy()[: self._count]
        return sh

    def recolour(self, sh: F32) -> None:
        """Replace the splats' spherical-harmonic coefficients, (N, K, 3)."""
        colours = self._model.engine.put(sh)
        wp.copy(self._moving.sh, colours, count=colours.size)

"""The parameters that a refit optimises, and their conversion from and to a model."""

import math
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from nanogs._arrays import each_row
from nanogs._types import F32, F64, Array, Bool
from nanogs.activations import LEAST_SCALE, alphas, rotations
from nanogs.findings import Finding
from nanogs.kernels.advance import DISPLACEMENT
from nanogs.kernels.project import MIN_ALPHA, reaches_of
from nanogs.kernels.symmetric3 import MOST_DEVIATION
from nanogs.raster.rendering import PreparedSplats
from nanogs.splats import Splats

# Bounds of the opacity's logit. Alpha is clamped to 0.99 when drawn, so that it would take many
# steps to reduce an opacity from a much larger logit; and a splat that falls below 1/255 is not
# drawn, has no gradient and could never come back.
HIGHEST_LOGIT = 7.0
LOWEST_LOGIT = -5.0
# Least log-scale: a scale of 0 is valid, but a step from its logarithm, -inf, would be NaN.
LOWEST_LOG_SCALE = float(np.log(np.float32(LEAST_SCALE)))


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """The parameters of N splats during a fit; a descent changes them in place.

    Attributes:
        means: (N, 3) float64, scene units.
        log_scales: (N, 3) float64.
        quats: (N, 4) float64, wxyz, unit.
        logits: (N,) float64.
        sh: (N, K, 3) float32.
        touched: (N,) bool, true for splats that have moved.
    """

    means: F64
    log_scales: F64
    quats: F64
    logits: F64
    sh: F32
    touched: Bool

    def copy(self) -> "State":
        """Return a copy of all arrays."""
        return State(*(getattr(self, field.name).copy() for field in fields(self)))

    def towards(self, other: "State", share: float) -> "State":
        """Interpolate, by a share in [0, 1], towards a later state of the same descent."""
        left = 1 - share
        quats = left * self.quats + share * _facing(other.quats, self.quats)
        quats /= np.linalg.norm(quats, axis=1, keepdims=True)
        return State(
            means=left * self.means + share * other.means,
            log_scales=left * self.log_scales + share * other.log_scales,
            quats=quats,
            logits=left * self.logits + share * other.logits,  # infinite ones stay infinite
            sh=np.float32(left) * self.sh + np.float32(share) * other.sh,
            touched=other.touched.copy(),
        )


class MeanState:
    """The running mean of the states of a descent (Polyak and Juditsky, 1992).

    Each step follows one view, so that states oscillate between the optima of single views; their
    mean does not.
    """

    def __init__(self) -> None:
        self._mean: State | None = None
        self._count = 0

    def add(self, state: State) -> None:
        """Add one more state."""
        self._count += 1
        if self._mean is None:
            self._mean = state.copy()
            return
        share = 1 / self._count
        for mean, new in (
            (self._mean.means, state.means),
            (self._mean.log_scales, state.log_scales),
            (self._mean.quats, state.quats),  # steps are small, so that none has changed its sign
            (self._mean.logits, state.logits),
            (self._mean.sh, state.sh),
        ):
            np.multiply(mean, 1 - share, out=mean)
            np.add(mean, new * share, out=mean)
        np.logical_or(self._mean.touched, state.touched, out=self._mean.touched)

    def state(self) -> State:
        """Return the mean, with unit quaternions; needs at least one `add`."""
        assert self._mean is not None  # noqa: S101 - callers have added a state
        self._mean.quats[:] /= np.linalg.norm(self._mean.quats, axis=1, keepdims=True)
        return self._mean


@dataclass(frozen=True, slots=True, eq=False)
class Active:
    """A state, activated for the kernels.

    Attributes:
        model: The model as `project` takes it; it shares the coefficients with the state.
        axes: (N, 3, 3) float32, rotation matrices.
        scales: (N, 3) float32, scene units.
    """

    model: PreparedSplats
    axes: F32
    scales: F32


def start(splats: Splats) -> State:
    """Convert a model to the state that a fit starts from."""
    return State(
        means=splats.means.astype(np.float64),
        log_scales=np.maximum(splats.log_scales, LOWEST_LOG_SCALE).astype(np.float64),
        quats=splats.unit_quats().astype(np.float64),
        logits=np.minimum(splats.opacity_logits.astype(np.float64), HIGHEST_LOGIT),
        sh=np.ascontiguousarray(splats.sh),
        touched=np.zeros(len(splats), np.bool_),
    )


def displacements_of(state: State, splats: Splats) -> F32:
    """Compute the (N, DISPLACEMENT) displacements of the parameters since the fit began.

    See `nanogs.kernels.advance`, also for the last column, which is 0 here. The displacement from a
    value that is not finite, such as the logit of opacity 0, is 0.
    """
    displacements = np.zeros((len(splats), DISPLACEMENT), np.float32)
    if not state.touched.any():
        return displacements
    log_scales = np.maximum(splats.log_scales, LOWEST_LOG_SCALE)
    logits = np.minimum(splats.opacity_logits, np.float32(HIGHEST_LOGIT))
    begun = splats.means, log_scales, splats.unit_quats(), logits[:, None]
    first = 0
    for now, then in zip(
        (state.means, state.log_scales, state.quats, state.logits[:, None]), begun, strict=True
    ):
        part = displacements[:, first : first + then.shape[1]]
        np.subtract(now, then, out=part, where=np.isfinite(then), casting="same_kind")
        first += then.shape[1]
    return displacements


def activate(state: State, splats: Splats, finite: Bool) -> Active:
    """Activate a state for the kernels; degree, render mode and dtype are those of `splats`."""
    axes = rotations(state.quats).astype(np.float32)
    opacities = alphas(state.logits).astype(np.float32)
    with np.errstate(invalid="ignore", over="ignore"):  # rows that are not finite are not drawn
        scales = np.exp(state.log_scales).astype(np.float32)
        factors = axes * scales[:, None, :]
        means = state.means.astype(splats.means.dtype)  # rounded as in the model to be stored
    model = PreparedSplats(
        means=means,
        factors=factors,
        opacities=opacities,
        reaches=reaches_of(opacities),
        sh=state.sh,
        keep=finite & (opacities >= MIN_ALPHA),
        sh_degree=splats.sh_degree,
        render_mode=splats.render_mode,
        skipped=0,
    )
    return Active(model, axes, scales)


def store(state: State, splats: Splats) -> Splats:
    """Return the model with the state's parameters.

    Rows that never moved keep their bytes. So do rows that left the range of float32: these would
    not be drawn at all, which could pass for an improvement.
    """
    columns = _columns(state)
    rows = state.touched & _storable(state)
    stored: dict[str, Any] = {}
    for name, values in columns.items():
        column: Array = getattr(splats, name).copy()
        changed = rows.reshape(-1, *[1] * (values.ndim - 1))
        np.copyto(column, values, where=changed, casting="same_kind")
        stored[name] = column
    return replace(splats, **stored)


def range_notes(state: State) -> tuple[str, ...]:
    """Return a note on the rows that `store` leaves as they were although they moved, if any."""
    count = int((state.touched & ~_storable(state)).sum())
    text = (
        "{:splat keeps its values|splats keep their values} of before the fit, which would have"
        " left the range of float32."
    )
    return (Finding(text, count),) if count else ()


def _columns(state: State) -> dict[str, Array]:
    return {
        "means": state.means,
        "log_scales": state.log_scales,
        "quats": state.quats,
        "opacity_logits": state.logits,
        "sh": state.sh,
    }


def _storable(state: State) -> Bool:
    """Return the (N,) bool mask of the rows whose values and scales are in the range of float32."""
    rows = each_row(state.log_scales <= math.log(MOST_DEVIATION))
    for values in _columns(state).values():
        rows &= each_row(np.abs(values) <= np.finfo(np.float32).max)
    return rows


def _facing(quats: F64, others: F64) -> F64:
    """Return (N, 4) the same rotations: q or -q, the one nearer to the quaternion in `others`."""
    dots = np.einsum("ni,ni->n", quats, others)[:, None]
    return np.where(dots < 0, -quats, quats)

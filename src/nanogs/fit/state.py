"""The parameters that a refit moves, and how they become a model again."""

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from nanogs._types import F32, F64, Array, Bool
from nanogs.kernels.advance import WAY
from nanogs.kernels.project import MIN_ALPHA, reaches_of
from nanogs.raster.rendering import PreparedSplats
from nanogs.splats import Splats
from nanogs.stored import alphas, rotations

# Alpha is held at 0.99 when drawn: from a logit far above, an opacity would take long to come down,
# and a splat that falls below 1/255 is not drawn and could never come back.
HIGHEST_LOGIT = 7.0
LOWEST_LOGIT = -5.0


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """N splats on their way; a descent moves them in place.

    Attributes:
        means: (N, 3) float64, scene units.
        log_scales: (N, 3) float64.
        quats: (N, 4) float64, wxyz, unit.
        logits: (N,) float64.
        sh: (N, K, 3) float32.
        touched: (N,) bool, which have moved.
    """

    means: F64
    log_scales: F64
    quats: F64
    logits: F64
    sh: F32
    touched: Bool

    def copy(self) -> "State":
        """The same numbers in arrays of their own."""
        return State(*(getattr(self, field.name).copy() for field in fields(self)))

    def towards(self, other: "State", share: float) -> "State":
        """The state at a share, in [0, 1], of the way to a later one of the same descent."""
        left = 1 - share
        quats = left * self.quats + share * _facing(other.quats, self.quats)
        quats /= np.linalg.norm(quats, axis=1, keepdims=True)
        return State(
            means=left * self.means + share * other.means,
            log_scales=left * self.log_scales + share * other.log_scales,
            quats=quats,
            logits=left * self.logits + share * other.logits,  # what is infinite stays so
            sh=np.float32(left) * self.sh + np.float32(share) * other.sh,
            touched=other.touched.copy(),
        )


class MeanState:
    """The mean of states that a descent passes through (Polyak and Juditsky, 1992).

    Each step follows one view, and states go to and fro between what views ask for; their mean
    does not.
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
            (self._mean.quats, state.quats),  # turns are small, so that none has changed its sign
            (self._mean.logits, state.logits),
            (self._mean.sh, state.sh),
        ):
            np.multiply(mean, 1 - share, out=mean)
            np.add(mean, new * share, out=mean)
        np.logical_or(self._mean.touched, state.touched, out=self._mean.touched)

    def state(self) -> State:
        """The mean, with unit quaternions; of at least one state."""
        assert self._mean is not None  # noqa: S101 - whoever asks has added some
        self._mean.quats[:] /= np.linalg.norm(self._mean.quats, axis=1, keepdims=True)
        return self._mean


@dataclass(frozen=True, slots=True, eq=False)
class Active:
    """A state as the kernels take it.

    Attributes:
        model: What `project` takes; its coefficients are the state's own.
        axes: (N, 3, 3) float32, rotation matrices.
        scales: (N, 3) float32, scene units.
    """

    model: PreparedSplats
    axes: F32
    scales: F32


def start(splats: Splats) -> State:
    """The state that a model starts from."""
    return State(
        means=splats.means.astype(np.float64),
        log_scales=splats.log_scales.astype(np.float64),
        quats=splats.unit_quats().astype(np.float64),
        logits=np.minimum(splats.opacity_logits.astype(np.float64), HIGHEST_LOGIT),
        sh=np.ascontiguousarray(splats.sh),
        touched=np.zeros(len(splats), np.bool_),
    )


def ways_of(state: State, splats: Splats) -> F32:
    """(N, WAY) how far a state is from the model that it started from, of which nothing is told.

    See `nanogs.kernels.advance`; 0 where the model has infinite opacities.
    """
    ways = np.zeros((len(splats), WAY), np.float32)
    if not state.touched.any():
        return ways
    logits = np.minimum(splats.opacity_logits, np.float32(HIGHEST_LOGIT))
    begun = splats.means, splats.log_scales, splats.unit_quats(), logits[:, None]
    first = 0
    for now, then in zip(
        (state.means, state.log_scales, state.quats, state.logits[:, None]), begun, strict=True
    ):
        part = ways[:, first : first + then.shape[1]]
        np.subtract(now, then, out=part, where=np.isfinite(then), casting="same_kind")
        first += then.shape[1]
    return ways


def activate(state: State, splats: Splats, finite: Bool) -> Active:
    """Arrays for the kernels; tags and everything that does not move from `splats`."""
    axes = rotations(state.quats).astype(np.float32)
    opacities = alphas(state.logits).astype(np.float32)
    with np.errstate(over="ignore"):
        scales = np.exp(state.log_scales).astype(np.float32)
    model = PreparedSplats(
        means=state.means.astype(splats.means.dtype),  # as they are stored, and drawn elsewhere
        factors=axes * scales[:, None, :],
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
    """The model with the state's parameters.

    Rows that never moved keep their bytes, and so do those that left the range of float32: not
    drawn at all, they could pass for a gain.
    """
    columns: dict[str, Array] = {
        "means": state.means,
        "log_scales": state.log_scales,
        "quats": state.quats,
        "opacity_logits": state.logits,
        "sh": state.sh,
    }
    rows = state.touched.copy()
    for values in columns.values():
        within = np.abs(values) <= np.finfo(np.float32).max
        rows &= within.reshape(len(rows), -1).all(axis=1)
    stored: dict[str, Any] = {}
    for name, values in columns.items():
        column: Array = getattr(splats, name).copy()
        column[rows] = values[rows]
        stored[name] = column
    return replace(splats, **stored)


def _facing(quats: F64, others: F64) -> F64:
    """(N, 4) the same rotations by that one of q and -q which is nearer to the other."""
    dots = np.einsum("ni,ni->n", quats, others)[:, None]
    return np.where(dots < 0, -quats, quats)

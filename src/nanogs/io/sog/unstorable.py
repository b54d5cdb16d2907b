"""Values that a SOG file cannot hold: those that are refused, and those that are left out."""

import numpy as np

from nanogs import parallel
from nanogs._types import Bool
from nanogs.errors import UnstorableError
from nanogs.formatting import counted
from nanogs.io import limits
from nanogs.io.sog.meta import MAX_DEGREE
from nanogs.io.sog.texture import MAX_SIDE
from nanogs.slices import slices
from nanogs.splats import Splats

_FARTHEST = 1e18  # largest magnitude of a value: squared differences must not overflow float32
_VALUES = f"colour coefficients or log-scales beyond ±{_FARTHEST:g}"


def losses(splats: Splats) -> tuple[str, ...]:
    """Name what a SOG file leaves out, or why it refuses the model, one sentence each."""
    refused = limits.refusal(int(_beyond(splats).sum()), ".sog", _VALUES)
    left_out = limits.left_out(splats, ".sog", max_degree=MAX_DEGREE)
    return (*refused, *left_out, *limits.rounded(splats, ".sog"))


def refuse_unstorable(splats: Splats) -> None:
    """Refuse a model with values that the file cannot hold, or with too many splats.

    Raises:
        UnstorableError: It has such values, or so many splats.
    """
    limits.refuse_unstorable(splats, ".sog")
    if len(splats) > MAX_SIDE**2 // 2:
        raise UnstorableError(
            f"{len(splats):,} splats are too many for one .sog file; simplify the model."
        )
    if (wrong := _beyond(splats)).any():
        raise UnstorableError(
            f"{counted(int(wrong.sum()), 'splat holds', 'splats hold')} {_VALUES}, the first in row"
            f" {int(np.argmax(wrong))}, which .sog cannot hold together with ordinary ones; correct"
            " them, or write .ply."
        )


def _beyond(splats: Splats) -> Bool:
    """Return an (N,) bool mask of the splats that hold some of `_VALUES`."""
    beyond = np.zeros(len(splats), bool)

    def look(rows: slice) -> None:
        for values in (splats.sh[rows, : (MAX_DEGREE + 1) ** 2], splats.log_scales[rows]):
            with np.errstate(invalid="ignore"):  # signalling NaNs would warn
                large = (np.abs(values) > _FARTHEST) & np.isfinite(values)
            beyond[rows] |= large.reshape(len(values), -1).any(axis=1)

    parallel.for_each(slices(len(splats)), look)
    return beyond

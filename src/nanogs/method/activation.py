"""Activation: means, scales and unit quaternions from stored values."""

import numpy as np

from nanogs import parallel
from nanogs._types import F32, F64, I32, F
from nanogs.activations import unit
from nanogs.slices import SLICE_STEPS, slices
from nanogs.splats import Splats, pick

_SAMPLE = 40_000  # most centres that the median is taken of


def scene_origin(means: F) -> F64:
    """Return the (3,) float64 median of the centres along each axis, scene units.

    Subtracting it keeps the precision of centres far from zero. A few strays far away do not move
    it.

    Args:
        means: (N, 3) finite, scene units; evenly spread rows of a large model.
    """
    # In float64: a median may be the mean of two values, whose sum can overflow in float32.
    some = means[:: len(means) // _SAMPLE + 1].astype(np.float64)
    origin: F64 = np.median(some, axis=0)
    return origin


def activated(splats: Splats, rows: I32, origin: F64) -> tuple[F64, F32, F32]:
    """Compute the activated means, scales and quaternions of some splats.

    Args:
        splats: The input.
        rows: (M,) rows of it, all finite.
        origin: (3,) subtracted from the centres, scene units.

    Returns:
        (M, 3) float64 centres, scene units from the origin; (M, 3) float32 standard deviations,
        scene units; (M, 4) float32, wxyz, unit.
    """
    means = np.empty((len(rows), 3))
    scales = np.empty((len(rows), 3), np.float32)
    quats = np.empty((len(rows), 4), np.float32)

    def activate(part: slice) -> None:
        some = rows[part]
        means[part] = pick(splats.means, some) - origin
        scales[part] = np.exp(pick(splats.log_scales, some))
        quats[part] = unit(pick(splats.quats, some))

    parallel.for_each(slices(len(rows), SLICE_STEPS), activate)
    return means, scales, quats

"""Rotations, scales and colours as formats with activated values hold them.

Read and encoded again, they are the same numbers, so that a file that is written a second time does
not change. Single precision alone would change the last bits of some.
"""

import numpy as np

from nanogs._types import F32, F64
from nanogs.activations import unit
from nanogs.splats import Splats

_GRID = 2.0**-20  # finest step of `rounded_colours`
LEAST_COLOUR_RANGE = 2.0**-8  # least width of a range of base colours that is divided into bytes
_UNIT_SLACK = 2e-7  # `unit` returns lengths within 1.4e-7 of 1


def unit_quats(splats: Splats) -> F32:
    """Return (N, 4) float32 unit quaternions, wxyz; those of unit length are kept as they are."""
    lengths = np.linalg.norm(splats.quats.astype(np.float64), axis=1, keepdims=True)
    kept = np.abs(lengths - 1) < _UNIT_SLACK
    result: F32 = np.where(kept, splats.quats, unit(splats.quats))
    return result


def scales(splats: Splats) -> F32:
    """Return (N, 3) float32 standard deviations, rounded once from double precision."""
    result: F32 = np.exp(splats.log_scales.astype(np.float64)).astype(np.float32)
    return result


def rounded_colours(colours: F64) -> F64:
    """Round base colours, usually by less than a millionth, so that reading keeps them.

    The SH coefficient of a colour, in single precision, gives a slightly different colour; it is
    rounded to the same.
    """
    step = np.maximum(4 * np.spacing(np.abs(colours).astype(np.float32)).astype(np.float64), _GRID)
    result: F64 = np.rint(colours / step) * step
    return result

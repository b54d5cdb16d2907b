"""Conversion of linear-light colours of a glTF file to the display (sRGB) colours of splats."""

import numpy as np

from nanogs._types import F32, F64
from nanogs.sh import basis

LINEAR = "lin_rec709_display"
_SIDES = 8  # sample directions per SH coefficient


def encoded(linear: F64) -> F64:
    """Encode linear light as sRGB, in the same shape; negative values are clamped to black."""
    light = np.maximum(linear, 0)
    result: F64 = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return result


def to_display(sh: F32) -> F64:
    """Fit (R, K, 3) SH coefficients of sRGB colours to coefficients of linear light.

    The fit is a least-squares one over directions on the sphere. Because the encoding is not a
    linear map, it is exact for degree 0 only.

    Args:
        sh: (R, K, 3) float32, SH coefficients of linear light.
    """
    degree = int(sh.shape[1] ** 0.5) - 1
    sides = basis(_directions(_SIDES * sh.shape[1]), degree)
    light = np.einsum("dk,rkc->rdc", sides, sh.astype(np.float64)) + 0.5
    result: F64 = np.einsum("kd,rdc->rkc", np.linalg.pinv(sides), encoded(light) - 0.5)
    return result


def _directions(count: int) -> F64:
    """Return (count, 3) unit vectors, spread evenly over the sphere on a spiral."""
    turns = np.arange(count) + 0.5
    z = 1 - 2 * turns / count
    angle, ring = np.pi * (1 + 5**0.5) * turns, np.sqrt(1 - z * z)
    return np.column_stack([ring * np.cos(angle), ring * np.sin(angle), z])

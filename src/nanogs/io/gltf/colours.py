"""Colours that a glTF file states in linear light, as those of a display, which splats hold."""

import numpy as np

from nanogs._types import F32, F64
from nanogs.sh import basis

LINEAR = "lin_rec709_display"
_SIDES = 8  # directions for each coefficient


def encoded(linear: F64) -> F64:
    """The sRGB encoding of linear light, of the same shape; nothing is darker than black."""
    light = np.maximum(linear, 0)
    result: F64 = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return result


def to_display(sh: F32) -> F64:
    """(R, K, 3): coefficients whose colours, from all sides, are nearest to the encoded ones.

    Encoding is no linear map, so of a degree above 0 the nearest is not the same; without
    harmonics of a higher degree nothing is lost.

    Args:
        sh: (R, K, 3) float32, coefficients of linear light.
    """
    degree = int(sh.shape[1] ** 0.5) - 1
    sides = basis(_directions(_SIDES * sh.shape[1]), degree)
    light = np.einsum("dk,rkc->rdc", sides, sh.astype(np.float64)) + 0.5
    result: F64 = np.einsum("kd,rdc->rkc", np.linalg.pinv(sides), encoded(light) - 0.5)
    return result


def _directions(count: int) -> F64:
    """(count, 3): unit vectors, evenly about the sphere on a spiral."""
    turns = np.arange(count) + 0.5
    z = 1 - 2 * turns / count
    angle, ring = np.pi * (1 + 5**0.5) * turns, np.sqrt(1 - z * z)
    return np.column_stack([ring * np.cos(angle), ring * np.sin(angle), z])

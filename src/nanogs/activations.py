"""Conversion between stored values (logits, SH coefficients) and activated ones, in NumPy."""

import math
from typing import TypeVar

import numpy as np

from nanogs._types import F32, F64, U8, F

SH_C0 = 0.28209479177387814  # the spherical harmonic of degree 0; as in `kernels/harmonics.py`

# Limits within which stored logarithms and logits stay finite.
LEAST_SCALE = float(np.finfo(np.float32).tiny)
LEAST_ALPHA = float(np.finfo(np.float32).tiny)

Floats = TypeVar("Floats", F32, F64)


def alphas(logits: F) -> F64:
    """Return (N,) float64 alpha in [0, 1], the sigmoid of the logits."""
    with np.errstate(over="ignore", invalid="ignore"):  # signalling NaNs would warn
        return 1.0 / (1.0 + np.exp(-logits.astype(np.float64)))


def logit(alpha: F64) -> F64:
    """Return the logit of alpha; exactly ±inf for alpha 1 and 0."""
    with np.errstate(divide="ignore"):
        result: F64 = -np.log(1 / alpha - 1)
    return result


def smooth(log_scales: F32, logits: F32, widths: F32) -> None:
    """Apply Mip-Splatting's 3D smoothing filter to splats, in place.

    Each Gaussian is convolved with an isotropic one, and its alpha is lowered so that the integral
    stays the same (Yu, Chen, Huang, Sattler, Geiger, "Mip-Splatting", 2024, section 4.1). Rows
    with a width of 0 keep every bit.

    Args:
        log_scales: (N, 3) in and out.
        logits: (N,) in and out.
        widths: (N,) standard deviations of the filter, scene units.
    """
    with np.errstate(divide="ignore", invalid="ignore"):  # also rows with infinite values and NaN
        sharp, width = log_scales.astype(np.float64), np.log(np.abs(widths.astype(np.float64)))
        smoothed = 0.5 * np.logaddexp(2 * sharp, 2 * width[:, None])
        log_alphas = (sharp - smoothed).sum(axis=1) - np.logaddexp(0, -logits.astype(np.float64))
        faded = log_alphas - np.log(-np.expm1(log_alphas))
    changed = widths != 0
    log_scales[changed], logits[changed] = smoothed[changed], faded[changed]


BYTE_LOGITS: F32 = logit(np.arange(256) / 255).astype(np.float32)
"""(256,) the opacity logit of each byte of formats in which 255 is alpha 1."""


def base_colour(rgb: F64) -> F64:
    """Return the SH coefficient of degree 0 for a colour from 0 to 1."""
    result: F64 = (rgb - 0.5) / SH_C0
    return result


def rounded_bytes(values: F) -> U8:
    """Clip to 0 to 255 and round to uint8, in the same shape."""
    result: U8 = np.rint(np.clip(values, 0, 255)).astype(np.uint8)
    return result


def unit(quats: F32) -> F32:
    """Normalise quaternions to (N, 4) float32; zero becomes the identity, infinite values NaN."""
    # In single precision, but divided by the largest component first, so that tiny and huge
    # quaternions do not under- or overflow. The length is 1 to within 1e-7 either way.
    w, x, y, z = np.abs(quats).T
    largest = np.maximum(np.maximum(w, x), np.maximum(y, z))
    zero = largest == 0
    largest[zero] = 1
    with np.errstate(invalid="ignore"):
        result: F32 = quats / largest[:, None]
    result[zero] = (1, 0, 0, 0)
    result /= np.sqrt(np.einsum("ij,ij->i", result, result))[:, None]
    return result


def rotations(quats: Floats) -> Floats:
    """Convert (N, 4) unit quaternions, wxyz, to (N, 3, 3) rotation matrices of the same dtype.

    The columns are the axes of the splat.
    """
    w, x, y, z = quats.T
    matrix = np.empty((len(quats), 3, 3), quats.dtype)
    matrix[:, 0, 0] = 1 - 2 * (y * y + z * z)
    matrix[:, 0, 1] = 2 * (x * y - w * z)
    matrix[:, 0, 2] = 2 * (x * z + w * y)
    matrix[:, 1, 0] = 2 * (x * y + w * z)
    matrix[:, 1, 1] = 1 - 2 * (x * x + z * z)
    matrix[:, 1, 2] = 2 * (y * z - w * x)
    matrix[:, 2, 0] = 2 * (x * z - w * y)
    matrix[:, 2, 1] = 2 * (y * z + w * x)
    matrix[:, 2, 2] = 1 - 2 * (x * x + y * y)
    return matrix


def rotation_about(axis: int, angle: float) -> F64:
    """Make the (3, 3) rotation by an angle, radians, counterclockwise about a coordinate axis."""
    matrix = np.eye(3)
    a, b = (axis + 1) % 3, (axis + 2) % 3
    matrix[a, a] = matrix[b, b] = math.cos(angle)
    matrix[b, a] = math.sin(angle)
    matrix[a, b] = -matrix[b, a]
    return matrix


def quaternions(matrices: F64) -> F64:
    """Convert (N, 3, 3) rotation matrices to (N, 4) unit quaternions, wxyz.

    Computed from the largest of the four components, which is made positive, so that nothing is
    divided by almost zero (Shepperd 1978).
    """
    xx, xy, xz, yx, yy, yz, zx, zy, zz = matrices.reshape(-1, 9).T
    table = np.empty((len(matrices), 4, 4))
    for row, column, value in (
        (0, 1, zy - yz), (0, 2, xz - zx), (0, 3, yx - xy),
        (1, 2, xy + yx), (1, 3, xz + zx), (2, 3, yz + zy),
    ):  # fmt: skip
        table[:, row, column] = table[:, column, row] = value
    for part, value in enumerate((xx + yy + zz, xx - yy - zz, yy - xx - zz, zz - xx - yy)):
        table[:, part, part] = 1 + value
    rows = np.arange(len(matrices))
    quats: F64 = table[rows, np.argmax(np.einsum("nii->ni", table), axis=1)]
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    return quats

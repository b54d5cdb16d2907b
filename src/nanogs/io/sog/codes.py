"""Codes of all values of SOG but centres and higher SH coefficients: each value is a byte.

Log-scales and base colours are entries of codebooks; opacities are alphas, and rotations the three
smaller components of quaternions, in equal steps. Values are rounded to the nearest code.
"""

import math
from dataclasses import replace

import numpy as np

from nanogs import parallel
from nanogs._types import F32, F64, I64, U8
from nanogs.activations import BYTE_LOGITS
from nanogs.io.precision import Precision
from nanogs.io.rotations import Rounding, split_quats
from nanogs.io.sog.codebook import codebook, nearest
from nanogs.slices import slices
from nanogs.splats import Splats


def codebooks(splats: Splats, precision: Precision) -> tuple[F32, F32]:
    """Compute the codebooks of the log-scales and of the base colours, (256,) each, in parallel."""
    wanted = (splats.log_scales, precision.scale_codes), (splats.sh[:, 0], precision.colour_codes)
    scales, colours = parallel.map_ordered(wanted, lambda values: codebook(*values))
    return scales, colours


def sizes_as_decoded(splats: Splats, scales: F32, precision: Precision) -> Splats:
    """Return the model with the scales and opacities that reading it again gives.

    Bits are spared by these, so that a model that was read is written with as many as before.

    Args:
        splats: N splats.
        scales: (256,) codebook of the log-scales.
        precision: Precision of the alphas.
    """
    return replace(
        splats,
        log_scales=scales[nearest(splats.log_scales, scales)],
        opacity_logits=BYTE_LOGITS[alpha_codes(splats.opacities(), precision.alpha_steps)],
    )


def alpha_codes(opacities: F64, steps: int) -> U8:
    """Round opacities to the nearest of `steps` + 1 levels from 0 to 255, both included, (N,)."""
    codes: U8 = np.rint(np.rint(opacities * steps) * (255 / steps)).astype(np.uint8)
    return codes


def quat_texels(quats: F64, step: int, *, without_w: bool) -> U8:
    """Encode rotations as (N, 4) bytes: three smaller components, and 252 + index of the largest.

    A quaternion is negated where its largest component is negative.

    Args:
        quats: (N, 4) wxyz unit quaternions.
        step: Codes of components are multiples of it.
        without_w: Whether w is left out in any case, also where rounding made another one larger.
    """
    out = np.empty((len(quats), 4), np.uint8)

    def pack(rows: slice) -> None:
        left_out = np.zeros(len(quats[rows]), np.int64) if without_w else None
        largest, small = split_quats(quats[rows], left_out)
        out[rows, :3] = _component_codes(small, step)
        out[rows, 3] = 252 + largest

    parallel.for_each(slices(len(quats)), pack)
    return out


def _component_codes(small: F64, step: int) -> F64:
    """Return the codes, multiples of the step, of components from -√½ to √½."""
    codes = 255 * np.clip(small / math.sqrt(2) + 0.5, 0, 1)
    whole: F64 = np.minimum(np.rint(codes / step), 255 // step) * step
    return whole


def restored_components(codes: F64 | I64) -> F64:
    """Return the components of rotations that codes stand for."""
    restored: F64 = (codes / 255 - 0.5) * math.sqrt(2)
    return restored


def rotation_rounding(step: int) -> Rounding:
    """Return how components of rotations are rounded to codes that are multiples of the step."""
    return Rounding(
        lambda small: restored_components(_component_codes(small, step)),
        step / 255 * math.sqrt(0.5),
    )

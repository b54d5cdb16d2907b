"""Codes of the values of `.spz` that are a byte each: alphas, base colours, log-scales, harmonics.

SH coefficients of degree 1 keep 5 bits and higher ones 4, as in the reference writer: the fewer
values a byte takes, the better it compresses. All other values take codes in steps, see `STEPS`.
"""

from dataclasses import dataclass, replace

import numpy as np

from nanogs._types import F32, F64, I64, U8
from nanogs.activations import BYTE_LOGITS, rounded_bytes
from nanogs.io.spz.read import COLOUR_SCALE, LOG_SCALES, SCALE_LOW, SCALE_STEPS, SH_STEPS
from nanogs.splats import Splats

SH_BITS = 5  # bits kept of an SH coefficient of degree 1; of a higher degree, one less
OPAQUE, ZERO = 255, 128  # the codes of alpha 1, and of 0 in a component of a rotation
_END = 1e-3  # distance, in codes, of values from an end that were read from its code
BLACK = 60  # the code of a base colour that is almost black


@dataclass(frozen=True, slots=True)
class Steps:
    """Quantisation steps, in units of the stored codes, for each kind of value.

    They are balanced so that each kind of value costs about the same error in rendered views.

    Attributes:
        scales: Step of log-scales.
        rotations: Step of the rotations of version 2.
        magnitudes: Step of the 9-bit magnitudes in the rotations of later versions.
        colours: Step of base colours, counted from black, which many splats have.
        alphas: Step of alphas, counted from opaque.
    """

    scales: int
    rotations: int
    magnitudes: int
    colours: int
    alphas: int


STEPS = {
    8: Steps(1, 1, 4, 1, 1),
    7: Steps(1, 1, 8, 2, 2),
    6: Steps(2, 2, 16, 4, 4),
    5: Steps(2, 3, 16, 5, 5),
    4: Steps(4, 5, 32, 8, 8),
}
"""Quantisation steps by the value of the option `bits`."""


def stepped(values: F32 | F64, step: int, start: int = 0) -> U8:
    """Round values, in units of codes, to the grid that contains `start` and has this step."""
    if step == 1:
        return rounded_bytes(values)
    nearest = start + step * np.rint((values - start) / step)
    # Both ends are codes of every grid: values beyond them are clamped to them, and stay there when
    # a file is read and written again.
    nearest = np.where(values < _END, 0, np.where(values > OPAQUE - _END, OPAQUE, nearest))
    return rounded_bytes(nearest)


def codes_of_grid(step: int, start: int = 0) -> I64:
    """Return the codes that `stepped` gives, ascending."""
    return np.unique(stepped(np.arange(256.0), step, start)).astype(np.int64)


def alpha_codes(block: Splats, step: int) -> U8:
    """Encode (R,) opacities as codes; invisible splats stay invisible, whatever the step."""
    values = block.opacities() * OPAQUE
    codes = stepped(values, step, OPAQUE)
    codes[values < 0.5] = 0  # the code that a step of 1 gives
    return codes


def scale_codes(log_scales: F32, step: int) -> U8:
    """Encode (R, 3) log-scales as codes."""
    return stepped((log_scales - np.float64(SCALE_LOW)) * SCALE_STEPS, step)


def sizes_as_decoded(block: Splats, steps: Steps) -> Splats:
    """Return a block with the scales and opacities that reading it again gives.

    Fraction bits are spared by these, so that a model that was read is written with as many as
    before.
    """
    return replace(
        block,
        log_scales=LOG_SCALES[scale_codes(block.log_scales, steps.scales)],
        opacity_logits=BYTE_LOGITS[alpha_codes(block, steps.alphas)],
    )


def colour_codes(block: Splats, step: int) -> U8:
    """Encode base colours as (R, 3) codes."""
    return stepped((block.sh[:, 0] * np.float64(COLOUR_SCALE) + 0.5) * OPAQUE, step, BLACK)


def buckets_of(degree: int, sh_bits: int) -> F64:
    """Return (K - 1,) quantisation steps of the higher SH coefficients, in units of codes."""
    per_band = [2.0 ** (8 - sh_bits + (band > 1)) for band in range(1, degree + 1)]
    return np.repeat(per_band, [2 * band + 1 for band in range(1, degree + 1)])


def coefficient_codes(sh: F32, buckets: F64) -> U8:
    """Encode higher SH coefficients as (R, 3 (K - 1)) codes, rounded to the bucket's multiples.

    The grid contains 128, the code of zero.
    """
    nearest = np.rint(sh.astype(np.float64) * SH_STEPS / buckets) * buckets + 128
    return rounded_bytes(nearest).reshape(len(sh), -1)

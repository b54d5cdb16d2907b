"""Centres of `.spz`: 24-bit integers whose number of fraction bits depends on the scene.

So a small scene keeps its detail, and a large one does not wrap around. Where splats are so large
that they need no finer centres, some fraction bits are left out.
"""

import math
from collections.abc import Iterable

import numpy as np

from nanogs._types import F32, F64, U8
from nanogs.errors import OptionError, UnstorableError
from nanogs.io import limits
from nanogs.io.precision import FINEST, MOST_BITS, Precision
from nanogs.io.spz.codes import STEPS, sizes_as_decoded
from nanogs.io.spz.header import SUFFIX
from nanogs.source import Source, source_of
from nanogs.splats import Splats

USUAL_FRACTION_BITS = 12
FIXED_MAX = (1 << 23) - 1  # largest magnitude of a 24-bit integer
_SIGNIFICANT_BITS = 16  # least number of bits of the farthest coordinate, where there is room


def fraction_bits(model: Splats | Source, precision: Precision = FINEST) -> int:
    """Return the number of fraction bits for centres: 12 or more, less those that are spared.

    They are spared where splats are so large that they do not need them. Very large scenes have
    fewer than 12, and then none is spared by default.

    Args:
        model: The model.
        precision: Precision of the values, and how many bits are spared if it states that.

    Raises:
        OptionError: The `spare` of `precision` exceeds the number of fraction bits that there are.
        OutputError: A value is NaN or infinite, or a centre is too far out for 24-bit integers.
    """
    most, spare = _fraction_and_spare(source_of(model), precision)
    if spare > most:
        raise OptionError(
            f"`spare_bits={spare}` leaves none of the {most} fraction bits of the centres; give"
            " fewer."
        )
    return most - spare


def spare_bits(source: Source, bits: int = MOST_BITS) -> int:
    """Return the number of fraction bits that `write.write` drops from centres by default.

    Args:
        source: The model.
        bits: As for `write.write`.

    Raises:
        OutputError: As for `fraction_bits`.
    """
    return _fraction_and_spare(source, Precision(bits))[1]


def _fraction_and_spare(source: Source, precision: Precision) -> tuple[int, int]:
    """Return the most fraction bits that the scene's extent allows, and how many are dropped.

    Raises:
        OutputError: As for `fraction_bits`.
    """
    reach = reach_of(limits.storable(source, SUFFIX))
    if (most := most_fraction_bits(reach)) < 0:
        raise UnstorableError(
            f"A centre is {reach:g} from the origin along an axis, but {SUFFIX} ends at"
            f" {FIXED_MAX:,}; move the model to the origin or scale it down."
        )
    spare = _spare(source, precision, most)
    # Rounding down to a power of two makes room for one more bit. Without it, a file that is read
    # and written again would change.
    decoded = math.ldexp(round(math.ldexp(reach, most - spare)), spare - most)
    if (more := most_fraction_bits(decoded)) > most:
        return more, _spare(source, precision, more)
    return most, spare


def _spare(source: Source, precision: Precision, fraction: int) -> int:
    """Return how many of a number of fraction bits to drop from centres."""
    if precision.spare is None and fraction < USUAL_FRACTION_BITS:
        return 0
    step = np.full((1, 1), math.ldexp(1.0, -fraction))
    decoded = (sizes_as_decoded(block, STEPS[precision.bits]) for block in source.blocks())
    return precision.spare_bits(decoded, lambda _block: step)


def reach_of(blocks: Iterable[Splats]) -> float:
    """Return the largest absolute coordinate of all centres; NaN if one of them is NaN."""
    return float(np.max([np.abs(block.means).max(initial=0) for block in blocks], initial=0))


def most_fraction_bits(reach: float) -> int:
    """Return the fraction bits for an extent; negative if it is too large or not finite."""
    if not reach <= FIXED_MAX:
        return -1
    mantissa, exponent = math.frexp(reach or math.ulp(0))  # as near as possible to zero
    exponent -= mantissa == 0.5  # reach <= 2^exponent: centres may be rounded up to it
    most = min(max(USUAL_FRACTION_BITS, _SIGNIFICANT_BITS - exponent), 23 - exponent, 20)
    return most - (round(math.ldexp(reach, most)) > FIXED_MAX)


def position_bytes(means: F32 | F64, fraction: int) -> U8:
    """Encode (R, 3) centres as (R, 3, 3) bytes: a little-endian 24-bit integer for each value.

    `fraction` is the number of their fraction bits.
    """
    fixed = _fixed_point(means, fraction).astype("<i4")
    wide: U8 = fixed[:, :, None].view(np.uint8)
    return wide[:, :, :3]


def on_grid(means: F32, fraction: int) -> F32:
    """Return centres, (N, 3), with this number of fraction bits."""
    return np.ldexp(_fixed_point(means, fraction), -fraction).astype(np.float32)


def _fixed_point(means: F32 | F64, fraction: int) -> F64:
    """Return centres as whole numbers, with this number of fraction bits."""
    fixed: F64 = np.rint(np.ldexp(means.astype(np.float64), fraction))
    return fixed

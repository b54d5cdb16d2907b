"""From what the user asks to an exact count. No Numba here: `--dry-run` uses it too."""

import math
from fractions import Fraction

from nanogs.errors import OptionError


def target_count(available: int, ratio: float | None, count: int | None) -> int:
    """Splats to deliver: the count, or ceil(ratio x available).

    The ratio is taken as the decimal that is written, so that 0.07 of 100 is 7 and not 8.

    Args:
        available: Splats that can be used.
        ratio: Compaction ratio in (0, 1], or None.
        count: Splats, or None.

    Raises:
        OptionError: Not exactly one of both is given, or it is out of range.
    """
    if ratio is not None and count is None:
        if not 0 < ratio <= 1:
            raise OptionError(f"The ratio must be above 0 and at most 1, not {ratio:g}.")
        return math.ceil(Fraction(str(float(ratio))) * available)
    if count is None or ratio is not None:
        raise OptionError("Give either a ratio or a count.")
    if count < 1:
        raise OptionError(f"The count must be at least 1, not {count}.")
    if count > available:
        raise OptionError(
            f"The count {count} is above the {available} usable splats of the input; "
            "nanogs makes models smaller."
        )
    return count

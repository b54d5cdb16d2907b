"""Peak signal-to-noise ratio."""

import math

import numpy as np

from nanogs._types import Array
from nanogs.errors import ModelError
from nanogs.metrics._images import NOT_FINITE, check_pair, check_range

ROWS = 32  # rows per step, so that their differences fit in the cache


def psnr(a: Array, b: Array, data_range: float = 1.0) -> float:
    """Compute the peak signal-to-noise ratio in dB, over all pixels and channels together.

    10 log10(data_range² / mean squared difference). Values are not clipped: clip renders to [0, 1]
    first if photographs are the reference.

    Args:
        a: (H, W) or (H, W, C), floating point.
        b: The same shape.
        data_range: Distance from the darkest to the brightest value.

    Returns:
        Decibels; inf for equal images.

    Raises:
        OptionError: Shapes differ, values are integers, or data_range is not above 0.
        ModelError: A pixel is not finite.
    """
    check_range(data_range)
    check_pair(a, b)
    total = 0.0
    with np.errstate(invalid="ignore", over="ignore"):  # refused below
        for row in range(0, len(a), ROWS):
            rows = slice(row, row + ROWS)
            change = np.subtract(a[rows], b[rows], dtype=np.float64)
            total += float(np.square(change, out=change).sum())
    if not math.isfinite(total):
        raise ModelError(NOT_FINITE)
    error = total / a.size
    if error == 0:
        return math.inf
    return 20 * math.log10(data_range) - 10 * math.log10(error)

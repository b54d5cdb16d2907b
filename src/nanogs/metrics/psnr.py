"""Peak signal-to-noise ratio."""

import math

import numpy as np

from nanogs._types import Array
from nanogs.metrics._images import check_range, image_pair


def psnr(a: Array, b: Array, data_range: float = 1.0) -> float:
    """Peak signal-to-noise ratio in dB, over all pixels and channels together.

    10 log10(data_range² / mean squared difference). Values are taken as they are: clip renders to
    [0, 1] first where photographs are the reference.

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
    first, second = image_pair(a, b)
    first -= second  # copies, both of them
    error = float(np.mean(np.square(first, out=first)))
    if error == 0:
        return math.inf
    return 20 * math.log10(data_range) - 10 * math.log10(error)

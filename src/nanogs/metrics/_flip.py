"""FLIP, a perceptual difference for alternating images; needs the package `flip-evaluator`."""

import numpy as np

from nanogs._types import Array
from nanogs.errors import OptionError
from nanogs.metrics._images import colour_pair


def flip(reference: Array, test: Array) -> float:
    """Compute the mean LDR-FLIP at the package's default viewing distance (67 pixels a degree).

    Source: Andersson et al., "FLIP: A Difference Evaluator for Alternating Images", 2020.

    Args:
        reference: (H, W, 3) sRGB, floating point, clipped to [0, 1].
        test: The same shape.

    Returns:
        0 for equal images, at most 1.

    Raises:
        OptionError: flip-evaluator is not installed, or the images are not RGB of one shape.
        ModelError: A pixel is not finite.
    """
    a, b = colour_pair(reference, test)
    try:
        import flip_evaluator
    except ImportError as error:
        raise OptionError('FLIP needs a package: pip install "nanogs[flip]".') from error
    first, second = a.astype(np.float32), b.astype(np.float32)
    _, mean, _ = flip_evaluator.evaluate(first, second, "LDR", applyMagma=False)
    return float(mean)

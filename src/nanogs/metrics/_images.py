"""Checks of the metrics' arguments."""

import math

import numpy as np

from nanogs._types import F64, Array
from nanogs.errors import ModelError, OptionError

NOT_FINITE = "an image holds pixels that are not finite; no metric is defined."


def check_range(data_range: float) -> None:
    """Refuse an invalid range of values.

    Raises:
        OptionError: It is not above 0, or not finite.
    """
    if not (data_range > 0 and math.isfinite(data_range)):
        raise OptionError(f"data_range must be above 0, not {data_range}.")


def check_arrays(*images: object) -> None:
    """Refuse images that are no arrays, such as lists.

    Raises:
        OptionError: One is none.
    """
    for image in images:
        if not isinstance(image, np.ndarray):
            kind = type(image).__name__
            raise OptionError(f"Images must be NumPy arrays, not {kind}; np.asarray makes them.")


def check_pair(a: Array, b: Array) -> None:
    """Refuse two arrays unless they are images of the same shape in floating point.

    Raises:
        OptionError: They are no arrays, their shapes differ, are not those of images or have no
            pixel, or the values are integers, whose range a metric would have to guess.
    """
    check_arrays(a, b)
    for image in (a, b):
        if image.ndim not in (2, 3) or image.size == 0:
            raise OptionError(f"An image must be (H, W) or (H, W, C), not {image.shape}.")
        if not np.issubdtype(image.dtype, np.floating):
            raise OptionError(
                f"Images must be floats in [0, 1], not {image.dtype}; divide 8-bit values by 255."
            )
    if a.shape != b.shape:
        raise OptionError(f"Images must have the same size, not {a.shape} and {b.shape}.")


def image_pair(a: Array, b: Array) -> tuple[F64, F64]:
    """Check two images, and convert them to float64; images of this type are not copied.

    Args:
        a: (H, W) or (H, W, C), floating point.
        b: The same shape.

    Returns:
        Both images as float64.

    Raises:
        OptionError: As `check_pair`.
        ModelError: A pixel is not finite.
    """
    check_pair(a, b)
    first, second = a.astype(np.float64, copy=False), b.astype(np.float64, copy=False)
    if not (np.isfinite(first).all() and np.isfinite(second).all()):
        raise ModelError(NOT_FINITE)
    return first, second


def colour_pair(a: Array, b: Array) -> tuple[F64, F64]:
    """Do the same as `image_pair` for metrics of RGB images (H, W, 3), and clip to [0, 1].

    Raises:
        OptionError: As `image_pair`, or the images are not RGB.
        ModelError: A pixel is not finite.
    """
    first, second = image_pair(a, b)
    if first.ndim != 3 or first.shape[2] != 3:
        raise OptionError(f"This metric needs RGB images (H, W, 3), not {first.shape}.")
    return first.clip(0, 1), second.clip(0, 1)

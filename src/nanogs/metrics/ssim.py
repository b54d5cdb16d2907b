"""Structural similarity.

Source: Wang, Bovik, Sheikh, Simoncelli, "Image Quality Assessment: From Error Visibility to
Structural Similarity", 2004, eq. 13, with the paper's Gaussian window and constants.
"""

import numpy as np
from scipy import ndimage

from nanogs._types import F64, Array
from nanogs.errors import OptionError
from nanogs.metrics._images import image_pair

RADIUS = 5  # 11 x 11 window
SIGMA = 1.5  # pixels
K1 = 0.01
K2 = 0.03


def ssim(a: Array, b: Array, data_range: float = 1.0) -> float:
    """Mean structural similarity, 11 x 11 Gaussian window of sigma 1.5, channel by channel.

    Population variances; windows that leave the image do not count. Equal to scikit-image's
    `structural_similarity(..., gaussian_weights=True, sigma=1.5, use_sample_covariance=False)`.

    Args:
        a: (H, W) or (H, W, C), floating point.
        b: The same shape.
        data_range: Distance from the darkest to the brightest value.

    Returns:
        At most 1, which equal images have.

    Raises:
        OptionError: Shapes differ, values are integers, the images are smaller than the window, or
            data_range is not above 0.
        ModelError: A pixel is not finite.
    """
    if not (data_range > 0 and np.isfinite(data_range)):
        raise OptionError(f"data_range must be above 0, not {data_range}.")
    first, second = image_pair(a, b)
    if min(first.shape[:2]) < 2 * RADIUS + 1:
        raise OptionError(f"SSIM needs at least 11 x 11 pixels, not {first.shape[:2]}.")
    mean_a, mean_b = _window(first), _window(second)
    var_a = _window(first * first) - mean_a * mean_a
    var_b = _window(second * second) - mean_b * mean_b
    cov = _window(first * second) - mean_a * mean_b
    c1, c2 = (K1 * data_range) ** 2, (K2 * data_range) ** 2
    luminance = (2 * mean_a * mean_b + c1) / (mean_a**2 + mean_b**2 + c1)
    structure = (2 * cov + c2) / (var_a + var_b + c2)
    return float(np.mean(luminance * structure))


def _window(image: F64) -> F64:
    """Gaussian means of the windows that lie inside the image."""
    for axis in (0, 1):
        image = ndimage.gaussian_filter1d(image, SIGMA, axis=axis, radius=RADIUS)
    inside: F64 = image[RADIUS:-RADIUS, RADIUS:-RADIUS]
    return inside

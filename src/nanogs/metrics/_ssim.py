"""Structural similarity.

Source: Wang, Bovik, Sheikh, Simoncelli, "Image Quality Assessment: From Error Visibility to
Structural Similarity", 2004, eq. 13, with the paper's Gaussian window and constants.
"""

import numpy as np

from nanogs._types import Array
from nanogs.errors import OptionError
from nanogs.kernels.window import similarity_rows
from nanogs.metrics._images import check_range, image_pair

RADIUS = 5  # 11 x 11 window
LEAST = 2 * RADIUS + 1  # fewest pixels along each side of an image
SIGMA = 1.5  # pixels
K1 = 0.01
K2 = 0.03


def ssim(a: Array, b: Array, data_range: float = 1.0) -> float:
    """Compute the mean SSIM, with an 11 x 11 Gaussian window of sigma 1.5, for each channel.

    Variances are population variances; windows beyond the image's border do not count. Equal to
    scikit-image's
    `structural_similarity(..., gaussian_weights=True, sigma=1.5, use_sample_covariance=False)`.

    Args:
        a: (H, W) or (H, W, C), floating point.
        b: The same shape.
        data_range: Distance from the darkest to the brightest value.

    Returns:
        At most 1; equal images have 1.

    Raises:
        OptionError: Shapes differ, values are integers, the images are smaller than the window, or
            data_range is not above 0.
        ModelError: A pixel is not finite.
    """
    check_range(data_range)
    first, second = image_pair(a, b)
    if min(first.shape[:2]) < LEAST:
        raise OptionError(f"SSIM needs at least 11 x 11 pixels, not {first.shape[:2]}.")
    distances = np.arange(-RADIUS, RADIUS + 1) / SIGMA
    taps = np.exp(-(distances**2) / 2)
    height, width = first.shape[:2]
    channels = first[0, 0].size
    sums = np.empty(height - 2 * RADIUS)
    c1, c2 = (K1 * data_range) ** 2, (K2 * data_range) ** 2
    flat = (height, width * channels)
    first, second = (np.ascontiguousarray(image.reshape(flat)) for image in (first, second))
    similarity_rows(first, second, channels, taps / taps.sum(), c1, c2, sums)
    mean = float(sums.sum() / (len(sums) * (width - 2 * RADIUS) * channels))
    return min(mean, 1.0)  # the sum of equal images is rounded

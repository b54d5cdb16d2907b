"""Kernel of structural similarity: Gaussian windows over two images at once."""

import numpy as np

from nanogs._types import F64
from nanogs.kernels.policy import parallel_kernel

MOMENTS = 5  # a, b, a², b², ab


@parallel_kernel("sums", least=8)
def similarity_rows(
    start: int, stop: int, a: F64, b: F64, channels: int, taps: F64, c1: float, c2: float, sums: F64
) -> None:
    """Add up the structural similarity of the windows of each row that lie inside the image.

    Source: Wang, Bovik, Sheikh, Simoncelli, 2004, eq. 13.

    Args:
        start: First row of the range.
        stop: The row after its last.
        a: (H, W C) an image, the channels of a pixel side by side.
        b: Of the same shape.
        channels: C.
        taps: (K,) weights of the window along either axis, sum 1.
        c1: Constant of the luminance.
        c2: Constant of the structure.
        sums: (H - K + 1,) out, over the (W - K + 1) C windows of a row.
    """
    width = a.shape[1]
    inside = width - (len(taps) - 1) * channels
    for row in range(start, stop):
        down = np.zeros((MOMENTS, width))
        for k in range(len(taps)):
            for x in range(width):
                p, q, weight = a[row + k, x], b[row + k, x], taps[k]
                down[0, x] += weight * p
                down[1, x] += weight * q
                down[2, x] += weight * p * p
                down[3, x] += weight * q * q
                down[4, x] += weight * p * q
        means = np.zeros((MOMENTS, inside))
        for m in range(MOMENTS):
            for k in range(len(taps)):
                for x in range(inside):
                    means[m, x] += taps[k] * down[m, x + k * channels]
        total = 0.0
        for x in range(inside):
            mean_a, mean_b = means[0, x], means[1, x]
            spread = means[2, x] - mean_a * mean_a + means[3, x] - mean_b * mean_b
            shared = means[4, x] - mean_a * mean_b
            luminance = (2 * mean_a * mean_b + c1) / (mean_a * mean_a + mean_b * mean_b + c1)
            total += luminance * (2 * shared + c2) / (spread + c2)
        sums[row] = total

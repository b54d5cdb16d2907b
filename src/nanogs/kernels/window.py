"""Kernel of the structural similarity (SSIM) of two images, with a Gaussian window."""

import numpy as np

from nanogs._types import F64
from nanogs.kernels.policy import inline, parallel_kernel

MOMENTS = 4  # a, b, a² + b², ab


@parallel_kernel("sums", least=8)
def similarity_rows(
    start: int, stop: int, a: F64, b: F64, channels: int, taps: F64, c1: float, c2: float, sums: F64
) -> None:
    """Sum the structural similarity over the windows of each row that are inside the image.

    Source: Wang, Bovik, Sheikh, Simoncelli, 2004, eq. 13.

    Args:
        start: First row of the range.
        stop: The row after its last.
        a: (H, W C) an image, with interleaved channels.
        b: The other image, of the same shape.
        channels: C.
        taps: (K,) weights of the window along either axis, sum 1; symmetric, K odd.
        c1: Constant of the luminance term.
        c2: Constant of the structure term.
        sums: (H - K + 1,) out, over the (W - K + 1) C windows of a row.
    """
    width, last = a.shape[1], len(taps) - 1
    inside = width - last * channels
    down, means = np.empty((MOMENTS, width)), np.empty((MOMENTS, inside))
    # Pixels of two taps of equal weight are added first; the middle tap is paired with itself.
    weights = taps[: last // 2 + 1].copy()
    weights[last // 2] /= 2
    for row in range(start, stop):
        down[:] = 0.0
        means[:] = 0.0
        for k, weight in enumerate(weights):
            p, q, r, s = a[row + k], b[row + k], a[row + last - k], b[row + last - k]
            _add(down[0], weight, p, r)
            _add(down[1], weight, q, s)
            _add_products(down[2], weight, p, p, q, q)
            _add_products(down[2], weight, r, r, s, s)
            _add_products(down[3], weight, p, q, r, s)
        for m in range(MOMENTS):
            for k, weight in enumerate(weights):
                left, right = k * channels, (last - k) * channels
                _add(means[m], weight, down[m, left : left + inside], down[m, right:])
        sums[row] = _sum_similarities(means[0], means[1], means[2], means[3], c1, c2)


# Separate loops over a few arrays each, because LLVM does not vectorise loops over more arrays.


@inline
def _add(total: F64, weight: float, a: F64, b: F64) -> None:
    for x in range(len(total)):
        total[x] += weight * (a[x] + b[x])


@inline
def _add_products(total: F64, weight: float, a: F64, b: F64, c: F64, d: F64) -> None:
    for x in range(len(total)):
        total[x] += weight * (a[x] * b[x] + c[x] * d[x])


@inline
def _sum_similarities(a: F64, b: F64, squares: F64, products: F64, c1: float, c2: float) -> float:
    total = 0.0
    for x in range(len(a)):
        both, shared = a[x] * a[x] + b[x] * b[x], a[x] * b[x]
        alike = (2 * shared + c1) * (2 * (products[x] - shared) + c2)
        total += alike / ((both + c1) * (squares[x] - both + c2))
    return total

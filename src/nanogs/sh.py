"""Real spherical harmonics in the order and with the signs of 3DGS models.

The reference rasteriser's colour is 0.5 + Σ sh_k Y_k(d), d the unit direction from the camera to
the splat. This module is for making and turning models; the rasteriser has its own kernel.
"""

from math import factorial, pi, sqrt

import numpy as np

from nanogs._types import F64


def basis(directions: F64, degree: int) -> F64:
    """Evaluate the basis functions, ordered by degree l and then by m from -l to l.

    Args:
        directions: (N, 3) float64, unit.
        degree: Highest degree, 0 or more.

    Returns:
        (N, (degree + 1)²) float64.
    """
    x, y, z = directions.T
    values = np.empty((len(directions), (degree + 1) ** 2))
    cosine, sine = np.ones_like(x), np.zeros_like(x)  # (x + iy)^m
    sectoral = 1.0  # (-1)^m (2m - 1)!!
    for m in range(degree + 1):
        below, legendre = np.zeros_like(z), np.full_like(z, sectoral)  # P_l^m over sin^m
        for level in range(m, degree + 1):
            if level > m:
                step = (2 * level - 1) * z * legendre - (level + m - 1) * below
                below, legendre = legendre, step / (level - m)
            norm = sqrt((2 * level + 1) / (4 * pi) * factorial(level - m) / factorial(level + m))
            middle = level * (level + 1)
            if m:
                norm *= sqrt(2)
                values[:, middle - m] = norm * sine * legendre
            values[:, middle + m] = norm * cosine * legendre
        cosine, sine = cosine * x - sine * y, cosine * y + sine * x
        sectoral *= -(2 * m + 1)
    return values


def band_matrix(turn: F64, degree: int) -> F64:
    """Compute the (K, K) matrix that maps coefficients to those of a turned or mirrored model.

    Args:
        turn: (3, 3) float64, orthonormal, from old to new coordinates.
        degree: Highest degree, 0 or more; K is (degree + 1)².
    """
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(8 * (degree + 1) ** 2, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before = basis(directions @ turn, degree)  # the same directions in old coordinates
    solved = np.linalg.lstsq(basis(directions, degree), before, rcond=None)[0]
    return np.asarray(solved, np.float64).round(12)


def lobe(axes: F64, degree: int, width: float) -> F64:
    """Compute the coefficients of a smooth highlight that peaks at 1 when seen along an axis.

    Args:
        axes: (N, 3) float64, unit: from the splat towards the brightest highlight.
        degree: Highest degree, 0 or more.
        width: Variance of the lobe, about that of its angle in square radians.

    Returns:
        (N, (degree + 1)²) float64.
    """
    levels = np.arange(degree + 1)
    blur = np.exp(-levels * (levels + 1) * width / 2)
    blur /= (blur * (2 * levels + 1)).sum() / (4 * pi)
    # Models are evaluated along camera -> splat, the opposite of the direction to the eye.
    weights = np.repeat(blur, 2 * levels + 1)
    coefficients: F64 = basis(-axes, degree) * weights
    return coefficients

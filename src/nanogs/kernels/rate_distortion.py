"""Kernels that choose codes by their cost: the error that they leave, and the price of their bits.

The error is a quadratic form of the change. See `nanogs.io.rate_distortion` for the source.
"""

import math

import numpy as np

from nanogs._types import F32, F64, I32
from nanogs.kernels.policy import inline, parallel_kernel

_SWEEPS = 2  # times that the three components of a rotation are chosen in turn
# How much w stays above the other components, so that a reader takes it for the largest.
_LARGEST = 1e-3


@parallel_kernel("values")
def cheapest_levels(
    start: int,
    stop: int,
    values: F64,
    curvatures: F32,
    levels: F64,
    lengths: F64,
    price: float,
    most: float,
    codes: I32,
) -> None:
    """Choose the level of each value that costs least.

    Args:
        start: First value.
        stop: End of the values.
        values: (N,).
        curvatures: (N,) error for a change of 1, squared.
        levels: (L,) ascending.
        lengths: (L,) bits of each level's code.
        price: Error that a bit is worth.
        most: Largest change of a value, apart from that to the nearest level.
        codes: (N,) the nearest level of each; replaced.
    """
    for i in range(start, stop):
        nearest = codes[i]
        best, value, curvature = nearest, values[i], curvatures[i]
        change = levels[nearest] - value
        least = curvature * change * change + price * lengths[nearest]
        for way in (-1, 1):
            code = nearest + way
            while 0 <= code < len(levels):
                change = levels[code] - value
                if abs(change) > most:
                    break
                cost = curvature * change * change + price * lengths[code]
                if cost < least:
                    best, least = code, cost
                code += way
        codes[i] = best


@inline
def _rotated(quat: F64, x: float, y: float, z: float, curvatures: F32, most: float) -> float:
    """Compute the error of a rotation, given as xyz with positive w, in place of a unit quaternion.

    It is infinite if the two are further apart than `most`, radians, or w is not the largest.
    """
    square = 1.0 - x * x - y * y - z * z
    largest = max(abs(x), abs(y), abs(z)) + _LARGEST
    if square < largest * largest:
        return math.inf
    w = math.sqrt(square)
    a, b, c, d = quat[0], quat[1], quat[2], quat[3]
    p = 2.0 * (a * x - b * w - c * z + d * y)
    q = 2.0 * (a * y + b * z - c * w - d * x)
    r = 2.0 * (a * z - b * y + c * x - d * w)
    if p * p + q * q + r * r > most * most:
        return math.inf
    error: float = curvatures[0] * p * p + curvatures[1] * q * q + curvatures[2] * r * r
    return error


@parallel_kernel("quats")
def cheapest_rotations(
    start: int,
    stop: int,
    quats: F64,
    curvatures: F32,
    levels: F64,
    lengths: F64,
    price: float,
    most: float,
    codes: I32,
) -> None:
    """Choose the levels of the components of each rotation that cost least, each in turn.

    Args:
        start: First rotation.
        stop: End of the rotations.
        quats: (N, 4) float64, wxyz, unit, of positive w.
        curvatures: (N, 3) error for a rotation by 1 radian about each of the splat's own axes.
        levels: (L,) of a component, ascending.
        lengths: (3, L) bits of each level's code in x, y and z.
        price: Error that a bit is worth.
        most: Largest rotation, radians.
        codes: (N, 3) the levels to start from; replaced.
    """
    place = np.empty(3)
    for i in range(start, stop):
        quat, curvature = quats[i], curvatures[i]
        for k in range(3):
            place[k] = levels[codes[i, k]]
        distance = _rotated(quat, place[0], place[1], place[2], curvature, most)
        for _ in range(_SWEEPS):
            for k in range(3):
                best = codes[i, k]
                least = distance + price * lengths[k, best]
                for way in (-1, 1):
                    code = codes[i, k] + way
                    while 0 <= code < len(levels):
                        place[k] = levels[code]
                        error = _rotated(quat, place[0], place[1], place[2], curvature, most)
                        if error == math.inf:
                            break
                        cost = error + price * lengths[k, code]
                        if cost < least:
                            best, least, distance = code, cost, error
                        code += way
                codes[i, k] = best
                place[k] = levels[best]

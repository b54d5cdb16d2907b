"""Kernels that project splats to the screen.

Source: Zwicker, Pfister, van Baar, Gross, "EWA Splatting", 2002 [Z]; the dilation and the guard
are those of Kerbl, Kopanas, Leimkühler, Drettakis, "3D Gaussian Splatting", 2023 [K].

A projected splat is one row of `geometry`, eight float64 (one cache line):

    0, 1  u, v    centre in pixels
    2     inv_w   1 / standard deviation of x given y, 1/pixels
    3     slope   cov_xy / cov_yy, the change of x's conditional mean with y
    4     inv_yy  1 / cov_yy, 1/pixels²
    5     reach   2 ln(255 opacity): the squared radius at which alpha falls to 1/255, plus SLACK
    6     opacity, in [0, 1], after the compensation of MIP models
    7     rise    half the height of the bounding box of the ellipse of alpha 1/255, pixels

With (dx, dy) from the centre to a pixel, the Gaussian's exponent is
-((inv_w (dx - slope dy))² + inv_yy dy²) / 2: a sum of squares, which float32 can represent for any
needle. The usual conic, a dx² + 2 b dx dy + c dy², suffers cancellation there.
"""

import math
from typing import Any

import numpy as np

from nanogs._types import F32, F64, I64, Bool, F
from nanogs.kernels.blocks import TILE, prefetch
from nanogs.kernels.harmonics import sh_basis
from nanogs.kernels.policy import inline, parallel_kernel

GUARD = 1.3  # x/z and y/z in the Jacobian are clamped to this many half fields of view
MIN_ALPHA = 1.0 / 255.0
WIDER = 1.001  # factor that widens a bound, so that rounding does not make it too small
SLACK = 1e-4  # widens bounds only, so that rounding never loses a pixel: alpha is tested exactly
AHEAD = 8  # rows are prefetched this many splats before they are read or written
HIDDEN = 0  # the packed box of tiles of a splat that reaches no pixel
LARGEST = 32767 * TILE  # pixels along a side of an image: a box of tiles is packed into 64 bits


@inline
def _project_gaussian(
    factor: F,
    x: float,
    y: float,
    z: float,
    rotation: F64,
    intrinsics: F64,
    bounds: tuple[float, float, float, float],
    row: F64,
) -> tuple[float, float, float]:
    """Compute centre and 2D covariance of one splat ([Z] eqs. 26 to 31).

    factor is R diag(s), so that Sigma = factor factorᵀ; (x, y, z) is the centre in camera space.
    The covariance is computed from its factor J W R diag(s), whose rows give it without
    cancellation.

    Returns:
        The variances of x and y on screen, and the determinant before over that after the dilation.
    """
    inv_z = 1.0 / z
    xz, yz = x * inv_z, y * inv_z
    row[0] = intrinsics[0] * xz + intrinsics[2]
    row[1] = intrinsics[1] * yz + intrinsics[3]
    tx = min(max(xz, bounds[0]), bounds[1])
    ty = min(max(yz, bounds[2]), bounds[3])
    jx, jy = intrinsics[0] * inv_z, intrinsics[1] * inv_z
    xx = xy = yy = 0.0
    ax = ay = az = bx = by = bz = 0.0
    for k in range(3):
        f0, f1, f2 = np.float64(factor[0, k]), np.float64(factor[1, k]), np.float64(factor[2, k])
        c0 = rotation[0, 0] * f0 + rotation[0, 1] * f1 + rotation[0, 2] * f2
        c1 = rotation[1, 0] * f0 + rotation[1, 1] * f1 + rotation[1, 2] * f2
        c2 = rotation[2, 0] * f0 + rotation[2, 1] * f1 + rotation[2, 2] * f2
        a, b = jx * (c0 - tx * c2), jy * (c1 - ty * c2)
        xx += a * a
        xy += a * b
        yy += b * b
        ax, ay, az = ay, az, a
        bx, by, bz = by, bz, b
    n0, n1, n2 = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    before = n0 * n0 + n1 * n1 + n2 * n2  # |a x b|² = det(a bᵀ), never negative
    dilation = intrinsics[11]
    after = before + dilation * (xx + yy) + dilation * dilation
    xx += dilation
    yy += dilation
    inv_yy = 1.0 / yy
    row[2] = math.sqrt(yy / after)
    row[3] = xy * inv_yy
    row[4] = inv_yy
    return xx, yy, before / after


@inline
def _tile_box(u: float, v: float, ex: float, ey: float, width: float, height: float) -> int:
    """Return the packed box of the tiles with pixel centres in the bounding box of a splat.

    (u, v) is the centre, ex and ey are half the sides of the bounding box, all in pixels.
    """
    inside_x = u + ex >= 0.5 and u - ex <= width - 0.5
    inside_y = v + ey >= 0.5 and v - ey <= height - 0.5
    if not (inside_x and inside_y):  # NaN is not inside
        return HIDDEN
    left = math.ceil(max(u - ex - 0.5, 0.0))
    right = math.floor(min(u + ex - 0.5, width - 1.0))
    top = math.ceil(max(v - ey - 0.5, 0.0))
    bottom = math.floor(min(v + ey - 0.5, height - 1.0))
    if right < left or bottom < top:  # no pixel centre is inside
        return HIDDEN
    x, y = left // TILE, top // TILE
    return pack_box(x, y, right // TILE + 1 - x, bottom // TILE + 1 - y)


@inline
def pack_box(x: int, y: int, across: int, down: int) -> int:
    """Pack a box of tiles, its corner and its size, into one number above 0."""
    return (down << 48) | (across << 32) | (y << 16) | x


@inline
def unpack_box(box: int) -> tuple[int, int, int, int]:
    """Undo `pack_box`; an empty box for HIDDEN."""
    return box & 0xFFFF, (box >> 16) & 0xFFFF, (box >> 32) & 0xFFFF, box >> 48


@inline
def _beside(
    factor: F,
    reach: float,
    x: float,
    y: float,
    z: float,
    intrinsics: F64,
    steepest: tuple[float, float],
) -> bool:
    """Return whether a splat is outside the picture in any orientation: cheap frustum culling.

    It culls no splat for which `_tile_box` would find tiles. The standard deviation on screen along
    x is at most that of the longest axis in space times fx / z, times the factor by which the
    steepest x / z of the Jacobian lengthens it; everything is squared, and multiplied by z². The
    sum of the squared axes serves as a bound of the longest one.
    """
    square = 0.0
    for r in range(3):
        for k in range(3):
            square += np.float64(factor[r, k]) * np.float64(factor[r, k])
    dilation = intrinsics[11] * z * z
    across = WIDER * reach * (square * steepest[0] + dilation)
    along = WIDER * reach * (square * steepest[1] + dilation)
    u, v = intrinsics[0] * x + intrinsics[2] * z, intrinsics[1] * y + intrinsics[3] * z
    left, right = 0.5 * z - u, u - (intrinsics[4] - 0.5) * z
    above, below = 0.5 * z - v, v - (intrinsics[5] - 0.5) * z
    beyond_x, beyond_y = max(left, right), max(above, below)
    beside = beyond_x > 0.0 and beyond_x * beyond_x > across
    return bool(beside or (beyond_y > 0.0 and beyond_y * beyond_y > along))


def _reach(opacity: Any) -> Any:  # noqa: ANN401 - a number, or an array of them
    """The squared radius at which alpha falls to 1/255, plus SLACK, in standard deviations."""
    return 2.0 * np.log(255.0 * opacity) + SLACK


reach_of = inline(_reach)  # of a number, in kernels


def reaches_of(opacities: F32) -> F32:
    """(N,) float32, the reach of each splat; that of opacity 1/255 if the splat's is less."""
    seen = np.maximum(opacities, np.float32(MIN_ALPHA)).astype(np.float64)
    reaches: F32 = _reach(seen).astype(np.float32)
    return reaches


@inline
def guard_bounds(intrinsics: F64) -> tuple[float, float, float, float]:
    """Return the bounds of x/z and y/z in the Jacobian ([K]), from the size of the whole picture.

    intrinsics: as `project_splats` takes them. The order is least and largest x/z, least and
    largest y/z.
    """
    fx, fy = intrinsics[0], intrinsics[1]
    cx, cy, width, height = intrinsics[7], intrinsics[8], intrinsics[9], intrinsics[10]
    margin_x = (GUARD - 1.0) * 0.5 * width / fx
    margin_y = (GUARD - 1.0) * 0.5 * height / fy
    return (
        -cx / fx - margin_x, (width - cx) / fx + margin_x,
        -cy / fy - margin_y, (height - cy) / fy + margin_y,
    )  # fmt: skip


@parallel_kernel("means")
def project_splats(
    start: int,
    stop: int,
    means: F,
    factors: F32,
    opacities: F32,
    reaches: F32,
    keep: Bool,
    sh: F32,
    rotation: F64,
    position: F64,
    intrinsics: F64,
    mip: bool,
    degree: int,
    geometry: F64,
    features: F32,
    boxes: I64,
) -> None:
    """Project N splats to the screen and evaluate their colour.

    Args:
        start: First splat of the range.
        stop: The splat after its last.
        means: (N, 3), scene units.
        factors: (N, 3, 3), R diag(s), scene units.
        opacities: (N,) in [0, 1].
        reaches: (N,) see `reaches_of`; for MIP models, upper bounds of the reaches on screen.
        keep: (N,) false for rows that are not to be drawn, such as those of opacity below 1/255.
        sh: (N, K, 3) with K >= (degree + 1)².
        rotation: (3, 3), world to camera.
        position: (3,) the camera's centre, scene units.
        intrinsics: (12,) fx, fy, cx, cy, width, height in pixels, near in scene units, cx, cy,
            width and height of the whole picture that this is a part of, and the dilation, pixels².
        mip: Multiply opacities by sqrt(det before / det after dilation).
        degree: Spherical-harmonic degree to evaluate.
        geometry: (N, 8) out, see the module's docstring.
        features: (N, 4) out, red, green, blue and depth.
        boxes: (N,) out, packed box of the tiles around the pixels that the splat can reach, see
            `unpack_box`; HIDDEN for one that can reach none, whose rows of the other outputs are
            undefined.
    """
    coefficients = (degree + 1) * (degree + 1)
    # A splat's 3 K numbers, which `prefetch` treats as 3 rows of K; the first begins with the base
    # colour.
    thirds = 1 if degree == 0 else 3
    basis = np.empty(25, np.float32)
    bounds = guard_bounds(intrinsics)
    px, py, pz = position[0], position[1], position[2]
    r = rotation
    near, width, height = intrinsics[6], intrinsics[4], intrinsics[5]
    steepest = (
        intrinsics[0] * intrinsics[0] * (1.0 + max(bounds[0] * bounds[0], bounds[1] * bounds[1])),
        intrinsics[1] * intrinsics[1] * (1.0 + max(bounds[2] * bounds[2], bounds[3] * bounds[3])),
    )
    for i in range(start, stop):
        ahead = min(i + AHEAD, len(means) - 1)
        prefetch(geometry, ahead, 0)
        for third in range(thirds):
            prefetch(sh, 3 * ahead + third, 0)
        boxes[i] = HIDDEN
        if not keep[i]:
            continue
        # Subtracted in float64, because scenes in map coordinates are far from the origin.
        dx = np.float64(means[i, 0]) - px
        dy = np.float64(means[i, 1]) - py
        dz = np.float64(means[i, 2]) - pz
        z = r[2, 0] * dx + r[2, 1] * dy + r[2, 2] * dz
        if not z > near:
            continue
        x = r[0, 0] * dx + r[0, 1] * dy + r[0, 2] * dz
        y = r[1, 0] * dx + r[1, 1] * dy + r[1, 2] * dz
        if _beside(factors[i], float(reaches[i]), x, y, z, intrinsics, steepest):
            continue
        row = geometry[i]
        xx, yy, ratio = _project_gaussian(factors[i], x, y, z, rotation, intrinsics, bounds, row)
        opacity, reach = float(opacities[i]), float(reaches[i])
        if mip:
            opacity *= math.sqrt(max(0.0, ratio))
            if not opacity >= MIN_ALPHA:
                continue
            reach = reach_of(opacity)
        row[5] = reach
        row[6] = opacity
        row[7] = math.sqrt(reach * yy)
        boxes[i] = _tile_box(row[0], row[1], math.sqrt(reach * xx), row[7], width, height)
        if boxes[i] == HIDDEN:
            continue
        inverse = 1.0 / math.sqrt(dx * dx + dy * dy + dz * dz)
        sh_basis(dx * inverse, dy * inverse, dz * inverse, degree, basis)
        red = green = blue = np.float32(0.5)
        for k in range(coefficients):
            red += basis[k] * sh[i, k, 0]
            green += basis[k] * sh[i, k, 1]
            blue += basis[k] * sh[i, k, 2]
        features[i, 0] = max(red, np.float32(0.0))
        features[i, 1] = max(green, np.float32(0.0))
        features[i, 2] = max(blue, np.float32(0.0))
        features[i, 3] = z

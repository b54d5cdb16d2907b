"""Kernels that project splats to the screen.

Source: Zwicker, Pfister, van Baar, Gross, "EWA Splatting", 2002 [Z]; the dilation and the guard
are those of Kerbl, Kopanas, Leimkühler, Drettakis, "3D Gaussian Splatting", 2023 [K].

A projected splat is one row of `geometry`, eight float64 (one cache line):

    0, 1  u, v    centre in pixels
    2     inv_w   1 / standard deviation of x given y, 1/pixels
    3     slope   cov_xy / cov_yy, the drift of x's mean with y
    4     inv_yy  1 / cov_yy, 1/pixels²
    5     reach   2 ln(255 opacity): the squared radius at which alpha falls to 1/255, plus SLACK
    6     opacity, in [0, 1], after the compensation of MIP models
    7     depth   along the viewing axis, scene units

With (dx, dy) from the centre to a pixel, the Gaussian's exponent is
-((inv_w (dx - slope dy))² + inv_yy dy²) / 2: a sum of squares, which float32 can hold for any
needle, where the usual a dx² + 2 b dx dy + c dy² cancels.
"""

import math

import numpy as np

from nanogs._types import F32, F64, I64, Bool, F
from nanogs.kernels.harmonics import sh_basis
from nanogs.kernels.policy import inline, parallel_kernel

DILATION = 0.3  # pixels², added to both variances on screen ([K]'s rasteriser)
GUARD = 1.3  # x/z and y/z in the Jacobian stay within this many half fields of view
MIN_ALPHA = 1.0 / 255.0
SLACK = 1e-4  # widens bounds only, so that rounding never loses a pixel: alpha is tested exactly
TILE = 16  # pixels along each side of a tile
HIDDEN = 0  # stands for the tiles of a splat that reaches no pixel
LARGEST = 32767 * TILE  # pixels along a side of an image: a box of tiles is packed into 64 bits


@inline
def _project_gaussian(factor: F, point: F64, rotation: F64, lens: F64, row: F64) -> float:
    """Centre and 2D covariance of one splat ([Z] eqs. 26 to 31); returns det before / after.

    factor is R diag(s), so that Sigma = factor factorᵀ; point is the centre in camera space. The
    covariance stays in its factor J W R diag(s), whose rows give it without cancellation.
    """
    fx, fy, cx, cy, width, height = lens[0], lens[1], lens[2], lens[3], lens[4], lens[5]
    z = point[2]
    xz, yz = point[0] / z, point[1] / z
    row[0] = fx * xz + cx
    row[1] = fy * yz + cy
    row[7] = z
    margin_x = (GUARD - 1.0) * 0.5 * width / fx
    margin_y = (GUARD - 1.0) * 0.5 * height / fy
    tx = min(max(xz, -cx / fx - margin_x), (width - cx) / fx + margin_x)
    ty = min(max(yz, -cy / fy - margin_y), (height - cy) / fy + margin_y)
    jx, jy = fx / z, fy / z
    xx = xy = yy = 0.0
    ax = ay = az = bx = by = bz = 0.0
    for k in range(3):
        c0 = rotation[0, 0] * factor[0, k] + rotation[0, 1] * factor[1, k]
        c0 += rotation[0, 2] * factor[2, k]
        c1 = rotation[1, 0] * factor[0, k] + rotation[1, 1] * factor[1, k]
        c1 += rotation[1, 2] * factor[2, k]
        c2 = rotation[2, 0] * factor[0, k] + rotation[2, 1] * factor[1, k]
        c2 += rotation[2, 2] * factor[2, k]
        a, b = jx * (c0 - tx * c2), jy * (c1 - ty * c2)
        xx += a * a
        xy += a * b
        yy += b * b
        ax, ay, az = ay, az, a
        bx, by, bz = by, bz, b
    n0, n1, n2 = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    before = n0 * n0 + n1 * n1 + n2 * n2  # |a x b|² = det(a bᵀ), never negative
    after = before + DILATION * (xx + yy) + DILATION * DILATION
    yy += DILATION
    row[2] = math.sqrt(yy / after)
    row[3] = xy / yy
    row[4] = 1.0 / yy
    return before / after


@inline
def _tile_box(row: F64, width: float, height: float) -> int:
    """Tiles that the box around all pixel centres with alpha 1/255 or more meets, packed."""
    ey = math.sqrt(row[5] / row[4])
    ex = math.sqrt(row[5] * (1.0 / (row[2] * row[2]) + row[3] * row[3] / row[4]))
    inside_x = row[0] + ex >= 0.5 and row[0] - ex <= width - 0.5
    inside_y = row[1] + ey >= 0.5 and row[1] - ey <= height - 0.5
    if not (inside_x and inside_y):  # nor is NaN
        return HIDDEN
    left = math.ceil(max(row[0] - ex - 0.5, 0.0))
    right = math.floor(min(row[0] + ex - 0.5, width - 1.0))
    top = math.ceil(max(row[1] - ey - 0.5, 0.0))
    bottom = math.floor(min(row[1] + ey - 0.5, height - 1.0))
    if right < left or bottom < top:  # between the pixels
        return HIDDEN
    x, y = left // TILE, top // TILE
    return pack_box(x, y, right // TILE + 1 - x, bottom // TILE + 1 - y)


@inline
def pack_box(x: int, y: int, across: int, down: int) -> int:
    """A box of tiles, its corner and its size, in one number above 0."""
    return (down << 48) | (across << 32) | (y << 16) | x


@inline
def unpack_box(box: int) -> tuple[int, int, int, int]:
    """What `pack_box` took; an empty one for HIDDEN."""
    return box & 0xFFFF, (box >> 16) & 0xFFFF, (box >> 32) & 0xFFFF, box >> 48


@parallel_kernel("means")
def project_splats(
    start: int,
    stop: int,
    means: F,
    factors: F32,
    opacities: F32,
    keep: Bool,
    sh: F32,
    rotation: F64,
    position: F64,
    lens: F64,
    mip: bool,
    degree: int,
    geometry: F64,
    features: F32,
    boxes: I64,
) -> None:
    """Project N splats and evaluate their colour.

    Args:
        start: First splat of the range.
        stop: The splat after its last.
        means: (N, 3), scene units.
        factors: (N, 3, 3), R diag(s), scene units.
        opacities: (N,) in [0, 1].
        keep: (N,) false for rows that are not to be drawn.
        sh: (N, K, 3) with K >= (degree + 1)².
        rotation: (3, 3), world to camera.
        position: (3,) the camera's centre, scene units.
        lens: (7,) fx, fy, cx, cy, width, height in pixels and near in scene units.
        mip: Multiply opacities by sqrt(det before / det after dilation).
        degree: Spherical-harmonic degree to evaluate.
        geometry: (N, 8) out, see the module.
        features: (N, 4) out, red, green, blue and depth.
        boxes: (N,) out, the tiles around the pixels it can reach, see `unpack_box`; HIDDEN for one
            that can reach none, whose rows of the other outputs are junk.
    """
    coefficients = (degree + 1) ** 2
    basis = np.empty(25, np.float64)
    point = np.empty(3, np.float64)
    for i in range(start, stop):
        boxes[i] = HIDDEN
        if not keep[i]:
            continue
        # Subtracted in double precision: scenes in map coordinates lie far from the origin.
        dx = np.float64(means[i, 0]) - position[0]
        dy = np.float64(means[i, 1]) - position[1]
        dz = np.float64(means[i, 2]) - position[2]
        for k in range(3):
            point[k] = rotation[k, 0] * dx + rotation[k, 1] * dy + rotation[k, 2] * dz
        if not point[2] > lens[6]:
            continue
        row = geometry[i]
        ratio = _project_gaussian(factors[i], point, rotation, lens, row)
        opacity = np.float64(opacities[i])
        if mip:
            opacity *= math.sqrt(max(0.0, ratio))
        if not opacity >= MIN_ALPHA:
            continue
        row[5] = 2.0 * math.log(255.0 * opacity) + SLACK
        row[6] = opacity
        boxes[i] = _tile_box(row, lens[4], lens[5])
        if boxes[i] == HIDDEN:
            continue
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        sh_basis(dx / length, dy / length, dz / length, degree, basis)
        red = green = blue = 0.5
        for k in range(coefficients):
            red += basis[k] * sh[i, k, 0]
            green += basis[k] * sh[i, k, 1]
            blue += basis[k] * sh[i, k, 2]
        features[i, 0] = max(red, 0.0)
        features[i, 1] = max(green, 0.0)
        features[i, 2] = max(blue, 0.0)
        features[i, 3] = point[2]

"""From a view's sums on screen to a step of a splat's parameters of shape.

There are ten of them, all without unit:

    0 to 2  its centre along its own axes, in standard deviations along them
    3 to 5  its log-scales
    6 to 8  a turn about its own axes, radians
    9       the logit of its opacity

Projection as in `nanogs.kernels.project`, whose derivatives these are.
"""

import math
from typing import TypeAlias

import numpy as np

from nanogs._types import F32, F64
from nanogs.kernels.policy import inline
from nanogs.kernels.project import GUARD

SHAPE = 10
PACKED = 55  # lower triangle of a 10 x 10 matrix, row by row
SCREEN = 6
# Where the parameters after those of the centre begin, and the opacity; and the first monomial of
# second order.
CENTRE, OPACITY, SPREAD = 3, 9, 3

# Where the product of two of the monomials 1, p, q, p², pq, q² stands among the moments.
PRODUCTS = np.array(
    [
        [10, 15, 11, 19, 16, 12],
        [15, 19, 16, 22, 20, 17],
        [11, 16, 12, 20, 17, 13],
        [19, 22, 20, 24, 23, 21],
        [16, 20, 17, 23, 21, 18],
        [12, 17, 13, 21, 18, 14],
    ]
)

Scratch: TypeAlias = tuple[F64, F64, F64, F64, F64, F64, F64]


@inline
def new_scratch() -> Scratch:
    """Allocate what `shape_terms` and `damped_step` work in, for any number of splats."""
    return (
        np.empty((3, 3)),  # axes in camera space
        np.empty((2, 3)),  # axes on screen
        np.empty((3, 3)),  # three triples
        np.empty(SCREEN),
        np.zeros((SHAPE, SCREEN)),  # the Jacobian; that of the opacity stays 0 but for one place
        np.empty((SCREEN, SCREEN)),
        np.empty((SHAPE, SHAPE)),  # Cholesky's factor
    )


@inline
def _to_screen(
    row: F64,
    before: F64,
    mip: bool,
    du: float,
    dv: float,
    xx: float,
    xy: float,
    yy: float,
    out: F64,
) -> None:
    """Change of ln alpha as six coefficients of 1, p, q, p², pq, q².

    (du, dv) is the change of the centre in pixels and (xx, xy, yy) that of the covariance in
    pixels²; before holds the covariance without the dilation (xx, xy, yy).
    """
    inv_w, slope, inv_h = row[2], row[3], math.sqrt(row[4])
    m00 = inv_w * inv_w * (xx - 2.0 * slope * xy + slope * slope * yy)
    m01 = inv_w * inv_h * (xy - slope * yy)
    m11 = inv_h * inv_h * yy
    out[0] = 0.0
    if mip:  # ln of sqrt(det before / det after)
        det = before[0] * before[2] - before[1] * before[1]
        trace = before[2] * xx - 2.0 * before[1] * xy + before[0] * yy
        out[0] = 0.5 * ((trace / det if det > 0.0 else 0.0) - m00 - m11)
    out[1] = inv_w * (du - slope * dv)
    out[2] = inv_h * dv
    out[3] = 0.5 * m00
    out[4] = m01
    out[5] = 0.5 * m11


@inline
def _screen_jacobian(
    turn: F64,
    scales: F64,
    point: F64,
    row: F64,
    lens: F64,
    mip: bool,
    flat: F64,
    before: F64,
    jacobian: F64,
) -> None:
    """(9, 6) change of ln alpha for each parameter but the opacity.

    turn: (3, 3) the splat's axes in camera space, in columns. flat: (2, 3), before: (3,) scratch.
    """
    fx, fy, cx, cy, width, height = lens[0], lens[1], lens[2], lens[3], lens[4], lens[5]
    z = point[2]
    xz, yz = point[0] / z, point[1] / z
    margin_x = (GUARD - 1.0) * 0.5 * width / fx
    margin_y = (GUARD - 1.0) * 0.5 * height / fy
    tx = min(max(xz, -cx / fx - margin_x), (width - cx) / fx + margin_x)
    ty = min(max(yz, -cy / fy - margin_y), (height - cy) / fy + margin_y)
    jx, jy = fx / z, fy / z
    before[0], before[1], before[2] = 0.0, 0.0, 0.0
    for k in range(3):
        flat[0, k] = jx * (turn[0, k] - tx * turn[2, k])
        flat[1, k] = jy * (turn[1, k] - ty * turn[2, k])
        square = scales[k] * scales[k]
        before[0] += square * flat[0, k] * flat[0, k]
        before[1] += square * flat[0, k] * flat[1, k]
        before[2] += square * flat[1, k] * flat[1, k]
    for k in range(3):
        s = scales[k]
        d0, d1, d2 = s * turn[0, k], s * turn[1, k], s * turn[2, k]
        along_x, along_y = (d0 - xz * d2) / z, (d1 - yz * d2) / z
        slide_x = along_x if tx == xz else 0.0
        slide_y = along_y if ty == yz else 0.0
        xx, xy, yy = -2.0 * d2 / z * before[0], -2.0 * d2 / z * before[1], -2.0 * d2 / z * before[2]
        for j in range(3):
            depth = scales[j] * scales[j] * turn[2, j]
            ax, ay = -jx * slide_x * depth, -jy * slide_y * depth
            xx += 2.0 * ax * flat[0, j]
            xy += ax * flat[1, j] + ay * flat[0, j]
            yy += 2.0 * ay * flat[1, j]
        _to_screen(row, before, mip, fx * along_x, fy * along_y, xx, xy, yy, jacobian[k])
        a, b = flat[0, k], flat[1, k]
        square = 2.0 * s * s
        xx, xy, yy = square * a * a, square * a * b, square * b * b
        _to_screen(row, before, mip, 0.0, 0.0, xx, xy, yy, jacobian[3 + k])
        i, j = (k + 1) % 3, (k + 2) % 3
        spread = scales[i] * scales[i] - scales[j] * scales[j]
        xx = 2.0 * spread * flat[0, i] * flat[0, j]
        xy = spread * (flat[0, i] * flat[1, j] + flat[0, j] * flat[1, i])
        yy = 2.0 * spread * flat[1, i] * flat[1, j]
        _to_screen(row, before, mip, 0.0, 0.0, xx, xy, yy, jacobian[6 + k])


@inline
def _bend(
    a: int, first: int, jacobian: F64, sums: F64, moments: F64, product: F64, pull: F64, block: F64
) -> None:
    """Row a of J g and of J M Jᵀ; its Jacobian is 0 from column 1 up to `first`."""
    total = jacobian[a, 0] * sums[4]
    for d in range(first, SCREEN):
        total += jacobian[a, d] * sums[4 + d]
    pull[a] = total
    for c in range(SCREEN):
        entry = jacobian[a, 0] * moments[0, c]
        for d in range(first, SCREEN):
            entry += jacobian[a, d] * moments[d, c]
        product[c] = entry
    row = a * (a + 1) // 2
    for b in range(min(a + 1, CENTRE)):
        entry = 0.0
        for c in range(SCREEN):
            entry += product[c] * jacobian[b, c]
        block[row + b] = entry
    for b in range(CENTRE, min(a + 1, OPACITY)):
        entry = product[0] * jacobian[b, 0]
        for c in range(SPREAD, SCREEN):
            entry += product[c] * jacobian[b, c]
        block[row + b] = entry
    if a == OPACITY:
        block[row + a] = product[0] * jacobian[a, 0]


@inline
def _pull_and_block(
    jacobian: F64, sums: F64, moments: F64, product: F64, pull: F64, block: F64
) -> None:
    """The pull J g, and of the block J M Jᵀ the lower triangle.

    Only the centre moves a splat on screen: the linear monomials, columns 1 and 2, are its alone.
    Only opacity changes alpha alike everywhere.
    """
    for d in range(SCREEN):
        for c in range(SCREEN):
            moments[d, c] = sums[PRODUCTS[d, c]]
    for a in range(CENTRE):
        _bend(a, 1, jacobian, sums, moments, product, pull, block)
    for a in range(CENTRE, OPACITY):
        _bend(a, SPREAD, jacobian, sums, moments, product, pull, block)
    _bend(OPACITY, SCREEN, jacobian, sums, moments, product, pull, block)


@inline
def shape_terms(
    row: F64,
    sums: F64,
    point: F64,
    axes: F32,
    scales: F32,
    opacity: float,
    rotation: F64,
    lens: F64,
    mip: bool,
    scratch: Scratch,
    pull: F64,
    block: F64,
) -> None:
    """Write how a view pulls at a splat's ten parameters of shape, and the curvatures.

    Args:
        row: (8,) the projected splat.
        sums: (25,) from `gather_entries`.
        point: (3,) its centre less the camera's, scene units.
        axes: (3, 3) its rotation matrix.
        scales: (3,) scene units.
        opacity: In [0, 1], before any compensation.
        rotation: (3, 3), world to camera.
        lens: (6 or more,) fx, fy, cx, cy, width, height in pixels.
        mip: Whether opacities were compensated for the dilation.
        scratch: From `new_scratch`; what is allocated for each splat costs a tenth of its step.
        pull: (10,) out.
        block: (55,) out, a lower triangle.
    """
    turn, flat, triples, product, jacobian, moments, _ = scratch
    seen, size, before = triples[0], triples[1], triples[2]
    for r in range(3):
        seen[r] = rotation[r, 0] * point[0] + rotation[r, 1] * point[1] + rotation[r, 2] * point[2]
        for k in range(3):
            turn[r, k] = rotation[r, 0] * axes[0, k] + rotation[r, 1] * axes[1, k]
            turn[r, k] += rotation[r, 2] * axes[2, k]
        size[r] = scales[r]
    _screen_jacobian(turn, size, seen, row, lens, mip, flat, before, jacobian)
    jacobian[OPACITY, 0] = 1.0 - opacity
    _pull_and_block(jacobian, sums, moments, product, pull, block)


@inline
def _factorise(block: F64, damping: float, lift: float, lower: F64) -> None:
    """Cholesky's lower factor of a damped block, with the inverse of its diagonal there."""
    for a in range(SHAPE):
        row = a * (a + 1) // 2
        for b in range(a):
            value = block[row + b]
            for k in range(b):
                value -= lower[a, k] * lower[b, k]
            lower[a, b] = value * lower[b, b]
        value = (1.0 + damping) * block[row + a] + lift
        for k in range(a):
            value -= lower[a, k] * lower[a, k]
        lower[a, a] = 1.0 / math.sqrt(max(value, lift))  # rounding alone could make it less


@inline
def _substitute(lower: F64, step: F64) -> None:
    """Solve for the step in place, with the factor of `_factorise`."""
    for a in range(SHAPE):
        value = step[a]
        for k in range(a):
            value -= lower[a, k] * step[k]
        step[a] = value * lower[a, a]
    for a in range(SHAPE - 1, -1, -1):
        value = step[a]
        for k in range(a + 1, SHAPE):
            value -= lower[k, a] * step[k]
        step[a] = value * lower[a, a]


@inline
def damped_step(
    pull: F64, block: F64, damping: float, floor: float, limits: F64, scratch: Scratch
) -> bool:
    """Solve a splat's ten equations (Levenberg and Marquardt) and hold the step to its limits.

    Args:
        pull: (10,) in; the step out.
        block: (55,) lower triangle.
        damping: Share of the diagonal added to it.
        floor: Share of the largest curvature added to all of the diagonal, more than 0: what
            nothing determines stays where it is.
        limits: (10 or more,) largest steps, above 0; a longer step is shortened as a whole.
        scratch: From `new_scratch`.

    Returns:
        Whether there is a step: not where nothing bends, or where numbers are past all bounds.
    """
    largest = 0.0
    for a in range(SHAPE):
        largest = max(largest, block[a * (a + 3) // 2])
    if not largest > 0.0:
        return False
    lower = scratch[6]
    _factorise(block, damping, floor * largest, lower)
    _substitute(lower, pull)
    excess, length = 1.0, 0.0
    for a in range(SHAPE):
        excess = max(excess, abs(pull[a]) / limits[a])
        length += abs(pull[a])
    if not length < math.inf:
        return False
    for a in range(SHAPE):
        pull[a] /= excess
    return True

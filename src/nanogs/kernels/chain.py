"""The chain rule from a view's sums on screen to a splat's parameters of shape.

There are ten of these parameters, all dimensionless:

    0 to 2  its centre along its own axes, in standard deviations along them
    3 to 5  its log-scales
    6 to 8  a rotation about its own axes, radians
    9       the logit of its opacity

The Jacobians are derivatives of the projection in `nanogs.kernels.project`. They are computed for
one splat at a time, and all that follows for many side by side (see `nanogs.kernels.damped`).
"""

import math
from typing import TypeAlias

import numpy as np

from nanogs._types import F32, F64
from nanogs.kernels.gradients import SUMS
from nanogs.kernels.policy import allocating_inline, exact_inline, inline

Triple: TypeAlias = tuple[float, float, float]
Bounds: TypeAlias = tuple[float, float, float, float]

SHAPE = 10
PACKED = 55  # lower triangle of a 10 x 10 matrix, row by row
SCREEN = 6
DIAGONAL = np.array([row * (row + 3) // 2 for row in range(SHAPE)])  # places in such a matrix
# Number of parameters of the centre, indices of the first rotation and of the opacity, and index of
# the first monomial of second order.
CENTRE, TURN, OPACITY, SPREAD = 3, 6, 9, 3
# Share of its displacement that each step of full length undoes if views determine nothing of a
# splat.
RESTORING = 0.2
# Weight of the views from which a splat would be in full sight, relative to the view of a step.
ELSEWHERE = 0.2
# Which monomials each parameter changes. Only the centre moves a splat on screen, so that only it
# changes the linear ones. The opacity changes only the constant.
CHANGES = np.ones((SHAPE, SCREEN), np.bool_)
CHANGES[CENTRE:OPACITY, 1:SPREAD] = CHANGES[OPACITY, 1:] = False

# Index, among a splat's 25 sums, of the moment of the product of two of 1, p, q, p², pq, q².
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


@allocating_inline
def new_chains(shape: int, screen: int, lanes: int) -> tuple[F64, F64, F64]:
    """Allocate arrays for `gradients_and_hessians`: Jacobians, sums, and scratch for products."""
    # Zeros, because only one entry of the opacity's row of a Jacobian is ever written.
    return np.zeros((shape, screen, lanes)), np.zeros((SUMS, lanes)), np.zeros((screen, lanes))


@inline
def resolved_share(row: F64, dilation: float) -> float:
    """Return how well a view determines a small splat, in [0, 1]: the share of its step to take.

    A view shows only the sum of the splat's own covariance on screen and the rasteriser's dilation.
    In the frame where this sum is the unit matrix, let own be the eigenvalues of the splat's part:
    1 for a splat of many pixels, 0 for a point. Seen from nearer, the dilation vanishes, and the
    error of a change there is to that here as 1 to own². If the splat is right there, both errors
    together are least at the share own² / (1 + own²) of the step that this view alone asks for. The
    result, the mean of own² over both axes, is nearly that for small own, and 1 for whole steps
    where nothing is hidden by the dilation.

    Args:
        row: (8,) the projected splat.
        dilation: Variance that is added on screen, pixels².
    """
    # Half the trace, and the determinant, of the dilation in the frame of the unit matrix.
    middle = 0.5 * dilation * (row[2] * row[2] * (1.0 + row[3] * row[3]) + row[4])
    det = dilation * dilation * row[2] * row[2] * row[4]
    share: float = 1.0 - 2.0 * middle + 2.0 * middle * middle - det
    return min(max(share, 0.0), 1.0)


@inline
def unoccluded_share(row: F64, weight: float) -> float:
    """Return how well a view determines a splat behind others, in [0, 1]: the share of its step.

    Let v be the part of the splat's light that the splats in front let through. The error of a
    change in this view is to that from where nothing is in front as v to 1. If the splat is right
    there, and these views count as `ELSEWHERE`, all errors together are least at the share
    v / (v + ELSEWHERE) of the step that this view alone asks for. It is scaled to 1 for v = 1.

    With nothing in front of it, T is 1 and no pixel's alpha A is less than the splat's own. Then
    the sum of T alpha A is at least that of alpha², half the area of the Gaussian times the squared
    opacity, or half of this if every other block of pixels counts. The latter is always taken, so
    that v is an upper estimate: twice as large if all pixels count, and too large for a faint splat
    in front of others.

    Args:
        row: (8,) the projected splat.
        weight: Sum over the pixels of T alpha A, of all or of every other block.
    """
    least = 0.5 * math.pi * row[6] * row[6] / (row[2] * math.sqrt(row[4]))
    shown = min(weight / least, 1.0)
    share: float = (1.0 + ELSEWHERE) * shown / (shown + ELSEWHERE)
    return share


@inline
def restoring_share(most_determined: float) -> float:
    """Return the share of a splat's displacement since its start that a step of full length undoes.

    Short steps add up to long ways if there are many. Without this, parameters that no view can
    distinguish from the dilation would drift, and so would splats that are hardly shown.

    Args:
        most_determined: The largest product of `resolved_share` and `unoccluded_share` of all views
            so far, in [0, 1].
    """
    undetermined = 1.0 - most_determined
    return RESTORING * undetermined * undetermined


@inline
def _to_monomials(
    p: float, q: float, pp: float, pq: float, qq: float, mip: bool, bare: Triple, out: F64
) -> None:
    """Write a change of ln alpha as six coefficients, of 1, p, q, p², pq, q².

    All is in the splat's own frame on screen, where its covariance is the unit matrix: (p, q) is
    the change of its centre, (pp, pq, qq) that of its covariance, and `bare` (pp, pq, qq) is its
    covariance without the dilation.
    """
    fade = 0.0
    if mip:  # ln of sqrt(det bare / det covariance)
        det = bare[0] * bare[2] - bare[1] * bare[1]
        trace = bare[2] * pp - 2.0 * bare[1] * pq + bare[0] * qq
        fade = 0.5 * ((trace / det if det > 0.0 else 0.0) - pp - qq)
    out[0], out[1], out[2] = fade, p, q
    out[3], out[4], out[5] = 0.5 * pp, pq, 0.5 * qq


@inline
def _turned(rotation: F64, x: float, y: float, z: float) -> Triple:
    """Rotate a vector from world to camera space."""
    return (
        rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z,
        rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z,
        rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z,
    )


@inline
def _flattened(
    axis: Triple,
    jx: float,
    jy: float,
    tx: float,
    ty: float,
    inv_w: float,
    slope: float,
    inv_h: float,
) -> tuple[float, float]:
    """Project a vector in camera space to the splat's own frame on screen."""
    y = jy * (axis[1] - ty * axis[2])
    return inv_w * (jx * (axis[0] - tx * axis[2]) - slope * y), inv_h * y


@inline
def screen_jacobian(
    row: F64,
    point: F64,
    axes: F32,
    scales: F32,
    opacity: float,
    rotation: F64,
    intrinsics: F64,
    bounds: Bounds,
    mip: bool,
    jacobian: F64,
) -> None:
    """Compute the Jacobian of ln alpha on screen by a splat's ten parameters of shape.

    Args:
        row: (8,) the projected splat.
        point: (3,) its centre less the camera's, scene units.
        axes: (3, 3) its rotation matrix.
        scales: (3,) scene units.
        opacity: In [0, 1], before any compensation.
        rotation: (3, 3), world to camera.
        intrinsics: (2 or more,) fx and fy in pixels.
        bounds: Bounds of x / z and y / z, see `guard_bounds`.
        mip: Whether opacities were compensated for the dilation.
        jacobian: (10, 6) out, coefficients of 1, p, q, p², pq, q²; of the opacity's row the first
            alone is written, the others are 0.
    """
    fx, fy = intrinsics[0], intrinsics[1]
    inv_w, slope, inv_h = row[2], row[3], math.sqrt(row[4])
    x, y, z = _turned(rotation, point[0], point[1], point[2])
    per_depth = 1.0 / z
    xz, yz = x * per_depth, y * per_depth
    tx, ty = min(max(xz, bounds[0]), bounds[1]), min(max(yz, bounds[2]), bounds[3])
    jx, jy = fx * per_depth, fy * per_depth
    slides_x, slides_y = (jx if tx == xz else 0.0), (jy if ty == yz else 0.0)

    # For each axis: its unit vector in camera space, the projection of that to the splat's own
    # frame on screen (p, q), and the scale.
    first = _turned(rotation, axes[0, 0], axes[1, 0], axes[2, 0])
    second = _turned(rotation, axes[0, 1], axes[1, 1], axes[2, 1])
    third = _turned(rotation, axes[0, 2], axes[1, 2], axes[2, 2])
    turned = (first, second, third)
    # In float64, whose range holds their squares; `float` would keep float32 here.
    lengths = (np.float64(scales[0]), np.float64(scales[1]), np.float64(scales[2]))
    flat = (
        _flattened(first, jx, jy, tx, ty, inv_w, slope, inv_h),
        _flattened(second, jx, jy, tx, ty, inv_w, slope, inv_h),
        _flattened(third, jx, jy, tx, ty, inv_w, slope, inv_h),
    )
    pp, pq, qq, leaning_p, leaning_q = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        square = lengths[k] * lengths[k]
        p, q = flat[k]
        pp += square * p * p
        pq += square * p * q
        qq += square * q * q
        leaning_p += square * turned[k][2] * p
        leaning_q += square * turned[k][2] * q
    bare = (pp, pq, qq)

    for k in range(3):
        nearer = lengths[k] * turned[k][2] * per_depth
        x = lengths[k] * turned[k][0] * per_depth - xz * nearer
        y = lengths[k] * turned[k][1] * per_depth - yz * nearer
        slide_p, slide_q = inv_w * (slides_x * x - slope * slides_y * y), inv_h * slides_y * y
        _to_monomials(
            inv_w * (fx * x - slope * fy * y),
            inv_h * fy * y,
            -2.0 * (nearer * bare[0] + slide_p * leaning_p),
            -2.0 * nearer * bare[1] - slide_p * leaning_q - slide_q * leaning_p,
            -2.0 * (nearer * bare[2] + slide_q * leaning_q),
            mip, bare, jacobian[k],
        )  # fmt: skip

        p, q = flat[k]
        square = 2.0 * lengths[k] * lengths[k]
        pp, pq, qq = square * p * p, square * p * q, square * q * q
        _to_monomials(0.0, 0.0, pp, pq, qq, mip, bare, jacobian[3 + k])

        i, j = (k + 1) % 3, (k + 2) % 3
        spread = lengths[i] * lengths[i] - lengths[j] * lengths[j]
        pp, qq = 2.0 * spread * flat[i][0] * flat[j][0], 2.0 * spread * flat[i][1] * flat[j][1]
        pq = spread * (flat[i][0] * flat[j][1] + flat[j][0] * flat[i][1])
        _to_monomials(0.0, 0.0, pp, pq, qq, mip, bare, jacobian[6 + k])
    jacobian[OPACITY, 0] = 1.0 - opacity


@exact_inline
def _add_products(out: F64, a: F64, b: F64) -> None:
    """Add a product elementwise, one for each splat."""
    for lane in range(len(out)):
        out[lane] += a[lane] * b[lane]


@exact_inline
def _clear(out: F64) -> None:
    """Set a sum to 0 for each splat; a loop, because assigning a slice takes longer to compile."""
    for lane in range(len(out)):
        out[lane] = 0.0


@exact_inline
def gradients_and_hessians(
    jacobians: F64, sums: F64, products: F64, gradients: F64, hessians: F64
) -> None:
    """Compute gradients J g and Gauss-Newton matrices J M Jᵀ of splats side by side.

    Args:
        jacobians: (10, 6, L) from `screen_jacobian`.
        sums: (25, L) from `gather_entries`.
        products: (6, L) scratch.
        gradients: (10, L) out, the gradients, negative as in `sums`.
        hessians: (55, L) out, lower triangles of the matrices.
    """
    screen = len(products)
    for a in range(len(gradients)):
        _clear(gradients[a])
        for c in range(screen):
            _clear(products[c])
        for d in range(screen):
            if CHANGES[a, d]:
                _add_products(gradients[a], jacobians[a, d], sums[4 + d])
                for c in range(screen):
                    _add_products(products[c], jacobians[a, d], sums[PRODUCTS[d, c]])
        row = a * (a + 1) // 2
        for b in range(a + 1):
            _clear(hessians[row + b])
            for c in range(screen):
                if CHANGES[b, c]:
                    _add_products(hessians[row + b], products[c], jacobians[b, c])

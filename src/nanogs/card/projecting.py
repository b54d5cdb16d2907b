"""Project splats to the screen; formulas and sources are in `nanogs.kernels.project`."""

import math

import warp as wp

from nanogs.card.shading import TILE
from nanogs.kernels import harmonics, project

_GUARD = wp.constant(wp.float64(project.GUARD))
_MIN_ALPHA = wp.constant(wp.float64(project.MIN_ALPHA))
_SLACK = wp.constant(wp.float64(project.SLACK))
_TURN = wp.constant(wp.float64(2.0 * math.pi))

_C0, _C1 = wp.constant(wp.float32(harmonics.C0)), wp.constant(wp.float32(harmonics.C1))
_C20, _C21, _C22 = (wp.constant(wp.float32(one)) for one in harmonics.C2)
_C30, _C31, _C32, _C33, _C34 = (wp.constant(wp.float32(one)) for one in harmonics.C3)
_C40, _C41, _C42, _C43, _C44, _C45, _C46 = (wp.constant(wp.float32(one)) for one in harmonics.C4)

Basis = wp.types.vector(25, wp.float32)
Intrinsics = wp.types.vector(12, wp.float64)  # see `kernels.project.project_splats`


@wp.func
def sh_basis(x: wp.float32, y: wp.float32, z: wp.float32, degree: wp.int32) -> Basis:
    """Evaluate the spherical harmonics of a unit vector, as in `nanogs.kernels.harmonics`."""
    basis = Basis()
    basis[0] = _C0
    if degree >= 1:
        basis[1] = -_C1 * y
        basis[2] = _C1 * z
        basis[3] = -_C1 * x
    xx, yy, zz = x * x, y * y, z * z
    if degree >= 2:
        basis[4] = _C20 * x * y
        basis[5] = -_C20 * y * z
        basis[6] = _C21 * (2.0 * zz - xx - yy)
        basis[7] = -_C20 * x * z
        basis[8] = _C22 * (xx - yy)
    if degree >= 3:
        basis[9] = -_C30 * y * (3.0 * xx - yy)
        basis[10] = _C31 * x * y * z
        basis[11] = -_C32 * y * (4.0 * zz - xx - yy)
        basis[12] = _C33 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy)
        basis[13] = -_C32 * x * (4.0 * zz - xx - yy)
        basis[14] = _C34 * z * (xx - yy)
        basis[15] = -_C30 * x * (xx - 3.0 * yy)
    if degree >= 4:
        basis[16] = _C40 * x * y * (xx - yy)
        basis[17] = -_C41 * y * z * (3.0 * xx - yy)
        basis[18] = _C42 * x * y * (7.0 * zz - 1.0)
        basis[19] = -_C43 * y * z * (7.0 * zz - 3.0)
        basis[20] = _C44 * (zz * (35.0 * zz - 30.0) + 3.0)
        basis[21] = -_C43 * x * z * (7.0 * zz - 3.0)
        basis[22] = _C45 * (xx - yy) * (7.0 * zz - 1.0)
        basis[23] = -_C41 * x * z * (xx - 3.0 * yy)
        basis[24] = _C46 * (xx * (xx - 3.0 * yy) - yy * (3.0 * xx - yy))
    return basis


@wp.func
def guard_bounds(intrinsics: Intrinsics) -> wp.vec4d:
    """Return the bounds of x/z, then of y/z, in the Jacobian; see `project.guard_bounds`."""
    margin_x = (_GUARD - wp.float64(1.0)) * wp.float64(0.5) * intrinsics[9] / intrinsics[0]
    margin_y = (_GUARD - wp.float64(1.0)) * wp.float64(0.5) * intrinsics[10] / intrinsics[1]
    return wp.vec4d(
        -intrinsics[7] / intrinsics[0] - margin_x,
        (intrinsics[9] - intrinsics[7]) / intrinsics[0] + margin_x,
        -intrinsics[8] / intrinsics[1] - margin_y,
        (intrinsics[10] - intrinsics[8]) / intrinsics[1] + margin_y,
    )


@wp.func
def box_side(centre: wp.float64, half: wp.float64, size: wp.float64) -> wp.vec2i:
    """Return first tile and number of tiles of a splat along one axis of an image; 0 for none.

    centre: of the splat's box, half: half of its side, size: of the image, all in pixels.
    """
    side = wp.vec2i(0, 0)
    one, middle = wp.float64(1.0), wp.float64(0.5)
    if centre + half >= middle and centre - half <= size - middle:  # NaN is not inside
        first = wp.ceil(wp.max(centre - half - middle, wp.float64(0.0)))
        last = wp.floor(wp.min(centre + half - middle, size - one))
        if first <= last:
            tile = wp.int32(first) / TILE
            side = wp.vec2i(tile, wp.int32(last) / TILE + 1 - tile)
    return side


@wp.kernel(enable_backward=False)
def project_splats(
    means: wp.array2d[wp.float64],
    factors: wp.array3d[wp.float32],
    opacities: wp.array[wp.float32],
    reaches: wp.array[wp.float32],
    keep: wp.array[wp.bool],
    sh: wp.array3d[wp.float32],
    rotation: wp.mat33d,
    position: wp.vec3d,
    intrinsics: Intrinsics,
    mip: wp.bool,
    degree: wp.int32,
    geometry: wp.array2d[wp.float64],
    features: wp.array[wp.vec4f],
    boxes: wp.array[wp.vec4i],
    depths: wp.array[wp.float32],
    order: wp.array[wp.int32],
    drawn: wp.array[wp.int32],
) -> None:
    """Project N splats and evaluate their colour, as `nanogs.kernels.project.project_splats` does.

    The arguments are the same, except boxes: (N,) out, first column and row of tiles, number of
    columns and rows, 0 for a splat that reaches no pixel; depths: (N,) out, infinite for such a
    splat; order: (N,) out, 0 to N - 1; drawn: (1,) in and out, number of splats drawn.
    """
    i = wp.tid()
    boxes[i] = wp.vec4i(0, 0, 0, 0)
    depths[i] = wp.inf
    order[i] = i
    if not keep[i]:
        return
    way = wp.vec3d(means[i, 0], means[i, 1], means[i, 2]) - position
    point = rotation * way
    z = point[2]
    if not z > intrinsics[6]:
        return
    bounds = guard_bounds(intrinsics)
    inv_z = wp.float64(1.0) / z
    xz, yz = point[0] * inv_z, point[1] * inv_z
    tx = wp.min(wp.max(xz, bounds[0]), bounds[1])
    ty = wp.min(wp.max(yz, bounds[2]), bounds[3])
    across, down = wp.vec3d(), wp.vec3d()  # rows of the factor of the covariance on screen
    for k in range(3):
        axis = rotation * wp.vec3d(
            wp.float64(factors[i, 0, k]), wp.float64(factors[i, 1, k]), wp.float64(factors[i, 2, k])
        )
        across[k] = intrinsics[0] * inv_z * (axis[0] - tx * axis[2])
        down[k] = intrinsics[1] * inv_z * (axis[1] - ty * axis[2])
    normal = wp.cross(across, down)
    before = wp.dot(normal, normal)
    xx, xy, yy = wp.dot(across, across), wp.dot(across, down), wp.dot(down, down)
    dilation = intrinsics[11]
    after = before + dilation * (xx + yy) + dilation * dilation
    xx += dilation
    yy += dilation
    opacity, reach = wp.float64(opacities[i]), wp.float64(reaches[i])
    if mip:
        opacity *= wp.sqrt(wp.max(wp.float64(0.0), before / after))
        if not opacity >= _MIN_ALPHA:
            return
        reach = wp.float64(2.0) * wp.log(wp.float64(255.0) * opacity) + _SLACK
    u, v = intrinsics[0] * xz + intrinsics[2], intrinsics[1] * yz + intrinsics[3]
    rise = wp.sqrt(reach * yy)
    columns = box_side(u, wp.sqrt(reach * xx), intrinsics[4])
    rows = box_side(v, rise, intrinsics[5])
    if columns[1] == 0 or rows[1] == 0:
        return
    boxes[i] = wp.vec4i(columns[0], rows[0], columns[1], rows[1])
    depths[i] = wp.float32(z)
    wp.atomic_add(drawn, 0, 1)
    geometry[i, 0] = u
    geometry[i, 1] = v
    geometry[i, 2] = wp.sqrt(yy / after)
    geometry[i, 3] = xy / yy
    geometry[i, 4] = wp.float64(1.0) / yy
    geometry[i, 5] = reach
    geometry[i, 6] = opacity
    geometry[i, 7] = rise
    unit = way / wp.length(way)
    basis = sh_basis(wp.float32(unit[0]), wp.float32(unit[1]), wp.float32(unit[2]), degree)
    colour = wp.vec3f(0.5, 0.5, 0.5)
    for k in range((degree + 1) * (degree + 1)):
        colour += basis[k] * wp.vec3f(sh[i, k, 0], sh[i, k, 1], sh[i, k, 2])
    features[i] = wp.vec4f(
        wp.max(colour[0], 0.0), wp.max(colour[1], 0.0), wp.max(colour[2], 0.0), wp.float32(z)
    )


@wp.kernel(enable_backward=False)
def add_unoccluded(
    geometry: wp.array2d[wp.float64],
    depths: wp.array[wp.float32],
    size: wp.vec2i,
    totals: wp.array[wp.float64],
) -> None:
    """Write each splat's contribution if nothing were in front of it; see `kernels.raster`.

    geometry: (N, 8); depths: (N,) infinite for splats not drawn; totals: (N,) out, 2 pi alpha
    sqrt(det) of each Gaussian whose centre is on the image, or else 0.
    """
    i = wp.tid()
    totals[i] = wp.float64(0.0)
    if depths[i] < wp.inf:
        u, v, none = geometry[i, 0], geometry[i, 1], wp.float64(0.0)
        if u >= none and u <= wp.float64(size[0]) and v >= none and v <= wp.float64(size[1]):
            root = geometry[i, 2] * wp.sqrt(geometry[i, 4])
            totals[i] = geometry[i, 6] * _TURN / root

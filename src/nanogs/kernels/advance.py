"""The kernel that takes one damped Newton step on all parameters of every splat of a view.

Gradient, mean curvatures and parameters of a splat are read once, and its step is taken at once, so
that no intermediate array of the size of the model is written.
"""

import math

import numpy as np

from nanogs._types import F32, F64, I32, I64, Bool, F
from nanogs.kernels.chain import (
    OPACITY,
    PACKED,
    gradients_and_hessians,
    new_chains,
    resolved_share,
    restoring_share,
    screen_jacobian,
    unoccluded_share,
)
from nanogs.kernels.damped import damped_steps, new_lanes
from nanogs.kernels.harmonics import sh_basis
from nanogs.kernels.policy import inline, parallel_kernel
from nanogs.kernels.project import MIN_ALPHA, guard_bounds, reach_of
from nanogs.kernels.quaternion import rotation_matrix

LEAST_WEIGHT = 1e-6  # least curvature of the colour, in pixels, at which a splat is moved
# Columns of `displacements`: a splat's displacement since the fit began, of its centre, log-scales,
# quaternion and logit, then how well it was determined by the view that determines it best.
DISPLACEMENT = 12
LOGIT, MOST_DETERMINED = 10, 11


@inline
def _turn(quat: F64, x: float, y: float, z: float) -> None:
    """Rotate a unit quaternion in place by (x, y, z), radians, about its own axes."""
    angle = math.sqrt(x * x + y * y + z * z)
    factor = math.sin(0.5 * angle) / angle if angle > 1e-9 else 0.5
    a, b, c, d = math.cos(0.5 * angle), factor * x, factor * y, factor * z
    w, i, j, k = quat[0], quat[1], quat[2], quat[3]
    w, i, j, k = (
        w * a - i * b - j * c - k * d,
        w * b + i * a + j * d - k * c,
        w * c - i * d + j * a + k * b,
        w * d + i * c - j * b + k * a,
    )
    length = math.sqrt(w * w + i * i + j * j + k * k)
    quat[0], quat[1], quat[2], quat[3] = w / length, i / length, j / length, k / length


@inline
def _reshape(
    step: F64, rate: float, mean: F64, log_scales: F64, quat: F64, axes: F32, scales: F32
) -> None:
    """Apply a step, given in the splat's own frame, to its centre, scales and rotation."""
    for r in range(3):
        for k in range(3):
            mean[r] += rate * step[k] * axes[r, k] * scales[k]
        log_scales[r] += rate * step[3 + r]
    _turn(quat, rate * step[6], rate * step[7], rate * step[8])


@inline
def _start(
    mean: F64, log_scales: F64, quat: F64, logit: float, displacement: F32, start: F64
) -> None:
    """Write the (11,) parameters that a splat began with: the current ones less `displacement`."""
    for r in range(3):
        start[r] = mean[r] - displacement[r]
        start[3 + r] = log_scales[r] - displacement[3 + r]
    for r in range(4):
        start[6 + r] = quat[r] - displacement[6 + r]
    start[LOGIT] = logit - displacement[LOGIT]


@inline
def _restore(
    share: float, start: F64, mean: F64, log_scales: F64, quat: F64, logit: float, displacement: F32
) -> float:
    """Undo a share of a splat's displacement, update the displacement, and return the logit."""
    length = 0.0
    for r in range(4):
        quat[r] += share * (start[6 + r] - quat[r])
        length += quat[r] * quat[r]
    length = math.sqrt(length)
    for r in range(4):
        quat[r] /= length
        displacement[6 + r] = quat[r] - start[6 + r]
    for r in range(3):
        mean[r] += share * (start[r] - mean[r])
        log_scales[r] += share * (start[3 + r] - log_scales[r])
        displacement[r], displacement[3 + r] = mean[r] - start[r], log_scales[r] - start[3 + r]
    logit += share * (start[LOGIT] - logit)
    displacement[LOGIT] = logit - start[LOGIT]
    return logit


@inline
def _activate(log_scales: F64, quat: F64, axes: F32, scales: F32, factors: F32) -> None:
    """Compute a splat's axes, which are its rotation matrix, its scales, and their products."""
    first, second, third = rotation_matrix(quat)
    for k in range(3):
        axes[0, k], axes[1, k], axes[2, k] = first[k], second[k], third[k]
        scales[k] = math.exp(log_scales[k])
        for r in range(3):
            factors[r, k] = axes[r, k] * scales[k]


@inline
def _recolour(
    sums: F32,
    shown: F32,
    point: F64,
    degree: int,
    basis: F64,
    bands: F64,
    curvature: float,
    rate: float,
    back: float,
    initial_sh: F32,
    sh: F32,
) -> None:
    """Apply a step to a splat's coefficients (K, 3); a channel clipped at black only brightens."""
    distance = math.sqrt(point[0] * point[0] + point[1] * point[1] + point[2] * point[2])
    sh_basis(point[0] / distance, point[1] / distance, point[2] / distance, degree, basis)
    for k in range(len(sh)):
        held = bands[k, 1] * curvature
        step = rate / (bands[k, 0] * curvature + held)
        for c in range(3):
            gradient = basis[k] * sums[c] if shown[c] > 0.0 or sums[c] > 0.0 else 0.0
            change = sh[k, c] - initial_sh[k, c]
            sh[k, c] += np.float32((gradient - held * change) * step - back * change)


@parallel_kernel("order")
def advance_splats(
    start: int,
    stop: int,
    order: I64,
    geometry: F64,
    features: F32,
    totals: F32,
    rotation: F64,
    position: F64,
    intrinsics: F64,
    mip: bool,
    degree: int,
    rate: float,
    damping: float,
    floor: float,
    memory: int,
    sizes: tuple[int, int, int],
    limits: F64,
    bands: F64,
    initial_sh: F32,
    means: F64,
    log_scales: F64,
    quats: F64,
    logits: F64,
    sh: F32,
    touched: Bool,
    centres: F,
    axes: F32,
    scales: F32,
    factors: F32,
    opacities: F32,
    reaches: F32,
    keep: Bool,
    seen: I32,
    hessians: F32,
    weights: F32,
    displacements: F32,
) -> None:
    """Take one step on each splat that a view shows, and activate it for the next view.

    A splat's curvatures are means over the views that showed it. If it has more pixels in this view
    than on average, which the weight of its colour measures, they are scaled up by that ratio, so
    that no single view moves it farther than the view's own curvatures allow. The step is also
    shortened by how well the view determines the splat, in view of its size on screen and of what
    is in front of it (`chain.resolved_share`, `unoccluded_share`); and if no view has determined a
    splat well, each step undoes a part of all earlier steps (`chain.restoring_share`).

    Args:
        start: First place in `order` of the range.
        stop: The place after its last.
        order: (M,) rows that were drawn, each once.
        geometry: (N, 8) rows of projected splats.
        features: (N, 4) the colours that were blended, channels from 0.
        totals: (N, 25) from `gather_entries`.
        rotation: (3, 3), world to camera.
        position: (3,) the camera's centre, scene units.
        intrinsics: (12,) as `nanogs.kernels.project.project_splats` takes them.
        mip: Whether opacities were compensated for the dilation.
        degree: Spherical-harmonic degree, of which `sh` has all coefficients.
        rate: Learning rate, 1 for the whole way to the minimum of the quadratic model;
            the view's share of it is found for each splat.
        damping: See `damped_steps`.
        floor: See `damped_steps`.
        memory: Number of views, about, over which a splat's curvatures are averaged.
        sizes: SIZES of `damped`.
        limits: (12,) largest steps of the ten parameters of shape, then least and largest logit of
            the opacity; a logit that starts below the least may stay there.
        bands: (K, 2) curvature of each coefficient for a weight of 1, and its ridge.
        initial_sh: (N, K, 3) coefficients that the ridges pull back to.
        means: (N, 3) in and out, scene units.
        log_scales: (N, 3) in and out.
        quats: (N, 4) in and out, wxyz, unit.
        logits: (N,) in and out, of the opacity.
        sh: (N, K, 3) in and out.
        touched: (N,) out, set to true for splats that are moved.
        centres: (N, 3) out, the means in the precision in which they are drawn.
        axes: (N, 3, 3) in and out, rotation matrices.
        scales: (N, 3) in and out, scene units.
        factors: (N, 3, 3) out, axes times scales.
        opacities: (N,) in and out.
        reaches: (N,) out, see `project.reaches_of`.
        keep: (N,) out, whether the splat is to be drawn.
        seen: (N,) in and out, number of views that have moved the splat.
        hessians: (N, 55) in and out, mean Gauss-Newton matrix of the shape, lower triangle.
        weights: (N,) in and out, mean curvature of the colours.
        displacements: (N, DISPLACEMENT) in and out, the splat's displacement since the fit began,
            and the largest share of its steps that views determined so far.
    """
    bounds = guard_bounds(intrinsics)
    point, basis = np.empty(3), np.empty(25)
    shape, screen, lanes = sizes
    jacobians, sums, products = new_chains(shape, screen, lanes)
    gradients, curvatures, moves = new_lanes(shape, lanes)
    rows, excesses, lifts = np.empty(lanes, np.int64), np.empty(lanes), np.empty(lanes)
    rates, backs, begun = np.empty(lanes), np.empty(lanes), np.empty(MOST_DETERMINED)
    place = start
    while place < stop:
        lane = 0
        while lane < lanes and place < stop:
            i = order[place]
            place += 1
            weight = totals[i, 3]
            if not weight > LEAST_WEIGHT:
                continue
            for r in range(3):
                point[r] = means[i, r] - position[r]
            screen_jacobian(
                geometry[i], point, axes[i], scales[i], opacities[i], rotation, intrinsics, bounds,
                mip, jacobians[:, :, lane],
            )  # fmt: skip
            for k in range(len(sums)):
                sums[k, lane] = totals[i, k]
            seen[i] += 1
            touched[i] = True
            # Computed in float64 and rounded only at the end, so that it is never 0.
            weights[i] = weights[i] + (weight - weights[i]) / min(seen[i], memory)
            excesses[lane] = max(weight / weights[i], 1.0)
            share = resolved_share(geometry[i], intrinsics[11]) * unoccluded_share(
                geometry[i], weight
            )
            displacements[i, MOST_DETERMINED] = max(
                displacements[i, MOST_DETERMINED], np.float32(share)
            )
            rates[lane], backs[lane] = (
                rate * share,
                rate * restoring_share(displacements[i, MOST_DETERMINED]),
            )
            _recolour(
                totals[i], features[i], point, degree, basis, bands, excesses[lane] * weights[i],
                rates[lane], backs[lane], initial_sh[i], sh[i],
            )  # fmt: skip
            rows[lane] = i
            lane += 1

        gradients_and_hessians(jacobians, sums, products, gradients, curvatures)
        for k in range(lane):
            i = rows[k]
            share = 1.0 / min(seen[i], memory)
            for a in range(PACKED):
                hessians[i, a] += np.float32(share * (curvatures[a, k] - hessians[i, a]))
                curvatures[a, k] = excesses[k] * hessians[i, a]
        damped_steps(gradients, curvatures, damping, floor, limits, lifts, moves)
        for k in range(lane):
            if not moves[k]:
                continue
            i = rows[k]
            _start(means[i], log_scales[i], quats[i], logits[i], displacements[i], begun)
            _reshape(
                gradients[:, k], rates[k], means[i], log_scales[i], quats[i], axes[i], scales[i]
            )
            least = min(limits[10], logits[i])
            logit = min(max(logits[i] + rates[k] * gradients[OPACITY, k], least), limits[11])
            logits[i] = _restore(
                backs[k], begun, means[i], log_scales[i], quats[i], logit, displacements[i]
            )  # fmt: skip
            for r in range(3):
                centres[i, r] = means[i, r]
            _activate(log_scales[i], quats[i], axes[i], scales[i], factors[i])
            opacity = 1.0 / (1.0 + math.exp(-logits[i]))
            opacities[i] = opacity
            keep[i] = opacity >= MIN_ALPHA
            reaches[i] = reach_of(max(opacity, MIN_ALPHA))

"""One damped Newton step on all parameters of each splat that a view shows.

There is one thread for each splat. Formulas and sources are in `nanogs.kernels.chain`, `damped` and
`advance`.
"""

import math

import warp as wp

from nanogs.card.gradients import SCALES
from nanogs.card.projecting import Intrinsics, guard_bounds, sh_basis
from nanogs.kernels import advance, chain, gradients, project

# Loops of up to 4 iterations are unrolled; unrolling longer ones only takes longer to compile.
wp.set_module_options({"max_unroll": 4, "enable_backward": False})

SHAPE, PACKED, SCREEN = (wp.constant(n) for n in (chain.SHAPE, chain.PACKED, chain.SCREEN))
CENTRE, OPACITY = wp.constant(chain.CENTRE), wp.constant(chain.OPACITY)
SUMS = wp.constant(gradients.SUMS)
LOGIT, MOST_DETERMINED = wp.constant(advance.LOGIT), wp.constant(advance.MOST_DETERMINED)
LEAST_WEIGHT = wp.constant(wp.float32(advance.LEAST_WEIGHT))
MIN_ALPHA = wp.constant(wp.float64(project.MIN_ALPHA))
SLACK = wp.constant(wp.float64(project.SLACK))
RESTORING = wp.constant(wp.float64(chain.RESTORING))
ELSEWHERE = wp.constant(wp.float64(chain.ELSEWHERE))
PI = wp.constant(wp.float64(math.pi))
ZERO, HALF = wp.constant(wp.float64(0.0)), wp.constant(wp.float64(0.5))
ONE, TWO = wp.constant(wp.float64(1.0)), wp.constant(wp.float64(2.0))
SMALLEST = wp.constant(wp.float64(1e-9))  # radians; below it, the sine is taken as the angle

Monomials = wp.types.vector(chain.SCREEN, wp.float64)
Step = wp.types.vector(chain.SHAPE, wp.float64)
Block = wp.types.vector(chain.PACKED, wp.float64)
Jacobian = wp.types.matrix((chain.SHAPE, chain.SCREEN), wp.float64)
Flat = wp.types.matrix((3, 2), wp.float64)
Sums = wp.types.vector(gradients.SUMS, wp.float64)
PRODUCTS = wp.constant(wp.types.matrix(chain.PRODUCTS.shape, wp.int32)(*chain.PRODUCTS.ravel()))


@wp.func
def resolved_share(
    geometry: wp.array2d[wp.float64], i: wp.int32, dilation: wp.float64
) -> wp.float64:
    """Return how well a view determines a small splat; see `chain.resolved_share`."""
    slope = geometry[i, 3]
    square = geometry[i, 2] * geometry[i, 2]
    middle = HALF * dilation * (square * (ONE + slope * slope) + geometry[i, 4])
    det = dilation * dilation * square * geometry[i, 4]
    return wp.clamp(ONE - TWO * middle + TWO * middle * middle - det, ZERO, ONE)


@wp.func
def unoccluded_share(
    geometry: wp.array2d[wp.float64], i: wp.int32, weight: wp.float64
) -> wp.float64:
    """Return how well a view determines a splat behind others; see `chain.unoccluded_share`."""
    opacity = geometry[i, 6]
    least = HALF * PI * opacity * opacity / (geometry[i, 2] * wp.sqrt(geometry[i, 4]))
    shown = wp.min(weight / least, ONE)
    return (ONE + ELSEWHERE) * shown / (shown + ELSEWHERE)


@wp.func
def restoring_share(most_determined: wp.float64) -> wp.float64:
    """Return the share of a displacement that a full step undoes; see `chain.restoring_share`."""
    undetermined = ONE - most_determined
    return RESTORING * undetermined * undetermined


@wp.func
def to_monomials(
    p: wp.float64, q: wp.float64, change: wp.vec3d, mip: wp.bool, bare: wp.vec3d
) -> Monomials:
    """Return a change of ln alpha as six coefficients, of 1, p, q, p², pq, q²; see `chain`.

    (p, q): change of the centre; change: that of the covariance (pp, pq, qq), in the splat's frame
    on screen; bare: the covariance without the dilation.
    """
    fade = wp.float64(0.0)
    if mip:
        det = bare[0] * bare[2] - bare[1] * bare[1]
        if det > ZERO:
            fade = (bare[2] * change[0] - TWO * bare[1] * change[1] + bare[0] * change[2]) / det
        fade = HALF * (fade - change[0] - change[2])
    return Monomials(fade, p, q, HALF * change[0], change[1], HALF * change[2])


@wp.func
def with_row(jacobian: Jacobian, row: wp.int32, values: Monomials) -> Jacobian:
    """Return the Jacobian with one row replaced."""
    for c in range(SCREEN):
        jacobian[row, c] = values[c]
    return jacobian


@wp.func
def screen_jacobian(
    geometry: wp.array2d[wp.float64],
    i: wp.int32,
    way: wp.vec3d,
    axes: wp.array3d[wp.float32],
    scales: wp.array2d[wp.float32],
    opacity: wp.float64,
    rotation: wp.mat33d,
    intrinsics: Intrinsics,
    mip: wp.bool,
) -> Jacobian:
    """Return the Jacobian of ln alpha by ten shape parameters; see `chain.screen_jacobian`.

    way: from the camera to the splat's centre, scene units; opacity: before any compensation.
    """
    bounds = guard_bounds(intrinsics)
    fx, fy = intrinsics[0], intrinsics[1]
    inv_w, slope, inv_h = geometry[i, 2], geometry[i, 3], wp.sqrt(geometry[i, 4])
    point = rotation * way
    per_depth = ONE / point[2]
    xz, yz = point[0] * per_depth, point[1] * per_depth
    tx = wp.min(wp.max(xz, bounds[0]), bounds[1])
    ty = wp.min(wp.max(yz, bounds[2]), bounds[3])
    jx, jy = fx * per_depth, fy * per_depth
    slides_x, slides_y = wp.float64(jx), wp.float64(jy)
    if tx != xz:
        slides_x = ZERO
    if ty != yz:
        slides_y = ZERO
    turned, flat = wp.mat33d(), Flat()
    lengths = wp.vec3d(wp.float64(scales[i, 0]), wp.float64(scales[i, 1]), wp.float64(scales[i, 2]))
    bare, leaning = wp.vec3d(), wp.vec2d()
    for k in range(3):
        axis = rotation * wp.vec3d(
            wp.float64(axes[i, 0, k]), wp.float64(axes[i, 1, k]), wp.float64(axes[i, 2, k])
        )
        y = jy * (axis[1] - ty * axis[2])
        p = inv_w * (jx * (axis[0] - tx * axis[2]) - slope * y)
        q = inv_h * y
        for r in range(3):
            turned[r, k] = axis[r]
        flat[k, 0] = p
        flat[k, 1] = q
        square = lengths[k] * lengths[k]
        bare += square * wp.vec3d(p * p, p * q, q * q)
        leaning += square * axis[2] * wp.vec2d(p, q)

    jacobian = Jacobian()
    for k in range(3):
        nearer = lengths[k] * turned[2, k] * per_depth
        x = lengths[k] * turned[0, k] * per_depth - xz * nearer
        y = lengths[k] * turned[1, k] * per_depth - yz * nearer
        slide_p = inv_w * (slides_x * x - slope * slides_y * y)
        slide_q = inv_h * slides_y * y
        change = wp.vec3d(
            -TWO * (nearer * bare[0] + slide_p * leaning[0]),
            -TWO * nearer * bare[1] - slide_p * leaning[1] - slide_q * leaning[0],
            -TWO * (nearer * bare[2] + slide_q * leaning[1]),
        )
        centre = to_monomials(inv_w * (fx * x - slope * fy * y), inv_h * fy * y, change, mip, bare)
        jacobian = with_row(jacobian, k, centre)

        p, q = flat[k, 0], flat[k, 1]
        change = TWO * lengths[k] * lengths[k] * wp.vec3d(p * p, p * q, q * q)
        jacobian = with_row(jacobian, CENTRE + k, to_monomials(ZERO, ZERO, change, mip, bare))

        a, b = (k + 1) % 3, (k + 2) % 3
        spread = lengths[a] * lengths[a] - lengths[b] * lengths[b]
        change = spread * wp.vec3d(
            TWO * flat[a, 0] * flat[b, 0],
            flat[a, 0] * flat[b, 1] + flat[b, 0] * flat[a, 1],
            TWO * flat[a, 1] * flat[b, 1],
        )
        jacobian = with_row(jacobian, 2 * CENTRE + k, to_monomials(ZERO, ZERO, change, mip, bare))
    jacobian[OPACITY, 0] = ONE - opacity
    return jacobian


@wp.func
def curvatures(jacobian: Jacobian, sums: Sums) -> Block:
    """Return the lower triangle of J M Jᵀ; see `chain.gradients_and_hessians`."""
    block = Block()
    for a in range(SHAPE):
        products = Monomials()
        for c in range(SCREEN):
            for d in range(SCREEN):
                products[c] += jacobian[a, d] * sums[PRODUCTS[d, c]]
        for b in range(a + 1):
            for c in range(SCREEN):
                block[a * (a + 1) / 2 + b] += products[c] * jacobian[b, c]
    return block


@wp.func
def factorised(lower: Block, lift: wp.float64) -> Block:
    """Return the lower Cholesky factor of a matrix, with an inverted diagonal; see `damped`."""
    for a in range(SHAPE):
        row = a * (a + 1) / 2
        for b in range(a + 1):
            other = b * (b + 1) / 2
            for k in range(b):
                lower[row + b] -= lower[row + k] * lower[other + k]
            if b < a:
                lower[row + b] *= lower[other + b]
        lower[row + a] = ONE / wp.sqrt(wp.max(lower[row + a], lift))
    return lower


@wp.func
def substituted(lower: Block, step: Step) -> Step:
    """Solve for a step by substitution; step: the negative gradient, lower: from `factorised`."""
    for a in range(SHAPE):
        row = a * (a + 1) / 2
        for k in range(a):
            step[a] -= lower[row + k] * step[k]
        step[a] *= lower[row + a]
    for above in range(SHAPE):
        a = SHAPE - 1 - above
        for k in range(a + 1, SHAPE):
            step[a] -= lower[k * (k + 1) / 2 + a] * step[k]
        step[a] *= lower[a * (a + 3) / 2]
    return step


@wp.func
def damped_step(
    block: Block,
    gradient: Step,
    damping: wp.float64,
    floor: wp.float64,
    limits: wp.array[wp.float64],
) -> Step:
    """Compute one splat's step, shortened to its limits; 0 if there is none; see `damped_steps`."""
    largest = wp.float64(0.0)
    for a in range(SHAPE):
        largest = wp.max(largest, block[a * (a + 3) / 2])
    step = Step()
    if largest > ZERO:
        for a in range(SHAPE):
            at = a * (a + 3) / 2
            block[at] = block[at] * (ONE + damping) + floor * largest
        step = substituted(factorised(block, floor * largest), gradient)
        excess, length = wp.float64(1.0), wp.float64(0.0)
        for a in range(SHAPE):
            excess = wp.max(excess, wp.abs(step[a]) / limits[a])
            length += wp.abs(step[a])
        step = step / excess
        if not wp.isfinite(length):
            step = Step()
    return step


@wp.func
def turned_by(quat: wp.vec4d, turn: wp.vec3d) -> wp.vec4d:
    """Rotate a unit quaternion, wxyz, by `turn`, radians about its own axes."""
    angle = wp.length(turn)
    factor = wp.float64(0.5)
    if angle > SMALLEST:
        factor = wp.sin(HALF * angle) / angle
    a, b, c, d = wp.cos(HALF * angle), factor * turn[0], factor * turn[1], factor * turn[2]
    w, i, j, k = quat[0], quat[1], quat[2], quat[3]
    return wp.normalize(
        wp.vec4d(
            w * a - i * b - j * c - k * d,
            w * b + i * a + j * d - k * c,
            w * c - i * d + j * a + k * b,
            w * d + i * c - j * b + k * a,
        )
    )


@wp.func
def rotation_of(quat: wp.vec4d) -> wp.mat33d:
    """Return the rotation matrix of a unit quaternion, wxyz."""
    w, x, y, z = quat[0], quat[1], quat[2], quat[3]
    return wp.mat33d(
        ONE - TWO * (y * y + z * z), TWO * (x * y - w * z), TWO * (x * z + w * y),
        TWO * (x * y + w * z), ONE - TWO * (x * x + z * z), TWO * (y * z - w * x),
        TWO * (x * z - w * y), TWO * (y * z + w * x), ONE - TWO * (x * x + y * y),
    )  # fmt: skip


@wp.struct
class FittedSplats:
    """The arrays of N splats that are fitted; see the arguments of `advance.advance_splats`."""

    initial_sh: wp.array3d[wp.float32]
    means: wp.array2d[wp.float64]
    log_scales: wp.array2d[wp.float64]
    quats: wp.array2d[wp.float64]
    logits: wp.array[wp.float64]
    sh: wp.array3d[wp.float32]
    touched: wp.array[wp.bool]
    centres: wp.array2d[wp.float64]
    axes: wp.array3d[wp.float32]
    scales: wp.array2d[wp.float32]
    factors: wp.array3d[wp.float32]
    opacities: wp.array[wp.float32]
    reaches: wp.array[wp.float32]
    keep: wp.array[wp.bool]
    seen: wp.array[wp.int32]
    hessians: wp.array2d[wp.float32]
    weights: wp.array[wp.float32]
    displacements: wp.array2d[wp.float32]


@wp.struct
class StepConstants:
    """Parameters of the steps; see `advance.advance_splats`. `single`: centres are float32."""

    rate: wp.float64
    damping: wp.float64
    floor: wp.float64
    memory: wp.int32
    single: wp.bool
    limits: wp.array[wp.float64]
    bands: wp.array2d[wp.float64]


@wp.func
def recolour(
    moving: FittedSplats,
    rules: StepConstants,
    features: wp.array[wp.vec4f],
    totals: wp.array2d[wp.float32],
    i: wp.int32,
    way: wp.vec3d,
    degree: wp.int32,
    curvature: wp.float64,
    rate: wp.float64,
    back: wp.float64,
) -> None:
    """Apply a step to a splat's coefficients; a channel clipped at black only brightens."""
    unit = way / wp.length(way)
    basis = sh_basis(wp.float32(unit[0]), wp.float32(unit[1]), wp.float32(unit[2]), degree)
    for k in range((degree + 1) * (degree + 1)):
        held = rules.bands[k, 1] * curvature
        step = rate / (rules.bands[k, 0] * curvature + held)
        for c in range(3):
            gradient = wp.float64(0.0)
            if features[i][c] > 0.0 or totals[i, c] > 0.0:
                gradient = wp.float64(basis[k]) * wp.float64(totals[i, c])
            changed = wp.float64(moving.sh[i, k, c] - moving.initial_sh[i, k, c])
            change = wp.float32((gradient - held * changed) * step - back * changed)
            moving.sh[i, k, c] = moving.sh[i, k, c] + change


@wp.func
def restored(
    moving: FittedSplats,
    i: wp.int32,
    at: wp.int32,
    old: wp.float64,
    new: wp.float64,
    back: wp.float64,
) -> wp.float64:
    """Undo a part of a parameter's displacement since the fit began, and return the parameter.

    at: its column in `displacements`; old, new: the parameter before and after this step.
    """
    begun = old - wp.float64(moving.displacements[i, at])
    new += back * (begun - new)
    moving.displacements[i, at] = wp.float32(new - begun)
    return new


@wp.func
def reshape(
    moving: FittedSplats,
    rules: StepConstants,
    i: wp.int32,
    step: Step,
    rate: wp.float64,
    back: wp.float64,
) -> None:
    """Apply a step to a splat's centre, scales, rotation and opacity, and activate them."""
    for r in range(3):
        old = moving.means[i, r]
        mean = wp.float64(old)
        for k in range(3):
            axis = wp.float64(moving.axes[i, r, k])
            mean += rate * step[k] * axis * wp.float64(moving.scales[i, k])
        mean = restored(moving, i, r, old, mean, back)
        moving.means[i, r] = mean
        moving.centres[i, r] = mean
        if rules.single:
            moving.centres[i, r] = wp.float64(wp.float32(mean))
        scale = moving.log_scales[i, r]
        longer = scale + rate * step[CENTRE + r]
        moving.log_scales[i, r] = restored(moving, i, CENTRE + r, scale, longer, back)
    before = wp.vec4d(
        moving.quats[i, 0], moving.quats[i, 1], moving.quats[i, 2], moving.quats[i, 3]
    )
    quat = turned_by(before, rate * wp.vec3d(step[6], step[7], step[8]))
    begun = wp.vec4d()
    for k in range(4):
        begun[k] = before[k] - wp.float64(moving.displacements[i, 2 * CENTRE + k])
    quat = wp.normalize(quat + back * (begun - quat))
    for k in range(4):
        moving.quats[i, k] = quat[k]
        moving.displacements[i, 2 * CENTRE + k] = wp.float32(quat[k] - begun[k])
    rotation = rotation_of(quat)
    for k in range(3):
        length = wp.float32(wp.exp(moving.log_scales[i, k]))
        moving.scales[i, k] = length
        for r in range(3):
            moving.axes[i, r, k] = wp.float32(rotation[r, k])
            moving.factors[i, r, k] = wp.float32(rotation[r, k]) * length
    given = moving.logits[i]
    least = wp.min(rules.limits[10], given)
    logit = wp.min(wp.max(given + rate * step[OPACITY], least), rules.limits[11])
    logit = restored(moving, i, LOGIT, given, logit, back)
    moving.logits[i] = logit
    opacity = ONE / (ONE + wp.exp(-logit))
    moving.opacities[i] = wp.float32(opacity)
    moving.keep[i] = opacity >= MIN_ALPHA
    seen = wp.max(opacity, MIN_ALPHA)
    moving.reaches[i] = wp.float32(TWO * wp.log(wp.float64(255.0) * seen) + SLACK)


@wp.kernel(enable_backward=False)
def advance_splats(
    geometry: wp.array2d[wp.float64],
    features: wp.array[wp.vec4f],
    totals: wp.array2d[wp.float32],
    rotation: wp.mat33d,
    position: wp.vec3d,
    intrinsics: Intrinsics,
    mip: wp.bool,
    degree: wp.int32,
    rules: StepConstants,
    moving: FittedSplats,
) -> None:
    """Take one step on each splat of a view, as `nanogs.kernels.advance.advance_splats` does.

    The arguments are the same; totals: (N or more, 25), 0 for splats not drawn, before
    `gradients.SCALES`.
    """
    i = wp.tid()
    weight = totals[i, 3]
    if not weight > LEAST_WEIGHT:
        return
    way = wp.vec3d(moving.means[i, 0], moving.means[i, 1], moving.means[i, 2]) - position
    jacobian = screen_jacobian(
        geometry, i, way, moving.axes, moving.scales, wp.float64(moving.opacities[i]), rotation,
        intrinsics, mip,
    )  # fmt: skip
    sums = Sums()
    for k in range(SUMS):
        sums[k] = wp.float64(totals[i, k] * SCALES[k])
    moving.seen[i] = moving.seen[i] + 1
    moving.touched[i] = True
    share = ONE / wp.float64(wp.min(moving.seen[i], rules.memory))
    mean = wp.float64(moving.weights[i])
    moving.weights[i] = wp.float32(mean + (wp.float64(weight) - mean) * share)
    mean = wp.float64(moving.weights[i])
    excess = wp.max(wp.float64(weight) / mean, ONE)
    determined = resolved_share(geometry, i, intrinsics[11]) * unoccluded_share(
        geometry, i, wp.float64(weight)
    )
    moving.displacements[i, MOST_DETERMINED] = wp.max(
        moving.displacements[i, MOST_DETERMINED], wp.float32(determined)
    )
    rate, back = (
        rules.rate * determined,
        rules.rate * restoring_share(wp.float64(moving.displacements[i, MOST_DETERMINED])),
    )
    recolour(moving, rules, features, totals, i, way, degree, excess * mean, rate, back)

    block = curvatures(jacobian, sums)
    for a in range(PACKED):
        known = wp.float64(moving.hessians[i, a])
        moving.hessians[i, a] = moving.hessians[i, a] + wp.float32(share * (block[a] - known))
        block[a] = excess * wp.float64(moving.hessians[i, a])
    gradient = Step()
    for a in range(SHAPE):
        for d in range(SCREEN):
            gradient[a] += jacobian[a, d] * sums[4 + d]
    step = damped_step(block, gradient, rules.damping, rules.floor, rules.limits)
    if wp.length_sq(step) > ZERO:
        reshape(moving, rules, i, step, rate, back)


@wp.kernel
def average(share: wp.float64, moving: FittedSplats, means: FittedSplats) -> None:
    """Move a running mean towards the current state by a share; see `fit.state.MeanState`.

    means: the running mean's means, log_scales, quats, logits and sh, in and out.
    """
    i = wp.tid()
    rest = ONE - share
    for k in range(3):
        means.means[i, k] = rest * means.means[i, k] + share * moving.means[i, k]
        scale = rest * means.log_scales[i, k]
        means.log_scales[i, k] = scale + share * moving.log_scales[i, k]
    for k in range(4):
        means.quats[i, k] = rest * means.quats[i, k] + share * moving.quats[i, k]
    means.logits[i] = rest * means.logits[i] + share * moving.logits[i]
    for k in range(means.sh.shape[1]):
        for c in range(3):
            colour = wp.float32(rest) * means.sh[i, k, c]
            means.sh[i, k, c] = colour + wp.float32(share) * moving.sh[i, k, c]

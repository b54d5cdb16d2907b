"""The backward pass: sums over the pixels of each tile, for each splat of it.

See `nanogs.kernels.backward`. The threads of a block share a tile's pixels: on a card the block is
a warp, and each thread has two pixels; on the CPU device the block is a single thread, which has
all. A block reduces its sums in a fixed order, so that a device gives the same numbers every time.
"""

from functools import cache
from typing import Any

import warp as wp

from nanogs.card.shading import (
    AHEAD,
    BATCH,
    CHANNELS,
    PIXELS,
    Shape,
    Weights,
    first_light,
    offset,
    place,
    shade_pixel,
    shapes_from,
    starts_open,
)
from nanogs.kernels import gradients

_SATURATED = wp.constant(wp.float32(gradients.SATURATED))
Sums = wp.types.vector(gradients.SUMS, wp.float32)
SCALES = wp.constant(Sums(*gradients.SCALES.tolist()))
# Loops of up to 4 iterations are unrolled; unrolling longer ones only takes longer to compile.
_OPTIONS = {"max_unroll": 4}


@wp.func
def most_light(light: Any) -> wp.float32:  # noqa: ANN401 - a vector of any length
    """Return the largest transmittance of a thread's pixels; below 0 if all are full."""
    most = wp.float32(-1.0)
    for k in range(len(light)):
        most = wp.max(most, light[k])
    return most


@wp.func
def with_moments(
    sums: Sums,
    gradient: wp.float32,
    curvature: wp.float32,
    p: wp.float32,
    q: wp.float32,
) -> Sums:
    """Add a pixel's gradient and curvature times powers of p and q to `sums`.

    The sums begin at index 4.
    """
    sums[4] += gradient
    sums[5] += gradient * p
    sums[6] += gradient * q
    sums[7] += gradient * p * p
    sums[8] += gradient * p * q
    sums[9] += gradient * q * q
    at, column = wp.int32(10), wp.float32(curvature)
    for a in range(5):
        moment = wp.float32(column)
        for _b in range(5 - a):
            sums[at] += moment
            moment *= q
            at += 1
        column *= p
    return sums


@cache
def share_kernel(lanes: int) -> wp.Kernel:
    """Build the kernel that sums each entry's T alpha times a probe over its tile.

    lanes: threads of a block.
    """
    each = PIXELS // lanes
    lights = wp.types.vector(each, wp.float32)

    @wp.kernel(enable_backward=False, module="unique", module_options=_OPTIONS)
    def share_tiles(
        shapes: wp.array[Shape],
        starts: wp.array[wp.int32],
        slots: wp.array[wp.int32],
        wanted: wp.int32,
        size: wp.vec2i,
        probe: wp.array2d[wp.float32],
        partial: wp.array[wp.float32],
    ) -> None:
        """Sum the weights; probe: (H, W); partial: (E,) zeros in, sums out, indexed by slot."""
        tile, lane = wp.tid()
        light, factor = lights(), lights()
        for k in range(each):
            at = place(tile, lane + k * lanes, size[0])
            light[k] = first_light(at[0], at[1], size, wanted)
            if light[k] > 0.0:
                factor[k] = probe[at[1], at[0]]
        start, end = starts[tile], starts[tile + 1]
        for e in range(start, end, AHEAD):
            if (e - start) % BATCH == 0:  # noqa: SIM102 - `and` would ask the block each time
                if wp.tile_max(wp.tile(most_light(light)))[0] <= 0.0:
                    break
            loaded, weights = shapes_from(shapes, e, end), Weights()
            for k in range(each):
                middle = offset(lane + k * lanes)
                for j in range(AHEAD):
                    if e + j < end and light[k] > 0.0:
                        shade = shade_pixel(loaded[j], middle[0], middle[1], light[k])
                        light[k] = shade.after
                        weights[j] += shade.weight * factor[k]
            totals = wp.tile_sum(wp.tile(weights, preserve_type=True))[0]
            for j in range(AHEAD):
                if lane == 0 and e + j < end:
                    partial[slots[e + j]] = totals[j]

    return share_tiles


@cache
def pull_kernel(lanes: int) -> wp.Kernel:  # noqa: C901 - of a single kernel
    """Build the kernel that sums gradient and curvature over a tile; lanes: threads of a block."""
    each = PIXELS // lanes
    lights = wp.types.vector(each, wp.float32)
    planes = wp.types.matrix((each, gradients.CHANNELS), wp.float32)

    @wp.kernel(enable_backward=False, module="unique", module_options=_OPTIONS)
    def gradient_tiles(
        shapes: wp.array[Shape],
        features: wp.array[wp.vec4f],
        starts: wp.array[wp.int32],
        entries: wp.array[wp.int32],
        slots: wp.array[wp.int32],
        wanted: wp.int32,
        size: wp.vec2i,
        image: wp.array2d[wp.vec4f],
        residual: wp.array2d[wp.vec4f],
        curvature_weights: wp.array2d[wp.float32],
        partial: wp.array[Sums],
    ) -> None:
        """Sum as `nanogs.kernels.backward.gradient_tiles` does, but without `gradients.SCALES`.

        partial: (E,) zeros in, sums out, indexed by slot.
        """
        tile, lane = wp.tid()
        light, behind, error, pixel_weights = lights(), planes(), planes(), lights()
        for k in range(each):
            at = place(tile, lane + k * lanes, size[0])
            light[k] = first_light(at[0], at[1], size, wanted)
            if light[k] > 0.0:
                behind[k] = image[at[1], at[0]]
                error[k] = residual[at[1], at[0]]
                pixel_weights[k] = curvature_weights[at[1], at[0]]
        start, end = starts[tile], starts[tile + 1]
        for e in range(start, end):
            if (e - start) % BATCH == 0:  # noqa: SIM102 - `and` would ask the block each time
                if wp.tile_max(wp.tile(most_light(light)))[0] <= 0.0:
                    break
            sums = Sums()
            shape, feature = shapes[e], features[entries[e]]
            for k in range(each):
                if light[k] > 0.0:
                    middle = offset(lane + k * lanes)
                    shade = shade_pixel(shape, middle[0], middle[1], light[k])
                    light[k] = shade.after
                    weight, after = wp.float32(shade.weight), wp.abs(shade.after)
                    if weight > 0.0:
                        gradient, curvature = wp.float32(0.0), wp.float32(0.0)
                        for c in range(CHANNELS):
                            back = behind[k, c] - weight * feature[c]
                            behind[k, c] = back
                            change = feature[c] - back / after
                            gradient += change * error[k, c]
                            curvature += change * change
                            if c < 3:
                                sums[c] += weight * error[k, c]
                        shared = weight * pixel_weights[k]
                        sums[3] += shared
                        if weight < _SATURATED * after:
                            gradient, curvature = weight * gradient, shared * curvature
                            sums = with_moments(sums, gradient, curvature, shade.p, shade.q)
            total = wp.tile_sum(wp.tile(sums, preserve_type=True))
            wp.tile_store(partial, total, offset=slots[e])

    return gradient_tiles


@wp.kernel(enable_backward=False)
def gather_slots(
    order: wp.array[wp.int32],
    ends: wp.array[wp.int64],
    partial: wp.array2d[wp.float32],
    totals: wp.array2d[wp.float32],
) -> None:
    """Sum each splat's slots, in the order of its tiles.

    order: (N,) splats by depth; ends: (N,) where the slots of each end; partial: (E, K) by slot;
    totals: (N, K) out, 0 for a splat without tiles.
    """
    m, k = wp.tid()
    slot = wp.int32(0)
    if m > 0:
        slot = wp.int32(ends[m - 1])
    total = wp.float32(0.0)
    while slot < wp.int32(ends[m]):
        total += partial[slot, k]
        slot += 1
    totals[order[m], k] = total


@wp.kernel(enable_backward=False)
def weigh_pixels(
    image: wp.array2d[wp.vec4f],
    target: wp.array3d[wp.uint8],
    white: wp.float32,
    alpha_scale: wp.float32,
    wanted: wp.int32,
    size: wp.vec2i,
    residual: wp.array2d[wp.vec4f],
    curvature_weights: wp.array2d[wp.float32],
    errors: wp.array2d[wp.float64],
) -> None:
    """Compute the residual of an image, as `nanogs.kernels.backward.weigh_pixels` does.

    errors: (H, W) out, the sum of a pixel's squared residuals; 0 for one that does not count.
    """
    y, x = wp.tid()
    total = wp.float64(0.0)
    if starts_open(x, y, size, wanted):
        drawn, error = image[y, x], wp.vec4f()
        alpha = drawn[3] / alpha_scale
        change = wp.float32(target[y, x, 3]) / 255.0 - alpha
        curvature_weights[y, x] = alpha
        error[3] = change * alpha_scale
        for c in range(3):
            colour = drawn[c] + white * alpha
            if wp.isnan(colour):
                colour = 0.0
            colour = wp.min(colour, 1.0)
            error[c] = wp.float32(target[y, x, c]) / 255.0 - colour - white * change
        residual[y, x] = error
        for c in range(4):
            total += wp.float64(error[c] * error[c])
    errors[y, x] = total


@wp.kernel(enable_backward=False)
def square_pixels(
    residual: wp.array2d[wp.vec4f], counted: wp.array2d[wp.float32], squares: wp.array2d[wp.float32]
) -> None:
    """Write the squared residual of each pixel times `counted`; all arrays are (H, W)."""
    y, x = wp.tid()
    squares[y, x] = wp.dot(residual[y, x], residual[y, x]) * counted[y, x]


@wp.kernel(enable_backward=False)
def tint(
    features: wp.array[wp.vec4f],
    depths: wp.array[wp.float32],
    white: wp.float32,
    alpha_scale: wp.float32,
    tinted: wp.array[wp.vec4f],
) -> None:
    """Write the features that a fit blends: colours less `white`, `alpha_scale` for the depth.

    features: (N,); depths: (N,) infinite for splats that are not drawn; tinted: (N,) out.
    """
    i = wp.tid()
    changed = wp.vec4f()
    if depths[i] < wp.inf:
        changed = features[i] - wp.vec4f(white)
    changed[3] = alpha_scale
    tinted[i] = changed

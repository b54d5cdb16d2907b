"""Blend the splats of each tile, with one thread for each pixel; see `nanogs.kernels.raster`."""

import warp as wp

from nanogs.card.shading import AHEAD, Shape, first_light, offset, place, shade_pixel, shapes_from


@wp.kernel(enable_backward=False)
def blend_tiles(
    shapes: wp.array[Shape],
    features: wp.array[wp.vec4f],
    starts: wp.array[wp.int32],
    entries: wp.array[wp.int32],
    wanted: wp.int32,
    background: wp.vec4f,
    size: wp.vec2i,
    image: wp.array2d[wp.vec4f],
    transmittance: wp.array2d[wp.float32],
) -> None:
    """Blend every tile's splats front to back, four channels; see `raster.blend_tiles`.

    shapes: (E,); features: (N,); image: (H, W) out; transmittance: (H, W) out.
    """
    tile, pixel = wp.tid()
    xy = place(tile, pixel, size[0])
    x, y = xy[0], xy[1]
    if x >= size[0] or y >= size[1]:
        return
    at = offset(pixel)
    sums = wp.vec4f()
    light = first_light(x, y, size, wanted)
    e, end = wp.int32(starts[tile]), starts[tile + 1]
    while e < end and light > 0.0:
        loaded = shapes_from(shapes, e, end)
        for j in range(AHEAD):
            if e + j < end and light > 0.0:
                shade = shade_pixel(loaded[j], at[0], at[1], light)
                if shade.weight > 0.0:
                    sums += shade.weight * features[entries[e + j]]
                light = shade.after
        e += AHEAD
    light = wp.abs(light)
    transmittance[y, x] = light
    image[y, x] = sums + light * background


@wp.func
def in_byte(value: wp.float32) -> wp.uint8:
    """Clip to [0, 1] and round to 255ths; NaN becomes 0."""
    inside = wp.float32(0.0)
    if value > 0.0:
        inside = wp.min(value, 1.0)
    return wp.uint8(wp.rint(255.0 * inside))


@wp.kernel(enable_backward=False)
def write_bytes(
    image: wp.array2d[wp.vec4f],
    transmittance: wp.array2d[wp.float32],
    written: wp.array3d[wp.uint8],
) -> None:
    """Write colour and alpha of each pixel as bytes; see `nanogs.fit.targets.as_target`.

    image: (H, W), the fourth channel is not used; transmittance: (H, W); written: (H, W, 4) out.
    """
    y, x = wp.tid()
    colour = image[y, x]
    for c in range(3):
        written[y, x, c] = in_byte(colour[c])
    written[y, x, 3] = in_byte(1.0 - transmittance[y, x])

"""A splat's weight in a pixel, and its shape in a tile; see `nanogs.kernels.blocks`.

Tiles have 8 x 8 pixels here. Threads of a card run in warps of 32, all of which wait for those with
work: with the tiles of 16 x 16 of the CPU, a warp would wait at most of the splats of its tile.
"""

import math

import warp as wp

from nanogs.kernels import blocks, gradients, project

EDGE = 8  # pixels along each side of a tile
TILE = wp.constant(EDGE)
PIXELS = EDGE * EDGE  # pixels of a tile
WARP = 32  # threads that sum over the pixels of a tile on a card: they need not wait for others
# Of the CPU's kernels: pixels along each side of tiles and blocks, and blocks in a row of a tile.
_MASKED, _SIDE = wp.constant(blocks.TILE), wp.constant(blocks.SIDE)
_ROW = wp.constant(blocks.TILE // blocks.SIDE)
BATCH = wp.constant(blocks.BATCH)
CHANNELS = wp.constant(gradients.CHANNELS)  # blended channels: three colours, and depth or alpha

_START, _ACROSS, _ALONG = (wp.constant(at) for at in (blocks.START, blocks.ACROSS, blocks.ALONG))
_HEIGHT, _RISE, _FAINT = (wp.constant(at) for at in (blocks.HEIGHT, blocks.RISE, blocks.FAINT))
Shape = wp.types.vector(6, wp.float32)
# Entries that a thread loads at once, and then shades one by one. The tiles with the most entries
# end last, when few threads are left to work while one waits for memory. It must divide `BATCH`.
_LOADED = 4
AHEAD = wp.constant(_LOADED)
Shapes = wp.types.matrix((_LOADED, 6), wp.float32)
Weights = wp.types.vector(_LOADED, wp.float32)
_MIDDLE = wp.constant(wp.float32(0.5 * (EDGE - 1)))
_HALF = wp.constant(wp.float64(0.5 * EDGE))
_UNIT = wp.constant(wp.float64(blocks.UNIT))
_LOG_255, _SLACK = wp.constant(wp.float64(math.log(255.0))), wp.constant(wp.float64(project.SLACK))
_FAINTEST = wp.constant(wp.float32(blocks.FAINTEST))
_MAX_ALPHA = wp.constant(wp.float32(blocks.MAX_ALPHA))
_LEAST = wp.constant(wp.float32(blocks.MIN_TRANSMITTANCE))
_C0, _C1, _C2, _C3, _C4, _C5 = (wp.constant(wp.float32(one)) for one in blocks.POLYNOMIAL)


@wp.struct
class Shade:
    """The result of shading a pixel with a splat.

    Attributes:
        weight: T alpha, 0 if the splat does not contribute.
        after: T behind the splat; negative once the pixel is full.
        p: Root of the first square in the exponent, over `blocks.UNIT`.
        q: Root of the second square, likewise.
    """

    weight: wp.float32
    after: wp.float32
    p: wp.float32
    q: wp.float32


@wp.func
def shapes_from(shapes: wp.array[Shape], e: wp.int32, end: wp.int32) -> Shapes:
    """Load the shapes of `AHEAD` entries from `e`; beyond `end`, that of the last entry."""
    loaded = Shapes()
    for j in range(AHEAD):
        loaded[j] = shapes[wp.min(e + j, end - 1)]
    return loaded


@wp.func
def shade_pixel(shape: Shape, x: wp.float32, y: wp.float32, before: wp.float32) -> Shade:
    """Compute a splat's weight in a pixel, as `nanogs.kernels.blocks.shade_pixel` does.

    shape: of the splat in the tile; (x, y): offset from the tile's middle, pixels; before: T.
    """
    shade = Shade()
    p = shape[_START] + shape[_ACROSS] * x + shape[_ALONG] * y
    q = shape[_HEIGHT] + shape[_RISE] * y
    s = shape[_FAINT] + p * p + q * q
    shade.p = p
    shade.q = q
    shade.after = before
    if s <= _FAINTEST:
        power = _C0 + s * (_C1 + s * (_C2 + s * (_C3 + s * (_C4 + s * _C5))))
        power = power * power
        power = power * power
        power = power * power
        power = power * power
        weight = before * wp.min(power, _MAX_ALPHA)
        if before - weight < _LEAST:
            shade.after = -wp.abs(before)
        else:
            shade.weight = weight
            shade.after = before - weight
    elif before < _LEAST:
        shade.after = -wp.abs(before)
    return shade


@wp.func
def place(tile: wp.int32, pixel: wp.int32, width: wp.int32) -> wp.vec2i:
    """Return column and row in the image of a tile's pixel; width: of the image."""
    tiles_x = (width + TILE - 1) / TILE
    return wp.vec2i(tile % tiles_x * TILE + pixel % TILE, tile / tiles_x * TILE + pixel / TILE)


@wp.func
def offset(pixel: wp.int32) -> wp.vec2f:
    """Return the offset from the middle of a tile to a pixel; pixels are numbered row by row."""
    return wp.vec2f(
        wp.float32(pixel % TILE) - _MIDDLE,
        wp.float32(pixel / TILE) - _MIDDLE,
    )


@wp.func
def starts_open(x: wp.int32, y: wp.int32, size: wp.vec2i, wanted: wp.int32) -> wp.bool:
    """Return whether a pixel is on the image, (width, height), and in a wanted block.

    wanted: bit mask of the blocks of 4 x 4 pixels of a tile of the CPU's kernels.
    """
    block = (y % _MASKED) / _SIDE * _ROW + (x % _MASKED) / _SIDE
    return x < size[0] and y < size[1] and ((wanted >> block) & 1) == 1


@wp.func
def first_light(x: wp.int32, y: wp.int32, size: wp.vec2i, wanted: wp.int32) -> wp.float32:
    """Return the initial transmittance of a pixel: 1, or -1 for one that is not to be drawn."""
    light = wp.float32(-1.0)
    if starts_open(x, y, size, wanted):
        light = 1.0
    return light


@wp.kernel(enable_backward=False)
def shape_entries(
    geometry: wp.array2d[wp.float64],
    entries: wp.array[wp.int32],
    tiles: wp.array[wp.int32],
    tiles_x: wp.int32,
    shapes: wp.array[Shape],
) -> None:
    """Write the shape of each entry's splat in its tile, as `nanogs.kernels.raster.fetch` does.

    geometry: (N, 8); entries and tiles: (E,) splat and tile of each; shapes: (E,) out.
    """
    e = wp.tid()
    i, tile = entries[e], tiles[e]
    u = geometry[i, 0] - (wp.float64(tile % tiles_x * TILE) + _HALF)
    v = geometry[i, 1] - (wp.float64(tile / tiles_x * TILE) + _HALF)
    across, slope = geometry[i, 2] / _UNIT, geometry[i, 3]
    rise = wp.sqrt(geometry[i, 4]) / _UNIT
    faint = (_LOG_255 - wp.float64(0.5) * (geometry[i, 5] - _SLACK)) / wp.float64(16.0)
    shape = Shape()
    shape[_ACROSS] = wp.float32(across)
    shape[_ALONG] = wp.float32(-across * slope)
    shape[_START] = wp.float32(-across * (u - slope * v))
    shape[_RISE] = wp.float32(rise)
    shape[_HEIGHT] = wp.float32(-rise * v)
    shape[_FAINT] = wp.float32(faint)
    shapes[e] = shape

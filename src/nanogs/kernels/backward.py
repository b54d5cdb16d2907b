"""Kernels of the rasteriser's backward pass: gradients and curvatures for each splat on screen.

Derivatives of the blending of Kerbl, Kopanas, Leimkühler, Drettakis, "3D Gaussian Splatting", 2023
[K], eq. 3, for least squares: with T the transmittance in front of splat k and w = T alpha,

    d pixel / d colour_k    = w
    d pixel / d ln alpha_k  = w (colour_k - behind_k),

where behind_k is the colour blended from all splats behind k. In the splat's own frame on screen,
where the Gaussian is exp(-(p² + q²) / 2) (see `nanogs.kernels.project`), moving, stretching and
fading it changes ln alpha by a combination of the six monomials 1, p, q, p², pq, q². So all that a
fit needs of a view are sums over the pixels: of the gradient by ln alpha times these monomials, and
of its curvature times the products of two of them.

If many splats share pixels and all move at once, the curvature of each splat alone is too small. So
the sums use w A in place of w², where A is the pixel's alpha. Because the w of a pixel add up to A,
the quadratic with one such block for each splat is an upper bound of the true one (the separable
surrogates of De Pierro, 1995).
"""

import math

import numpy as np

from nanogs._types import F32, F64, I32, I64, U8
from nanogs.kernels.blocks import BATCH, LANES, SHAPE, TILE, mark_blocks, open_blocks
from nanogs.kernels.gradients import CHANNELS, SUMS, gradient_blocks
from nanogs.kernels.policy import inline, parallel_kernel
from nanogs.kernels.raster import fetch, place_in_tile, start_tile


@inline
def _load_tile(image: F32, x0: int, y0: int, planes: F32) -> None:
    """Copy a tile of an (H, W, 4) image into (4, 16, 16) blocks, 0 outside."""
    height, width = image.shape[0], image.shape[1]
    for y in range(TILE):
        for x in range(TILE):
            block, lane = place_in_tile(x, y)
            inside = y0 + y < height and x0 + x < width
            for c in range(CHANNELS):
                planes[c, block, lane] = image[y0 + y, x0 + x, c] if inside else np.float32(0.0)


@inline
def _in_byte(value: float) -> np.uint8:
    """Clip to [0, 1] and round to 255ths; NaN becomes 0."""
    if not value > 0:
        return np.uint8(0)
    scaled = np.float32(255.0) * np.float32(value)
    return np.uint8(np.rint(scaled)) if scaled < 255 else np.uint8(255)


@parallel_kernel("color", least=8)
def write_bytes(start: int, stop: int, color: F32, alpha: F32, written: U8) -> None:
    """Write the colours, clipped as on a screen, and alpha of an image as bytes.

    Args:
        start: First row of the range.
        stop: The row after its last.
        color: (H, W, 3) over black.
        alpha: (H, W).
        written: (H, W, 4) out, 255 is 1.
    """
    for y in range(start, stop):
        for x in range(alpha.shape[1]):
            for c in range(3):
                written[y, x, c] = _in_byte(color[y, x, c])
            written[y, x, 3] = _in_byte(alpha[y, x])


@parallel_kernel("image", least=8)
def weigh_pixels(
    start: int,
    stop: int,
    image: F32,
    target: U8,
    white: float,
    alpha_scale: float,
    wanted: int,
    residual: F32,
    curvature_weights: F32,
    errors: F64,
) -> None:
    """Compute the residual of an image, which is the target minus the image, and its alpha.

    Colours are clipped at 1, as on a screen, so that one that is brighter in both has no residual;
    NaN, as of coefficients near the end of float32, is black.

    Args:
        start: First row of the range.
        stop: The row after its last.
        image: (H, W, 4) blended colours less `white`, and alpha times `alpha_scale`.
        target: (H, W, 4) colours over black, and alpha; 255 is 1.
        white: Weight of the white background among those that errors are averaged over.
        alpha_scale: Weight of an error in alpha.
        wanted: Bit mask of the blocks of each tile that count; the others are not written.
        residual: (H, W, 4) out, the target minus the image, in the channels of `image`.
        curvature_weights: (H, W) out, alpha of the image: the A of the module's docstring.
        errors: (H, 2) out, for each row the sum of the squared residuals, and the number of pixels
            that count.
    """
    width = image.shape[1]
    for y in range(start, stop):
        total, count = 0.0, 0
        for x in range(width):
            block, _ = place_in_tile(x % TILE, y % TILE)
            if wanted >> block & 1 == 0:
                continue
            count += 1
            alpha = image[y, x, 3] / alpha_scale
            change = target[y, x, 3] / 255.0 - alpha
            curvature_weights[y, x] = alpha
            residual[y, x, 3] = change * alpha_scale
            total += change * change * alpha_scale * alpha_scale
            for c in range(3):
                colour = image[y, x, c] + white * alpha
                colour = 0.0 if math.isnan(colour) else min(colour, 1.0)
                error = target[y, x, c] / 255.0 - colour - white * change
                residual[y, x, c] = error
                total += error * error
        errors[y, 0], errors[y, 1] = total, count


@parallel_kernel("starts", least=8)
def gradient_tiles(
    start: int,
    stop: int,
    geometry: F64,
    features: F32,
    starts: I64,
    first_tile: int,
    entries: I32,
    wanted: int,
    image: F32,
    residual: F32,
    curvature_weights: F32,
    partial: F32,
) -> None:
    """Sum gradient and curvature over the pixels of each of T tiles, for each of its splats.

    Gradients are negative ones, the direction of descent, of half the sum of squares.

    Args:
        start: First tile of the range.
        stop: The tile after its last.
        geometry: (N, 8) rows of projected splats.
        features: (N, 4) the features that were blended.
        starts: (T + 1,) from `list_tiles`, for these tiles.
        first_tile: Number of the first of them in the image.
        entries: All entries from `list_tiles`, of which E are of these tiles.
        wanted: Bit mask of the blocks of each tile whose pixels count.
        image: (H, W, 4) the result of `blend_tiles` for these.
        residual: (H, W, 4) residual of each pixel, times the pixel's weight in the sum of squares.
        curvature_weights: (H, W) that weight of each pixel, times its alpha.
        partial: (E, 25) out, for each of these E: 0 to 2 the gradient by the first three channels,
            3 the sum of w times the curvature weights, their curvature; 4 to 9 the gradient by
            ln alpha times 1, p, q, p², pq, q²; 10 to 24 the curvature of ln alpha times p^a q^b
            for a + b <= 4, b running fastest.
    """
    height, width = image.shape[0], image.shape[1]
    tiles_x = (width + TILE - 1) // TILE
    transmittances = np.empty((LANES, LANES), np.float32)
    behind = np.empty((CHANNELS, LANES, LANES), np.float32)
    change = np.empty((CHANNELS, LANES, LANES), np.float32)
    tile_weights = np.zeros((LANES, LANES), np.float32)
    shapes = np.empty((BATCH, SHAPE), np.float32)
    values = np.empty((BATCH, CHANNELS), np.float32)
    marks = np.zeros(LANES, np.uint32)  # taken by `mark_blocks`, not used here
    for tile in range(start, min(stop, len(starts) - 1)):
        x0 = ((first_tile + tile) % tiles_x) * TILE
        y0 = ((first_tile + tile) // tiles_x) * TILE
        end = starts[tile + 1]
        partial[starts[tile] - starts[0] : end - starts[0]] = np.float32(0.0)
        start_tile(transmittances, x0, y0, width, height, wanted)
        _load_tile(image, x0, y0, behind)
        _load_tile(residual, x0, y0, change)
        for y in range(min(TILE, height - y0)):
            for x in range(min(TILE, width - x0)):
                block, lane = place_in_tile(x, y)
                tile_weights[block, lane] = curvature_weights[y0 + y, x0 + x]
        for first in range(starts[tile], end, BATCH):
            open_mask = open_blocks(transmittances)
            if open_mask == 0:
                break
            count = min(BATCH, end - first)
            for j in range(count):
                fetch(geometry, features, entries[first + j], x0, y0, CHANNELS, j, shapes, values)
            for j in range(count):
                mark = mark_blocks(shapes, j, marks) & open_mask
                gradient_blocks(
                    mark,
                    j,
                    shapes,
                    values,
                    transmittances,
                    behind,
                    change,
                    tile_weights,
                    partial,
                    first + j - starts[0],
                )


@parallel_kernel("totals", each=1)
def gather_entries(start: int, stop: int, entries: I32, partial: F32, totals: F32) -> None:
    """Add each splat's entries to its totals, in the order of the tiles.

    Args:
        start: First splat of the range.
        stop: The splat after its last.
        entries: (E,) from `list_tiles`.
        partial: (E, 25) from `gradient_tiles`.
        totals: (N, 25) in and out.
    """
    for e in range(len(entries)):
        i = entries[e]
        if start <= i < stop:
            for k in range(SUMS):
                totals[i, k] += partial[e, k]

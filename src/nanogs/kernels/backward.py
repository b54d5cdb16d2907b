"""Kernels that walk a rendering backwards: how each splat on screen would change the pixels.

Derivatives of the blending of Kerbl, Kopanas, Leimkühler, Drettakis, "3D Gaussian Splatting", 2023
[K], eq. 3, written for least squares: with T the light that reaches splat k and w = T alpha,

    d pixel / d colour_k    = w
    d pixel / d ln alpha_k  = w (colour_k - behind_k),

where behind_k is the colour that shows through splat k from behind it. In the splat's own frame on
screen, where the Gaussian is exp(-(p² + q²) / 2) (see `nanogs.kernels.project`), moving, stretching
and fading it changes ln alpha by a combination of the six monomials 1, p, q, p², pq, q²: all that a
fit needs of a view are sums of these over the pixels.

Each splat's own curvature is not enough where many splats share pixels and are all moved at once:
the sums use w A in place of w², A being the pixel's alpha. As the w of a pixel add up to A, the
quadratic with these blocks lies above the true one (the separable surrogates of De Pierro, 1995).
"""

import math

import numpy as np

from nanogs._types import F32, F64, I32, I64, U16
from nanogs.kernels.pixels import Single, blend_pixels
from nanogs.kernels.policy import inline, parallel_kernel
from nanogs.kernels.raster import start_tile
from nanogs.kernels.spans import BATCH, PIXELS, TILE, any_open

CHANNELS = 4
SUMS = 25  # what `pull_tiles` writes for an entry: see there
SATURATED = 98.9  # T alpha over what is left of T: beyond it alpha is held at 0.99

Row = tuple[
    Single, Single, Single, Single, Single, Single, Single, Single, Single, Single, Single, Single
]


@inline
def _pull_row(
    base: Single,
    step: Single,
    features: F32,
    i: int,
    r: int,
    lanes: F32,
    left: F32,
    weights: F32,
    behind: F32,
    residual: F32,
    precision: F32,
) -> Row:
    """Sums over the 16 pixels of tile row r for splat i; takes its colour out of `behind`.

    Returns:
        Pulls on three channels, the weight, then sums of the pull on ln alpha times 1, p, p² and
        of its curvature times 1, p, p², p³, p⁴.
    """
    c0, c1, c2, c3 = features[i, 0], features[i, 1], features[i, 2], features[i, 3]
    zero = np.float32(0.0)
    e0 = e1 = e2 = weight = g0 = g1 = g2 = m0 = m1 = m2 = m3 = m4 = zero
    for x in range(len(lanes)):
        w = weights[x]
        after = abs(left[r, x])
        inv = np.float32(1.0) / after
        b0 = behind[0, r, x] - w * c0
        b1 = behind[1, r, x] - w * c1
        b2 = behind[2, r, x] - w * c2
        b3 = behind[3, r, x] - w * c3
        behind[0, r, x] = b0
        behind[1, r, x] = b1
        behind[2, r, x] = b2
        behind[3, r, x] = b3
        d0, d1, d2, d3 = c0 - b0 * inv, c1 - b1 * inv, c2 - b2 * inv, c3 - b3 * inv
        r0, r1, r2, r3 = residual[0, r, x], residual[1, r, x], residual[2, r, x], residual[3, r, x]
        shared = w * precision[r, x]
        e0 += w * r0
        e1 += w * r1
        e2 += w * r2
        weight += shared
        free = np.float32(1.0) if w < np.float32(SATURATED) * after else zero
        pull = free * w * (d0 * r0 + d1 * r1 + d2 * r2 + d3 * r3)
        bend = free * shared * (d0 * d0 + d1 * d1 + d2 * d2 + d3 * d3)
        p = base + step * lanes[x]
        pp = p * p
        g0 += pull
        g1 += pull * p
        g2 += pull * pp
        m0 += bend
        m1 += bend * p
        m2 += bend * pp
        m3 += bend * pp * p
        m4 += bend * pp * pp
    return e0, e1, e2, weight, g0, g1, g2, m0, m1, m2, m3, m4


@inline
def _add_row(row: Row, q: Single, sums: F32) -> None:
    """Add a pixel row's sums, of which q is the height in the splat's frame."""
    e0, e1, e2, weight, g0, g1, g2, m0, m1, m2, m3, m4 = row
    sums[0] += e0
    sums[1] += e1
    sums[2] += e2
    sums[3] += weight
    q2 = q * q
    q3, q4 = q2 * q, q2 * q2
    sums[4] += g0
    sums[5] += g1
    sums[6] += g0 * q
    sums[7] += g2
    sums[8] += g1 * q
    sums[9] += g0 * q2
    sums[10] += m0
    sums[11] += m0 * q
    sums[12] += m0 * q2
    sums[13] += m0 * q3
    sums[14] += m0 * q4
    sums[15] += m1
    sums[16] += m1 * q
    sums[17] += m1 * q2
    sums[18] += m1 * q3
    sums[19] += m2
    sums[20] += m2 * q
    sums[21] += m2 * q2
    sums[22] += m3
    sums[23] += m3 * q
    sums[24] += m4


@inline
def _pull_splat(
    geometry: F64,
    features: F32,
    i: int,
    x0: int,
    y0: int,
    lanes: F32,
    left: F32,
    open_rows: I32,
    weights: F32,
    behind: F32,
    residual: F32,
    precision: F32,
    sums: F32,
) -> None:
    """Sums of splat i over the tile whose corner is (x0, y0); the twin of blending it."""
    u, v = geometry[i, 0] - x0 - 0.5, geometry[i, 1] - y0 - 0.5
    inv_w, slope, inv_yy, reach = geometry[i, 2], geometry[i, 3], geometry[i, 4], geometry[i, 5]
    opacity = np.float32(geometry[i, 6])
    ey, width, inv_h = math.sqrt(reach / inv_yy), 1.0 / inv_w, math.sqrt(inv_yy)
    low, high = max(v - ey, 0.0), min(v + ey, TILE - 1.0)
    if not low <= high:  # before rounding: too large a number makes no integer
        return
    for r in range(math.ceil(low), math.floor(high) + 1):
        dy = r - v
        q = dy * dy * inv_yy
        half = math.sqrt(max(0.0, reach - q)) * width
        centre = u + slope * dy
        if open_rows[r] == 0 or centre + half < 0.0 or centre - half > TILE - 1.0:
            continue
        base, step = np.float32(-inv_w * centre), np.float32(inv_w)
        for x in range(0, TILE, PIXELS):
            at = r * TILE + x
            blend_pixels(base, step, np.float32(q), opacity, x, left, at, weights, x)
        row = _pull_row(
            base, step, features, i, r, lanes, left, weights, behind, residual, precision
        )
        _add_row(row, np.float32(dy * inv_h), sums)


@inline
def _load_tile(image: F32, x0: int, y0: int, planes: F32) -> None:
    """Copy a tile of an (H, W, 4) image into (4, 16, 16) planes, 0 outside."""
    height, width = image.shape[0], image.shape[1]
    for r in range(TILE):
        for x in range(TILE):
            inside = y0 + r < height and x0 + x < width
            for c in range(CHANNELS):
                planes[c, r, x] = image[y0 + r, x0 + x, c] if inside else np.float32(0.0)


@parallel_kernel("image", least=8)
def weigh_pixels(
    start: int,
    stop: int,
    image: F32,
    wanted: U16,
    white: float,
    alpha_scale: float,
    residual: F32,
    precision: F32,
    errors: F64,
) -> None:
    """How far an image is from what is wanted.

    A colour that is brighter than a screen in both is not wanted to change.

    Args:
        start: First row of the range.
        stop: The row after its last.
        image: (H, W, 4) blended colours less `white`, and alpha times `alpha_scale`.
        wanted: (H, W, 4) colours over black and alpha, 65535 for 1.
        white: Share of white in the background that errors are taken over.
        alpha_scale: Weight of an error in alpha.
        residual: (H, W, 4) out, wanted change of the image.
        precision: (H, W) out, alpha.
        errors: (H,) out, sums of the squared residuals of each row.
    """
    width = image.shape[1]
    for y in range(start, stop):
        total = 0.0
        for x in range(width):
            alpha = image[y, x, 3] / alpha_scale
            change = wanted[y, x, 3] / 65535.0 - alpha
            precision[y, x] = alpha
            residual[y, x, 3] = change * alpha_scale
            total += change * change * alpha_scale * alpha_scale
            for c in range(3):
                colour = min(image[y, x, c] + white * alpha, 1.0)
                error = wanted[y, x, c] / 65535.0 - colour - white * change
                residual[y, x, c] = error
                total += error * error
        errors[y] = total


@parallel_kernel("starts", least=8)
def pull_tiles(
    start: int,
    stop: int,
    geometry: F64,
    features: F32,
    starts: I64,
    entries: I32,
    image: F32,
    residual: F32,
    precision: F32,
    partial: F32,
) -> None:
    """Sums that say how each tile's pixels pull at its splats.

    Args:
        start: First tile of the range.
        stop: The tile after its last.
        geometry: (N, 8) rows of projected splats.
        features: (N, 4) what was blended.
        starts: (T + 1,) from `list_tiles`.
        entries: (E,) from `list_tiles`.
        image: (H, W, 4) what `blend_tiles` made of these.
        residual: (H, W, 4) wanted change of the pixels, times their precision.
        precision: (H, W) weight of a pixel in the sum of squares, times its alpha.
        partial: (E, 25) out, for each entry: 0 to 2 the pulls on the first three channels, 3 the
            sum of w x precision; 4 to 9 the pulls on ln alpha times 1, p, q, p², pq, q²; 10 to 24
            the curvature of ln alpha times p^a q^b for a + b <= 4, b running fastest.
    """
    height, width = image.shape[0], image.shape[1]
    tiles_x = (width + TILE - 1) // TILE
    for tile in range(start, min(stop, len(starts) - 1)):
        x0, y0 = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        partial[starts[tile] : starts[tile + 1]] = np.float32(0.0)
        left = np.empty((TILE, TILE), np.float32)
        behind = np.empty((CHANNELS, TILE, TILE), np.float32)
        wanted = np.empty((CHANNELS, TILE, TILE), np.float32)
        trust = np.zeros((TILE, TILE), np.float32)
        weights = np.empty(TILE, np.float32)
        lanes = np.arange(TILE).astype(np.float32)
        open_rows = np.empty(TILE, np.int32)
        start_tile(left, x0, y0, width, height)
        _load_tile(image, x0, y0, behind)
        _load_tile(residual, x0, y0, wanted)
        for r in range(min(TILE, height - y0)):
            for x in range(min(TILE, width - x0)):
                trust[r, x] = precision[y0 + r, x0 + x]
        for e in range(starts[tile], starts[tile + 1]):
            if (e - starts[tile]) % BATCH == 0 and any_open(left, open_rows) == 0:
                break
            _pull_splat(
                geometry,
                features,
                entries[e],
                x0,
                y0,
                lanes,
                left,
                open_rows,
                weights,
                behind,
                wanted,
                trust,
                partial[e],
            )


@parallel_kernel("totals", each=1)
def gather_entries(start: int, stop: int, entries: I32, partial: F32, totals: F64) -> None:
    """Add up each splat's entries in the order of the tiles.

    Args:
        start: First splat of the range.
        stop: The splat after its last.
        entries: (E,) from `list_tiles`.
        partial: (E, 25) from `pull_tiles`.
        totals: (N, 25) out.
    """
    totals[start:stop] = 0.0
    for e in range(len(entries)):
        i = entries[e]
        if start <= i < stop:
            for k in range(SUMS):
                totals[i, k] += partial[e, k]

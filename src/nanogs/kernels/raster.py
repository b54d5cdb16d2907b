"""Kernels of the rasteriser: project splats, list them by tile, blend.

Sources: Zwicker, Pfister, van Baar, Gross, "EWA Splatting", 2002 [Z] for the projection of a
Gaussian; Kerbl, Kopanas, Leimkühler, Drettakis, "3D Gaussian Splatting", 2023 [K] for blending.

A projected splat is one row of `geometry`, eight float64 (one cache line):

    0, 1  u, v    centre in pixels
    2     inv_w   1 / standard deviation of x given y, 1/pixels
    3     slope   cov_xy / cov_yy, the drift of x's mean with y
    4     inv_yy  1 / cov_yy, 1/pixels²
    5     reach   2 ln(255 opacity): the squared radius at which alpha falls to 1/255, plus SLACK
    6     opacity, in [0, 1], after the compensation of MIP models
    7     depth   along the viewing axis, scene units

With (dx, dy) from the centre to a pixel, the Gaussian's exponent is
-((inv_w (dx - slope dy))² + inv_yy dy²) / 2: a sum of squares, which float32 can hold for any
needle, where the usual a dx² + 2 b dx dy + c dy² cancels.
"""

import math
from typing import TypeAlias

import numba
import numpy as np

from nanogs._types import F32, F64, I32, I64, Bool, F
from nanogs.kernels.harmonics import sh_basis
from nanogs.kernels.policy import inline, kernel, parallel_kernel

TILE = 16
Single: TypeAlias = np.float32

DILATION = 0.3  # pixels², added to both variances on screen ([K]'s rasteriser)
GUARD = 1.3  # x/z and y/z in the Jacobian stay within this many half fields of view
MIN_ALPHA = 1.0 / 255.0
MAX_ALPHA = 0.99
MIN_TRANSMITTANCE = 1e-4
SLACK = 1e-4  # widens bounds only, so that rounding never loses a pixel: alpha is tested exactly
BLOCK = 2048  # splats that share one scratch buffer
CHUNKS = 16  # runs of the depth order listed independently; fixed, so that threads do not matter
CHECK = 16  # splats between two looks at whether a tile is full
STRIDE = 61  # consecutive tiles go to different threads: one half of an image is often empty

# exp(x) = P(x/16)^16 on [-6, 0]: least squares over P(0) = 1, relative error below 2e-6.
P1 = np.float32(0.999999749030319)
P2 = np.float32(0.4999909362769371)
P3 = np.float32(0.1665583204458221)
P4 = np.float32(0.041092303836772995)
P5 = np.float32(0.006918978553628526)


@inline
def _project_gaussian(factor: F, point: F64, rotation: F64, lens: F64, row: F64) -> float:
    """Centre and 2D covariance of one splat ([Z] eqs. 26 to 31); returns det before / after.

    factor is R diag(s), so that Sigma = factor factorᵀ; point is the centre in camera space. The
    covariance stays in its factor J W R diag(s), whose rows give it without cancellation.
    """
    fx, fy, cx, cy, width, height = lens[0], lens[1], lens[2], lens[3], lens[4], lens[5]
    z = point[2]
    xz, yz = point[0] / z, point[1] / z
    row[0] = fx * xz + cx
    row[1] = fy * yz + cy
    row[7] = z
    margin_x = (GUARD - 1.0) * 0.5 * width / fx
    margin_y = (GUARD - 1.0) * 0.5 * height / fy
    tx = min(max(xz, -cx / fx - margin_x), (width - cx) / fx + margin_x)
    ty = min(max(yz, -cy / fy - margin_y), (height - cy) / fy + margin_y)
    jx, jy = fx / z, fy / z
    xx = xy = yy = 0.0
    ax = ay = az = bx = by = bz = 0.0
    for k in range(3):
        c0 = rotation[0, 0] * factor[0, k] + rotation[0, 1] * factor[1, k]
        c0 += rotation[0, 2] * factor[2, k]
        c1 = rotation[1, 0] * factor[0, k] + rotation[1, 1] * factor[1, k]
        c1 += rotation[1, 2] * factor[2, k]
        c2 = rotation[2, 0] * factor[0, k] + rotation[2, 1] * factor[1, k]
        c2 += rotation[2, 2] * factor[2, k]
        a, b = jx * (c0 - tx * c2), jy * (c1 - ty * c2)
        xx += a * a
        xy += a * b
        yy += b * b
        ax, ay, az = ay, az, a
        bx, by, bz = by, bz, b
    n0, n1, n2 = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    before = n0 * n0 + n1 * n1 + n2 * n2  # |a x b|² = det(a bᵀ), never negative
    after = before + DILATION * (xx + yy) + DILATION * DILATION
    yy += DILATION
    row[2] = math.sqrt(yy / after)
    row[3] = xy / yy
    row[4] = 1.0 / yy
    return before / after


@inline
def _on_image(row: F64, width: float, height: float) -> bool:
    """Whether the splat can reach alpha 1/255 at a pixel centre; false for NaN."""
    ey = math.sqrt(row[5] / row[4])
    ex = math.sqrt(row[5] * (1.0 / (row[2] * row[2]) + row[3] * row[3] / row[4]))
    inside_x = row[0] + ex >= 0.5 and row[0] - ex <= width - 0.5
    inside_y = row[1] + ey >= 0.5 and row[1] - ey <= height - 0.5
    return bool(inside_x and inside_y)


@parallel_kernel
def project_splats(
    means: F,
    factors: F32,
    opacities: F32,
    keep: Bool,
    sh: F32,
    rotation: F64,
    position: F64,
    lens: F64,
    mip: bool,
    degree: int,
    geometry: F64,
    features: F32,
    drawn: Bool,
) -> None:
    """Project N splats and evaluate their colour.

    Args:
        means: (N, 3), scene units.
        factors: (N, 3, 3), R diag(s), scene units.
        opacities: (N,) in [0, 1].
        keep: (N,) false for rows that are not to be drawn.
        sh: (N, K, 3) with K >= (degree + 1)².
        rotation: (3, 3), world to camera.
        position: (3,) the camera's centre, scene units.
        lens: (7,) fx, fy, cx, cy, width, height in pixels and near in scene units.
        mip: Multiply opacities by sqrt(det before / det after dilation).
        degree: Spherical-harmonic degree to evaluate.
        geometry: (N, 8) out, see the module.
        features: (N, 4) out, red, green, blue and depth.
        drawn: (N,) out, whether the splat can reach a pixel; other rows of the outputs are junk.
    """
    n = len(means)
    coefficients = (degree + 1) ** 2
    for block in numba.prange((n + BLOCK - 1) // BLOCK):
        basis = np.empty(25, np.float64)
        point = np.empty(3, np.float64)
        for i in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            drawn[i] = False
            if not keep[i]:
                continue
            # Subtracted in double precision: scenes in map coordinates lie far from the origin.
            dx = np.float64(means[i, 0]) - position[0]
            dy = np.float64(means[i, 1]) - position[1]
            dz = np.float64(means[i, 2]) - position[2]
            for k in range(3):
                point[k] = rotation[k, 0] * dx + rotation[k, 1] * dy + rotation[k, 2] * dz
            if not point[2] > lens[6]:
                continue
            row = geometry[i]
            ratio = _project_gaussian(factors[i], point, rotation, lens, row)
            opacity = np.float64(opacities[i])
            if mip:
                opacity *= math.sqrt(max(0.0, ratio))
            if not opacity >= MIN_ALPHA:
                continue
            row[5] = 2.0 * math.log(255.0 * opacity) + SLACK
            row[6] = opacity
            if not _on_image(row, lens[4], lens[5]):
                continue
            drawn[i] = True
            length = math.sqrt(dx * dx + dy * dy + dz * dz)
            sh_basis(dx / length, dy / length, dz / length, degree, basis)
            for c in range(3):
                colour = 0.5
                for k in range(coefficients):
                    colour += basis[k] * sh[i, k, c]
                features[i, c] = max(colour, 0.0)
            features[i, 3] = point[2]


@inline
def _tile_span(
    geometry: F64, i: int, lowest: float, ty: int, width: int, height: int
) -> tuple[int, int]:
    """Tiles [first, end) of tile row ty that hold a pixel centre inside splat i's ellipse.

    lowest is the height above the centre, in pixels, at which the ellipse is leftmost.
    """
    u, v, sigma = geometry[i, 0], geometry[i, 1], 1.0 / geometry[i, 2]
    slope, inv_yy, reach = geometry[i, 3], geometry[i, 4], geometry[i, 5]
    y0 = ty * TILE + 0.5 - v
    y1 = min(ty * TILE + TILE, height) - 0.5 - v
    left_y = min(max(lowest, y0), y1)
    right_y = min(max(-lowest, y0), y1)
    left = slope * left_y - math.sqrt(max(0.0, reach - left_y * left_y * inv_yy)) * sigma
    right = slope * right_y + math.sqrt(max(0.0, reach - right_y * right_y * inv_yy)) * sigma
    first = math.ceil(max(u + left - 0.5, 0.0))
    last = math.floor(min(u + right - 0.5, width - 1.0))
    if last < first:
        return 0, 0
    return first // TILE, last // TILE + 1


@inline
def _tile_rows(geometry: F64, i: int, height: int) -> tuple[int, int, float]:
    """Tile rows [first, end) that splat i meets, and the height of its leftmost point."""
    ey = math.sqrt(geometry[i, 5] / geometry[i, 4])
    first = math.ceil(max(geometry[i, 1] - ey - 0.5, 0.0))
    last = math.floor(min(geometry[i, 1] + ey - 0.5, height - 1.0))
    if last < first:
        return 0, 0, 0.0
    drift = geometry[i, 3] / math.sqrt(geometry[i, 4])
    lowest = -ey * drift / math.sqrt(drift * drift + 1.0 / (geometry[i, 2] * geometry[i, 2]))
    return first // TILE, last // TILE + 1, lowest


@parallel_kernel
def list_tiles(geometry: F64, order: I64, width: int, height: int) -> tuple[I64, I32]:
    """List, for every tile, the splats that meet it, nearest first.

    Args:
        geometry: (N, 8) rows of projected splats.
        order: (M,) indices of the drawn splats, nearest first.
        width: Image width in pixels.
        height: Image height in pixels.

    Returns:
        starts (T + 1,) and entries (starts[T],): tile t (row by row) holds the splats
        entries[starts[t]:starts[t + 1]].
    """
    tiles_x, tiles_y = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    tiles, size = tiles_x * tiles_y, (len(order) + CHUNKS - 1) // CHUNKS
    cursors = np.zeros((CHUNKS, tiles), np.int64)
    for chunk in numba.prange(CHUNKS):
        for rank in range(chunk * size, min(len(order), (chunk + 1) * size)):
            index = order[rank]
            top, bottom, lowest = _tile_rows(geometry, index, height)
            for ty in range(top, bottom):
                first, end = _tile_span(geometry, index, lowest, ty, width, height)
                for tx in range(first, end):
                    cursors[chunk, ty * tiles_x + tx] += 1
    starts = np.empty(tiles + 1, np.int64)
    total = 0
    for tile in range(tiles):
        starts[tile] = total
        for chunk in range(CHUNKS):
            count = cursors[chunk, tile]
            cursors[chunk, tile] = total
            total += count
    starts[tiles] = total
    entries = np.empty(total, np.int32)
    for chunk in numba.prange(CHUNKS):
        for rank in range(chunk * size, min(len(order), (chunk + 1) * size)):
            index = order[rank]
            top, bottom, lowest = _tile_rows(geometry, index, height)
            for ty in range(top, bottom):
                first, end = _tile_span(geometry, index, lowest, ty, width, height)
                for tx in range(first, end):
                    tile = ty * tiles_x + tx
                    entries[cursors[chunk, tile]] = index
                    cursors[chunk, tile] += 1
    return starts, entries


@inline
def _blend_row(
    base: Single,
    slope: Single,
    q: Single,
    opacity: Single,
    r: int,
    lanes: F32,
    left: F32,
    weights: F32,
) -> None:
    """Weights T alpha of one splat on the 16 pixels of tile row r; updates transmittances.

    A pixel that is full keeps its transmittance with a negative sign, which makes every later
    weight zero without a branch. LLVM turns these loops into vector code only if their length is
    unknown to it (a known one it unrolls first), and no row is sliced: a view costs two atomic
    operations, more than the arithmetic.
    """
    for x in range(len(lanes)):
        p = base + slope * lanes[x]
        y = max(np.float32(-6.0), np.float32(-0.5) * (p * p + q)) * np.float32(0.0625)
        e = np.float32(1.0) + y * (P1 + y * (P2 + y * (P3 + y * (P4 + y * P5))))
        e = e * e
        e = e * e
        e = e * e
        e = e * e
        alpha = min(np.float32(MAX_ALPHA), opacity * e)
        weights[x] = alpha if alpha >= np.float32(MIN_ALPHA) else np.float32(0.0)
    for x in range(len(lanes)):
        before = left[r, x]
        after = before * (np.float32(1.0) - weights[x])
        weight, closed = before * weights[x], -abs(before)
        full = after < np.float32(MIN_TRANSMITTANCE)
        weights[x] = np.float32(0.0) if full else weight
        left[r, x] = closed if full else after


@inline
def _count_open(left: F32, open_rows: I64) -> int:
    """How many pixels of the tile still take light, and per row into open_rows."""
    total = 0
    for r in range(TILE):
        count = 0
        for x in range(TILE):
            count += left[r, x] > np.float32(0.0)
        open_rows[r] = count
        total += count
    return total


@inline
def _start_tile(left: F32, x0: int, y0: int, width: int, height: int) -> None:
    """Set the transmittances of a tile: 1 on the image, full outside."""
    for r in range(TILE):
        for x in range(TILE):
            inside = y0 + r < height and x0 + x < width
            left[r, x] = np.float32(1.0) if inside else np.float32(-1.0)


@inline
def _blend_splat(
    geometry: F64,
    features: F32,
    i: int,
    x0: int,
    y0: int,
    lanes: F32,
    left: F32,
    open_rows: I64,
    planes: F32,
    weights: F32,
    sums: F32,
) -> None:
    """Blend splat i into the tile whose corner is (x0, y0).

    sums gets the weights by column, unless it is empty.
    """
    u, v = geometry[i, 0] - x0 - 0.5, geometry[i, 1] - y0 - 0.5
    inv_w, slope, inv_yy, reach = geometry[i, 2], geometry[i, 3], geometry[i, 4], geometry[i, 5]
    opacity = np.float32(geometry[i, 6])
    ey, width = math.sqrt(reach / inv_yy), 1.0 / inv_w
    top = math.ceil(max(v - ey, 0.0))
    bottom = math.floor(min(v + ey, TILE - 1.0))
    for x in range(len(sums)):
        sums[x] = np.float32(0.0)
    for r in range(top, bottom + 1):
        dy = r - v
        q = dy * dy * inv_yy
        half = math.sqrt(max(0.0, reach - q)) * width
        centre = u + slope * dy
        if open_rows[r] == 0 or centre + half < 0.0 or centre - half > TILE - 1.0:
            continue
        base = np.float32(-inv_w * centre)
        _blend_row(base, np.float32(inv_w), np.float32(q), opacity, r, lanes, left, weights)
        for c in range(len(planes)):
            value = features[i, c]
            for x in range(len(weights)):
                planes[c, r, x] += value * weights[x]
        for x in range(len(sums)):
            sums[x] += weights[x]


@inline
def _write_tile(
    x0: int, y0: int, left: F32, planes: F32, background: F32, image: F32, transmittance: F32
) -> None:
    """Copy a tile's pixels into the image, over the background."""
    height, width, channels = image.shape
    for r in range(min(TILE, height - y0)):
        for x in range(min(TILE, width - x0)):
            rest = abs(left[r, x])
            transmittance[y0 + r, x0 + x] = rest
            for c in range(channels):
                image[y0 + r, x0 + x, c] = planes[c, r, x] + rest * background[c]


@parallel_kernel
def blend_tiles(
    geometry: F64,
    features: F32,
    starts: I64,
    entries: I32,
    background: F32,
    image: F32,
    transmittance: F32,
    partial: F32,
) -> None:
    """Blend every tile's splats front to back ([K] eq. 3).

    Args:
        geometry: (N, 8) rows of projected splats.
        features: (N, C) what to blend.
        starts: (T + 1,) from `list_tiles`.
        entries: (E,) from `list_tiles`.
        background: (C,) added with the transmittance that is left.
        image: (H, W, C) out.
        transmittance: (H, W) out, what is left of the light.
        partial: (E,) out, sum of the weights T alpha of each entry over its tile; or (0,).
    """
    height, width, channels = image.shape
    tiles_x = (width + TILE - 1) // TILE
    tiles = len(starts) - 1
    per_class = (tiles + STRIDE - 1) // STRIDE
    for slot in numba.prange(per_class * STRIDE):
        tile = (slot % per_class) * STRIDE + slot // per_class
        if tile >= tiles:
            continue
        x0, y0 = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        left = np.empty((TILE, TILE), np.float32)
        planes = np.zeros((channels, TILE, TILE), np.float32)
        weights = np.empty(TILE, np.float32)
        sums = np.empty(TILE if len(partial) > 0 else 0, np.float32)
        lanes = np.arange(TILE).astype(np.float32)
        open_rows = np.empty(TILE, np.int64)
        _start_tile(left, x0, y0, width, height)
        if len(partial) > 0:
            partial[starts[tile] : starts[tile + 1]] = np.float32(0.0)
        for e in range(starts[tile], starts[tile + 1]):
            if (e - starts[tile]) % CHECK == 0 and _count_open(left, open_rows) == 0:
                break
            _blend_splat(
                geometry,
                features,
                entries[e],
                x0,
                y0,
                lanes,
                left,
                open_rows,
                planes,
                weights,
                sums,
            )
            if len(partial) > 0:
                partial[e] = np.sum(sums)
        _write_tile(x0, y0, left, planes, background, image, transmittance)


@kernel
def sum_entries(entries: I32, partial: F32, totals: F64) -> None:
    """Add each entry's partial sum to its splat's total, in the order of the tiles.

    Args:
        entries: (E,) from `list_tiles`.
        partial: (E,) from `blend_tiles`.
        totals: (N,) in and out.
    """
    for e in range(len(entries)):
        totals[entries[e]] += partial[e]

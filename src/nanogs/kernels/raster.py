"""Kernels of the rasteriser: list projected splats by tile, blend.

Source: Kerbl, Kopanas, Leimkühler, Drettakis, "3D Gaussian Splatting", 2023 [K]. What a row of
`geometry` holds is said in `nanogs.kernels.project`.
"""

import math

import numpy as np

from nanogs._types import F32, F64, I32, I64, U64
from nanogs.kernels.pixels import PIXELS, add_products, add_scaled, blend_pixels
from nanogs.kernels.policy import inline, kernel, parallel_kernel
from nanogs.kernels.project import HIDDEN, TILE, unpack_box

CHUNKS = 16  # runs of the depth order listed independently; fixed, so that threads do not matter
SMALL = 2  # tiles along a side of a box that is listed whole: what lies beside it draws nothing
BATCH = 16  # splats fetched at a time, and between two looks at whether a tile is full


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
def _lowest(geometry: F64, i: int) -> float:
    """The height above the centre at which splat i is leftmost, in pixels."""
    ey = math.sqrt(geometry[i, 5] / geometry[i, 4])
    drift = geometry[i, 3] / math.sqrt(geometry[i, 4])
    height: float = -ey * drift / math.sqrt(drift * drift + 1.0 / (geometry[i, 2] * geometry[i, 2]))
    return height


@kernel
def depth_keys(features: F32, boxes: I64, keys: U64) -> int:
    """Sort keys of the splats that are drawn: depth above, index below; returns their number.

    features: (N, 4), the last one the depth, above 0, whose bits sort as its values do; boxes: (N,)
    from `project_splats`; keys: (N,) out.
    """
    bits = features.view(np.uint32)
    count = 0
    for i in range(len(boxes)):
        if boxes[i] != HIDDEN:
            keys[count] = np.uint64(bits[i, 3]) << np.uint64(32) | np.uint64(i)
            count += 1
    return count


@inline
def _walk(
    geometry: F64, boxes: I64, index: int, width: int, height: int, cursors: I64, entries: I32
) -> None:
    """Move the cursor of each tile that a splat meets; write the splat if there is room."""
    tiles_x = (width + TILE - 1) // TILE
    left, top, across, down = unpack_box(boxes[index])
    small = across <= SMALL and down <= SMALL
    lowest = 0.0 if small else _lowest(geometry, index)
    for ty in range(top, top + down):
        first, end = left, left + across
        if not small:
            first, end = _tile_span(geometry, index, lowest, ty, width, height)
        for tile in range(ty * tiles_x + first, ty * tiles_x + end):
            if len(entries) > 0:
                entries[cursors[tile]] = index
            cursors[tile] += 1


@parallel_kernel("cursors", least=1)
def walk_order(
    start: int,
    stop: int,
    geometry: F64,
    boxes: I64,
    order: I64,
    width: int,
    height: int,
    cursors: I64,
    entries: I32,
) -> None:
    """Move each tile's cursors past the runs of the depth order; write the splats if there is room.

    Args:
        start: First run of the range.
        stop: The run after its last.
        geometry: (N, 8) rows of projected splats.
        boxes: (N,) the tiles around each, from `project_splats`.
        order: (M,) indices of the drawn splats, nearest first.
        width: Image width in pixels.
        height: Image height in pixels.
        cursors: (runs, T) in and out, one for each run of the order and tile.
        entries: (E,) out, or (0,) where only the cursors are wanted.
    """
    size = (len(order) + len(cursors) - 1) // len(cursors)
    for run in range(start, stop):
        for index in order[run * size : (run + 1) * size]:
            _walk(geometry, boxes, index, width, height, cursors[run], entries)


def list_tiles(geometry: F64, boxes: I64, order: I64, width: int, height: int) -> tuple[I64, I32]:
    """List, for every tile, the splats that meet it, nearest first.

    Args:
        geometry: (N, 8) rows of projected splats.
        boxes: (N,) the tiles around each, from `project_splats`.
        order: (M,) indices of the drawn splats, nearest first.
        width: Image width in pixels.
        height: Image height in pixels.

    Returns:
        starts (T + 1,) and entries (starts[T],): tile t (row by row) holds the splats
        entries[starts[t]:starts[t + 1]].
    """
    tiles = (-(-width // TILE)) * (-(-height // TILE))
    counts = np.zeros((CHUNKS, tiles), np.int64)
    walk_order(geometry, boxes, order, width, height, counts, np.empty(0, np.int32))
    ends = np.cumsum(counts.T).reshape(tiles, CHUNKS)
    starts = np.append(ends[:, 0] - counts[0], ends[-1, -1])
    cursors = np.ascontiguousarray((ends - counts.T).T)
    entries = np.empty(starts[-1], np.int32)
    walk_order(geometry, boxes, order, width, height, cursors, entries)
    return starts, entries


@inline
def count_open(left: F32, open_rows: I64) -> int:
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
def start_tile(left: F32, x0: int, y0: int, width: int, height: int) -> None:
    """Set the transmittances of a tile: 1 on the image, full outside."""
    for r in range(TILE):
        for x in range(TILE):
            inside = y0 + r < height and x0 + x < width
            left[r, x] = np.float32(1.0) if inside else np.float32(-1.0)


@inline
def _list_pieces(
    rows: F64, count: int, x0: int, y0: int, open_rows: I64, numbers: F32, places: I64
) -> int:
    """The half rows of a tile that each of some splats reaches, splat by splat; how many.

    Listed first and blended later, since branches that depend on a splat cost as much as blending.
    rows: (count, 8) and more, of geometry; (x0, y0): the tile's corner; numbers: (n, 4) filled
    with what `blend_pixels` takes; places: (n, 2) filled, the first pixel and which splat.
    """
    n = 0
    for j in range(count):
        u, v = rows[j, 0] - x0 - 0.5, rows[j, 1] - y0 - 0.5
        inv_w, slope, inv_yy, reach = rows[j, 2], rows[j, 3], rows[j, 4], rows[j, 5]
        ey, width = math.sqrt(reach / inv_yy), 1.0 / inv_w
        top = math.ceil(max(v - ey, 0.0))
        bottom = math.floor(min(v + ey, TILE - 1.0))
        for r in range(top, bottom + 1):
            dy = r - v
            q = dy * dy * inv_yy
            half = math.sqrt(max(0.0, reach - q)) * width
            centre = u + slope * dy
            low, high = centre - half, centre + half
            taken = (
                (open_rows[r] != 0) & (low <= PIXELS - 1.0) & (high >= 0.0),
                (open_rows[r] != 0) & (low <= TILE - 1.0) & (high >= PIXELS),
            )
            for side in range(2):
                numbers[n, 0] = -inv_w * centre
                numbers[n, 1] = inv_w
                numbers[n, 2] = q
                numbers[n, 3] = rows[j, 6]
                places[n, 0] = r * TILE + side * PIXELS
                places[n, 1] = j
                n += int(taken[side])
    return n


@inline
def _blend_pieces(
    numbers: F32,
    places: I64,
    values: F32,
    left: F32,
    planes: F32,
    weights: F32,
    probes: F32,
    sums: F32,
) -> None:
    """Blend half rows of a tile, one after the other.

    numbers, places: from `_list_pieces`; values: (n, C) features of the splats; sums: (n P, 8), of
    each splat and probe, get the weights times the probes (P, 16, 16), by column modulo 8.
    """
    for k in range(len(numbers)):
        at, j = places[k, 0], places[k, 1]
        base, slope, q, opacity = numbers[k, 0], numbers[k, 1], numbers[k, 2], numbers[k, 3]
        blend_pixels(base, slope, q, opacity, at % TILE, left, at, weights, 0)
        for c in range(len(planes)):
            add_scaled(values[j, c], weights, planes, c * TILE * TILE + at)
        for p in range(len(probes)):
            to = (j * len(probes) + p) * PIXELS
            add_products(weights, probes, p * TILE * TILE + at, sums, to)


@inline
def fetch(
    geometry: F64, features: F32, entries: I32, first: int, count: int, rows: F64, values: F32
) -> None:
    """Copy some splats side by side: many reads of far memory then wait at the same time."""
    for j in range(count):
        i = entries[first + j]
        for k in range(8):
            rows[j, k] = geometry[i, k]
        for c in range(features.shape[1]):
            values[j, c] = features[i, c]


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


@kernel
def _blend_tile(
    geometry: F64,
    features: F32,
    entries: I32,
    x0: int,
    y0: int,
    background: F32,
    image: F32,
    transmittance: F32,
    probes: F32,
    partial: F32,
) -> None:
    """Blend the splats of the tile whose corner is (x0, y0); entries and partial are its own."""
    height, width, channels = image.shape
    left = np.empty((TILE, TILE), np.float32)
    planes = np.zeros((channels, TILE, TILE), np.float32)
    weights = np.empty(PIXELS, np.float32)
    sums = np.empty((BATCH * len(probes), PIXELS), np.float32)
    numbers = np.empty((2 * TILE * BATCH + 1, 4), np.float32)
    places = np.empty((2 * TILE * BATCH + 1, 2), np.int64)
    probed = np.zeros((len(probes), TILE, TILE), np.float32)
    open_rows = np.empty(TILE, np.int64)
    rows = np.empty((BATCH, 8), np.float64)
    values = np.empty((BATCH, channels), np.float32)
    for p in range(len(probes)):
        for r in range(min(TILE, height - y0)):
            for x in range(min(TILE, width - x0)):
                probed[p, r, x] = probes[p, y0 + r, x0 + x]
    start_tile(left, x0, y0, width, height)
    for e in range(len(partial)):
        for p in range(len(probes)):
            partial[e, p] = np.float32(0.0)
    for first in range(0, len(entries), BATCH):
        if count_open(left, open_rows) == 0:
            break
        count = min(BATCH, len(entries) - first)
        fetch(geometry, features, entries, first, count, rows, values)
        pieces = _list_pieces(rows, count, x0, y0, open_rows, numbers, places)
        sums[: count * len(probes)] = np.float32(0.0)
        _blend_pieces(numbers[:pieces], places, values, left, planes, weights, probed, sums)
        for k in range(count * len(probes)):
            total = np.float32(0.0)
            for x in range(PIXELS):
                total += sums[k, x]
            partial[first + k // len(probes), k % len(probes)] = total
    _write_tile(x0, y0, left, planes, background, image, transmittance)


@parallel_kernel("starts", least=8)
def blend_tiles(
    start: int,
    stop: int,
    geometry: F64,
    features: F32,
    starts: I64,
    entries: I32,
    background: F32,
    image: F32,
    transmittance: F32,
    probes: F32,
    partial: F32,
) -> None:
    """Blend every tile's splats front to back ([K] eq. 3), and probe their weights.

    Args:
        start: First tile of the range.
        stop: The tile after its last.
        geometry: (N, 8) rows of projected splats.
        features: (N, C) what to blend.
        starts: (T + 1,) from `list_tiles`.
        entries: (E,) from `list_tiles`.
        background: (C,) added with the transmittance that is left.
        image: (H, W, C) out.
        transmittance: (H, W) out, what is left of the light.
        probes: (P, H, W) what the weights T alpha are multiplied by; P may be 0.
        partial: (E, P) out, sums of these products for each entry over its tile.
    """
    tiles_x = (image.shape[1] + TILE - 1) // TILE
    for tile in range(start, min(stop, len(starts) - 1)):
        first, end = starts[tile], starts[tile + 1]
        _blend_tile(
            geometry,
            features,
            entries[first:end],
            (tile % tiles_x) * TILE,
            (tile // tiles_x) * TILE,
            background,
            image,
            transmittance,
            probes,
            partial[first:end],
        )


@kernel
def sum_entries(entries: I32, partial: F32, totals: F64) -> None:
    """Add each entry's partial sums to its splat's totals, in the order of the tiles.

    Args:
        entries: (E,) from `list_tiles`.
        partial: (E, P) from `blend_tiles`.
        totals: (N, P) in and out.
    """
    for e in range(len(entries)):
        for p in range(partial.shape[1]):
            totals[entries[e], p] += partial[e, p]


@kernel
def add_unhidden(geometry: F64, boxes: I64, width: int, height: int, totals: F64) -> None:
    """Add 2 pi alpha sqrt(det) of each Gaussian whose centre is on the image, in pixels.

    geometry: (N, 8) and boxes: (N,) from `project_splats`; totals: (N,) in and out.
    """
    for i in range(len(boxes)):
        if boxes[i] == HIDDEN:
            continue
        u, v = geometry[i, 0], geometry[i, 1]
        if 0.0 <= u <= width and 0.0 <= v <= height:
            area = 2.0 * math.pi / (geometry[i, 2] * math.sqrt(geometry[i, 4]))
            totals[i] += geometry[i, 6] * area

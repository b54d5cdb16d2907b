"""Kernels of the rasteriser that blend the splats of each tile; `listing` tells which they are.

Source: Kerbl, Kopanas, Leimkühler, Drettakis, "3D Gaussian Splatting", 2023 [K]. What a row of
`geometry` holds is said in `nanogs.kernels.project`.
"""

import math

import numpy as np

from nanogs._types import F32, F64, I32, I64, U32
from nanogs.kernels.pixels import add_products, add_scaled, blend_pair, blend_pair_three
from nanogs.kernels.policy import inline, kernel, parallel_kernel
from nanogs.kernels.project import HIDDEN
from nanogs.kernels.spans import (
    BATCH,
    PIXELS,
    ROWS,
    ROWS_OF,
    SECOND,
    SPLAT,
    TILE,
    any_open,
    prefetch,
    span_rows,
)

FAR = np.float32(1e30)  # so far from a splat that it gives no light


@inline
def start_tile(left: F32, x0: int, y0: int, width: int, height: int) -> None:
    """Set the transmittances of a tile: 1 on the image, full outside."""
    for r in range(len(left)):
        for x in range(TILE):
            inside = y0 + r < height and x0 + x < width
            left[r, x] = np.float32(1.0) if inside else np.float32(-1.0)


@inline
def _list_pieces(
    geometry: F64,
    entries: I32,
    first: int,
    count: int,
    x0: int,
    y0: int,
    open_rows: I32,
    bases: F32,
    squares: F32,
    starts: I32,
    pieces: U32,
) -> int:
    """The runs of 8 pixels of a tile that each of some splats reaches, splat by splat; how many.

    Listed first and blended later, since branches that depend on a splat cost as much as blending.
    Those of a splat come in pairs. The splats are `count` of the entries, from place `first` on;
    (x0, y0): the tile's corner; bases, squares, starts and pieces: out, see `span_rows`.
    """
    n = 0
    for j in range(count):
        i = entries[first + j]
        u, v = geometry[i, 0] - x0 - 0.5, geometry[i, 1] - y0 - 0.5
        inv_w, slope, inv_yy = geometry[i, 2], geometry[i, 3], geometry[i, 4]
        reach, ey = geometry[i, 5], geometry[i, 7]
        above = v - ey + 1.0  # compared first: too large a number makes no integer
        top = int(above) if 0.0 < above < PIXELS else PIXELS if above >= PIXELS else 0
        tall = top < PIXELS and v + ey >= top + PIXELS
        for row in range(0 if tall else top, TILE if tall else top + 1, PIXELS):
            n = span_rows(
                u, v, inv_w, slope, inv_yy, reach, row, open_rows, bases, squares, starts,
                j * SPLAT + row, pieces, n, ROWS_OF,
            )  # fmt: skip
        pieces[n] = j * SPLAT + TILE  # makes an even number
        n += n & 1
    return n


@inline
def _blend_pieces(
    n: int,
    pieces: U32,
    bases: F32,
    squares: F32,
    starts: I32,
    slopes: F32,
    opacities: F32,
    values: F32,
    left: F32,
    weights: F32,
    planes: F32,
) -> None:
    """Blend runs of 8 pixels of a tile, one after the other.

    n, pieces, bases, squares, starts: from `_list_pieces`; slopes, opacities: (n,) of the splats;
    values: (n, C or more) their colours; weights: (8 pieces,) out; planes: (C, 17, 16).
    """
    for k in range(0, n, 2):
        if len(planes) == 3:  # at once, since most of the time goes here
            blend_pair_three(
                pieces, k, bases, squares, starts, slopes, opacities, left, weights, values, planes
            )
        else:
            blend_pair(pieces, k, bases, squares, starts, slopes, opacities, left, weights)
    if len(planes) != 3:
        for k in range(n):
            place = pieces[k] & (SECOND - 1)
            at = (place % SPLAT) * TILE + starts[pieces[k]]
            for c in range(len(planes)):
                add_scaled(values, place // SPLAT, c, weights, k * PIXELS, planes, at)


@inline
def _probe_pieces(n: int, pieces: U32, starts: I32, weights: F32, probes: F32, sums: F32) -> None:
    """Add the weights times the probes (P, 17, 16) to the sums (n, P, 8) of each splat."""
    for p in range(len(probes)):
        for k in range(n):
            place = pieces[k] & (SECOND - 1)
            there = (p * ROWS + place % SPLAT) * TILE + starts[pieces[k]]
            to = (place // SPLAT * len(probes) + p) * PIXELS
            add_products(weights, k * PIXELS, probes, there, sums, to)


@inline
def _fetch(
    geometry: F64,
    features: F32,
    entries: I32,
    first: int,
    count: int,
    values: F32,
    slopes: F32,
    opacities: F32,
) -> None:
    """Copy some splats side by side: many reads of far memory then wait at the same time."""
    for j in range(count):
        i = entries[first + j]
        slopes[j] = np.float32(geometry[i, 2])
        opacities[j] = np.float32(geometry[i, 6])
        for c in range(values.shape[1]):
            values[j, c] = features[i, c]


@inline
def _write_tile(
    x0: int, y0: int, left: F32, planes: F32, background: F32, image: F32, transmittance: F32
) -> None:
    """Copy a tile's pixels into the image, over the background."""
    height, width, channels = image.shape
    for r in range(min(TILE, height - y0)):
        for x in range(min(TILE, width - x0)):
            transmittance[y0 + r, x0 + x] = abs(left[r, x])
        for c in range(channels):
            for x in range(min(TILE, width - x0)):
                image[y0 + r, x0 + x, c] = planes[c, r, x] + abs(left[r, x]) * background[c]


@inline
def _clear(planes: F32) -> None:
    """Set an array of three axes to 0."""
    for plane in range(len(planes)):
        for row in range(planes.shape[1]):
            for column in range(planes.shape[2]):
                planes[plane, row, column] = np.float32(0.0)


@inline
def _read_tile(probes: F32, x0: int, y0: int, planes: F32) -> None:
    """Copy a tile of (P, H, W) probes into (P, 17, 16) planes, 0 beside the image."""
    _clear(planes)
    for p in range(len(probes)):
        for r in range(min(TILE, probes.shape[1] - y0)):
            for x in range(min(TILE, probes.shape[2] - x0)):
                planes[p, r, x] = probes[p, y0 + r, x0 + x]


@inline
def _add_up(sums: F32, partial: F32, first: int, count: int) -> None:
    """Write the sums (n, P, 8) of some splats and all probes into partial (E, P)."""
    for j in range(count):
        for p in range(partial.shape[1]):
            total = np.float32(0.0)
            for x in range(PIXELS):
                total += sums[j, p, x]
            partial[first + j, p] = total


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
        features: (N, C or more) what to blend.
        starts: (T + 1,) from `list_tiles`.
        entries: (E,) from `list_tiles`.
        background: (C,) added with the transmittance that is left.
        image: (H, W, C) out.
        transmittance: (H, W) out, what is left of the light.
        probes: (P, H, W) what the weights T alpha are multiplied by; P may be 0.
        partial: (E, P) out, sums of these products for each entry over its tile.
    """
    height, width, channels = image.shape
    tiles_x = (width + TILE - 1) // TILE
    left = np.empty((ROWS, TILE), np.float32)
    planes = np.empty((channels, ROWS, TILE), np.float32)
    probed = np.empty((len(probes), ROWS, TILE), np.float32)
    open_rows = np.empty(TILE, np.int32)
    slopes, opacities = np.empty(BATCH, np.float32), np.empty(BATCH, np.float32)
    values = np.empty((BATCH, channels), np.float32)
    bases, squares = np.empty(SECOND, np.float32), np.empty(SECOND, np.float32)
    begins = np.empty(2 * SECOND, np.int32)
    for place in range(SECOND):
        bases[place], squares[place] = np.float32(0.0), FAR
        begins[place], begins[SECOND + place] = 0, PIXELS
    pieces = np.empty(2 * TILE * BATCH + PIXELS, np.uint32)
    weights = np.empty(len(pieces) * PIXELS, np.float32)
    sums = np.empty((BATCH, len(probes), PIXELS), np.float32)
    for tile in range(start, min(stop, len(starts) - 1)):
        x0, y0 = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        for e in range(starts[tile], starts[tile + 1]):
            for p in range(len(probes)):
                partial[e, p] = np.float32(0.0)
        _clear(planes)
        start_tile(left, x0, y0, width, height)
        _read_tile(probes, x0, y0, probed)
        end = starts[tile + 1]
        for first in range(starts[tile], end, BATCH):
            if any_open(left, open_rows) == 0:
                break
            count = min(BATCH, end - first)
            _fetch(geometry, features, entries, first, count, values, slopes, opacities)
            for e in range(first + BATCH, min(first + 2 * BATCH, end)):
                prefetch(geometry, entries[e])
                prefetch(features, entries[e])
            n = _list_pieces(
                geometry, entries, first, count, x0, y0, open_rows, bases, squares, begins, pieces
            )
            _clear(sums)
            _blend_pieces(
                n, pieces, bases, squares, begins, slopes, opacities, values, left, weights, planes
            )
            _probe_pieces(n, pieces, begins, weights, probed, sums)
            _add_up(sums, partial, first, count)
        _write_tile(x0, y0, left, planes, background, image, transmittance)


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

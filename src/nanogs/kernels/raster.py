"""Kernels of the rasteriser that blend the splats of each tile, as listed by `listing`.

Source: Kerbl, Kopanas, Leimkühler, Drettakis, "3D Gaussian Splatting", 2023 [K]. The columns of
`geometry` are described in `nanogs.kernels.project`.
"""

import math

import numpy as np

from nanogs._types import F32, F64, I32, I64, U32
from nanogs.kernels import blending, blocks
from nanogs.kernels.blocks import (
    ACROSS,
    ALONG,
    BATCH,
    FAINT,
    HEIGHT,
    LANES,
    RISE,
    SHAPE,
    SIDE,
    START,
    TILE,
    UNIT,
)
from nanogs.kernels.policy import inline, parallel_kernel
from nanogs.kernels.project import HIDDEN, SLACK

LOG_255 = math.log(255.0)
AHEAD = 16  # totals are prefetched this many entries before they are added to


@inline
def place_in_tile(x: int, y: int) -> tuple[int, int]:
    """Return the block that a pixel of a tile is in, and the pixel's index in that block."""
    return y // SIDE * SIDE + x // SIDE, y % SIDE * SIDE + x % SIDE


@inline
def start_tile(transmittances: F32, x0: int, y0: int, width: int, height: int, wanted: int) -> None:
    """Set the transmittances of a tile's blocks: 1, or -1 outside the image and if not wanted."""
    for y in range(TILE):
        for x in range(TILE):
            block, lane = place_in_tile(x, y)
            inside = y0 + y < height and x0 + x < width and wanted >> block & 1 == 1
            transmittances[block, lane] = np.float32(1.0) if inside else np.float32(-1.0)


@inline
def _clear(planes: F32) -> None:
    """Set an array of three axes to 0."""
    for plane in range(len(planes)):
        for row in range(planes.shape[1]):
            for column in range(planes.shape[2]):
                planes[plane, row, column] = np.float32(0.0)


@inline
def fetch(
    geometry: F64,
    features: F32,
    i: int,
    x0: int,
    y0: int,
    channels: int,
    j: int,
    shapes: F32,
    values: F32,
) -> None:
    """Write the shape of splat i in a tile, and its features, to row j of a batch; see `blocks`.

    (x0, y0): the tile's corner, in pixels.
    """
    u, v = geometry[i, 0] - (x0 + 0.5 * TILE), geometry[i, 1] - (y0 + 0.5 * TILE)
    inv_w, slope, inv_yy, reach = geometry[i, 2], geometry[i, 3], geometry[i, 4], geometry[i, 5]
    across, rise = inv_w / UNIT, math.sqrt(inv_yy) / UNIT
    shapes[j, ACROSS] = across
    shapes[j, ALONG] = -across * slope
    shapes[j, START] = -across * (u - slope * v)
    shapes[j, RISE] = rise
    shapes[j, HEIGHT] = -rise * v
    shapes[j, FAINT] = (LOG_255 - 0.5 * (reach - SLACK)) / 16.0
    for c in range(channels):
        values[j, c] = features[i, c]


@inline
def _write_tile(
    x0: int,
    y0: int,
    transmittances: F32,
    planes: F32,
    background: F32,
    image: F32,
    transmittance: F32,
) -> None:
    """Copy a tile's pixels into the image, over the background."""
    height, width, channels = image.shape
    for y in range(min(TILE, height - y0)):
        for x in range(min(TILE, width - x0)):
            block, lane = place_in_tile(x, y)
            light = abs(transmittances[block, lane])
            transmittance[y0 + y, x0 + x] = light
            for c in range(channels):
                image[y0 + y, x0 + x, c] = planes[c, block, lane] + light * background[c]


@inline
def _read_tile(probes: F32, x0: int, y0: int, planes: F32) -> None:
    """Copy a tile of (P, H, W) probes into (P, 16, 16) blocks, 0 outside the image."""
    _clear(planes)
    for p in range(len(probes)):
        for y in range(min(TILE, probes.shape[1] - y0)):
            for x in range(min(TILE, probes.shape[2] - x0)):
                block, lane = place_in_tile(x, y)
                planes[p, block, lane] = probes[p, y0 + y, x0 + x]


@inline
def _blend_batch(
    open_mask: int, marks: U32, shapes: F32, values: F32, channels: int, transmittances: F32,
    weights: F32, planes: F32, probes: F32, sums: F32,
) -> None:  # fmt: skip
    """Blend a batch of splats into the open blocks, and sum their weights times probes."""
    for block in range(LANES):
        if marks[block] == 0 or open_mask >> block & 1 == 0:
            continue
        blending.blend_block(marks[block], block, shapes, values, transmittances, weights, planes)
        for c in range(3, channels):
            blending.add_block(marks[block], block, weights, values, c, planes)
        for p in range(len(probes)):
            blending.probe_block(marks[block], block, weights, probes, p, sums)


@inline
def _add_up(sums: F32, partial: F32, first: int, count: int) -> None:
    """Sum (P, BATCH, 16) of a batch over the last axis, and write the result to partial (E, P)."""
    for j in range(count):
        for p in range(partial.shape[1]):
            partial[first + j, p] = blending.total(sums, p, j)


@parallel_kernel("starts", least=8)
def blend_tiles(
    start: int,
    stop: int,
    geometry: F64,
    features: F32,
    starts: I64,
    entries: I32,
    wanted: int,
    background: F32,
    image: F32,
    transmittance: F32,
    probes: F32,
    partial: F32,
) -> None:
    """Blend every tile's splats front to back ([K] eq. 3), and sum their weights times probes.

    Args:
        start: First tile of the range.
        stop: The tile after its last.
        geometry: (N, 8) rows of projected splats.
        features: (N, C or more) features to blend.
        starts: (T + 1,) from `list_tiles`.
        entries: (E,) from `list_tiles`.
        wanted: Bit mask of the blocks of each tile to blend; others show the background.
        background: (C,) added, weighted by the final transmittance.
        image: (H, W, C) out.
        transmittance: (H, W) out, the final transmittance.
        probes: (P, H, W) images that the weights T alpha are multiplied by; P may be 0.
        partial: (E, P) out, for each entry the sums of these products over its tile.
    """
    height, width, channels = image.shape
    tiles_x = (width + TILE - 1) // TILE
    blended = max(channels, 3)
    transmittances = np.empty((LANES, LANES), np.float32)
    planes = np.empty((blended, LANES, LANES), np.float32)
    probed = np.empty((len(probes), LANES, LANES), np.float32)
    shapes = np.empty((BATCH, SHAPE), np.float32)
    values = np.zeros((BATCH, blended), np.float32)
    marks = np.empty(LANES, np.uint32)
    weights = np.empty((BATCH, LANES), np.float32)
    sums = np.empty((len(probes), BATCH, LANES), np.float32)
    for tile in range(start, min(stop, len(starts) - 1)):
        x0, y0 = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        end = starts[tile + 1]
        for e in range(starts[tile], end):
            for p in range(len(probes)):
                partial[e, p] = np.float32(0.0)
        _clear(planes)
        start_tile(transmittances, x0, y0, width, height, wanted)
        _read_tile(probes, x0, y0, probed)
        for first in range(starts[tile], end, BATCH):
            open_mask = blocks.open_blocks(transmittances)
            if open_mask == 0:
                break
            count = min(BATCH, end - first)
            for block in range(LANES):
                marks[block] = 0
            for j in range(count):
                i = entries[first + j]
                fetch(geometry, features, i, x0, y0, channels, j, shapes, values)
            for e in range(first + BATCH, min(first + 2 * BATCH, end)):
                blocks.prefetch(geometry, entries[e], 0)
                blocks.prefetch(features, entries[e], 0)
            for j in range(count):
                blocks.mark_blocks(shapes, j, marks)
            _clear(sums)
            _blend_batch(
                open_mask,
                marks,
                shapes,
                values,
                channels,
                transmittances,
                weights,
                planes,
                probed,
                sums,
            )
            _add_up(sums, partial, first, count)
        _write_tile(x0, y0, transmittances, planes, background, image, transmittance)


@parallel_kernel("totals", least=1)
def sum_entries(
    start: int, stop: int, entries: I32, partial: F32, bounds: I64, totals: F64
) -> None:
    """Add each entry's partial sums to its splat's totals, in the order of the tiles.

    Args:
        start: First run of entries of the range.
        stop: The run after its last.
        entries: (E,) from `list_tiles`.
        partial: (E, P) from `blend_tiles`.
        bounds: (runs + 1,) where each run begins in `entries`.
        totals: (runs, N, P) in and out, separate totals for each run.
    """
    for run in range(start, stop):
        sums = totals[run]
        for e in range(bounds[run], bounds[run + 1]):
            blocks.prefetch(sums, entries[min(e + AHEAD, len(entries) - 1)], 0)
            i = entries[e]
            for p in range(partial.shape[1]):
                sums[i, p] += partial[e, p]


@parallel_kernel("totals")
def add_unoccluded(
    start: int, stop: int, geometry: F64, boxes: I64, width: int, height: int, totals: F64
) -> None:
    """Add each splat's contribution if nothing were in front of it, if its centre is on the image.

    This is 2 pi alpha sqrt(det) of each Gaussian whose centre is on the image, in pixels. It
    includes the part with an alpha below 1/255, which is not drawn: a splat of opacity 0.01 in full
    sight has a visibility of 0.6. Results were worse without this part; a splat's coverage in
    `method/nodes.py` includes it, too.

    Args:
        start: First splat of the range.
        stop: The splat after its last.
        geometry: (N, 8) from `project_splats`.
        boxes: (N,) from `project_splats`.
        width: Image width in pixels.
        height: Image height in pixels.
        totals: (N,) in and out.
    """
    for i in range(start, stop):
        if boxes[i] == HIDDEN:
            continue
        u, v = geometry[i, 0], geometry[i, 1]
        if 0.0 <= u <= width and 0.0 <= v <= height:
            area = 2.0 * math.pi / (geometry[i, 2] * math.sqrt(geometry[i, 4]))
            totals[i] += geometry[i, 6] * area

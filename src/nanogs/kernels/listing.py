"""Kernels of the rasteriser that list the projected splats of each tile, nearest first.

The columns of `geometry` are described in `nanogs.kernels.project`.
"""

import math

import numpy as np

from nanogs import parallel
from nanogs._types import F32, F64, I32, I64, U64
from nanogs.kernels.blocks import TILE, prefetch
from nanogs.kernels.policy import exact_inline, kernel, parallel_kernel
from nanogs.kernels.project import HIDDEN, pack_box, unpack_box
from nanogs.slices import SLICE_STEPS, slices

CHUNKS = 16  # runs of the depth order listed independently; fixed, so that threads do not matter
SMALL = 2  # tiles a side up to which a box is listed whole: tiles not reached draw nothing
HIGHEST, WIDEST = 4, 254  # rows and columns of tiles of the largest box whose spans are stored
AHEAD = 16  # rows are prefetched this many places of the order before they are read
WHOLE, UNKNOWN = np.uint64(0), np.uint64(0xFFFFFFFFFFFFFFFF)


# Exact floating point, because two kernels must find the same tiles.
@exact_inline
def _tile_span(
    row: F64, lowest: float, left_tile: int, across: int, ty: int, width: int, height: int
) -> tuple[int, int]:
    """Return the tiles [first, end) of row ty that have a pixel centre inside a splat's ellipse.

    row: of `geometry`; lowest: from `_lowest`; left_tile and across: first column and number of
    columns of the splat's box of tiles, to which the result is limited.
    """
    u, v, sigma = row[0], row[1], 1.0 / row[2]
    slope, inv_yy, reach = row[3], row[4], row[5]
    y0 = ty * TILE + 0.5 - v
    y1 = min(ty * TILE + TILE, height) - 0.5 - v
    left_y = min(max(lowest, y0), y1)
    right_y = min(max(-lowest, y0), y1)
    left = slope * left_y - math.sqrt(max(0.0, reach - left_y * left_y * inv_yy)) * sigma
    right = slope * right_y + math.sqrt(max(0.0, reach - right_y * right_y * inv_yy)) * sigma
    low, high = max(u + left - 0.5, 0.0), min(u + right - 0.5, width - 1.0)
    if not low <= high:  # tested before rounding, which fails for numbers that are too large
        return left_tile, left_tile
    first, last = math.ceil(low), math.floor(high)
    if last < first:
        return left_tile, left_tile
    return max(first // TILE, left_tile), min(last // TILE + 1, left_tile + across)


@exact_inline
def _lowest(row: F64) -> float:
    """Return the y offset from a splat's centre to its leftmost point, in pixels."""
    drift = row[3] * row[2]
    height: float = -row[7] * drift / math.sqrt(drift * drift + row[4])
    return height


@parallel_kernel("places", least=1)
def depth_keys(
    start: int, stop: int, features: F32, boxes: I64, bounds: I64, places: I64, keys: U64
) -> None:
    """Write a sort key for each splat that is drawn: depth in the upper half, index in the lower.

    Args:
        start: First run of rows of the range.
        stop: The run after its last.
        features: (N, 4), the last column is the depth, above 0, whose bits sort as its values do.
        boxes: (N,) from `project_splats`.
        bounds: (runs + 1,) where each run begins.
        places: (runs,) where the keys of each run begin.
        keys: (M,) out.
    """
    for run in range(start, stop):
        place = places[run]
        for i in range(bounds[run], bounds[run + 1]):
            if boxes[i] != HIDDEN:
                depth = np.float32(features[i, 3]).view(np.uint32)
                keys[place] = np.uint64(depth) << np.uint64(32) | np.uint64(i)
                place += 1


@kernel
def extent_of(boxes: I64) -> tuple[int, int, int, int]:
    """Return the bounding box of all boxes of tiles.

    These are its first column and row, and those after its last; 0 if there is no box.
    boxes: (N,) from `project_splats`.
    """
    left = top = right = bottom = 0
    for box in boxes:
        if box == HIDDEN:
            continue
        x, y, across, down = unpack_box(box)
        if right == 0:
            left, top = x, y
        left, top = min(left, x), min(top, y)
        right, bottom = max(right, x + across), max(bottom, y + down)
    return left, top, right, bottom


@kernel
def cut_boxes(
    boxes: I64, left: int, top: int, right: int, bottom: int, rows: I64, cut: I64
) -> tuple[int, int, int]:
    """Find the splats that may reach a part of a picture, and clip their boxes of tiles to it.

    Args:
        boxes: (N,) from `project_splats`.
        left: The first column of tiles of the part.
        top: Its first row of tiles.
        right: The column after its last.
        bottom: The row after its last.
        rows: (N,) out, in its first places the splats that may reach the part, in their order.
        cut: (N,) out, their boxes, clipped to the part.

    Returns:
        The number of these splats, the number of tiles of their clipped boxes, and the number of
        splats whose box has its corner in the part: of all parts of a picture, exactly one.
    """
    count = tiles = corners = 0
    for i in range(len(boxes)):
        if boxes[i] == HIDDEN:
            continue
        x, y, across, down = unpack_box(boxes[i])
        corners += int(left <= x < right and top <= y < bottom)
        x0, x1 = max(x, left), min(x + across, right)
        y0, y1 = max(y, top), min(y + down, bottom)
        if x0 < x1 and y0 < y1:
            rows[count] = i
            cut[count] = pack_box(x0, y0, x1 - x0, y1 - y0)
            tiles += (x1 - x0) * (y1 - y0)
            count += 1
    return count, tiles, corners


@parallel_kernel("counts", least=1)
def span_tiles(
    start: int,
    stop: int,
    geometry: F64,
    boxes: I64,
    order: I64,
    width: int,
    height: int,
    spans: U64,
    counts: I64,
) -> None:
    """Find the tiles that the splats of each run of the depth order meet, and count the splats.

    Args:
        start: First run of the range.
        stop: The run after its last.
        geometry: (N, 8) rows of projected splats.
        boxes: (M,) the box of tiles of each splat, in the order of `order`.
        order: (M,) indices of the drawn splats, nearest first.
        width: Image width in pixels.
        height: Image height in pixels.
        spans: (M,) out, for each splat in this order the first tile and the end in up to four rows
            of its box, one byte each, counted from the left of the box; 0 for a box that is listed
            whole, and `UNKNOWN` for one that does not fit.
        counts: (runs, T) out, number of splats for each run and tile.
    """
    tiles_x = (width + TILE - 1) // TILE
    size = (len(order) + len(counts) - 1) // len(counts)
    for run in range(start, stop):
        counts[run] = 0
        for m in range(run * size, min((run + 1) * size, len(order))):
            index = order[m]
            prefetch(geometry, order[min(m + AHEAD, len(order) - 1)], 0)
            left, top, across, down = unpack_box(boxes[m])
            whole = across == 1 or down == 1 or (across <= SMALL and down <= SMALL)
            spans[m] = WHOLE if whole else UNKNOWN
            fits = not whole and across <= WIDEST and down <= HIGHEST
            row = geometry[index]
            lowest = 0.0 if whole else _lowest(row)
            found = 0
            for k in range(down):
                first, end = left, left + across
                if not whole:
                    first, end = _tile_span(row, lowest, left, across, top + k, width, height)
                    if first < end and fits:
                        found |= ((first - left) | (end - left) << 8) << (16 * k)
                for tile in range((top + k) * tiles_x + first, (top + k) * tiles_x + end):
                    counts[run, tile] += 1
            if fits and found != 0:
                spans[m] = np.uint64(found)


@parallel_kernel("cursors", least=1)
def list_runs(
    start: int,
    stop: int,
    geometry: F64,
    boxes: I64,
    order: I64,
    width: int,
    height: int,
    spans: U64,
    cursors: I64,
    entries: I32,
) -> None:
    """Write the splats of each run of the depth order into the lists of the tiles that they meet.

    Args:
        start: First run of the range.
        stop: The run after its last.
        geometry: (N, 8) rows of projected splats.
        boxes: (M,) the box of tiles of each splat, in the order of `order`.
        order: (M,) indices of the drawn splats, nearest first.
        width: Image width in pixels.
        height: Image height in pixels.
        spans: (M,) from `span_tiles`.
        cursors: (runs, T) in, where each run begins in each tile's list; out, where it ends.
        entries: (E,) out.
    """
    tiles_x = (width + TILE - 1) // TILE
    size = (len(order) + len(cursors) - 1) // len(cursors)
    for run in range(start, stop):
        for m in range(run * size, min((run + 1) * size, len(order))):
            index, span = order[m], spans[m]
            left, top, across, down = unpack_box(boxes[m])
            row = geometry[index]
            lowest = _lowest(row) if span == UNKNOWN else 0.0
            for k in range(down):
                first, end = left, left + across
                if span == UNKNOWN:
                    first, end = _tile_span(row, lowest, left, across, top + k, width, height)
                elif span != WHOLE:
                    both = int(span >> np.uint64(16 * k)) & 0xFFFF
                    first, end = left + (both & 0xFF), left + (both >> 8)
                for tile in range((top + k) * tiles_x + first, (top + k) * tiles_x + end):
                    entries[cursors[run, tile]] = index
                    cursors[run, tile] += 1


def list_tiles(geometry: F64, boxes: I64, order: I64, width: int, height: int) -> tuple[I64, I32]:
    """List, for every tile, the splats that meet it, nearest first.

    Args:
        geometry: (N, 8) rows of projected splats.
        boxes: (N,) the box of tiles of each splat, from `project_splats`.
        order: (M,) indices of the drawn splats, nearest first.
        width: Image width in pixels.
        height: Image height in pixels.

    Returns:
        starts (T + 1,) and entries (starts[T],): tile t (row by row) holds the splats
        entries[starts[t]:starts[t + 1]].
    """
    tiles = (-(-width // TILE)) * (-(-height // TILE))
    counts = np.empty((CHUNKS, tiles), np.int64)
    boxes = _taken(boxes, order)  # all at once, so that cache misses overlap
    spans = np.empty(len(order), np.uint64)
    span_tiles(geometry, boxes, order, width, height, spans, counts)
    ends = np.cumsum(counts.T).reshape(tiles, CHUNKS)
    starts = np.append(ends[:, 0] - counts[0], ends[-1, -1])
    cursors = np.ascontiguousarray((ends - counts.T).T)
    entries = np.empty(starts[-1], np.int32)
    list_runs(geometry, boxes, order, width, height, spans, cursors, entries)
    return starts, entries


def _taken(boxes: I64, order: I64) -> I64:
    """Gather the boxes of the rows in `order`: (M,) int64."""
    taken = np.empty(len(order), np.int64)

    def take(part: slice) -> None:
        taken[part] = boxes.take(order[part])

    parallel.for_each(slices(len(order), SLICE_STEPS), take)
    return taken

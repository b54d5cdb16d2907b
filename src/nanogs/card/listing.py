"""List the splats of each tile, nearest first; see `nanogs.kernels.listing`.

Pairs of splat and tile are written in the splats' order of depth, and a stable sort by tile keeps
that order within each tile. A pair's index before the sort is its slot: the slots of a splat are
contiguous, so that sums over a splat's tiles are reductions over its slots.
"""

import warp as wp

from nanogs.card.shading import TILE


@wp.func
def tile_span(
    geometry: wp.array2d[wp.float64], i: wp.int32, box: wp.vec4i, row: wp.int32, size: wp.vec2i
) -> wp.vec2i:
    """Return the tiles [first, end) of a row that have a pixel centre inside a splat's ellipse."""
    u, v, sigma = geometry[i, 0], geometry[i, 1], wp.float64(1.0) / geometry[i, 2]
    slope, inv_yy, reach = geometry[i, 3], geometry[i, 4], geometry[i, 5]
    drift = slope * geometry[i, 2]
    lowest = -geometry[i, 7] * drift / wp.sqrt(drift * drift + inv_yy)
    none, half = wp.float64(0.0), wp.float64(0.5)
    y0 = wp.float64(row * TILE) + half - v
    y1 = wp.float64(wp.min(row * TILE + TILE, size[1])) - half - v
    left_y = wp.min(wp.max(lowest, y0), y1)
    right_y = wp.min(wp.max(-lowest, y0), y1)
    left = slope * left_y - wp.sqrt(wp.max(none, reach - left_y * left_y * inv_yy)) * sigma
    right = slope * right_y + wp.sqrt(wp.max(none, reach - right_y * right_y * inv_yy)) * sigma
    low = wp.max(u + left - half, none)
    high = wp.min(u + right - half, wp.float64(size[0] - 1))
    span = wp.vec2i(box[0], box[0])
    if low <= high:
        first, last = wp.int32(wp.ceil(low)), wp.int32(wp.floor(high))
        if first <= last:
            span = wp.vec2i(wp.max(first / TILE, box[0]), wp.min(last / TILE + 1, box[0] + box[2]))
    return span


@wp.kernel(enable_backward=False)
def count_tiles(
    geometry: wp.array2d[wp.float64],
    boxes: wp.array[wp.vec4i],
    order: wp.array[wp.int32],
    size: wp.vec2i,
    counts: wp.array[wp.int64],
) -> None:
    """Count the tiles that each splat meets, in the order of depth; counts: (N,) out."""
    m = wp.tid()
    i = order[m]
    box = boxes[i]
    count = wp.int64(0)
    for row in range(box[1], box[1] + box[3]):
        span = tile_span(geometry, i, box, row, size)
        count += wp.int64(wp.max(span[1] - span[0], 0))
    counts[m] = count


@wp.kernel(enable_backward=False)
def write_tiles(
    geometry: wp.array2d[wp.float64],
    boxes: wp.array[wp.vec4i],
    order: wp.array[wp.int32],
    size: wp.vec2i,
    ends: wp.array[wp.int64],
    tiles: wp.array[wp.int32],
    slots: wp.array[wp.int32],
    owners: wp.array[wp.int32],
) -> None:
    """Write tile, slot and splat of each pair of a splat and a tile that it meets.

    ends: (N,) inclusive prefix sums of the counts; tiles, slots, owners: (E or more,) out, the
    slots being 0, 1, ...
    """
    m = wp.tid()
    i = order[m]
    box = boxes[i]
    slot = wp.int32(0)
    if m > 0:
        slot = wp.int32(ends[m - 1])
    tiles_x = (size[0] + TILE - 1) / TILE
    for row in range(box[1], box[1] + box[3]):
        span = tile_span(geometry, i, box, row, size)
        for column in range(span[0], span[1]):
            tiles[slot] = row * tiles_x + column
            slots[slot] = slot
            owners[slot] = i
            slot += 1


@wp.kernel(enable_backward=False)
def find_starts(
    tiles: wp.array[wp.int32],
    slots: wp.array[wp.int32],
    owners: wp.array[wp.int32],
    count: wp.int32,
    starts: wp.array[wp.int32],
    entries: wp.array[wp.int32],
) -> None:
    """Find where each tile begins in the sorted list, and the splat of each entry.

    tiles, slots: (E or more,) sorted by tile; starts: (T + 1,) out; entries: (E,) out.
    """
    e = wp.tid()
    entries[e] = owners[slots[e]]
    before = wp.int32(-1)
    if e > 0:
        before = tiles[e - 1]
    for tile in range(before + 1, tiles[e] + 1):
        starts[tile] = e
    if e == count - 1:
        for tile in range(tiles[e] + 1, starts.shape[0]):
            starts[tile] = count

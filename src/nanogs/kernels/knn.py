"""Exact k nearest neighbours, 16 queries at a time.

The 16 points of a leaf of the tree are queries that search it together, from their own leaf
outwards. Each has a list of the k smallest keys of distances (`lanes.py`), into which candidates
are inserted by vector minima and maxima alone; a candidate that entered any list is noted. The
largest key of a list bounds which noted candidates can be among the nearest: the few within it are
compared exactly, by (squared distance, row). Keys drop the lower bits of a number but never reverse
an order, and distances to boxes are computed with the same operations as distances to points, each
of which rounds monotonically. So a candidate that is excluded by a box or a key is farther,
rounding included.
"""

import numpy as np

from nanogs._types import F64, I32, I64, Bool
from nanogs.kernels.knn_tree import DEEPEST, push, squared_length
from nanogs.kernels.lanes import LANES, box_keys, distance_keys, insert, lowest_bit, within
from nanogs.kernels.policy import exact_inline, exact_parallel_kernel

_FAR = 0x7FF00000  # the key of infinity
_CLOSED = -1  # bound of a query that is finished: below every key
_NOTES = 512  # candidates that are noted before the nearest of them are selected


@exact_inline
def _box_to_box(boxes: F64, a: int, b: int) -> float:
    """Squared distance between the boxes of two nodes."""
    x = max(0.0, boxes[a, 0] - boxes[b, 3], boxes[b, 0] - boxes[a, 3])
    y = max(0.0, boxes[a, 1] - boxes[b, 4], boxes[b, 1] - boxes[a, 4])
    z = max(0.0, boxes[a, 2] - boxes[b, 5], boxes[b, 2] - boxes[a, 5])
    return squared_length(x, y, z)


@exact_inline
def _keep_nearest(
    found: I32, at: int, count: int, k: int, query: int, points: F64, rows: I32, full: F64, ids: I32
) -> None:
    """Sort a query's candidates by (squared distance, row) and keep the first k.

    found: places of points, `count` from place `at`, reordered; full: (room,) and ids: (2 room,)
    scratch. The rank of a candidate is the number of those before it: counting has no branches to
    mispredict, and is vectorised.
    """
    n = len(rows)
    x, y, z = points[query], points[n + query], points[2 * n + query]
    for i in range(count):
        p = found[at + i]
        full[i] = squared_length(x - points[p], y - points[n + p], z - points[2 * n + p])
        ids[i] = rows[p]
    for i in range(count):
        rank = 0
        for j in range(count):
            rank += (full[j] < full[i]) | ((full[j] == full[i]) & (ids[j] < ids[i]))
        if rank < k:
            ids[count + rank] = found[at + i]
    for i in range(min(k, count)):
        found[at + i] = ids[count + i]


@exact_inline
def _take_noted(
    noted: I32, keys: I32, notes: int, bounds: I32, k: int, first: int,
    found: I32, counts: I64, points: F64, rows: I32, full: F64, ids: I32,
) -> None:  # fmt: skip
    """Append the noted candidates within a query's bound to the candidates found for it.

    noted: (notes,) places of points; keys: (notes * 16,); bounds: (16,) and more; first: place of
    the first query; found: (16 * room,), counts: (16,), candidates of each query so far.
    """
    room = len(full)
    for note in range(notes):
        mask = within(keys, note * LANES, bounds)
        while mask != 0:
            lane = lowest_bit(mask)
            mask &= mask - 1
            count = counts[lane]
            found[lane * room + count] = noted[note]
            count += 1
            if count == room:
                _keep_nearest(found, lane * room, room, k, first + lane, points, rows, full, ids)
                count = k
            counts[lane] = count


@exact_inline
def _load_queries(leaf: int, points: F64, rows: I32, queries: F64, lists: I32, counts: I64) -> int:
    """Load the points of a leaf as queries with empty lists; return the number of points."""
    n = len(rows)
    first = leaf * LANES
    lanes = min(LANES, n - first)
    lists[:] = _FAR
    for lane in range(LANES):
        p = first + min(lane, lanes - 1)
        queries[lane] = points[p]
        queries[LANES + lane] = points[n + p]
        queries[2 * LANES + lane] = points[2 * n + p]
        counts[lane] = 0
        if lane >= lanes:
            lists[lane] = _CLOSED
    return lanes


@exact_inline
def _push_children(
    boxes: F64, home: int, node: int, first: int, last: int, stack: I64, gaps: F64, waiting: int
) -> int:
    """Push a node's children and their distances on the stack, the nearer one on top."""
    middle = (first + last) // 2
    left = _box_to_box(boxes, home, 2 * node)
    right = _box_to_box(boxes, home, 2 * node + 1)
    gaps[waiting], gaps[waiting + 1] = max(left, right), min(left, right)
    if left > right:
        waiting = push(stack, waiting, 2 * node, first, middle)
        return push(stack, waiting, 2 * node + 1, middle, last)
    waiting = push(stack, waiting, 2 * node + 1, middle, last)
    return push(stack, waiting, 2 * node, first, middle)


@exact_inline
def _path_to(leaf: int, leaves: int, boxes: F64, stack: I64, gaps: F64) -> int:
    """Push the siblings of all nodes from the root to a leaf, and the leaf; return the number."""
    node, first, last, waiting = 1, 0, leaves, 0
    while last - first > 1:
        middle = (first + last) // 2
        if leaf < middle:
            waiting = push(stack, waiting, 2 * node + 1, middle, last)
            node, last = 2 * node, middle
        else:
            waiting = push(stack, waiting, 2 * node, first, middle)
            node, first = 2 * node + 1, middle
    waiting = push(stack, waiting, node, leaf, leaf + 1)
    for place in range(waiting):
        gaps[place] = _box_to_box(boxes, node, stack[3 * place])
    return waiting


@exact_inline
def _close(bounds: I32) -> int:
    """Finish queries that have k neighbours at distance zero; return the highest bound.

    Nothing can be nearer, and the caller has to find out whether more are as near: in a large group
    of coincident points, each would have to visit all others.
    """
    highest = _CLOSED
    for lane in range(LANES):
        if bounds[lane] == 0:
            bounds[lane] = _CLOSED
        highest = max(highest, bounds[lane])
    return highest


@exact_inline
def _write(found: I32, at: int, rows: I32, out: I32, row: int) -> None:
    for place in range(out.shape[1]):
        out[row, place] = rows[found[at + place]]


@exact_parallel_kernel("rows", least=64 * LANES, each=32)
def search_tree(
    start: int, stop: int, points: F64, rows: I32, boxes: F64, out: I32, crowded: Bool
) -> None:
    """Find the k nearest neighbours of every point, by (squared distance, row), without itself.

    points: (3 N,), rows: (N,) and boxes: (nodes, 6) from `build_tree`; out: (N, k) rows, nearest
    first, k < N; crowded: (N,) out, whether a row has k others at distance zero: its row of `out`
    is then not written.
    """
    n, k = out.shape
    room = 2 * k + 32
    queries = np.empty(3 * LANES)
    lists = np.empty(k * LANES, dtype=np.int32)
    near = np.empty(LANES, dtype=np.int32)
    noted = np.empty(_NOTES, dtype=np.int32)
    keys = np.empty(_NOTES * LANES, dtype=np.int32)
    found = np.empty(LANES * room, dtype=np.int32)
    counts = np.empty(LANES, dtype=np.int64)
    full = np.empty(room)
    ids = np.empty(2 * room, dtype=np.int32)
    stack = np.empty(3 * DEEPEST, dtype=np.int64)
    gaps = np.empty(DEEPEST)
    leaves = (n + LANES - 1) // LANES
    for leaf in range((start + LANES - 1) // LANES, (stop + LANES - 1) // LANES):
        begin = leaf * LANES
        lanes = _load_queries(leaf, points, rows, queries, lists, counts)
        waiting = _path_to(leaf, leaves, boxes, stack, gaps)
        home = stack[3 * waiting - 3]
        bound, notes = _FAR, 0
        while waiting > 0:
            waiting -= 1
            node, first, last = stack[3 * waiting], stack[3 * waiting + 1], stack[3 * waiting + 2]
            if np.float64(gaps[waiting]).view(np.int64) >> 32 > bound:
                continue
            if last - first > 1:
                waiting = _push_children(boxes, home, node, first, last, stack, gaps, waiting)
                continue
            box_keys(queries, boxes, node, near)
            if within(near, 0, lists) == 0:
                continue
            if notes > _NOTES - LANES:
                _take_noted(
                    noted, keys, notes, lists, k, begin, found, counts, points, rows, full, ids
                )
                notes = 0
            for p in range(first * LANES, min(n, last * LANES)):
                at = notes * LANES
                distance_keys(queries, points[p], points[n + p], points[2 * n + p], keys, at)
                if node == home:
                    keys[at + p - begin] = _FAR + 1  # a point is not its own neighbour
                if within(keys, at, lists) != 0:
                    insert(lists, keys, at, k)
                    noted[notes] = p
                    notes += 1
            bound = _close(lists)
        _take_noted(noted, keys, notes, lists, k, begin, found, counts, points, rows, full, ids)
        for lane in range(lanes):
            crowded[rows[begin + lane]] = lists[lane] == _CLOSED
            if lists[lane] != _CLOSED:
                at, query = lane * room, begin + lane
                _keep_nearest(found, at, counts[lane], k, query, points, rows, full, ids)
                _write(found, at, rows, out, rows[query])

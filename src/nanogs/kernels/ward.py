"""Kernels of Ward clustering: merge near points into fewer, with little squared error.

Source: Ward, "Hierarchical grouping to optimize an objective function", 1963. Merging points a and
b of weights v and w costs v w / (v + w) |a - b|², the increase of the squared error.

Each point is in a cell. The table has a block for each cell, a matrix of D rows with one point in
each column, whose width is a multiple of 16. A column without a point has an infinite square.
"""

import math

import numpy as np

from nanogs._types import F32, I32, I64
from nanogs.kernels.blocks import prefetch_row
from nanogs.kernels.closest import LANES, TOGETHER, closest, rounding
from nanogs.kernels.policy import exact_inline, exact_kernel, inline, parallel_kernel

EMPTY = np.float32(math.inf)  # the square of a column without a point
NOBODY = np.int32(-1)
# A lower bound of a lane's cost, its last four bits replaced by the lane: positive numbers are
# ordered like their bits. This one is above all.
NO_KEY = np.int32(0x7FFFFFFF)
TWO = np.float32(2)
ZERO = np.float32(0)


@exact_inline
def _apart(points: F32, i: int, j: int) -> np.float32:
    """Return |a - b|² of two points, the same on every machine; D is a multiple of three."""
    x, y, z = np.float32(0), np.float32(0), np.float32(0)
    for d in range(0, points.shape[1], 3):
        u = points[i, d] - points[j, d]
        v = points[i, d + 1] - points[j, d + 1]
        w = points[i, d + 2] - points[j, d + 2]
        x += u * u
        y += v * v
        z += w * w
    return np.float32(x + y + z)


@exact_inline
def _cost(points: F32, weights: F32, i: int, j: int) -> np.float32:
    """Ward's cost of merging two points: |a - b|² times v w / (v + w), of their weights v and w."""
    v, w = weights[i], weights[j]
    return np.float32(_apart(points, i, j) * (v / (v + w) * w))


@exact_inline
def _nearest(points: F32, i: int, holders: I32, start: int, stop: int) -> int:
    """Return the nearest other point in one lane, every sixteenth column; ties to the lower row."""
    least, found = EMPTY, NOBODY
    for column in range(start, stop, LANES):
        other = holders[column]
        if other != NOBODY and other != i:
            apart = _apart(points, i, other)
            if apart < least or (apart == least and other < found):
                least, found = apart, other
    return int(found)


@inline
def _enter(partners: I32, costs: F32, i: int, partner: int, cost: np.float32) -> None:
    """Insert a partner into a point's sorted list of cheapest ones, if it is one of them.

    Ties go to the lower row.
    """
    last = costs.shape[1] - 1
    if not (cost < costs[i, last] or (cost == costs[i, last] and partner < partners[i, last])):
        return
    place = last
    while place > 0 and (
        cost < costs[i, place - 1]
        or (cost == costs[i, place - 1] and partner < partners[i, place - 1])
    ):
        costs[i, place], partners[i, place] = costs[i, place - 1], partners[i, place - 1]
        place -= 1
    costs[i, place], partners[i, place] = cost, partner


@parallel_kernel("bounds", least=2)
def lay_out(
    start: int, stop: int,
    bounds: I64, starts: I64, order: I64, points: F32, lengths: F32, weights: F32, table: F32,
    squares: F32, masses: F32, holders: I32, places: I64,
) -> None:  # fmt: skip
    """Copy the points of each cell into its block of the table.

    bounds: (C,) the first column of each cell; starts: (C + 1,) where the points of each cell begin
    in `order`; points: (N, D); lengths: (N,) squared; weights: (N,); table: (S D,) out; squares,
    masses: (S,) out, lengths and weights by column; holders: (S,) out, the point of each column;
    places: (N,) out, the column of each point.
    """
    dimensions = points.shape[1]
    for cell in range(start, stop):
        count = starts[cell + 1] - starts[cell]
        width = -(-count // LANES) * LANES
        base = bounds[cell] * dimensions
        for c in range(width):
            squares[bounds[cell] + c] = EMPTY
            masses[bounds[cell] + c] = np.float32(1)
            holders[bounds[cell] + c] = NOBODY
            for d in range(dimensions):
                table[base + d * width + c] = np.float32(0)
        for c in range(count):
            i = order[starts[cell] + c]
            places[i] = bounds[cell] + c
            squares[bounds[cell] + c] = lengths[i]
            masses[bounds[cell] + c] = weights[i]
            holders[bounds[cell] + c] = np.int32(i)
            for d in range(dimensions):
                table[base + d * width + c] = points[i, d]


@inline
def _take_nearest(
    i: int, points: F32, lengths: F32, weights: F32, squares: F32, masses: F32, holders: I32,
    lowest: F32, second: F32, tiles: I32, partners: I32, costs: F32, keys: I32,
) -> None:  # fmt: skip
    """Insert the nearest point of each lane of a cell as a partner of a point, if cheap enough.

    i: the point; squares, masses, holders: of the cell's columns; lowest, second: (16,) the two
    least squared distances in each lane, less the point's own square; tiles: (16,) the tile of the
    lowest; keys: (16,) scratch; the others as in `near_partners`.
    """
    last, width = costs.shape[1] - 1, len(squares)
    hidden, nearest = -1, EMPTY  # hidden: the lane in which the point itself is the nearest
    length, v, error = lengths[i], weights[i], rounding(points.shape[1])
    for lane in range(LANES):  # without branches, for vectors
        column = tiles[lane] * LANES + lane
        w, itself = masses[column], holders[column] == i
        doubt = error * (length + squares[column])
        bound = (lowest[lane] + length - TWO * doubt) * (v / (v + w) * w)
        least = np.float32(max(bound, ZERO))
        key = np.int32((least.view(np.int32) & -LANES) | lane)
        keys[lane] = NO_KEY if itself or lowest[lane] == EMPTY else key
        hidden = lane if itself else hidden
        nearest = min(nearest, EMPTY if itself else lowest[lane])
    # By lower bounds of their costs, so that few are computed that cheaper ones replace.
    for _ in range(LANES):
        key = NO_KEY
        for place in range(LANES):
            key = min(key, keys[place])
        if key == NO_KEY or np.int32(key & -LANES).view(np.float32) > costs[i, last]:
            break
        lane = int(key) & (LANES - 1)
        keys[lane] = NO_KEY
        column = tiles[lane] * LANES + lane
        partner = int(holders[column])
        if second[lane] - lowest[lane] <= error * (length + squares[column]):
            partner = _nearest(points, i, holders, lane, width)
        _enter(partners, costs, i, partner, _cost(points, weights, i, partner))
    if hidden < 0 or second[hidden] == EMPTY:
        return
    if second[hidden] - 4 * error * length <= nearest:
        partner = _nearest(points, i, holders, hidden, width)
        _enter(partners, costs, i, partner, _cost(points, weights, i, partner))


@parallel_kernel("pieces", least=1)
def near_partners(
    start: int, stop: int,
    pieces: I64, order: I64, points: F32, lengths: F32, weights: F32, bounds: I64, widths: I64,
    table: F32, squares: F32, masses: F32, holders: I32, partners: I32, costs: F32,
) -> None:  # fmt: skip
    """Search cells for the cheapest partners of points, and add them to those found before.

    Only the nearest point of each lane of a cell, a sixteenth of it, is considered. If the second
    nearest is as near but for rounding, all of the lane are compared exactly, so that the result is
    the same on every machine.

    Args:
        start: First piece of the range.
        stop: The piece after its last.
        pieces: (Q, 3) a cell, and the range in `order` of the points that search it.
        order: Points, sorted by the cell to search.
        points: (N, D), D a multiple of three.
        lengths: (N,) squared.
        weights: (N,) positive.
        bounds: (C,) the first column of each cell.
        widths: (C,) number of columns of each cell, a multiple of 16.
        table: (S D,) the blocks of all cells.
        squares: (S,) squared length of each column.
        masses: (S,) weight of each column.
        holders: (S,) the point of each column.
        partners: (N, P) in and out, the cheapest partners, the cheapest first; NOBODY for none.
        costs: (N, P) in and out, their costs, infinite for none.
    """
    dimensions = points.shape[1]
    factors = np.empty((TOGETHER, dimensions), np.float32)
    lowest = np.empty((TOGETHER, LANES), np.float32)
    second = np.empty((TOGETHER, LANES), np.float32)
    tiles = np.empty((TOGETHER, LANES), np.int32)
    keys = np.empty(LANES, np.int32)
    squared, loads = lengths.reshape((-1, 1)), weights.reshape((-1, 1))
    for piece in range(start, stop):
        cell, at, end = pieces[piece, 0], pieces[piece, 1], pieces[piece, 2]
        first, width = bounds[cell], widths[cell]
        if width == 0:
            continue
        block = table[first * dimensions : (first + width) * dimensions]
        columns = block.reshape((dimensions, width))
        own = squares[first : first + width]
        heavy, held = masses[first : first + width], holders[first : first + width]
        while at < end:
            for j in range(TOGETHER):
                ahead = order[min(at + TOGETHER + j, end - 1)]  # rows are far from each other
                prefetch_row(points, ahead)
                prefetch_row(squared, ahead)
                prefetch_row(loads, ahead)
                prefetch_row(partners, ahead)
                prefetch_row(costs, ahead)
            for j in range(TOGETHER):
                i = order[min(at + j, end - 1)]
                for d in range(dimensions):
                    factors[j, d] = points[i, d] * -TWO
            closest(factors, columns, own, width // LANES, lowest, second, tiles)
            for j in range(min(TOGETHER, end - at)):
                _take_nearest(
                    order[at + j], points, lengths, weights, own, heavy, held, lowest[j],
                    second[j], tiles[j], partners, costs, keys,
                )  # fmt: skip
            at += TOGETHER


@parallel_kernel("labels")
def own_costs(
    start: int, stop: int, labels: I32, points: F32, weights: F32, partners: I32, costs: F32
) -> None:
    """Write given partners of points and the costs of merging with them.

    labels: (M,) the partner of each of the last M points; points: (N, D); weights: (N,); partners,
    costs: (N, 1) out.
    """
    first = len(points) - len(labels)
    for m in range(start, stop):
        i = first + m
        partners[i, 0] = labels[m]
        costs[i, 0] = _cost(points, weights, i, labels[m])


@parallel_kernel("rows")
def cheapest(
    start: int, stop: int,
    rows: I64, parents: I32, changed: I32, searched: I32, partners: I32, costs: F32, best: I32,
    least: F32,
) -> None:  # fmt: skip
    """Find the cheapest partner of each point that has not been merged since it was found.

    rows: (R,) points; parents: (N,) the point itself if it has not been merged into another;
    changed: (N,) the pass in which a point last moved; searched: (N,) the pass in which its
    partners were found; partners, costs: of `near_partners`; best: (R,) out, the partner, or NOBODY
    if none is left; least: (R,) out, its cost, or if none is left, a lower bound of any other's.
    """
    count = partners.shape[1]
    for r in range(start, stop):
        i = rows[r]
        best[r], least[r] = NOBODY, EMPTY
        for p in range(count):
            j = partners[i, p]
            if j == NOBODY:
                break
            least[r] = costs[i, p]
            if parents[j] == j and changed[j] <= searched[i]:
                best[r] = j
                break


@exact_kernel
def merge_pairs(
    rows: I64, best: I32, most: int, now: int, points: F32, lengths: F32, weights: F32,
    parents: I32, changed: I32, places: I64, cells: I32, bounds: I64, widths: I64, table: F32,
    squares: F32, masses: F32, holders: I32, merged: I64,
) -> int:  # fmt: skip
    """Merge pairs in the order given, each point once; the heavier one is replaced by their mean.

    Args:
        rows: (R,) points, the cheapest pair first.
        best: (R,) their partners.
        most: Number of merges, at most.
        now: Number of the current pass.
        points: (N, D) in and out.
        lengths: (N,) squared, in and out.
        weights: (N,) in and out.
        parents: (N,) in and out, the point into which each was merged, or itself.
        changed: (N,) in and out, the pass in which each was last merged.
        places: (N,) the column of each.
        cells: (N,) the cell of each.
        bounds: (C,) the first column of each cell.
        widths: (C,) number of columns of each cell.
        table: (S D,) in and out.
        squares: (S,) in and out.
        masses: (S,) in and out.
        holders: (S,) in and out.
        merged: (most,) out, the points that others were merged into.

    Returns:
        The number of merges.
    """
    dimensions = points.shape[1]
    count = 0
    for r in range(len(rows)):
        a, b = rows[r], np.int64(best[r])
        if b == NOBODY or changed[a] == now or changed[b] == now:
            continue
        if weights[b] > weights[a] or (weights[b] == weights[a] and b < a):
            a, b = b, a
        v, w = weights[a], weights[b]
        cell = cells[a]
        column = bounds[cell] * dimensions + places[a] - bounds[cell]
        square = np.float32(0)
        for d in range(dimensions):
            mean = (v * points[a, d] + w * points[b, d]) / (v + w)
            points[a, d] = mean
            table[column + d * widths[cell]] = mean
            square += mean * mean
        lengths[a] = square
        weights[a] = v + w
        squares[places[a]], squares[places[b]] = square, EMPTY
        masses[places[a]] = v + w
        holders[places[b]] = NOBODY
        parents[b] = np.int32(a)
        changed[a] = changed[b] = now
        merged[count] = a
        count += 1
        if count == most:
            break
    return count

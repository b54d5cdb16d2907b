"""Kernels of k-means with so many centres that a point only looks at those in cells near it.

Source: Lloyd, "Least squares quantization in PCM", 1982; the cells are those of an inverted file,
Jégou, Douze, Schmid, "Product quantization for nearest neighbor search", 2011, section IV.
Distances lack the point's own square, which is the same for all centres. Ties go to the earlier.
The number D of dimensions is a multiple of three, as there are three channels.
"""

import math

import numpy as np

from nanogs._types import F32, I32, I64
from nanogs.kernels.closest import LANES, TOGETHER, closest
from nanogs.kernels.policy import inline, kernel, parallel_kernel

_ROWS = 64  # points that are worth a range of their own
TWO = np.float32(2)


@inline
def _distances(point: F32, columns: F32, squares: F32, start: int, stop: int, out: F32) -> None:
    """|c|² - 2 x.c to the centres from `start` to `stop`, which lie in the columns."""
    # Three rows a pass, and slices from zero on: this is what becomes vector instructions.
    count = stop - start
    own = squares[start:stop]
    for c in range(count):
        out[c] = own[c]
    for d in range(0, len(point), 3):
        x, y, z = point[d] * TWO, point[d + 1] * TWO, point[d + 2] * TWO
        first = columns[d, start:stop]
        second = columns[d + 1, start:stop]
        third = columns[d + 2, start:stop]
        for c in range(count):
            out[c] -= x * first[c] + y * second[c] + z * third[c]


@parallel_kernel("points", least=_ROWS)
def nearest_cells(
    start: int, stop: int, points: F32, columns: F32, squares: F32, cells: I32
) -> None:
    """The nearest centres of each point, the nearest first.

    points: (N, D); columns: (D, C) the centres; squares: (C,) their squared lengths; cells:
    (N, P) out, P up to C.
    """
    count = columns.shape[1]
    wanted = cells.shape[1]
    distances = np.empty(count, np.float32)
    kept = np.empty(wanted, np.float32)
    for i in range(start, stop):
        _distances(points[i], columns, squares, 0, count, distances)
        kept[:] = math.inf
        cells[i, :] = 0
        for c in range(count):
            if distances[c] < kept[wanted - 1]:
                place = wanted - 1
                while place > 0 and distances[c] < kept[place - 1]:
                    kept[place] = kept[place - 1]
                    cells[i, place] = cells[i, place - 1]
                    place -= 1
                kept[place] = distances[c]
                cells[i, place] = c


@parallel_kernel("pieces", least=1)
def likely_entries(
    start: int, stop: int,
    pieces: I64, order: I64, points: F32, starts: I64, entries: I64, columns: F32, squares: F32,
    share: np.float32, labels: I32, least: F32, second: F32,
) -> None:  # fmt: skip
    """Look for the nearest entry of points among some of a cell, beside what was found before.

    Distances are rounded in another order than those of `nearest_entries`, which has the last word
    where a second entry is nearly as near.

    pieces: (Q, 3) a cell, and from where to where its points are in the order; order: of points by
    the cell to look into; points: (N, D); starts: (C + 1,) where in `entries` those of a cell are,
    of the entries to look at; columns: (D, K or more) all entries; squares: (K,) their squared
    lengths, of which a share is taken off; labels, least, second: (N,) in and out, the nearest
    entry, and the least and the second least distance without the point's own square.
    """
    dimensions = points.shape[1]
    width = -(-np.max(starts[1:] - starts[:-1]) // LANES) * LANES
    own = np.zeros((dimensions, width), np.float32)
    lowered = np.empty(width, np.float32)
    factors = np.empty((TOGETHER, dimensions), np.float32)
    lowest = np.empty((TOGETHER, LANES), np.float32)
    next_lowest = np.empty((TOGETHER, LANES), np.float32)
    places = np.empty((TOGETHER, LANES), np.int32)
    for piece in range(start, stop):
        cell, at, end = pieces[piece, 0], pieces[piece, 1], pieces[piece, 2]
        first, count = starts[cell], starts[cell + 1] - starts[cell]
        if count == 0:
            continue
        lowered[:] = math.inf
        for c in range(count):
            square = squares[entries[first + c]]
            lowered[c] = square - share * square
        for d in range(dimensions):
            for c in range(count):
                own[d, c] = columns[d, entries[first + c]]
        tiles = -(-count // LANES)
        while at < end:
            for j in range(TOGETHER):
                i = order[min(at + j, end - 1)]
                for d in range(dimensions):
                    factors[j, d] = points[i, d] * -TWO
            closest(factors, own, lowered, tiles, lowest, next_lowest, places)
            for j in range(min(TOGETHER, end - at)):
                i = order[at + j]
                nearest, then, label = least[i], second[i], labels[i]
                for lane in range(LANES):
                    if lowest[j, lane] < nearest:
                        then, nearest = nearest, lowest[j, lane]
                        label = entries[first + places[j, lane] * LANES + lane]
                    else:
                        then = min(then, lowest[j, lane])
                    then = min(then, next_lowest[j, lane])
                least[i], second[i], labels[i] = nearest, then, label
            at += TOGETHER


@parallel_kernel("rows", least=_ROWS)
def nearest_entries(
    start: int, stop: int,
    rows: I64, points: F32, cells: I32, probes: int, starts: I64, columns: F32, squares: F32,
    labels: I32,
) -> None:  # fmt: skip
    """The nearest entry of some points, among those of their first cells.

    rows: (R,) which points; points: (N, D); cells: (N, P); probes: how many of them to look into;
    starts: (C + 1,) the entries of a cell; columns: (D, K or more) the entries; squares: (K,) their
    squared lengths; labels: (N,) out, of these points.
    """
    widest = np.max(starts[1:] - starts[:-1])
    distances = np.empty(widest, np.float32)
    for row in range(start, stop):
        i = rows[row]
        least, chosen = np.float32(math.inf), 0
        for probe in range(probes):
            first, end = starts[cells[i, probe]], starts[cells[i, probe] + 1]
            _distances(points[i], columns, squares, first, end, distances)
            for c in range(end - first):
                entry = first + c
                nearer = distances[c] < least or (distances[c] == least and entry < chosen)
                if nearer:
                    least, chosen = distances[c], entry
        labels[i] = chosen


@parallel_kernel("points", least=_ROWS)
def squared_errors(
    start: int, stop: int, points: F32, columns: F32, labels: I32, errors: F32
) -> None:
    """Squared distances of points and their entries.

    points: (N, D); columns: (D, K or more) the entries; labels: (N,); errors: (N,) out.
    """
    for i in range(start, stop):
        total = np.float32(0)
        for d in range(points.shape[1]):
            step = points[i, d] - columns[d, labels[i]]
            total += step * step
        errors[i] = total


@kernel
def group(labels: I32, starts: I64, order: I64) -> None:
    """List the points of each label, ascending: a counting sort.

    labels: (N,) from 0 to K - 1; starts: (K + 1,) out; order: (N,) out.
    """
    starts[:] = 0
    for label in labels:
        starts[label + 1] += 1
    for k in range(len(starts) - 1):
        starts[k + 1] += starts[k]
    places = starts[:-1].copy()
    for i in range(len(labels)):
        order[places[labels[i]]] = i
        places[labels[i]] += 1


@parallel_kernel("squares", least=_ROWS)
def weighted_means(
    start: int,
    stop: int,
    points: F32,
    weights: F32,
    starts: I64,
    order: I64,
    columns: F32,
    squares: F32,
) -> None:
    """Move each centre to the mean of its points; one without points stays.

    points: (N, D); weights: (N,) positive; starts, order: of `group`; columns: (D, K or more) in
    and out; squares: (K,) out.
    """
    dimensions = points.shape[1]
    for k in range(start, stop):
        if starts[k + 1] > starts[k]:
            total = 0.0
            sums = np.zeros(dimensions)
            for place in range(starts[k], starts[k + 1]):
                i = order[place]
                total += weights[i]
                for d in range(dimensions):
                    sums[d] += weights[i] * points[i, d]
            for d in range(dimensions):
                columns[d, k] = sums[d] / total
        square = np.float32(0)
        for d in range(dimensions):
            square += columns[d, k] * columns[d, k]
        squares[k] = square

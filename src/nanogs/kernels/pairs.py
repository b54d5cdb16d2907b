"""Kernels of the matching: candidate pairs from neighbour lists, and a matching from costs."""

import numpy as np

from nanogs._types import F32, I32, I64, U32, U64, Bool
from nanogs.kernels.policy import inline, kernel, parallel_kernel

_LEAST = 1 << 13  # least number of smaller rows for which a thread scans all neighbours


@inline
def _lists(neighbours: I32, row: int, larger: int) -> bool:
    """Return whether a row's neighbours include a larger row; has no early exit, to be vectorised.

    Another thread may be marking the row meanwhile, which changes only neighbours below the row.
    """
    hits = 0
    for place in range(neighbours.shape[1]):
        hits += neighbours[row, place] == larger
    return hits != 0


@parallel_kernel("neighbours")
def _count_larger(start: int, stop: int, neighbours: I32, starts: I64) -> None:
    """Count the larger neighbours of each row, and mark neighbours as `count_pairs` says."""
    for i in range(start, stop):
        larger = 0
        for place in range(neighbours.shape[1]):
            j = neighbours[i, place]
            larger += i < j
            if j < i and not _lists(neighbours, j, i):
                neighbours[i, place] = ~j
        starts[i + 1] = larger


@parallel_kernel("starts", least=_LEAST, each=1)
def _add_marked(start: int, stop: int, starts: I64, neighbours: I32) -> None:
    """Count the pairs that only their larger row lists, for a range of smaller rows.

    Every thread scans all neighbours, because a list of the marked ones would raise the peak of
    memory.
    """
    for i in range(len(neighbours)):
        for place in range(neighbours.shape[1]):
            j = ~neighbours[i, place]
            if start <= j < stop:  # below 0 if not marked
                starts[j + 1] += 1


def count_pairs(neighbours: I32, starts: I64) -> None:
    """Find where the pairs of each row start; a pair belongs to its smaller row.

    neighbours: (N, k), changed: a neighbour is marked, by its complement, if it is the smaller row
    and does not have this row among its own neighbours; starts: (N + 1,), filled, the last is the
    number of pairs.
    """
    _count_larger(neighbours, starts)
    starts[0] = 0
    _add_marked(starts, neighbours)
    np.cumsum(starts, out=starts)


@parallel_kernel("nexts", least=_LEAST, each=1)
def _fill_marked(start: int, stop: int, neighbours: I32, nexts: U32 | I64, seconds: I32) -> None:
    """Write the larger rows of pairs that only their larger row lists, for some smaller rows."""
    for i in range(len(neighbours)):  # the rows ascend, and so do those given to each smaller one
        for place in range(neighbours.shape[1]):
            j = ~neighbours[i, place]
            if start <= j < stop:
                seconds[nexts[j]] = i
                nexts[j] += 1


@parallel_kernel("neighbours")
def _fill_larger(
    start: int, stop: int, neighbours: I32, starts: I64, nexts: U32 | I64, seconds: I32
) -> None:
    """Insert the larger rows of all other pairs, in order, among those of their smaller row."""
    for i in range(start, stop):
        count = np.int64(nexts[i])
        for place in range(neighbours.shape[1]):
            j = neighbours[i, place]
            if i < j:
                hole = count
                while hole > starts[i] and seconds[hole - 1] > j:
                    seconds[hole] = seconds[hole - 1]
                    hole -= 1
                seconds[hole] = j
                count += 1


def fill_seconds(neighbours: I32, starts: I64, nexts: U32 | I64, seconds: I32) -> None:
    """Write the larger row of each pair of neighbours, in either direction, once and ascending.

    neighbours, starts: from `count_pairs`; nexts: (N,) a copy of the starts, changed;
    seconds: (E,), filled: those of row i from starts[i] to starts[i + 1].
    """
    _fill_marked(neighbours, nexts, seconds)
    _fill_larger(neighbours, starts, nexts, seconds)


@parallel_kernel("starts")
def fill_firsts(start: int, stop: int, starts: I64, firsts: I32) -> None:
    """Write the smaller row of each pair; starts: (N + 1,) from `count_pairs`; firsts: (E,)."""
    for i in range(start, min(stop, len(starts) - 1)):
        for pair in range(starts[i], starts[i + 1]):
            firsts[pair] = i


@inline
def _sortable(cost: np.float32) -> np.uint32:
    """Return an integer that sorts like a cost; -0.0 ties with 0.0."""
    bits = np.float32(cost).view(np.uint32)
    if bits == np.uint32(0x80000000):
        return bits
    return np.uint32(~bits if bits >> np.uint32(31) else bits | np.uint32(0x80000000))


NONE = np.uint64(0xFFFFFFFFFFFFFFFF)


@inline
def _key(costs: F32, edge: int) -> np.uint64:
    """Return an integer that sorts like (cost, row of the pair)."""
    bits = _sortable(costs[edge])
    return np.uint64(bits) << np.uint64(32) | np.uint64(edge)


@parallel_kernel("bounds", least=1, each=32)
def offer_pairs(
    start: int,
    stop: int,
    firsts: I32,
    seconds: I32,
    costs: F32,
    taken: Bool,
    bounds: I64,
    crossing: I32,
    reached: I64,
    size: int,
    bests: U64,
) -> None:
    """Find the cheapest free pair of every row.

    A stretch is a range of rows, and writes to its own rows alone. It considers the pairs whose
    smaller row is in it, and those from earlier stretches whose larger row is in it.

    Args:
        start: First stretch of the range.
        stop: The stretch after its last.
        firsts: (E,) the smaller row of each pair, ascending.
        seconds: (E,) the larger.
        costs: (E,) costs of the pairs; one whose cost is NaN is no candidate.
        taken: (N,) true for rows that are not free.
        bounds: (stretches + 1,) where the pairs of each stretch's smaller rows begin.
        crossing: (C,) pairs whose rows are in two stretches, sorted by that of the larger row.
        reached: (stretches + 1,) where the pairs of each stretch begin in `crossing`.
        size: Number of rows of a stretch.
        bests: (N,) out, `_key` of the pair, or NONE.
    """
    for stretch in range(start, min(stop, len(bounds) - 1)):
        end = min((stretch + 1) * size, len(bests))
        bests[stretch * size : end] = NONE
        for edge in range(bounds[stretch], bounds[stretch + 1]):
            i, j = firsts[edge], seconds[edge]
            if not (taken[i] or taken[j] or np.isnan(costs[edge])):
                key = _key(costs, edge)
                bests[i] = min(bests[i], key)
                if j < end:
                    bests[j] = min(bests[j], key)
        for place in range(reached[stretch], reached[stretch + 1]):
            late = crossing[place]
            i, j = firsts[late], seconds[late]
            if not (taken[i] or taken[j] or np.isnan(costs[late])):
                bests[j] = min(bests[j], _key(costs, late))


@parallel_kernel("bests")
def join_pairs(
    start: int, stop: int, firsts: I32, seconds: I32, bests: U64, taken: Bool, joined: U64
) -> None:
    """Match the pairs that are the cheapest of both their rows.

    firsts, seconds, bests: from `offer_pairs`; taken: (N,), changed; joined: (N,) the key of the
    matched pair of each smaller row, changed.
    """
    for i in range(start, stop):
        if bests[i] != NONE:
            edge = np.int64(bests[i] & np.uint64(0xFFFFFFFF))
            j = seconds[edge]
            if firsts[edge] == i and bests[j] == bests[i]:
                taken[i] = taken[j] = True
                joined[i] = bests[i]


@kernel
def tally_free(firsts: I32, seconds: I32, costs: F32, taken: Bool, counts: I64) -> None:
    """Count the pairs whose rows are both free in a histogram of the upper 16 bits of their costs.

    firsts, seconds, costs: (E,), pairs whose cost is NaN are not counted; taken: (N,); counts:
    (65536,) zeros, filled.
    """
    for edge in range(len(costs)):
        if not (taken[firsts[edge]] or taken[seconds[edge]] or np.isnan(costs[edge])):
            counts[_sortable(costs[edge]) >> np.uint32(16)] += 1


@parallel_kernel("bounds", least=1, each=32)
def collect_free(
    start: int, stop: int,
    firsts: I32, seconds: I32, costs: F32, taken: Bool, bounds: I64, end: int,
    places: I64, without: I64, keys: U64,
) -> None:  # fmt: skip
    """Write the keys, which sort like (cost, row of the pair), of pairs whose rows are both free.

    firsts, seconds, costs, taken, bounds: as `offer_pairs` takes them; end: the least value of the
    upper 16 bits of a cost that is too high; places: (stretches,) where the keys of each stretch
    begin; out, where they end; without: (stretches,), filled: number of pairs whose cost is NaN;
    keys: filled; if it is empty, keys are only counted.
    """
    for stretch in range(start, min(stop, len(bounds) - 1)):
        at, numberless = places[stretch], 0
        for edge in range(bounds[stretch], bounds[stretch + 1]):
            if np.isnan(costs[edge]):
                numberless += 1
                continue
            free = not (taken[firsts[edge]] or taken[seconds[edge]])
            if free and _sortable(costs[edge]) >> np.uint32(16) < end:
                if len(keys) > 0:
                    keys[at] = _key(costs, edge)
                at += 1
        places[stretch], without[stretch] = at, numberless


@kernel
def greedy_matching(
    firsts: I32, seconds: I32, keys: U64, taken: Bool, chosen: U64, count: int
) -> int:  # fmt: skip
    """Match greedily: choose pairs in order if both their rows are free, until there is no room.

    firsts, seconds: (E,); keys: from `collect_free`, sorted; taken: (N,), changed; chosen: (limit,)
    keys of pairs, filled from place `count`. Returns the number of chosen pairs.
    """
    for key in keys:
        if count == len(chosen):
            break
        edge = np.int64(key & np.uint64(0xFFFFFFFF))
        i, j = firsts[edge], seconds[edge]
        if not taken[i] and not taken[j]:
            taken[i] = True
            taken[j] = True
            chosen[count] = key
            count += 1
    return count

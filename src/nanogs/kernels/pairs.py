"""From neighbour lists to candidate pairs, and from costs to a matching."""

import numba
import numpy as np

from nanogs._types import F32, I32, I64, U64, Bool
from nanogs.kernels.policy import inline, kernel, parallel_kernel


@inline
def _lists(neighbours: I32, row: int, value: int) -> bool:
    """Whether a row's neighbours hold a value; without an early exit, the loop is vectorised."""
    hits = 0
    for place in range(neighbours.shape[1]):
        hits += neighbours[row, place] == value
    return hits != 0


@parallel_kernel
def count_pairs(neighbours: I32, one_sided: Bool, starts: I64) -> None:
    """Find where the pairs of each row start; a pair belongs to its smaller row.

    neighbours: (N, k); one_sided: (N, k), filled: the neighbour is the smaller row and does not
    have this row among its own; starts: (N + 1,), filled, the last is the number of pairs.
    """
    n, k = neighbours.shape
    for i in numba.prange(n):
        larger = 0
        for place in range(k):
            j = neighbours[i, place]
            larger += i < j
            one_sided[i, place] = j < i and not _lists(neighbours, j, i)
        starts[i + 1] = larger
    for i in range(n):
        for place in range(k):
            if one_sided[i, place]:
                starts[neighbours[i, place] + 1] += 1
    starts[0] = 0
    for i in range(n):
        starts[i + 1] += starts[i]


@parallel_kernel
def fill_pairs(neighbours: I32, one_sided: Bool, starts: I64, nexts: I64, pairs: I32) -> None:
    """Each unordered pair of the union of both directions once, ascending.

    neighbours, one_sided, starts: see `count_pairs`; nexts: (N,) a copy of the starts, changed;
    pairs: (E, 2), filled, smaller row first.
    """
    n, k = neighbours.shape
    for i in range(n):  # the rows i ascend, and so do those given to each j
        for place in range(k):
            if one_sided[i, place]:
                j = neighbours[i, place]
                pairs[nexts[j], 1] = i
                nexts[j] += 1
    for i in numba.prange(n):
        count = nexts[i]
        for place in range(k):
            j = neighbours[i, place]
            if i < j:
                hole = count
                while hole > starts[i] and pairs[hole - 1, 1] > j:
                    pairs[hole, 1] = pairs[hole - 1, 1]
                    hole -= 1
                pairs[hole, 1] = j
                count += 1
        for pair in range(starts[i], count):
            pairs[pair, 0] = i


@kernel
def greedy_matching(pairs: I32, keys: U64, taken: Bool, limit: int, chosen: I64) -> int:
    """Walk the pairs in order and choose those whose ends are both free, at most `limit`.

    pairs: (E, 2); keys: (E',) from `cost_keys`, sorted; taken: (N,) all False, changed;
    chosen: (limit,) rows of pairs, filled in order. Returns how many were chosen.
    """
    count = 0
    for key in keys:
        if count == limit:
            break
        edge = np.int64(key & np.uint64(0xFFFFFFFF))
        i = pairs[edge, 0]
        j = pairs[edge, 1]
        if not taken[i] and not taken[j]:
            taken[i] = True
            taken[j] = True
            chosen[count] = edge
            count += 1
    return count


@kernel
def cost_keys(costs: F32, keys: U64) -> int:
    """Integers that sort like (cost, row of the pair); pairs whose cost is NaN are left out.

    costs: (E,); keys: (E,), the first of which are filled. Returns how many.
    The bits of a float sort like integers once negative ones are reversed.
    """
    bits = costs.view(np.uint32)
    count = 0
    for edge in range(len(costs)):
        if np.isnan(costs[edge]):
            continue
        b = bits[edge] if costs[edge] != 0 else np.uint32(0)  # -0.0 ties with 0.0
        b = ~b if b >> np.uint32(31) else b | np.uint32(0x80000000)
        keys[count] = np.uint64(b) << np.uint64(32) | np.uint64(edge)
        count += 1
    return count

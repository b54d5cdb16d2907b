"""From neighbour lists to candidate pairs, and from costs to a matching."""

import numpy as np

from nanogs._types import F32, I32, I64, U64, Bool
from nanogs.kernels.policy import inline, kernel


@inline
def _contains(row: I32, value: int) -> bool:
    for position in range(len(row)):  # noqa: SIM110 - kernels hold no generators
        if row[position] == value:
            return True
    return False


@kernel
def count_pairs(neighbours: I32) -> int:
    """Number of unordered pairs in the union of both directions of (N, k) neighbour lists."""
    count = 0
    for i in range(neighbours.shape[0]):
        for position in range(neighbours.shape[1]):
            j = neighbours[i, position]
            if i < j or not _contains(neighbours[j], i):
                count += 1
    return count


@kernel
def fill_pairs(neighbours: I32, packed: U64) -> None:
    """Each unordered pair once, as (smaller row << 32 | larger row); unsorted."""
    count = 0
    for i in range(neighbours.shape[0]):
        for position in range(neighbours.shape[1]):
            j = neighbours[i, position]
            if i < j:
                packed[count] = np.uint64(i) << np.uint64(32) | np.uint64(j)
                count += 1
            elif not _contains(neighbours[j], i):
                packed[count] = np.uint64(j) << np.uint64(32) | np.uint64(i)
                count += 1


@kernel
def greedy_matching(pairs: I32, keys: U64, taken: Bool, limit: int, chosen: I64) -> int:
    """Walk the pairs in order and choose those whose ends are both free, at most `limit`.

    pairs: (E, 2); keys: (E',) from `sort_keys`, sorted; taken: (N,) all False, changed;
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
def sort_keys(costs: F32, keys: U64) -> int:
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

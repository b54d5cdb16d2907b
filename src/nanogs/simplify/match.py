"""Stage 4, match: choose disjoint pairs, cheapest first. No geometry here, only rows and costs."""

from dataclasses import dataclass

import numpy as np

from nanogs._types import F32, I32, I64, U64, Bool
from nanogs.kernels.pairs import collect_free, greedy_matching, tally_free
from nanogs.kernels.radix import radix_sort

# The pairs are sorted in batches, the cheapest first: those that an earlier batch made impossible
# are never sorted, and the keys take little memory.
BATCH = 0.5  # pairs for each row
SMALLEST_BATCH = 1 << 16


@dataclass(frozen=True, slots=True, eq=False)
class MergePlan:
    """Which rows become one.

    Attributes:
        pairs: (P, 2) int32, i < j, no row twice; cheapest first.
        costs: (P,) float32, ascending.
        without_cost: Candidates left out because their cost is NaN.
    """

    pairs: I32
    costs: F32
    without_cost: int

    def __len__(self) -> int:
        return len(self.pairs)


def match(pairs: I32, costs: F32, rows: int, limit: int) -> MergePlan:
    """Take pairs in ascending order of (cost, pair) while both ends are free.

    Args:
        pairs: (E, 2) candidates, i < j, ascending.
        costs: (E,) float32; a pair whose cost is NaN is no candidate.
        rows: Number of rows the pairs index.
        limit: Most pairs to take.
    """
    firsts, seconds = pairs.T
    taken = np.zeros(rows, dtype=bool)
    chosen: I64 = np.empty(limit, dtype=np.int64)
    room = max(int(BATCH * rows), SMALLEST_BATCH)
    count, without_cost = 0, 0
    while count < limit:
        counts = np.zeros(1 << 16, dtype=np.int64)
        without_cost = tally_free(firsts, seconds, costs, taken, counts)
        if not counts.any():
            break
        end = _end_of_batch(counts, room)
        keys = _sorted_keys(firsts, seconds, costs, taken, end, int(counts[:end].sum()))
        count = greedy_matching(firsts, seconds, keys, taken, chosen, count)
        del keys
    chosen = chosen[:count]
    matched = np.stack((firsts[chosen], seconds[chosen]), axis=1)
    return MergePlan(matched, costs[chosen], without_cost)


def _end_of_batch(counts: I64, room: int) -> int:
    """Upper halves of cost bits up to which the pairs fit into the room, or the lowest alone."""
    lowest = int(np.argmax(counts > 0))
    return max(int(np.searchsorted(np.cumsum(counts), room, side="right")), lowest + 1)


def _sorted_keys(
    firsts: I32, seconds: I32, costs: F32, taken: Bool, end: int, count: int
) -> U64:  # fmt: skip
    keys: U64 = np.empty(count, dtype=np.uint64)
    other: U64 = np.empty(count, dtype=np.uint64)
    collect_free(firsts, seconds, costs, taken, end, keys)
    return other if radix_sort(keys, other) else keys

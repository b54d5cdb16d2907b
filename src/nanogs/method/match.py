"""Stage 4, match: choose disjoint pairs, cheapest first. No geometry here, only rows and costs."""

from dataclasses import dataclass

import numpy as np

from nanogs._types import F32, I32, I64, U64, Bool
from nanogs.errors import ModelError
from nanogs.kernels.pairs import (
    NONE,
    collect_free,
    greedy_matching,
    join_pairs,
    offer_crossing,
    offer_pairs,
    tally_free,
)
from nanogs.kernels.radix import radix_sort
from nanogs.method.slices import SLICE_PAIRS, slices

# The pairs are sorted in batches, the cheapest first: those that an earlier batch made impossible
# are never sorted, and the keys take little memory.
BATCH = 0.5  # pairs for each row
SMALLEST_BATCH = 1 << 16
STRETCH = 1 << 16  # rows that one thread goes through; fixed, so that threads do not matter
MOST_PAIRS = (1 << 31) - 1
FEW = 0.01  # share of the rows that is no longer worth a round


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

    A pair that is the cheapest of both its rows is taken whatever the order of the others (Preis,
    "Linear time 1/2-approximation algorithm for maximum weighted matching", 1999). So rounds of
    taking all of these, in which rows need not wait for each other, come before sorting the few
    pairs that are left: the matching is the same.

    Args:
        pairs: (E, 2) candidates, i < j, ascending.
        costs: (E,) float32; a pair whose cost is NaN is no candidate.
        rows: Number of rows the pairs index.
        limit: Most pairs to take.

    Raises:
        ModelError: There are more pairs than their numbers have bits for.
    """
    if len(pairs) > MOST_PAIRS:
        raise ModelError(
            f"The graph has {len(pairs):,} pairs, and {MOST_PAIRS:,} can be matched at once; ask"
            " for fewer neighbours with `k`, or for blocks with `max_memory`."
        )
    firsts, seconds = pairs.T
    taken = np.zeros(rows, dtype=bool)
    joined = _agree(firsts, seconds, costs, taken)
    left, without_cost = _match_sorted(firsts, seconds, costs, taken)
    keys = np.concatenate((joined, left))
    del joined, left
    keys.sort()
    chosen = (keys[:limit] & np.uint64(0xFFFFFFFF)).astype(np.int64)
    matched = np.stack((firsts[chosen], seconds[chosen]), axis=1)
    return MergePlan(matched, costs[chosen], without_cost)


def _agree(firsts: I32, seconds: I32, costs: F32, taken: Bool) -> U64:
    """Keys of the pairs that are the cheapest of both their rows, then of those left, and so on.

    It ends when a round takes few: in a chain of ascending costs each round would take one.
    """
    rows = len(taken)
    stretches = -(-rows // STRETCH)
    starts = np.minimum(np.arange(stretches + 1) * STRETCH, rows)
    # Of the pairs' own type: they would be copied otherwise.
    bounds = np.searchsorted(firsts, starts.astype(np.int32))
    crossing = _crossing(firsts, seconds)
    bests: U64 = np.empty(rows, dtype=np.uint64)
    joined: U64 = np.full(rows, NONE, dtype=np.uint64)
    before, now = -rows, 0
    while now - before > FEW * rows:
        offer_pairs(firsts, seconds, costs, taken, bounds, STRETCH, bests)
        offer_crossing(firsts, seconds, costs, taken, crossing, bests)
        join_pairs(firsts, seconds, bests, taken, joined)
        before, now = now, int(np.count_nonzero(taken))
    del bests
    keys: U64 = joined[joined != NONE]
    return keys


def _crossing(firsts: I32, seconds: I32) -> I32:
    """Rows of the pairs whose rows are in two stretches."""
    found = [
        np.flatnonzero(firsts[part] // STRETCH != seconds[part] // STRETCH).astype(np.int32)
        + np.int32(part.start)
        for part in slices(len(firsts), SLICE_PAIRS)
    ]
    return np.concatenate([*found, np.empty(0, np.int32)])


def _match_sorted(firsts: I32, seconds: I32, costs: F32, taken: Bool) -> tuple[U64, int]:
    """Keys of the pairs that are taken of what is free, and how many pairs have no cost."""
    chosen: U64 = np.empty((len(taken) - np.count_nonzero(taken)) // 2, dtype=np.uint64)
    room = max(int(BATCH * len(taken)), SMALLEST_BATCH)
    count = 0
    while True:
        counts = np.zeros(1 << 16, dtype=np.int64)
        without_cost = tally_free(firsts, seconds, costs, taken, counts)
        if not counts.any():
            return chosen[:count], without_cost
        end = _end_of_batch(counts, room)
        keys = _sorted_keys(firsts, seconds, costs, taken, end, int(counts[:end].sum()))
        count = greedy_matching(firsts, seconds, keys, taken, chosen, count)
        del keys


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

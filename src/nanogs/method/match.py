"""Choose disjoint pairs, cheapest first, from rows and costs alone.

A stage of both methods; stage 4 of the published one.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from nanogs import parallel
from nanogs._types import F32, I32, I64, U64, Bool
from nanogs.errors import ModelError
from nanogs.kernels.pairs import (
    NONE,
    collect_free,
    greedy_matching,
    join_pairs,
    offer_pairs,
    tally_free,
)
from nanogs.slices import SLICE_STEPS, slices

# The pairs are sorted in batches, the cheapest first: pairs whose rows an earlier batch has taken
# are never sorted, and the keys take little memory.
BATCH = 0.5  # pairs in a batch, for each row
SMALLEST_BATCH = 1 << 16
STRETCH = 1 << 15  # rows in a unit of work; fixed, so that results do not depend on threads
MOST_PAIRS = (1 << 31) - 1
ALL = 1 << 16  # number of values of the upper half of a cost's bits
FEW = 0.01  # least share of the rows that a round must take to be followed by another


@dataclass(frozen=True, slots=True, eq=False)
class MergePlan:
    """The pairs of rows to merge.

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


class _Candidates(NamedTuple):
    """The pairs that may be matched, and the rows that are matched so far.

    Attributes:
        firsts: (E,) int32, the smaller row of each pair, ascending.
        seconds: (E,) int32, the larger row of each pair.
        costs: (E,) float32; NaN for a pair that is no candidate.
        taken: (N,) bool, the rows that are matched; changed by each stage of the matching.
        bounds: (S + 1,) int64, first pair whose smaller row is in each stretch of rows, and E.
    """

    firsts: I32
    seconds: I32
    costs: F32
    taken: Bool
    bounds: I64


def match(pairs: I32, costs: F32, rows: int, limit: int) -> MergePlan:
    """Match greedily: take pairs in ascending order of (cost, pair) while both ends are free.

    A pair that is the cheapest of both its rows is always taken, independent of the order of the
    others (Preis, "Linear time 1/2-approximation algorithm for maximum weighted matching", 1999).
    So rounds that take all of these in parallel come first, and only the few pairs that are left
    are sorted: the matching is the same.

    Args:
        pairs: (E, 2) candidates, i < j, ascending.
        costs: (E,) float32; a pair whose cost is NaN is no candidate.
        rows: Number of rows that the pairs refer to.
        limit: Most pairs to take.

    Raises:
        ModelError: There are more pairs than fit into the bits of a key.
    """
    if len(pairs) > MOST_PAIRS:
        raise ModelError(
            f"The graph has {len(pairs):,} pairs, but at most {MOST_PAIRS:,} can be matched at"
            " once; use fewer neighbours (`k`), or blocks (`max_memory`)."
        )
    firsts, seconds = pairs.T
    taken = np.zeros(rows, dtype=bool)
    stretches = -(-rows // STRETCH)
    starts = np.minimum(np.arange(stretches + 1) * STRETCH, rows)
    # int32 like the pairs, which would be copied otherwise.
    bounds = np.searchsorted(firsts, starts.astype(np.int32))
    candidates = _Candidates(firsts, seconds, costs, taken, bounds)
    joined = _agree(candidates, starts)
    left, without_cost = _match_sorted(candidates)
    keys = np.concatenate((*joined, left))
    del joined, left
    keys.sort()
    keys = keys[:limit]
    matched, matched_costs = np.empty((len(keys), 2), np.int32), np.empty(len(keys), np.float32)

    def look_up(part: slice) -> None:
        chosen = (keys[part] & np.uint64(0xFFFFFFFF)).astype(np.int64)
        matched[part, 0], matched[part, 1] = firsts.take(chosen), seconds.take(chosen)
        matched_costs[part] = costs.take(chosen)

    parallel.for_each(slices(len(keys), SLICE_STEPS), look_up)
    return MergePlan(matched, matched_costs, without_cost)


def _agree(candidates: _Candidates, starts: I64) -> list[U64]:
    """Take pairs that are the cheapest of both their rows, in rounds; return their keys in parts.

    Stops when a round takes few: in a chain of ascending costs each round would take one.

    Args:
        candidates: The pairs.
        starts: (S + 1,) first row of each stretch, and the number of rows.
    """
    firsts, seconds, _, taken, bounds = candidates
    rows, stretches = len(taken), len(starts) - 1
    crossing, reached = _crossing(seconds, starts, bounds)
    bests: U64 = np.empty(rows, dtype=np.uint64)
    joined: U64 = np.full(rows, NONE, dtype=np.uint64)
    before, now = -rows, 0
    while now - before > FEW * rows:
        offer_pairs(*candidates, crossing, reached, STRETCH, bests)
        join_pairs(firsts, seconds, bests, taken, joined)
        before, now = now, int(np.count_nonzero(taken))
    del bests

    def collect(stretch: int) -> U64:
        some = joined[starts[stretch] : starts[stretch + 1]]
        found: U64 = some[some != NONE]
        return found

    return parallel.map_ordered(range(stretches), collect)


def _crossing(seconds: I32, starts: I64, bounds: I64) -> tuple[I32, I64]:
    """List the pairs whose rows are in two stretches, by the stretch of the larger row.

    Args:
        seconds: (E,) the larger row of each pair.
        starts: (S + 1,) first row of each stretch, and the number of rows.
        bounds: (S + 1,) first pair whose smaller row is in each stretch, and the number of pairs.

    Returns:
        (C,) int32 pairs, and (S + 1,) int64, the start of those of each stretch.
    """
    stretches = len(starts) - 1

    def find(stretch: int) -> I32:
        some = seconds[bounds[stretch] : bounds[stretch + 1]]
        crossing = np.flatnonzero(some >= starts[stretch + 1]).astype(np.int32)
        return crossing + np.int32(bounds[stretch])

    found = parallel.map_ordered(range(stretches), find)
    pairs = np.concatenate([*found, np.empty(0, np.int32)])
    # Rows are int32: fewer than 2^31, which is at most 2^16 stretches.
    reached = (seconds.take(pairs) // STRETCH).astype(np.uint16)
    order = np.argsort(reached, kind="stable")
    ends = np.searchsorted(reached.take(order), np.arange(stretches + 1))
    return pairs.take(order), ends


def _match_sorted(candidates: _Candidates) -> tuple[U64, int]:
    """Match the free rows by sorting; return the keys of the pairs and the number without cost."""
    firsts, seconds, costs, taken, _ = candidates
    chosen: U64 = np.empty((len(taken) - np.count_nonzero(taken)) // 2, dtype=np.uint64)
    most_pairs = max(int(BATCH * len(taken)), SMALLEST_BATCH)
    count, end = 0, 0
    while end < ALL:
        end = ALL
        free, without_cost = _count_free(candidates, end)
        if free.sum() > most_pairs:
            counts = np.zeros(ALL, dtype=np.int64)
            tally_free(firsts, seconds, costs, taken, counts)
            end = _end_of_batch(counts, most_pairs)
            free, _ = _count_free(candidates, end)
        keys = _sorted_keys(candidates, end, free)
        count = greedy_matching(firsts, seconds, keys, taken, chosen, count)
        del keys
    return chosen[:count], without_cost


def _count_free(candidates: _Candidates, end: int) -> tuple[I64, int]:
    """Count pairs of free rows below a bound of the cost.

    Args:
        candidates: The pairs.
        end: Exclusive bound of the upper half of a cost's bits.

    Returns:
        (S,) int64 count for each stretch, and the number of pairs whose cost is NaN.
    """
    free, without = np.zeros((2, len(candidates.bounds) - 1), dtype=np.int64)
    none: U64 = np.empty(0, dtype=np.uint64)
    collect_free(*candidates, end, free, without, none)
    return free, int(without.sum())


def _end_of_batch(counts: I64, most_pairs: int) -> int:
    """Return the exclusive bound of a batch: as many upper halves as make up to `most_pairs`.

    Args:
        counts: (ALL,) number of pairs by the upper half of their cost's bits.
        most_pairs: Most pairs of a batch; the lowest upper half with any is taken in any case.
    """
    lowest = int(np.argmax(counts > 0))
    return max(int(np.searchsorted(np.cumsum(counts), most_pairs, side="right")), lowest + 1)


def _sorted_keys(candidates: _Candidates, end: int, free: I64) -> U64:
    """Return the ascending keys of the pairs that `_count_free` has counted, as `free`."""
    keys: U64 = np.empty(int(free.sum()), dtype=np.uint64)
    if len(keys):
        places, without = np.cumsum(free) - free, np.empty_like(free)
        collect_free(*candidates, end, places, without, keys)
    keys.sort()
    return keys

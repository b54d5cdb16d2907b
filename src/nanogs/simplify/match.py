"""Stage 4, match: choose disjoint pairs, cheapest first. No geometry here, only rows and costs."""

from dataclasses import dataclass

import numpy as np

from nanogs._types import F32, I32, I64, U64
from nanogs.kernels.pairs import cost_keys, greedy_matching
from nanogs.kernels.radix import radix_sort


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
    keys: U64 = np.empty(len(costs), dtype=np.uint64)
    keys = keys[: cost_keys(costs, keys)]
    other: U64 = np.empty_like(keys)
    if radix_sort(keys, other):
        keys = other
    chosen: I64 = np.empty(limit, dtype=np.int64)
    count = greedy_matching(pairs, keys, np.zeros(rows, dtype=bool), limit, chosen)
    chosen = chosen[:count]
    return MergePlan(pairs[chosen], costs[chosen], len(costs) - len(keys))

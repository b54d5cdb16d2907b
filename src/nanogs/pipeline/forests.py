"""The merge forest of each block, and how late each of its merges is to be done."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace

import numpy as np

from nanogs._types import F32, I64, U32, Array
from nanogs.method.cut import merge_scores
from nanogs.method.forest import grow_forest
from nanogs.method.nodes import Nodes
from nanogs.method.parameters import ForestParameters
from nanogs.progress import untold
from nanogs.report import PassReport
from nanogs.store.scratch import Scratch
from nanogs.store.tables import Record, Sorted, write_table

CHILDREN = "children"
BINS = 1 << 16


def scores_of(balance: int) -> str:
    """Name of the column of scores of a balance, by its number."""
    return f"scores_{balance}"


def histogram_of(balance: int) -> str:
    """Name of the column of their histogram."""
    return f"histogram_{balance}"


def grow(
    scratch: Scratch,
    name: str,
    leaves: Callable[[], Nodes],
    parameters: ForestParameters,
    balances: Sequence[float],
    threads: int,
) -> Record:
    """Grow a block's forest and write its merges, their scores and a histogram of these.

    Args:
        scratch: Where to.
        name: Of the table.
        leaves: Makes the block's nodes, in units that all blocks share; none are kept.
        parameters: Of the method.
        balances: Of the cuts that are going to be made of it.
        threads: Threads for the nearest-neighbour query.
    """
    forest = grow_forest(leaves(), parameters, threads, untold)
    columns: dict[str, Array | Sorted] = {CHILDREN: forest.children}
    for number, balance in enumerate(balances):
        # Errors are not over the block's own median, so that scores of all blocks compare. In
        # single precision none falls below those of the merges under it: rounding keeps the order.
        scores = merge_scores(forest, balance, 1.0).astype(np.float32)
        columns[scores_of(number)] = scores
        columns[histogram_of(number)] = np.bincount(keys(scores) >> 16, minlength=BINS)
    facts = {
        "splats": forest.splats,
        "fewest": forest.fewest,
        "stop": str(forest.stop),
        # No seconds: they would differ from run to run.
        "passes": [asdict(replace(each, seconds={})) for each in forest.passes],
    }
    return write_table(scratch, name, columns, facts)


def passes_of(forests: Sequence[Record]) -> tuple[PassReport, ...]:
    """The passes of all forests, added up; a forest of fewer passes stays at what it has left."""
    passes = [[PassReport(**each) for each in record.facts["passes"]] for record in forests]
    found = []
    for number in range(max(map(len, passes), default=0)):
        here = [each[number] for each in passes if number < len(each)]
        left = sum(each[-1].count_after for each in passes if each and number >= len(each))
        costs = [each.highest_cost for each in here if each.highest_cost is not None]
        found.append(
            PassReport(
                count_before=left + sum(each.count_before for each in here),
                candidates=sum(each.candidates for each in here),
                without_cost=sum(each.without_cost for each in here),
                merged=sum(each.merged for each in here),
                count_after=left + sum(each.count_after for each in here),
                highest_cost=max(costs, default=None),
                seconds={},
            )
        )
    return tuple(found)


def keys(scores: F32) -> U32:
    """(M,) uint32 keys that sort as the scores do, unlike the bits of floats below zero."""
    bits = (scores + np.float32(0)).view(np.uint32)  # -0 becomes 0
    negative = bits >> 31 != 0
    result: U32 = np.where(negative, ~bits, bits | np.uint32(1 << 31))
    return result


def counts_of(low_bits: U32) -> I64:
    """(65536,) how often each low half of a key occurs."""
    counts: I64 = np.bincount(low_bits & 0xFFFF, minlength=BINS)
    return counts

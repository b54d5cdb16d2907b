"""The merge forest of each block, and the scores that order its merges."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace

import numpy as np

from nanogs._types import F32, U32, Array
from nanogs.method.correct import Correction
from nanogs.method.cut import merge_scores
from nanogs.method.forest import grow_forest
from nanogs.method.nodes import Nodes
from nanogs.method.parameters import ForestParameters
from nanogs.pipeline.scene import SUMS
from nanogs.progress import ignore_progress
from nanogs.report import PassReport
from nanogs.store.scratch import Scratch
from nanogs.store.tables import Record, Sorted, write_table

CHILDREN = "children"
_BALANCES = "balances"  # fact of a forest: the balances whose scores it has
BINS = 1 << 16


def scores_of(number: int) -> str:
    """Return the name of the column with the merge scores of a balance, by its number."""
    return f"scores_{number}"


def histogram_of(number: int) -> str:
    """Return the name of the column with the histogram of these scores."""
    return f"histogram_{number}"


def number_of(forest: Record, balance: float) -> int:
    """Return the number of a balance whose scores a forest has; see `scores_of`."""
    balances: list[float] = forest.facts[_BALANCES]
    return balances.index(balance)


def grow(
    scratch: Scratch,
    name: str,
    leaves: Callable[[], Nodes],
    parameters: ForestParameters,
    balances: Sequence[float],
) -> Record:
    """Grow a block's forest and write its merges, their scores and a histogram of the scores.

    Args:
        scratch: Storage to write to.
        name: Name of the table.
        leaves: Makes the block's nodes, in units that all blocks share; no reference is kept here.
        parameters: Parameters of the method.
        balances: Balances of the cuts that will be made of the forest.
    """
    forest = grow_forest(leaves(), parameters, ignore_progress)
    columns: dict[str, Array | Sorted] = {CHILDREN: forest.children}
    for number, balance in enumerate(balances):
        # Errors are not divided by the block's own median, so that the scores of all blocks are
        # comparable. Rounding to float32 is monotonic: no merge's score falls below its children's.
        scores = merge_scores(forest, balance, 1.0).astype(np.float32)
        columns |= _scores(scores, number)
    facts = {
        **_size(forest.splats, forest.fewest),
        _BALANCES: [*balances],
        "stop": str(forest.stop),
        # Without seconds, which would differ from run to run: tables are the same byte for byte.
        "passes": [asdict(replace(each, seconds={})) for each in forest.passes],
    }
    return write_table(scratch, name, columns, facts)


def write_correction(scratch: Scratch, name: str, splats: int, correction: Correction) -> Record:
    """Write the corrected scores of a block's merges, with their histogram, as `grow` does.

    Args:
        scratch: Storage to write to.
        name: Name of the table.
        splats: Number of splats of the block.
        correction: The scores.
    """
    scores = correction.scores.astype(np.float32)
    facts = {**_size(splats, splats - len(scores)), SUMS: correction.sums.tolist()}
    return write_table(scratch, name, _scores(scores, 0), facts)


def _scores(scores: F32, number: int) -> dict[str, Array]:
    histogram = np.bincount(keys(scores) >> 16, minlength=BINS)
    return {scores_of(number): scores, histogram_of(number): histogram}


def _size(splats: int, fewest: int) -> dict[str, int]:
    return {"splats": splats, "fewest": fewest}


def passes_of(forests: Sequence[Record]) -> tuple[PassReport, ...]:
    """Add up the passes of all forests; one with fewer passes counts with its last nodes."""
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
    """Return (M,) uint32 keys in the order of the scores, for radix selection on the bits.

    The bits of negative floats would sort in reverse, and after the positive ones.
    """
    bits = (scores + np.float32(0)).view(np.uint32)  # -0 becomes 0
    negative = bits >> 31 != 0
    result: U32 = np.where(negative, ~bits, bits | np.uint32(1 << 31))
    return result

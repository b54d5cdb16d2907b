"""How many groups each block keeps: the merges of lowest score of all blocks are done.

The one threshold is found by radix selection over the scores' bits: a histogram of the upper half
of all scores, then one of the lower half of those in the bin that holds the threshold.
"""

from collections.abc import Sequence

import numpy as np

from nanogs._types import I64, Array
from nanogs.pipeline.forests import BINS, counts_of, histogram_of, keys, scores_of
from nanogs.store.scratch import Scratch
from nanogs.store.tables import Record, Table


def budget(scratch: Scratch, forests: Sequence[Record], target: int, balance: int = 0) -> list[int]:
    """Groups of each block, as many as are asked for in all, or the fewest that there can be.

    Ties are given to the blocks in their order.

    Args:
        scratch: Where the forests are.
        forests: Their records.
        target: Groups in all.
        balance: Number of the one by whose scores.
    """
    splats = np.array([int(record.facts["splats"]) for record in forests], np.int64)
    merges = splats - np.array([int(record.facts["fewest"]) for record in forests], np.int64)
    wanted = int(min(splats.sum() - target, merges.sum()))
    if wanted <= 0:
        return [int(n) for n in splats]
    upper = np.stack([_read(scratch, record, histogram_of(balance)) for record in forests])
    high, done, left = _select(upper, wanted)
    lower = np.zeros((len(forests), BINS), np.int64)
    for row, record in enumerate(forests):
        if upper[row, high]:
            found = keys(_read(scratch, record, scores_of(balance)))
            lower[row] = counts_of(found[found >> 16 == high])
    low, more, left = _select(lower, left)
    ties = lower[:, low]
    taken = np.clip(left - (np.cumsum(ties) - ties), 0, ties)
    return [int(n) for n in splats - done - more - taken]


def _select(histograms: I64, wanted: int) -> tuple[int, I64, int]:
    """The bin in which the last one wanted lies.

    Args:
        histograms: (B, bins) of each block.
        wanted: How many are to be taken from the lowest bins, 1 or more.

    Returns:
        The bin; (B,) how many lie below it in each block; how many are still wanted of it.
    """
    below = np.cumsum(histograms.sum(axis=0))
    chosen = int(np.searchsorted(below, wanted))
    done: I64 = histograms[:, :chosen].sum(axis=1)
    return chosen, done, wanted - int(done.sum())


def _read(scratch: Scratch, record: Record, column: str) -> Array:
    with Table(scratch, record) as table:
        return table.read(column)

"""Number of groups that each block keeps, so that the merges of lowest score overall are done.

The threshold common to all blocks is found by radix selection over the bits of the scores: a
histogram of the upper halves of all scores, then one of the lower halves of the scores in the bin
that holds the threshold.
"""

from collections.abc import Sequence

import numpy as np

from nanogs._types import F32, F64, I64, U32
from nanogs.pipeline.tasks.forests import BINS, histogram_of, keys, scores_of
from nanogs.store.scratch import Scratch
from nanogs.store.tables import Record, read_column


def budget(
    scratch: Scratch,
    forests: Sequence[Record],
    target: int,
    number: int = 0,
    shifts: F64 | None = None,
) -> list[int]:
    """Divide a total number of groups among the blocks by one threshold on the merge scores.

    Merges whose score equals the threshold are done in the order of the blocks. If `target` is less
    than the forests can be merged to, each block keeps the fewest groups that it can.

    Args:
        scratch: Storage of the forests.
        forests: Their records.
        target: Number of groups of all blocks together.
        number: Of the balance whose scores are used.
        shifts: (B,) added to the scores of each block; by default 0.

    Returns:
        Number of groups of each block.
    """
    splats = np.array([int(record.facts["splats"]) for record in forests], np.int64)
    merges = splats - np.array([int(record.facts["fewest"]) for record in forests], np.int64)
    wanted = int(min(splats.sum() - target, merges.sum()))
    if wanted <= 0:
        return [int(n) for n in splats]
    shifted = np.zeros(len(forests)) if shifts is None else shifts

    def keys_in(row: int) -> U32:
        scores: F32 = read_column(scratch, forests[row], scores_of(number))
        return keys(scores + np.float32(shifted[row]))

    upper = np.stack([
        np.bincount(keys_in(row) >> 16, minlength=BINS)
        if shifted[row]
        else read_column(scratch, record, histogram_of(number))
        for row, record in enumerate(forests)
    ])  # fmt: skip
    high, done, left = _select(upper, wanted)
    lower = np.zeros((len(forests), BINS), np.int64)
    for row in range(len(forests)):
        if upper[row, high]:
            found = keys_in(row)
            lower[row] = np.bincount(found[found >> 16 == high] & 0xFFFF, minlength=BINS)
    low, more, left = _select(lower, left)
    ties = lower[:, low]
    taken = np.clip(left - (np.cumsum(ties) - ties), 0, ties)
    return [int(n) for n in splats - done - more - taken]


def _select(histograms: I64, wanted: int) -> tuple[int, I64, int]:
    """Find the bin that holds the `wanted`-th lowest element of all blocks.

    Args:
        histograms: (B, bins), one of each block.
        wanted: Number of elements to take from the lowest bins, at least 1.

    Returns:
        The bin; (B,) number of elements of each block below it; how many to take from the bin.
    """
    below = np.cumsum(histograms.sum(axis=0))
    chosen = int(np.searchsorted(below, wanted))
    done: I64 = histograms[:, :chosen].sum(axis=1)
    return chosen, done, wanted - int(done.sum())

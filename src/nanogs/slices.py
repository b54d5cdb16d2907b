"""Processing of rows in slices, so that temporary arrays take negligible memory."""

from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence

from nanogs._types import I64
from nanogs.threads import most_threads

SLICE = 1 << 13  # rows; few, because the allocator keeps the memory that each thread has freed
# Rows for a few simple steps on few numbers each: long enough that threads do not wait for the GIL.
SLICE_STEPS = 1 << 15
SLICE_PAIRS = 1 << 15  # pairs; a kernel takes milliseconds for these
# Rows read, decoded or encoded at a time: bounds the memory used beside the model. With 250 bytes
# per row a block of this size fits into the cache and is encoded twice as fast as one of 64 K rows.
BLOCK_ROWS = 1 << 13
_FEWEST_THREADS = 16  # so that plans are the same on all machines with at most so many


def slices(count: int, size: int = SLICE) -> Iterator[slice]:
    """Iterate over consecutive slices of `size` rows."""
    for start in range(0, count, size):
        yield slice(start, min(start + size, count))


def overlapping(ends: Sequence[int] | I64, start: int, stop: int) -> Iterator[tuple[int, int, int]]:
    """Yield each part that holds some of rows `start` to `stop`: its number, and their range in it.

    `ends` has P + 1 entries, ascending: where each part begins, and the end of the last.
    """
    for number in range(bisect_right(ends, start) - 1, bisect_left(ends, stop)):
        first, end = int(ends[number]), int(ends[number + 1])
        if max(start, first) < min(stop, end):  # not for an empty part
            yield number, max(start, first) - first, min(stop, end) - first


def pairs_in_flight() -> int:
    """Return the number of pairs that all threads process at once, for planning memory.

    Fewer threads may be in use, but a plan, and with it the result, must not depend on that.
    """
    return max(most_threads(), _FEWEST_THREADS) * SLICE_PAIRS

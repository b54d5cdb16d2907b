"""Processing of rows in slices, so that temporary arrays take negligible memory."""

from collections.abc import Iterator

SLICE = 1 << 13  # rows; few, because the allocator keeps the memory that each thread has freed
# Rows for a few simple steps on few numbers each: long enough that threads do not wait for the GIL.
SLICE_STEPS = 1 << 15
SLICE_PAIRS = 1 << 15  # pairs; a kernel takes milliseconds for these
PAIRS_IN_FLIGHT = 16 * SLICE_PAIRS  # pairs that 16 threads process at once, for planning memory


def slices(count: int, size: int = SLICE) -> Iterator[slice]:
    """Iterate over consecutive slices of `size` rows."""
    for start in range(0, count, size):
        yield slice(start, min(start + size, count))

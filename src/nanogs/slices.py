"""Rows taken a slice at a time: what is computed on the way takes no memory worth counting."""

from collections.abc import Iterator

SLICE = 1 << 13  # few, since each thread keeps what it once freed
# Of few and simple steps on few numbers a row: each long enough for threads not to wait for Python.
SLICE_STEPS = 1 << 15
SLICE_PAIRS = 1 << 15  # pairs, of which a kernel takes milliseconds
IN_HAND = 16 * SLICE_PAIRS  # at once, by as many threads: what memory is planned with


def slices(count: int, size: int = SLICE) -> Iterator[slice]:
    """Consecutive rows, so many at a time."""
    for start in range(0, count, size):
        yield slice(start, min(start + size, count))

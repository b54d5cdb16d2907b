"""Rows taken a slice at a time: what is computed on the way takes no memory worth counting."""

from collections.abc import Iterator

SLICE = 1 << 14  # few, since each thread keeps what it once freed
SLICE_PAIRS = 1 << 19  # more, since threads wait for each other after every slice


def slices(count: int, size: int = SLICE) -> Iterator[slice]:
    """Consecutive rows, so many at a time."""
    for start in range(0, count, size):
        yield slice(start, min(start + size, count))

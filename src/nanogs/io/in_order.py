"""Permuting the rows of a source, with a temporary file if the source is not in memory."""

from tempfile import TemporaryFile
from threading import Lock
from typing import IO, Any
from weakref import finalize

import numpy as np

from nanogs._types import I32, I64, Array
from nanogs.io.temporary import close_quietly, into_temporary
from nanogs.source import InMemory, Layout, Source
from nanogs.splats import COLUMNS, RenderMode, Splats

_LEAST_ROWS, _MOST_BUCKETS = 1 << 12, 256


def in_order(source: Source, order: I64 | I32) -> Source:
    """Return a source with the rows permuted; extra columns are dropped if it is not in memory.

    Args:
        source: N splats.
        order: (N,) the input row of each output row.

    Raises:
        OutputError: The temporary file cannot be written.
    """
    return _Taken(source, order) if isinstance(source, InMemory) else _Sorted(source, order)


class _Taken(Source):
    """Permuted rows of a model in memory."""

    def __init__(self, source: Source, order: I64 | I32) -> None:
        self._source, self._order = source, order
        self.count, self.columns = len(order), source.columns

    def _span(self, start: int, stop: int) -> Splats:
        """Read rows `start` to `stop`; see `Source.read`."""
        return self._source.take(self._order[start:stop].astype(np.int64, copy=False))


class _Sorted(Source):
    """Permuted rows in a temporary file, by a bucket sort.

    A bucket is a range of output rows. The file holds the buckets one after another, each in input
    order; a bucket is sorted when it is read.
    """

    def __init__(self, source: Source, order: I64 | I32) -> None:
        self._source = source
        self.count, self.columns = source.count, source.columns
        self._rows = max(_LEAST_ROWS, -(-len(order) // _MOST_BUCKETS))
        self._dtype = np.dtype([("place", "<i8"), *_columns(source.read(0, 1))])
        with into_temporary():
            self._file: IO[bytes] = TemporaryFile(prefix="nanogs-")  # noqa: SIM115 - closed by `close`
        finalize(self, close_quietly, self._file)
        self._last: tuple[int, Array] | None = None
        self._lock = Lock()  # threads share the position in the file
        self._fill(order)

    def _fill(self, order: I64 | I32) -> None:
        places = np.empty_like(order)
        places[order] = np.arange(len(places))
        ends = np.arange(0, len(places), self._rows)  # the next free row of each bucket
        at = 0
        for block in self._source.blocks():
            rows = np.empty(len(block), self._dtype)
            rows["place"] = places[at : at + len(block)]
            for name in COLUMNS:
                rows[name] = getattr(block, name)
            buckets = rows["place"] // self._rows
            for bucket in np.unique(buckets):
                some = rows[buckets == bucket]
                with into_temporary():
                    self._file.seek(int(ends[bucket]) * self._dtype.itemsize)
                    self._file.write(some.tobytes())
                ends[bucket] += len(some)
            at += len(block)
        with into_temporary():
            self._file.flush()

    def _span(self, start: int, stop: int) -> Splats:
        """Read rows `start` to `stop`; see `Source.read`."""
        parts = [np.empty(0, self._dtype)]
        while start < stop:
            number, skipped = divmod(start, self._rows)
            parts.append(self._bucket(number)[skipped : skipped + stop - start])
            start += len(parts[-1])
        return _splats(np.concatenate(parts), self.columns)

    def _bucket(self, number: int) -> Array:
        last = self._last  # another thread may replace it
        if last is None or last[0] != number:
            last = self._last = None
            count = min(self._rows, self.count - number * self._rows)
            with self._lock:
                self._file.seek(number * self._rows * self._dtype.itemsize)
                stored = self._file.read(count * self._dtype.itemsize)
            rows = np.frombuffer(stored, self._dtype, count)  # raises if the file is too short
            last = self._last = number, rows[np.argsort(rows["place"])]
        return last[1]

    def close(self) -> None:
        """Remove the temporary file."""
        close_quietly(self._file)


def _columns(splats: Splats) -> list[tuple[str, Any, tuple[int, ...]]]:
    """Return name, dtype and shape of each column of a stored row."""
    return [(n, getattr(splats, n).dtype, getattr(splats, n).shape[1:]) for n in COLUMNS]


def _splats(rows: Array, columns: Layout) -> Splats:
    """Convert stored rows to `Splats`."""
    found: dict[str, Any] = {name: np.ascontiguousarray(rows[name]) for name in COLUMNS}
    return Splats(**found, render_mode=RenderMode(columns.render_mode))

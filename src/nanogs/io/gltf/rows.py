"""Accessors of glTF: rows of numbers in a binary buffer, separate or interleaved with others."""

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from nanogs._types import F64, Array
from nanogs.io.files import unreadable
from nanogs.io.parts import fill
from nanogs.io.section import Section


@dataclass(frozen=True, slots=True)
class Accessor:
    """Rows of numbers of one type in a buffer, within the buffer's bounds.

    Attributes:
        count: Number of rows.
        components: Numbers per row.
        kind: Their numpy dtype.
        normalized: Whether integers encode -1 to 1 (signed) or 0 to 1 (unsigned).
        buffer: Index of the buffer.
        offset: Byte offset of the first row in the buffer.
        stride: Bytes from one row to the next.
        view: Byte range in the buffer of the buffer view, which other accessors may share.
    """

    count: int
    components: int
    kind: str
    normalized: bool
    buffer: int
    offset: int
    stride: int
    view: tuple[int, int]

    def values(self, body: "BufferReader", start: int, stop: int) -> Array:
        """Read the stored numbers of rows `start` to `stop`, (R, components).

        Raises:
            FormatError: The file cannot be read.
        """
        width = np.dtype(self.kind).itemsize
        # Read whole interleaved rows, because their other columns are usually requested next.
        before = (self.offset - self.view[0]) % self.stride
        first = self.offset + start * self.stride
        end = self.offset + (stop - 1) * self.stride + self.components * width
        whole_rows = first - before + (stop - start) * self.stride
        data = body.read(self.buffer, first - before, max(end, min(whole_rows, self.view[1])))
        shape, strides = (stop - start, self.components), (self.stride, width)
        return np.ndarray(shape, self.kind, buffer=data, offset=before, strides=strides)

    def decoded(self, stored: Array) -> F64:
        """Convert stored numbers to float64, normalised integers to their range."""
        values = stored.astype(np.float64)
        if self.normalized and stored.dtype.kind in "iu":
            values /= np.iinfo(stored.dtype).max
            np.maximum(values, -1, out=values)
        return values


class BufferReader:
    """The bytes of open buffers, with a cache of the range read last."""

    def __init__(self, path: Path, files: Mapping[int, BinaryIO]) -> None:
        self._path, self._files = path, files
        self._start, self._data = (-1, 0), np.empty(0, np.uint8)

    def read(self, buffer: int, start: int, stop: int) -> Array:
        """Read bytes `start` to `stop` of a buffer.

        Raises:
            FormatError: They cannot be read.
        """
        if (buffer, start) != self._start or stop > start + len(self._data):
            self._files[buffer].seek(start)
            self._start, self._data = (buffer, start), np.empty(stop - start, np.uint8)
            fill(self._path, self._files[buffer], self._data)
        return self._data[: stop - start]


@contextmanager
def opened(path: Path, buffers: Mapping[int, Section]) -> Iterator[BufferReader]:
    """Open the buffers of a document, for the length of a `with` block.

    Raises:
        FormatError: One cannot be read.
    """
    with ExitStack() as stack:
        try:
            files = {n: stack.enter_context(each.opened()) for n, each in buffers.items()}
            yield BufferReader(path, files)
        except OSError as error:
            raise unreadable(path, error) from error

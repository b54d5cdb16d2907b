"""Accessors of glTF: rows of numbers in a binary buffer, alone or between those of others."""

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
    """Rows of equal numbers in a buffer, its place checked against the buffer's size.

    Attributes:
        count: Rows.
        components: Numbers in each.
        kind: Their numpy type.
        normalized: Whether integers stand for -1 to 1, or 0 to 1.
        buffer: The index of the buffer that they lie in.
        offset: Of the first row in the buffer, bytes.
        stride: From one row to the next, bytes.
        view: Where the bytes that it shares with others begin in the buffer, and where they end.
    """

    count: int
    components: int
    kind: str
    normalized: bool
    buffer: int
    offset: int
    stride: int
    view: tuple[int, int]

    def values(self, body: "Body", start: int, stop: int) -> Array:
        """(R, components) stored numbers of some rows.

        Raises:
            FormatError: The file cannot be read.
        """
        width = np.dtype(self.kind).itemsize
        before = (self.offset - self.view[0]) % self.stride  # columns beside it are asked for next
        first = self.offset + start * self.stride
        end = self.offset + (stop - 1) * self.stride + self.components * width
        whole_rows = first - before + (stop - start) * self.stride
        data = body.read(self.buffer, first - before, max(end, min(whole_rows, self.view[1])))
        shape, strides = (stop - start, self.components), (self.stride, width)
        return np.ndarray(shape, self.kind, buffer=data, offset=before, strides=strides)

    def decoded(self, stored: Array) -> F64:
        """Decode stored numbers to float64."""
        values = stored.astype(np.float64)
        if self.normalized and stored.dtype.kind in "iu":
            values /= np.iinfo(stored.dtype).max
            np.maximum(values, -1, out=values)
        return values


class Body:
    """The bytes of opened buffers, of which those read last are kept."""

    def __init__(self, path: Path, files: Mapping[int, BinaryIO]) -> None:
        self._path, self._files = path, files
        self._start, self._data = (-1, 0), np.empty(0, np.uint8)

    def read(self, buffer: int, start: int, stop: int) -> Array:
        """Some bytes of a buffer.

        Raises:
            FormatError: They cannot be read.
        """
        if (buffer, start) != self._start or stop > start + len(self._data):
            self._files[buffer].seek(start)
            self._start, self._data = (buffer, start), np.empty(stop - start, np.uint8)
            fill(self._path, self._files[buffer], self._data)
        return self._data[: stop - start]


@contextmanager
def opened(path: Path, buffers: Mapping[int, Section]) -> Iterator[Body]:
    """The buffers of a document, open.

    Raises:
        FormatError: One cannot be read.
    """
    with ExitStack() as stack:
        try:
            files = {n: stack.enter_context(each.opened()) for n, each in buffers.items()}
            yield Body(path, files)
        except OSError as error:
            raise unreadable(path, error) from error

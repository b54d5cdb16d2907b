"""Accessors of glTF: rows of numbers in a binary buffer, alone or between those of others."""

from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from nanogs._types import F64, Array
from nanogs.io.parts import fill


@dataclass(frozen=True, slots=True)
class Accessor:
    """Rows of equal numbers in the file, its place checked against the file's size.

    Attributes:
        count: Rows.
        components: Numbers in each.
        kind: Their numpy type.
        normalized: Whether integers stand for -1 to 1, or 0 to 1.
        offset: Of the first row in the file, bytes.
        stride: From one row to the next, bytes.
        view: Where the bytes that it shares with others begin in the file, and where they end.
    """

    count: int
    components: int
    kind: str
    normalized: bool
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
        data = body.read(first - before, max(end, min(whole_rows, self.view[1])))
        shape, strides = (stop - start, self.components), (self.stride, width)
        return np.ndarray(shape, self.kind, buffer=data, offset=before, strides=strides)

    def decoded(self, stored: Array) -> F64:
        """What the stored numbers stand for, float64."""
        values = stored.astype(np.float64)
        if self.normalized and stored.dtype.kind in "iu":
            values /= np.iinfo(stored.dtype).max
            np.maximum(values, -1, out=values)
        return values


class Body:
    """The bytes of an open file, of which those read last are kept."""

    def __init__(self, path: Path, file: BinaryIO) -> None:
        self._path, self._file = path, file
        self._start, self._data = 0, np.empty(0, np.uint8)

    def read(self, start: int, stop: int) -> Array:
        """Some bytes.

        Raises:
            FormatError: They cannot be read.
        """
        if start != self._start or stop > start + len(self._data):
            self._file.seek(start)
            self._start, self._data = start, np.empty(stop - start, np.uint8)
            fill(self._path, self._file, self._data)
        return self._data[: stop - start]

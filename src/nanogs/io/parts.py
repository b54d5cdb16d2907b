"""Files that are read in parts: what a format offers of it, and the rows of a file in blocks.

Some files hold their rows one after the other, and any of them can be read. Others are packed as a
whole; those are unpacked once, column by column, to where columns can be read in parts.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import numpy as np

from nanogs._types import Array
from nanogs.errors import FormatError
from nanogs.io.files import BLOCK_ROWS, unreadable
from nanogs.splats import Splats


class Rows(Protocol):
    """A file that is read in parts; what is held of it does not grow with its size."""

    def read(self, start: int, stop: int) -> Splats:
        """Some rows, bit for bit as the whole file has them; further elements without theirs.

        Args:
            start: The first row.
            stop: The row after the last, at most the file's count.

        Raises:
            FormatError: They cannot be read, or are damaged.
        """


@dataclass(frozen=True, slots=True)
class Column:
    """A column of a packed file as it is unpacked: NumPy's name of its type, and its shape."""

    kind: str
    shape: tuple[int, ...]

    @property
    def bytes(self) -> int:
        """Bytes of the column."""
        return np.dtype(self.kind).itemsize * prod(self.shape)


ColumnReader = Callable[[str, int, int], Array]
"""Rows of an unpacked column by its name, the first and the one after the last: a new array."""


class Packed(Protocol):
    """A file whose rows can only be read once its columns are unpacked."""

    @property
    def columns(self) -> Mapping[str, Column]:
        """The columns that are unpacked, by name, in the order they come."""

    @property
    def memory(self) -> int:
        """Bytes that unpacking takes at most, the libraries aside."""

    def unpack(self, notes: list[str]) -> Iterator[Array]:
        """All columns one after the other, in pieces of rows; no piece has rows of two.

        Args:
            notes: Gets what is to be said of the file as a whole.

        Raises:
            FormatError: The file cannot be read, is damaged, or holds more or less than it states.
        """

    def read(self, columns: ColumnReader, start: int, stop: int) -> Splats:
        """Some rows of the model, bit for bit as the whole file has them.

        Args:
            columns: What has been unpacked.
            start: The first row.
            stop: The row after the last.

        Raises:
            FormatError: What belongs to the columns cannot be read.
        """


def row_blocks(
    path: Path, dtype: "np.dtype[Any]", offset: int, count: int
) -> Iterator[tuple[slice, Array]]:
    """Rows of one size in blocks, in a buffer that the next overwrites: maps count as memory.

    Args:
        path: The file.
        dtype: Of a row.
        offset: Of the first row, bytes.
        count: Rows.

    Yields:
        The numbers of the rows, from 0, and the rows.

    Raises:
        FormatError: The file cannot be read, or ends before the last row.
    """
    buffer = np.empty(min(count, BLOCK_ROWS), dtype)
    try:
        with path.open("rb", buffering=0) as file:
            file.seek(offset)
            for start in range(0, count, BLOCK_ROWS):
                values = buffer[: min(count - start, BLOCK_ROWS)]
                fill(path, file, values)
                yield slice(start, start + len(values)), values
    except OSError as error:
        raise unreadable(path, error) from error


def fill(path: Path, file: BinaryIO, values: Array) -> None:
    """Fill an array with the next bytes of a file.

    Raises:
        FormatError: The file ends before.
    """
    left = values.reshape(-1).view(np.uint8).data
    while left:
        if not (count := file.readinto(left)):  # type: ignore[attr-defined]
            raise FormatError(
                f"{path} became shorter while it was read; export or download it again."
            )
        left = left[count:]

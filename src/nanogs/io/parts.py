"""Base classes of the formats' readers, one for each of three ways of reading rows.

`FileSource`: rows are stored one after another, and any range of them can be read directly.
`Packed`: the file is compressed as a whole; its columns are unpacked once to a place from which
rows can be read. `Whole`: the file can only be loaded whole.
"""

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate
from math import prod
from pathlib import Path
from tempfile import TemporaryFile
from threading import Lock
from typing import IO, Any, BinaryIO
from weakref import finalize

import numpy as np

from nanogs._types import Array
from nanogs.errors import FormatError, OptionError
from nanogs.io.files import reading
from nanogs.io.info import FileInfo
from nanogs.io.temporary import into_temporary
from nanogs.slices import BLOCK_ROWS
from nanogs.source import Layout, Source, span_of
from nanogs.splats import Splats


def level_note(level: int, levels: int) -> str:
    """Return the note that says which level of detail was read, and of how many."""
    return f"Level {level} of {levels} was read; level 0 is the finest."


class FileSource(Source):
    """A model in a file, read so that memory does not grow with the size of the file.

    Attributes:
        path: The file.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.name = path, str(path)

    def __repr__(self) -> str:
        return f"<Source {self.name}>"

    @cached_property
    def info(self) -> FileInfo:
        """The metadata of the file."""
        raise NotImplementedError

    @cached_property
    def count(self) -> int:
        """Number of splats."""
        return self.info.splats

    @cached_property
    def columns(self) -> Layout:
        """The columns, from the metadata."""
        return self.info.layout

    @property
    def files(self) -> Sequence[Path]:
        """All files of the model.

        Raises:
            FormatError: A manifest, which names further files, cannot be read.
        """
        return (self.path,)

    @property
    def levels(self) -> tuple[int, ...]:
        """Number of splats of each level of detail, the finest first; empty without levels.

        Raises:
            FormatError: One of its files cannot be read.
        """
        return ()

    @property
    def frame(self) -> str:
        """Name of the coordinate frame that the file itself states, such as "rub"; mostly empty.

        Raises:
            FormatError: The part that states it cannot be read, or names no known frame.
        """
        return ""

    @property
    def environment(self) -> int:
        """Number of splats of the environment, such as the sky: last rows, part of every level.

        Raises:
            FormatError: The file that holds them cannot be read.
        """
        return 0

    @property
    def packed(self) -> bool:
        """Whether the file holds quantised values although not all files of its format do."""
        return False

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences on values of the file that the caller has overridden."""
        return ()


@dataclass(frozen=True, slots=True)
class Column:
    """An unpacked column of a packed file: NumPy's name of its dtype, and its shape."""

    kind: str
    shape: tuple[int, ...]

    @property
    def bytes(self) -> int:
        """Size of the column in bytes."""
        return np.dtype(self.kind).itemsize * prod(self.shape)


ColumnReader = Callable[[str, int, int], Array]
"""Reads rows `start` to `stop` of an unpacked column, given its name; returns a new array."""


class Packed(FileSource):
    """A file that is compressed as a whole, so that rows can only be read from unpacked columns.

    When some but not all rows are first read, the columns are unpacked to a temporary file, unless
    `use` has provided unpacked columns before. They stay in this process: a pickled source unpacks
    them again.
    """

    _unpacked: "UnpackedColumns | None" = None

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._lock = Lock()

    def __getstate__(self) -> dict[str, Any]:
        return {k: v for k, v in self.__dict__.items() if k not in ("_lock", "_unpacked")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _lock=Lock())

    @cached_property
    def stored(self) -> Mapping[str, Column]:
        """The columns that `unpack` yields, by name, in the same order."""
        raise NotImplementedError

    @cached_property
    def memory(self) -> int:
        """Upper bound of the memory that unpacking takes, in bytes, without the libraries."""
        raise NotImplementedError

    @abstractmethod
    def unpack(self, notes: list[str]) -> Iterator[Array]:
        """Yield all columns one after another, in pieces of rows, each of one column only.

        Args:
            notes: List to which notes on the whole file are appended.

        Raises:
            FormatError: The file cannot be read, is damaged, or holds more or less than it states.
        """

    @abstractmethod
    def decode(self, columns: ColumnReader, start: int, stop: int) -> Splats:
        """Decode some rows of the model, bit for bit equal to the same rows of the whole model.

        Args:
            columns: Reads rows of the unpacked columns.
            start: The first row.
            stop: The row after the last.

        Raises:
            FormatError: Something that decoding needs beside the columns cannot be read.
        """

    def _span(self, start: int, stop: int) -> Splats:
        """Read rows `start` to `stop`; see `Source.read`.

        Raises:
            FormatError: They cannot be read, or are damaged.
            OutputError: The columns cannot be written to a temporary file.
        """
        if self._unpacked is None and (start, stop) == (0, self.count):
            return self.load()
        with self._lock:
            if self._unpacked is None:
                self._unpacked = _unpacked(self)
            unpacked = self._unpacked
        splats = self.decode(unpacked.columns, start, stop)
        return replace(splats, notes=[*splats.notes, *unpacked.notes])

    def use(self, unpacked: "UnpackedColumns") -> None:
        """Use columns that were unpacked before; `close` closes them."""
        self._unpacked = unpacked

    def load(self) -> Splats:
        """Read the whole model, with its columns unpacked in memory."""
        notes: list[str] = []
        pieces, held = self.unpack(notes), {}
        for name, column in self.stored.items():
            held[name] = np.empty(column.shape, column.kind)
            fill_rows(held[name], pieces)
        for _ in pieces:  # run the generator to its end, where it checks the rest of the file
            pass
        splats = self.decode(lambda name, start, stop: held[name][start:stop], 0, self.count)
        return replace(splats, notes=[*splats.notes, *notes])

    def close(self) -> None:
        """Close the unpacked columns, which deletes them if they are in a temporary file."""
        if self._unpacked is not None:
            self._unpacked.close()
            self._unpacked = None


def fill_rows(out: Array, pieces: Iterator[Array]) -> None:
    """Fill an array with the next pieces of rows from an iterator."""
    at = 0
    while at < len(out):
        piece = next(pieces)
        out[at : at + len(piece)] = piece
        at += len(piece)


@dataclass(frozen=True, slots=True)
class UnpackedColumns:
    """Unpacked columns of a packed file, of which any rows can be read.

    Attributes:
        columns: Reads rows of a column.
        notes: Notes on the whole file.
        close: Closes the storage of the columns.
    """

    columns: ColumnReader
    notes: Sequence[str]
    close: Callable[[], None]


def _unpacked(packed: Packed) -> UnpackedColumns:
    """Unpack the columns one after another to an anonymous temporary file."""
    ends = accumulate((column.bytes for column in packed.stored.values()), initial=0)
    places = dict(zip(packed.stored, ends, strict=False))
    notes: list[str] = []
    with into_temporary(f"{packed.path} cannot be unpacked"), ExitStack() as stack:
        file: IO[bytes] = stack.enter_context(TemporaryFile(prefix="nanogs-"))
        for piece in packed.unpack(notes):
            file.write(_as_bytes(np.ascontiguousarray(piece)))
        file.flush()
        stack.pop_all()
    finalize(packed, file.close)  # on garbage collection, if `close` is not called
    lock = Lock()  # threads share the position in the file

    def column(name: str, start: int, stop: int) -> Array:
        shape = packed.stored[name].shape
        out = np.empty((stop - start, *shape[1:]), packed.stored[name].kind)
        with lock:
            file.seek(places[name] + start * out.itemsize * prod(shape[1:]))
            fill(packed.path, file, out)  # type: ignore[arg-type]
        return out

    return UnpackedColumns(column, notes, file.close)


class Whole(FileSource):
    """A file that can only be loaded whole; it is kept in memory once some rows are read."""

    _held: Splats | None = None

    def _span(self, start: int, stop: int) -> Splats:
        """Read rows `start` to `stop`; see `Source.read`."""
        if self._held is None:
            self._held = self.load()
        return span_of(self._held, start, stop)

    def close(self) -> None:
        """Release the model that is kept in memory."""
        self._held = None


def check_level(path: Path, level: int, count: int) -> None:
    """Refuse a level of detail that a file does not have.

    Raises:
        OptionError: There is no such level.
    """
    if count == 1 and level != 0:
        raise OptionError(f"{path} has one level, 0, and no level {level}; leave `level` out.")
    if not 0 <= level < count:
        raise OptionError(f"{path} has levels 0 to {count - 1}; level {level} is not among them.")


def row_blocks(
    path: Path, dtype: "np.dtype[Any]", offset: int, count: int, most: int | None = None
) -> Iterator[tuple[slice, Array]]:
    """Read rows of fixed size in blocks, in one buffer that each block overwrites.

    The file is not memory-mapped, because mapped pages count as memory of the process.

    Args:
        path: The file.
        dtype: The dtype of a row.
        offset: Byte offset of the first row.
        count: Number of rows.
        most: Largest number of rows in a block; `BLOCK_ROWS` by default.

    Yields:
        The range of the rows, counted from 0, and the rows.

    Raises:
        FormatError: The file cannot be read, or ends before the last row.
    """
    most = most or BLOCK_ROWS
    buffer = np.empty(min(count, most), dtype)
    with reading(path, buffering=0) as file:
        file.seek(offset)
        for start in range(0, count, most):
            values = buffer[: min(count - start, most)]
            fill(path, file, values)
            yield slice(start, start + len(values)), values


def fill(path: Path, file: BinaryIO, values: Array) -> None:
    """Fill an array with the next bytes of a file.

    Raises:
        FormatError: The file ends before the array is full.
    """
    left = _as_bytes(values)
    while left:
        if not (count := file.readinto(left)):  # type: ignore[attr-defined]
            raise FormatError(
                f"{path} became shorter while it was read; export or download it again."
            )
        left = left[count:]


def _as_bytes(values: Array) -> memoryview:
    """Return the memory of a contiguous array; dates, unlike numbers, give no buffer themselves."""
    return values.reshape(-1).view(np.uint8).data

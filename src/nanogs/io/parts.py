"""Files as sources: how the formats' readers give rows, which are read in three ways.

Some files hold their rows one after the other, and any of them can be read: `FileSource` itself.
Others are packed as a whole; those are unpacked once, column by column, to where columns can be
read in parts: `Packed`. The rest is read whole: `Whole`.
"""

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate
from math import prod
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any, BinaryIO
from weakref import finalize

import numpy as np

from nanogs._types import Array
from nanogs.errors import FormatError, OptionError
from nanogs.io.files import BLOCK_ROWS, reading
from nanogs.io.info import FileInfo
from nanogs.io.temporary import no_room
from nanogs.source import Layout, Source
from nanogs.splats import Splats


def level_note(level: int, levels: int) -> str:
    """Say which level was read, of how many."""
    return f"Level {level} was read, of {levels} from 0, the finest, on."


class FileSource(Source):
    """A model in a file; what is held of it does not grow with its size.

    Attributes:
        path: The file.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.name = path, str(path)

    def __repr__(self) -> str:
        return f"<Source {self.name}>"

    @cached_property
    def info(self) -> FileInfo:
        """The file's description of itself."""
        raise NotImplementedError

    @cached_property
    def count(self) -> int:
        """Number of splats."""
        return self.info.splats

    @cached_property
    def columns(self) -> Layout:
        """The columns, from the description."""
        return self.info.layout

    @property
    def files(self) -> Sequence[Path]:
        """All files of the model.

        Raises:
            FormatError: One of those that name others cannot be read.
        """
        return (self.path,)

    @property
    def levels(self) -> tuple[int, ...]:
        """Splats of each level of detail, the finest first; none of a model without.

        Raises:
            FormatError: One of its files cannot be read.
        """
        return ()

    @property
    def frame(self) -> str:
        """The frame of its axes that the file states itself, such as "rub"; mostly empty.

        Raises:
            FormatError: What states it cannot be read, or names no frame.
        """
        return ""

    @property
    def environment(self) -> int:
        """Splats of the sky and the like, a model's last rows, which belong to all its levels.

        Raises:
            FormatError: The file that holds them cannot be read.
        """
        return 0

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences on values that are read otherwise than the file says, as the caller asked."""
        return ()


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


class Packed(FileSource):
    """A file whose rows can only be read once its columns are unpacked.

    The first time that some rows and not all are read, they are unpacked into a temporary file, but
    for those who call `unpack` and `decode` themselves.
    """

    _unpacked: "UnpackedColumns | None" = None

    @cached_property
    def stored(self) -> Mapping[str, Column]:
        """The columns that are unpacked, by name, in the order they come."""
        raise NotImplementedError

    @cached_property
    def memory(self) -> int:
        """Bytes that unpacking takes at most, the libraries aside."""
        raise NotImplementedError

    @abstractmethod
    def unpack(self, notes: list[str]) -> Iterator[Array]:
        """All columns one after the other, in pieces of rows; no piece has rows of two.

        Args:
            notes: Gets what is to be said of the file as a whole.

        Raises:
            FormatError: The file cannot be read, is damaged, or holds more or less than it states.
        """

    @abstractmethod
    def decode(self, columns: ColumnReader, start: int, stop: int) -> Splats:
        """Some rows of the model, bit for bit as the whole file has them.

        Args:
            columns: What has been unpacked.
            start: The first row.
            stop: The row after the last.

        Raises:
            FormatError: What belongs to the columns cannot be read.
        """

    def _span(self, start: int, stop: int) -> Splats:
        """Some rows; see `Source`.

        Raises:
            FormatError: They cannot be read, or are damaged.
            OutputError: The columns cannot be written to a temporary file.
        """
        if self._unpacked is None:
            if (start, stop) == (0, self.count):
                return self.load()
            self._unpacked = _unpacked(self)
        splats = self.decode(self._unpacked.columns, start, stop)
        return replace(splats, notes=[*splats.notes, *self._unpacked.notes])

    def use(self, unpacked: "UnpackedColumns") -> None:
        """Read rows from columns that have been unpacked before; `close` closes them."""
        self._unpacked = unpacked

    def load(self) -> Splats:
        """The whole model, its columns unpacked in memory."""
        notes: list[str] = []
        pieces, held = self.unpack(notes), {}
        for name, column in self.stored.items():
            held[name] = np.empty(column.shape, column.kind)
            fill_rows(held[name], pieces)
        for _ in pieces:  # what follows the columns is looked at
            pass
        splats = self.decode(lambda name, start, stop: held[name][start:stop], 0, self.count)
        return replace(splats, notes=[*splats.notes, *notes])

    def close(self) -> None:
        """Close the unpacked columns; those in a temporary file are gone then."""
        if self._unpacked is not None:
            self._unpacked.close()
            self._unpacked = None


def fill_rows(out: Array, pieces: Iterator[Array]) -> None:
    """Fill an array with the next pieces of rows."""
    at = 0
    while at < len(out):
        piece = next(pieces)
        out[at : at + len(piece)] = piece
        at += len(piece)


@dataclass(frozen=True, slots=True)
class UnpackedColumns:
    """The columns of a packed file where rows of them can be read.

    Attributes:
        columns: Reads them.
        notes: What is to be said of the file as a whole.
        close: Closes what holds them.
    """

    columns: ColumnReader
    notes: Sequence[str]
    close: Callable[[], None]


def _unpacked(packed: Packed) -> UnpackedColumns:
    """The columns, one after the other in a temporary file without a name."""
    ends = accumulate((column.bytes for column in packed.stored.values()), initial=0)
    places = dict(zip(packed.stored, ends, strict=False))
    notes: list[str] = []
    try:
        file: IO[bytes] = TemporaryFile(prefix="nanogs-")  # noqa: SIM115 - closed with the source
        finalize(packed, file.close)  # if `Packed` does not do it before
        for piece in packed.unpack(notes):
            file.write(np.ascontiguousarray(piece).data)
    except OSError as error:
        raise no_room(f"{packed.path} cannot be unpacked", error) from error

    def column(name: str, start: int, stop: int) -> Array:
        shape = packed.stored[name].shape
        out = np.empty((stop - start, *shape[1:]), packed.stored[name].kind)
        file.seek(places[name] + start * out.itemsize * prod(shape[1:]))
        fill(packed.path, file, out)  # type: ignore[arg-type]
        return out

    return UnpackedColumns(column, notes, file.close)


class Whole(FileSource):
    """A file that is only read whole, by `load`; the first time that some rows are, it is held."""

    _held: Splats | None = None

    def _span(self, start: int, stop: int) -> Splats:
        """Some rows; see `Source`."""
        if self._held is None:
            found = self.load()
            # Of the whole, whatever rows are read: plain texts are not added up.
            self._held = replace(found, notes=tuple(map(str, found.notes)))
        return self._held.span(start, stop)

    def close(self) -> None:
        """Let go of the model."""
        self._held = None


def check_level(path: Path, level: int, count: int) -> None:
    """Refuse a level of detail that a file has not.

    Raises:
        OptionError: As said.
    """
    if not 0 <= level < count:
        raise OptionError(f"{path} has levels 0 to {count - 1}; level {level} is not among them.")


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
    with reading(path, buffering=0) as file:
        file.seek(offset)
        for start in range(0, count, BLOCK_ROWS):
            values = buffer[: min(count - start, BLOCK_ROWS)]
            fill(path, file, values)
            yield slice(start, start + len(values)), values


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

"""Tables: columns of numbers in `.npy` files and a record in JSON; rows are read by ranges.

A table is `NAME.0.npy` and so on, one file for each column, and `NAME.json`, its record, which is
written last: if it exists, the task that made it is done. Records are data and hold no code.
"""

import hashlib
import io
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any, BinaryIO, Self

import numpy as np
from numpy.lib import format as npy

from nanogs._types import I64, Array
from nanogs.errors import FormatError
from nanogs.slices import slices
from nanogs.store.scratch import Scratch, hash_file

_WINDOW = 1 << 15  # rows


@dataclass(frozen=True, slots=True)
class Column:
    """The file of a column, its type and shape.

    Attributes:
        file: Its name.
        dtype: As NumPy writes it.
        shape: Number of rows, and the shape of each.
        bytes: Size of the file.
        sha256: Of the file.
    """

    file: str
    dtype: str
    shape: tuple[int, ...]
    bytes: int
    sha256: str

    @property
    def row_bytes(self) -> int:
        """Bytes of a row."""
        return int(np.dtype((np.dtype(self.dtype), self.shape[1:])).itemsize)

    @property
    def nbytes(self) -> int:
        """Bytes of all rows, which are the end of the file, after its header."""
        return self.shape[0] * self.row_bytes


@dataclass(frozen=True, slots=True)
class Record:
    """The record of a table that a task made.

    Attributes:
        name: Of the table.
        columns: By name.
        facts: Other results of the task, as plain data.
    """

    name: str
    columns: Mapping[str, Column]
    facts: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Sorted:
    """Rows of a column to be written in the order of `rows`, all or some of them."""

    values: Array
    rows: I64


@dataclass(frozen=True, slots=True)
class Streamed:
    """A column that is written in pieces of rows, so that it is never held whole."""

    dtype: "np.dtype[Any]"
    shape: tuple[int, ...]
    pieces: Iterable[Array]


def write_table(
    scratch: Scratch,
    name: str,
    columns: Mapping[str, Array | Sorted | Streamed] | Iterable[tuple[str, Array]],
    facts: Mapping[str, Any],
) -> Record:
    """Write columns and facts; the record is written last, with the facts as they are then.

    Args:
        scratch: Where to write.
        name: Of the table.
        columns: By name; or an iterable, of which one at a time is made and written.
        facts: Other results; read when all columns are written.

    Raises:
        OutputError: They cannot be written.
    """
    written: dict[str, Column] = {}
    for key, column in columns.items() if isinstance(columns, Mapping) else columns:
        values = column.values if isinstance(column, Sorted) else column
        rows = column.rows.shape if isinstance(column, Sorted) else column.shape[:1]
        file, shape = f"{name}.{len(written)}.npy", (*rows, *values.shape[1:])
        parts = _parts(column, values.dtype, shape)
        written[key] = Column(file, values.dtype.str, shape, *scratch.write(file, parts))
    record = Record(name, written, facts)
    text = json.dumps(asdict(record))
    whole = json.dumps({"record": text, "sha256": _sha256(text)}).encode()
    scratch.write(f"{name}.json", [np.frombuffer(whole, np.uint8)])
    return record


def _parts(
    column: Array | Sorted | Streamed, dtype: "np.dtype[Any]", shape: tuple[int, ...]
) -> Iterator[Array]:
    """Yield the parts of a `.npy` file: its header, and then rows."""
    header = io.BytesIO()
    about = {"descr": npy.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
    npy.write_array_header_1_0(header, about)
    yield np.frombuffer(header.getvalue(), np.uint8)
    if isinstance(column, Streamed):
        rows = iter(column.pieces)
    elif isinstance(column, Sorted):
        rows = (column.values[column.rows[block]] for block in slices(shape[0]))
    else:
        rows = (column[block] for block in slices(shape[0]))
    yield from map(np.ascontiguousarray, rows)


def read_record(scratch: Scratch, name: str) -> Record | None:
    """Read the record of a table; None if it is missing or damaged."""
    try:
        with scratch.open(f"{name}.json") as file:
            whole = json.loads(file.read())
        if _sha256(whole["record"]) != whole["sha256"]:
            return None
        data = json.loads(whole["record"])
        columns = {str(key): _column(**given) for key, given in data["columns"].items()}
        return Record(name, columns, dict(data["facts"]))
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def _column(file: str, dtype: str, shape: list[int], bytes: int, sha256: str) -> Column:  # noqa: A002
    if np.dtype(dtype).hasobject:
        raise ValueError("a column of objects")
    return Column(str(file), str(dtype), tuple(map(int, shape)), int(bytes), str(sha256))


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def verified(scratch: Scratch, name: str) -> Record | None:
    """Read the record of a table whose files match its sizes and hashes; None if one does not."""
    record = read_record(scratch, name)
    if record is None:
        return None
    try:
        for column in record.columns.values():
            with scratch.open(column.file) as file:
                if hash_file(file) != (column.bytes, column.sha256):
                    return None
    except OSError:
        return None
    return record


class Table:
    """A table that is open for reading."""

    def __init__(self, scratch: Scratch, record: Record) -> None:
        self.record = record
        self._scratch = scratch
        self._files: dict[str, BinaryIO] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the files."""
        for file in self._files.values():
            file.close()

    def __len__(self) -> int:
        """Number of rows; 0 for a table without columns."""
        return next((column.shape[0] for column in self.record.columns.values()), 0)

    def read(self, column: str, start: int = 0, stop: int | None = None) -> Array:
        """Read rows of a column; all by default."""
        about = self.record.columns[column]
        stop = about.shape[0] if stop is None else stop
        out = np.empty((stop - start, *about.shape[1:]), about.dtype)
        self.read_into(column, start, out)
        return out

    def read_into(self, column: str, start: int, out: Array) -> None:
        """Fill a contiguous array of the column's type with its rows from `start` on.

        Raises:
            FormatError: The file is shorter than its record says.
        """
        about = self.record.columns[column]
        if column not in self._files:
            self._files[column] = self._scratch.open(about.file, about.bytes)
        file = self._files[column]
        file.seek(about.bytes - about.nbytes + start * about.row_bytes)
        left = out.reshape(-1).view(np.uint8).data
        while left:
            count = file.readinto(left)  # type: ignore[attr-defined]
            if not count:
                raise FormatError(f"{about.file} of the job was cut short; `resume=True` mends it.")
            left = left[count:]

    def take_into(self, column: str, rows: I64, out: Array) -> None:
        """Fill an array with the given rows of a column, which are ascending."""
        for run in _runs(rows):
            low = int(rows[run.start])
            some = self.read(column, low, int(rows[run.stop - 1]) + 1)
            out[run] = some[rows[run] - low]


def read_column(scratch: Scratch, record: Record, column: str) -> Array:
    """Read a whole column of a table.

    Raises:
        FormatError: The file is shorter than its record says.
    """
    with Table(scratch, record) as table:
        return table.read(column)


def _runs(rows: I64) -> Iterator[slice]:
    """Split ascending rows by windows of a file, so that the size of a read is bounded."""
    breaks = np.flatnonzero(np.diff(rows // _WINDOW)) + 1
    bounds = [0, *map(int, breaks), len(rows)]
    yield from (slice(*pair) for pair in pairwise(bounds) if pair[0] < pair[1])

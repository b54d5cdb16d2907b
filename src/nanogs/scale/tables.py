"""Columns of numbers in a file, with a record of what they are; rows are read without the rest.

A table is `NAME.bin`, the columns one after the other, and `NAME.json`, its record, which is
written last: where it stands, the task that made it is done. Records are data and hold no code.
"""

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from typing import Any, Self

import numpy as np

from nanogs._types import I64, Array
from nanogs.errors import FormatError
from nanogs.method.slices import slices
from nanogs.scale.scratch import Scratch, hash_file

ALIGN = 64
_WINDOW = 1 << 15  # rows


@dataclass(frozen=True, slots=True)
class Place:
    """The place of a column in the file, and what it holds."""

    dtype: str
    shape: tuple[int, ...]
    offset: int

    def row(self) -> "np.dtype[Any]":
        """The type of one row.

        Raises:
            FormatError: It is of no kind that a model has.
        """
        kind = np.dtype(self.dtype)
        if kind.hasobject:
            raise FormatError("A record names a column of objects; remove the job folder.")
        return np.dtype((kind, self.shape[1:]))


@dataclass(frozen=True, slots=True)
class Record:
    """The record of a table that a task made.

    Attributes:
        name: Of the table.
        bytes: Of its file; 0 where there is none.
        sha256: Of the file.
        columns: By name.
        facts: What else the task found; plain data.
    """

    name: str
    bytes: int = 0
    sha256: str = ""
    columns: Mapping[str, Place] = field(default_factory=dict)
    facts: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Sorted:
    """A column whose rows are written in another order, or only some of them."""

    values: Array
    rows: I64


@dataclass(frozen=True, slots=True)
class Streamed:
    """A column that comes in pieces of rows, so that it is never held whole."""

    dtype: "np.dtype[Any]"
    shape: tuple[int, ...]
    pieces: Iterable[Array]

    def __len__(self) -> int:
        return self.shape[0]


def write_table(
    scratch: Scratch,
    name: str,
    columns: Mapping[str, Array | Sorted | Streamed],
    facts: Mapping[str, Any],
) -> Record:
    """Write columns and facts; the record comes last, and has the facts as they then are.

    Raises:
        OutputError: They cannot be written.
    """
    places, offset = {}, 0
    for key, column in columns.items():
        values = column.values if isinstance(column, Sorted) else column
        rows = len(column.rows) if isinstance(column, Sorted) else len(column)
        places[key] = Place(values.dtype.str, (rows, *values.shape[1:]), offset)
        size = rows * places[key].row().itemsize
        offset += size + -size % ALIGN
    written = scratch.write(f"{name}.bin", _parts(columns)) if columns else (0, "")
    return _write_record(scratch, Record(name, *written, places, facts))


def write_files(
    scratch: Scratch, name: str, files: Iterable[tuple[str, bytes]], facts: Mapping[str, Any]
) -> Record:
    """Write files as the columns of a table, one at a time as they come.

    Args:
        scratch: Where to.
        name: Of the table.
        files: Name and contents of each.
        facts: What else was found; looked at when all files have come.

    Raises:
        OutputError: They cannot be written.
    """
    places: dict[str, Place] = {}

    def parts() -> Iterator[Array]:
        offset = 0
        for file, data in files:
            places[file] = Place("|u1", (len(data),), offset)
            offset += len(data)
            yield np.frombuffer(data, np.uint8)

    written = scratch.write(f"{name}.bin", parts())
    return _write_record(scratch, Record(name, *written, places, facts))


def _write_record(scratch: Scratch, record: Record) -> Record:
    text = json.dumps(asdict(record))
    whole = json.dumps({"record": text, "sha256": _sha256(text)}).encode()
    scratch.write(f"{record.name}.json", [np.frombuffer(whole, np.uint8)])
    return record


def _parts(columns: Mapping[str, Array | Sorted | Streamed]) -> Iterator[Array]:
    for column in columns.values():
        size = 0
        for part in _blocks(column):
            size += part.nbytes
            yield np.ascontiguousarray(part).reshape(-1).view(np.uint8)
        yield np.zeros(-size % ALIGN, np.uint8)


def _blocks(column: Array | Sorted | Streamed) -> Iterable[Array]:
    if isinstance(column, Streamed):
        return column.pieces
    if isinstance(column, Sorted):
        return (column.values[column.rows[block]] for block in slices(len(column.rows)))
    return (column[block] for block in slices(len(column)))


def read_record(scratch: Scratch, name: str) -> Record | None:
    """The record of a table; None where it is missing or damaged."""
    try:
        with scratch.open(f"{name}.json") as file:
            whole = json.loads(file.read())
        if _sha256(whole["record"]) != whole["sha256"]:
            return None
        data = json.loads(whole["record"])
        places = {
            str(key): Place(str(p["dtype"]), tuple(map(int, p["shape"])), int(p["offset"]))
            for key, p in data["columns"].items()
        }
        return Record(name, int(data["bytes"]), str(data["sha256"]), places, dict(data["facts"]))
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def verified(scratch: Scratch, name: str) -> Record | None:
    """The record of a table whose file is as it was written; None where it is not."""
    record = read_record(scratch, name)
    if record is None or not record.columns:
        return record
    try:
        with scratch.open(f"{name}.bin") as file:
            found = hash_file(file)
    except OSError:
        return None
    return record if found == (record.bytes, record.sha256) else None


class Table:
    """A table that is open for reading."""

    def __init__(self, scratch: Scratch, record: Record) -> None:
        self.record = record
        self._file = scratch.open(f"{record.name}.bin", record.bytes)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __len__(self) -> int:
        return next(iter(self.record.columns.values())).shape[0]

    def read(self, column: str, start: int = 0, stop: int | None = None) -> Array:
        """Rows of a column; all by default."""
        place = self.record.columns[column]
        stop = place.shape[0] if stop is None else stop
        out = np.empty((stop - start, *place.shape[1:]), place.dtype)
        self.read_into(column, start, out)
        return out

    def read_into(self, column: str, start: int, out: Array) -> None:
        """Fill an array of the column's type, contiguous, with its rows from `start` on.

        Raises:
            FormatError: The file is shorter than its record says.
        """
        place = self.record.columns[column]
        self._file.seek(place.offset + start * place.row().itemsize)
        left = out.reshape(-1).view(np.uint8).data
        while left:
            count = self._file.readinto(left)  # type: ignore[attr-defined]
            if not count:
                raise FormatError(
                    f"{self.record.name}.bin of the job was cut short; `resume=True` mends it."
                )
            left = left[count:]

    def take_into(self, column: str, rows: I64, out: Array) -> None:
        """Fill an array with the given rows, ascending, of a column."""
        for run in _runs(rows):
            low = int(rows[run.start])
            some = self.read(column, low, int(rows[run.stop - 1]) + 1)
            out[run] = some[rows[run] - low]


def _runs(rows: I64) -> Iterator[slice]:
    """Ascending rows that lie in the same window of a file: what is read at a time is bounded."""
    breaks = np.flatnonzero(np.diff(rows // _WINDOW)) + 1
    bounds = [0, *map(int, breaks), len(rows)]
    yield from (slice(*pair) for pair in pairwise(bounds) if pair[0] < pair[1])

"""Unpacking: the columns of a packed file are written to the scratch, for random access to rows.

Some formats hold columns that are compressed as a whole, so that a row cannot be read without all
before it. The columns are written as the file encodes them, not decoded: a fifth as much.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from nanogs._types import Array
from nanogs.io.parts import FileSource, Packed, UnpackedColumns
from nanogs.pipeline.job.inputs import check_unchanged, open_unchanged
from nanogs.pipeline.options.settings import InputFile, Settings
from nanogs.store.scratch import Scratch
from nanogs.store.tables import Record, Streamed, Table, write_table

NOTES = "notes"


@dataclass(frozen=True, slots=True)
class Unpacked:
    """The input files that have been unpacked.

    Attributes:
        scratch: Where their columns are.
        records: The records of their tables, by index of the file.
    """

    scratch: Scratch
    records: Mapping[int, Record]

    def give(self, number: int, source: FileSource) -> None:
        """Let a file read its columns from the scratch, if it has been unpacked.

        Args:
            number: Index of the file.
            source: The file.
        """
        if number in self.records:
            assert isinstance(source, Packed), "only those are unpacked"  # noqa: S101
            table = Table(self.scratch, self.records[number])
            source.use(UnpackedColumns(table.read, table.record.facts[NOTES], table.close))


@dataclass(frozen=True, slots=True)
class Cost:
    """Memory and disk that unpacking takes.

    Attributes:
        scratch: Bytes of the columns of all files.
        memory: Bytes, of the file that takes most.
        path: Of that file.
    """

    scratch: int = 0
    memory: int = 0
    path: str = ""


def cost_of(settings: Settings) -> Cost:
    """Compute the memory and disk that unpacking will take, from headers.

    Raises:
        FormatError: A file cannot be read.
    """
    cost = Cost()
    for number in settings.unpacked:
        file = settings.inputs[number]
        packed = _packed(file)
        scratch = cost.scratch + sum(column.bytes for column in packed.stored.values())
        most = max((cost.memory, cost.path), (packed.memory, file.path))
        cost = Cost(scratch, *most)
    return cost


def unpack(scratch: Scratch, name: str, file: InputFile) -> Record:
    """Write the columns of a file to a table; they are never held whole.

    Args:
        scratch: Where to write.
        name: Of the table.
        file: To unpack.

    Raises:
        FormatError: It cannot be read, is damaged, or has changed since the job began.
        OutputError: The table cannot be written.
    """
    notes: list[str] = []
    columns = streamed(_packed(file), notes, lambda: check_unchanged(file))
    return write_table(scratch, name, columns, {NOTES: notes})


def _packed(file: InputFile) -> Packed:
    source = open_unchanged(file)
    assert isinstance(source, Packed), "only those are unpacked"  # noqa: S101
    return source


def streamed(
    packed: Packed, notes: list[str], at_end: Callable[[], None] = lambda: None
) -> dict[str, Streamed]:
    """Return the columns of a file as streams, which must be written one by one in this order.

    Args:
        packed: The file.
        notes: Gets the notes on the file as a whole.
        at_end: Called when all has been read.
    """
    pieces = _then(packed.unpack(notes), at_end)
    last = [*packed.stored][-1]
    return {
        name: Streamed(
            np.dtype(column.kind),
            column.shape,
            pieces if name == last else _first(pieces, column.shape[0]),
        )
        for name, column in packed.stored.items()
    }


def _first(pieces: Iterator[Array], rows: int) -> Iterator[Array]:
    """Yield the next pieces, `rows` rows in all.

    The last column of a file takes all that is left instead, so that the checks at the end are run.
    """
    while rows:
        piece = next(pieces)
        rows -= len(piece)
        yield piece


def _then(pieces: Iterator[Array], at_end: Callable[[], None]) -> Iterator[Array]:
    yield from pieces
    at_end()

"""`.csv`: a line with the names of the columns, then one line for each splat.

The columns are those of a `.ply`, with the values as stored; all are float32, of which nine digits
reproduce every one exactly. So a file is read as a `.ply` of text with commas.
"""

import csv
import io
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

import numpy as np

from nanogs._types import F32
from nanogs.errors import FormatError, OutputError
from nanogs.findings import Finding, Names
from nanogs.io import limits
from nanogs.io.files import input_size, reading
from nanogs.io.format import Format
from nanogs.io.ply.header import MAX_HEADER_BYTES, Element, Header, Property
from nanogs.io.ply.read import TextPly
from nanogs.io.ply.rows import check_body
from nanogs.io.ply.write import refuse_own_names, vertex_columns
from nanogs.io.texts import decode, encode, one_line, printable
from nanogs.slices import BLOCK_ROWS
from nanogs.source import Layout, Source, source_of
from nanogs.splats import Splats

_SUFFIX = ".csv"
_PIECE = 1 << 20  # bytes
_NUMBERS = "biuf"  # kinds of dtypes


class CsvFile(TextPly):
    """A `.csv` file; the lines are counted when it is opened.

    Raises:
        FormatError: It cannot be read, has no rows, or its columns are not those of splats.
    """

    def __init__(self, path: Path) -> None:
        header = Header(path, input_size(path), encoding="ascii", separator=b",")
        with reading(path) as file:
            line = file.readline(MAX_HEADER_BYTES)
            header.size, count, last = len(line), 0, b"\n"
            while piece := file.read(_PIECE):
                count, last = count + piece.count(b"\n"), piece[-1:]
        names = _names(path, line)
        if twice := [name for name in names if not header.is_new(name)]:
            raise FormatError(
                f"{path}: two columns are called {printable(twice[0])[:40]!r}; rename one of them."
            )
        columns = [Property(name, "f4") for name in names]
        header.elements.append(Element("vertex", count + (last != b"\n"), columns))
        super().__init__(header)
        if not self.count:
            raise FormatError(f"{path} has no rows; export a model with splats.")
        check_body(header)
        self.info = replace(self.info, format="csv")


def _names(path: Path, line: bytes) -> list[str]:
    try:
        return next(csv.reader([decode(line)]), [])
    except csv.Error as error:  # of a binary file, for example
        raise FormatError(
            f"{path}: the first line holds no names of columns ({error}); export the file again."
        ) from error


def write(model: Splats | Source, file: BinaryIO) -> None:
    """Write a model in its own order, block by block; `losses` names what the file cannot hold.

    Raises:
        OutputError: There is no splat, or an extra column holds no numbers or has a name that no
            file can hold; nothing has been written then.
        OSError: The system refuses to write.
    """
    source = source_of(model)
    limits.refuse_empty(source, _SUFFIX)
    check_columns(source.columns)
    names = list(vertex_columns(source.read(0, 1)))
    header = io.StringIO()
    csv.writer(header, lineterminator="\n").writerow(names)  # quotes names with commas
    file.write(encode(header.getvalue()))
    line = ",".join(["%.9g"] * len(names)) + "\n"
    for block in source.blocks(BLOCK_ROWS):
        rows = _rows(block)
        file.write((line * len(rows) % tuple(rows.ravel().tolist())).encode("ascii"))


def _rows(block: Splats) -> F32:
    """Return all values of some splats, (R, number of columns)."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.stack([c.astype(np.float32) for c in vertex_columns(block).values()], axis=1)


def check_columns(layout: Layout) -> None:
    """Refuse extra columns that hold no numbers, or whose name no file can hold.

    Args:
        layout: The columns of a model.

    Raises:
        OutputError: There is one.
    """
    refuse_own_names(name for name, _ in layout.extras)
    for name, code in layout.extras:
        if np.dtype(code).kind not in _NUMBERS:
            raise OutputError(
                f"Extra column {printable(name)[:40]!r} is {np.dtype(code)}, which {_SUFFIX} cannot"
                " hold; convert it to numbers."
            )
        one_line(name, "name")


def losses(splats: Splats) -> tuple[str, ...]:
    """Name what the file leaves out or rounds, one sentence each."""
    out = limits.left_out(splats, _SUFFIX, extras=False)
    numbers = {n: c for n, c in splats.extras.items() if c.dtype.kind in _NUMBERS}
    if rounded := [name for name, column in numbers.items() if limits.is_rounded(column)]:
        text = f"Extra columns are rounded, {_SUFFIX} holds single precision: {{}}."
        out.append(Finding(text, Names(map(printable, rounded)), Names.union))
    out += limits.rounded(splats, _SUFFIX)
    return (*out, *limits.lost_mode(splats, _SUFFIX))


FORMATS = (
    Format(
        _SUFFIX,
        CsvFile,
        write,
        losses=losses,
        streams=True,
        any_value=True,
        check_columns=check_columns,
        magic=(b"x,y,z,",),
    ),
)

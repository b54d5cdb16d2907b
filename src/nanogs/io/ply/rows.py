"""Reading the body of a PLY file, in any encoding, as blocks of structured rows."""

from collections.abc import Iterator
from dataclasses import dataclass
from math import isinf
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from nanogs._types import F64, Array, Bool
from nanogs.errors import FormatError
from nanogs.formatting import counted
from nanogs.io.files import reading
from nanogs.io.parts import row_blocks
from nanogs.io.ply.header import Element, Header
from nanogs.slices import BLOCK_ROWS, slices

_MAX_TOKEN = 400  # characters; the longest double in plain decimals has about 330
_AGAIN = "export or download it again."


@dataclass(frozen=True, slots=True)
class Block:
    """Consecutive rows of one element.

    Attributes:
        element: The element.
        rows: Their numbers, from 0 on; see `iter_blocks` and `iter_span`.
        values: (R,) structured, in the file's own byte order; valid only until the next block is
            requested.
    """

    element: Element
    rows: slice
    values: Array


def check_body(header: Header) -> None:
    """Compare the counts in the header with the size of the file, before anything is allocated.

    Raises:
        FormatError: An element holds lists or nothing, or the body is too short or too long.
    """
    for element in header.elements:
        _check_keepable(header.path, element)
    if header.encoding == "ascii":
        _check_ascii_size(header)
    else:
        _check_binary_size(header)


def iter_blocks(header: Header) -> Iterator[Block]:
    """Read all rows of all elements in the file's order; call `check_body` first.

    Raises:
        FormatError: A row of text contradicts the header, or the file cannot be read.
    """
    if header.encoding != "ascii":
        for element in header.elements:
            yield from iter_span(header, element, 0, element.count) if element.count else ()
        return
    yield from _ascii_blocks(header)


def iter_span(
    header: Header, element: Element, start: int, stop: int, most: int | None = None
) -> Iterator[Block]:
    """Read some rows of one element of a binary file; call `check_body` first.

    The rows of the blocks are numbered from 0, which is row `start` of the element.

    Args:
        header: The header of the file.
        element: One of its elements.
        start: The first row.
        stop: The row after the last.
        most: Largest number of rows in a block; see `row_blocks`.

    Raises:
        FormatError: The file cannot be read.
    """
    offset = header.size
    for before in header.elements:
        if before is element:
            break
        offset += before.count * before.dtype("<").itemsize if before.count else 0
    dtype = element.dtype(header.order)
    at = offset + start * dtype.itemsize
    for span, values in row_blocks(header.path, dtype, at, stop - start, most):
        yield Block(element, span, values)


def read_element(header: Header, element: Element) -> Array:
    """Read all rows of one element of a binary file; call `check_body` first.

    Raises:
        FormatError: The file cannot be read.
    """
    rows = np.empty(element.count, element.dtype())
    for block in iter_span(header, element, 0, element.count):
        rows[block.rows] = block.values
    return rows


def _check_keepable(path: Path, element: Element) -> None:
    if element.count == 0:
        return  # an element without rows is left out without loss
    if lists := element.lists():
        raise FormatError(
            f"{path}: element {element.name!r} has the list property {lists[0]!r}, whose indices"
            " cannot be kept when splats are merged; export the splats without it."
        )
    if not element.properties:
        raise FormatError(
            f"{path}: element {element.name!r} has {counted(element.count, 'row')} but no"
            " properties; correct the header or export the file again."
        )


def _check_binary_size(header: Header) -> None:
    left = header.file_bytes - header.size
    for element in header.elements:
        if element.count == 0:
            continue
        row_bytes = element.dtype("<").itemsize
        if element.count * row_bytes > left:
            raise FormatError(
                f"{header.path} is cut short: element {element.name!r} should have"
                f" {counted(element.count, 'row')} of {counted(row_bytes, 'byte')}, but only"
                f" {left // row_bytes:,} ({counted(left, 'byte')}) are there; {_AGAIN}"
            )
        left -= element.count * row_bytes
    if left:
        raise FormatError(
            f"{header.path}: {counted(left, 'byte follows', 'bytes follow')} the last row, so the"
            f" header has the wrong count or row size; {_AGAIN}"
        )


def _check_ascii_size(header: Header) -> None:
    # Each value takes at least a digit and a separator; the last separator may be missing.
    least = sum(2 * element.count * len(element.properties) for element in header.elements) - 1
    left = header.file_bytes - header.size
    if least > left:
        rows = sum(element.count for element in header.elements)
        raise FormatError(
            f"{header.path} is cut short: {counted(rows, 'row of text needs', 'rows of text need')}"
            f" at least {counted(least, 'byte')}, but only {left:,} are there; {_AGAIN}"
        )


def _ascii_blocks(header: Header) -> Iterator[Block]:
    with reading(header.path) as file:
        file.seek(header.size)
        for element in header.elements:
            for span in slices(element.count, BLOCK_ROWS):
                yield Block(element, span, _ascii_rows(header, file, element, span))
        while rest := file.read(1 << 20):
            if rest.strip():
                raise FormatError(
                    f"{header.path}: text follows the last row, so the header has the wrong"
                    f" count; {_AGAIN}"
                )


def _ascii_rows(header: Header, file: BinaryIO, element: Element, span: slice) -> Array:
    width = len(element.properties)
    limit = width * _MAX_TOKEN + 2
    tokens = [file.readline(limit).split(header.separator) for _ in range(span.stop - span.start)]
    for i, row in enumerate(tokens):
        if len(row) != width:
            raise FormatError(
                f"{header.path}: row {span.start + i + 1} of {element.count} of"
                f" {header.place(element)} has {counted(len(row), 'value')} instead of {width};"
                f" {_AGAIN}"
            )
    return _structured(header, element, span, _numbers(header, element, span, tokens))


def _numbers(header: Header, element: Element, span: slice, tokens: list[list[bytes]]) -> F64:
    """Convert the tokens to (R, P) float64, which holds every PLY type exactly."""
    try:
        return np.array([[_number(token) for token in row] for row in tokens], np.float64)
    except ValueError:
        pass
    for i, row in enumerate(tokens):  # a second pass finds the bad value for the message
        for name, token in zip(element.names, row, strict=True):
            try:
                _number(token)
            except ValueError:
                raise _bad_value(header, element, span.start + i, name, token) from None
    raise AssertionError("unreachable: a token failed above and passed here")


def _number(token: bytes) -> float:
    value = float(token)
    # Python reads 1_000 as a number and 1e999 as infinity, no PLY writer means that.
    if b"_" in token or (isinf(value) and b"i" not in token.lower()):
        raise ValueError(token)
    return value


def _structured(header: Header, element: Element, span: slice, numbers: F64) -> Array:
    out = np.empty(len(numbers), element.dtype())
    for column, prop in zip(numbers.T, element.properties, strict=True):
        good = _storable(column, np.dtype(prop.code))
        if not good.all():
            row = int(np.argmin(good))
            token = str(column[row]).encode()
            raise _bad_value(header, element, span.start + row, prop.name, token)
        out[prop.name] = column
    return out


def _storable(column: F64, kind: "np.dtype[Any]") -> Bool:
    """Return an (R,) mask of the numbers that a type holds, whole or rounded to its precision."""
    if kind.kind in "iu":
        limits = np.iinfo(kind)
        good = (column >= limits.min) & (column <= limits.max) & (column == np.floor(column))
        return np.asarray(good)
    with np.errstate(over="ignore"):
        return np.asarray(np.isfinite(column.astype(kind)) | ~np.isfinite(column))


def _bad_value(header: Header, element: Element, row: int, name: str, token: bytes) -> FormatError:
    kind = next(prop.code for prop in element.properties if prop.name == name)
    shown = token.strip()[:40].decode("ascii", "replace")
    return FormatError(
        f"{header.path}: row {row + 1} of {element.count} of {header.place(element)}: {shown!r} is"
        f" no value of type {kind} for {name!r}; correct it or export the file again."
    )

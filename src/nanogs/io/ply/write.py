"""Writing 3DGS `.ply` files: binary little-endian, canonical column order, in bounded memory."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, BinaryIO

import numpy as np

from nanogs._types import Array
from nanogs.errors import OutputError
from nanogs.io import columns, limits, render_tag
from nanogs.io.ply.header import MAX_HEADER_BYTES, TYPE_NAMES
from nanogs.io.texts import encode, one_line
from nanogs.slices import BLOCK_ROWS, slices
from nanogs.source import Layout, Source, source_of
from nanogs.splats import Splats

ElementRows = tuple[str, int, Sequence[tuple[str, str]]]
"""Name of an element, number of its rows, and name and PLY type of each property."""


def write(model: Splats | Source, file: BinaryIO) -> None:
    """Write a model with all its extra columns, elements and comments, block by block.

    Raises:
        OutputError: The model holds no splat, or something that PLY cannot hold; nothing has been
            written then.
        OSError: The system refuses to write.
    """
    source = source_of(model)
    limits.refuse_empty(source, ".ply")
    first = replace(source.read(0, 1), elements=source.read_elements())
    tables = _tables(first)
    file.write(_header(first, tables, source.count))
    buffer = None
    for block in source.blocks(BLOCK_ROWS):
        # Whole arrays as fields of a row, not single columns: fewer and longer copies.
        arrays = {names[0]: array for names, array in _arrays(block) if names}
        if buffer is None:
            buffer = np.empty(min(source.count, BLOCK_ROWS), _row(arrays))
        file.write(_filled(buffer, arrays, slice(None)))
    for name, table in tables.items():
        if name != "vertex" and (count := len(next(iter(table.values())))):
            buffer = np.empty(min(count, BLOCK_ROWS), _row(table))
            file.writelines(_filled(buffer, table, part) for part in slices(count, BLOCK_ROWS))


def file_bytes(splats: Splats, count: int) -> int:
    """Compute the file size in bytes of a model of `count` splats that is otherwise like this one.

    Args:
        splats: The model that columns, comments and further elements are taken from.
        count: Number of splats, 1 or more.

    Raises:
        OutputError: As for `write`.
    """
    tables = _tables(splats)
    rows = {name: len(next(iter(table.values()), ())) for name, table in tables.items()}
    rows["vertex"] = count
    header = _header(splats, tables, count)
    return len(header) + sum(rows[name] * _row_bytes(table) for name, table in tables.items())


def _row_bytes(table: Mapping[str, Array]) -> int:
    return sum(column.dtype.itemsize for column in table.values())


def _tables(splats: Splats) -> dict[str, dict[str, Array]]:
    """Return the columns of every element by its name, `vertex` first."""
    tables = {"vertex": vertex_columns(splats)}
    for element in splats.elements:
        if element.name in tables:
            raise OutputError(f"Two elements are called {element.name!r}; rename one of them.")
        names = element.rows.dtype.names or ()
        tables[element.name] = {name: element.rows[name] for name in names}
    return tables


def vertex_columns(splats: Splats) -> dict[str, Array]:
    """Return the columns of the vertex rows by name, each (N,), in the order they are written.

    Raises:
        OutputError: An extra column has a splat's own name.
    """
    return {
        name: column
        for names, array in _arrays(splats)
        for name, column in columns.by_column(names, array)
    }


def _arrays(splats: Splats) -> list[tuple[Sequence[str], Array]]:
    """Return the arrays of the vertex rows in writing order, with the names of their columns."""
    refuse_own_names(splats.extras)
    extras = dict(splats.extras)
    normals = [((name,), extras.pop(name)) for name in columns.NORMALS if name in extras]
    return [
        (columns.MEANS, splats.means),
        *normals,
        (columns.BASE_COLOUR, splats.sh[:, 0]),
        (columns.rest_names(splats.sh_degree), splats.sh[:, 1:].transpose(0, 2, 1)),
        ((columns.OPACITY,), splats.opacity_logits),
        (columns.SCALES, splats.log_scales),
        (columns.QUATS, splats.quats),
        *(((name,), column) for name, column in extras.items()),
    ]


def _header(splats: Splats, tables: Mapping[str, Mapping[str, Array]], splat_count: int) -> bytes:
    elements = []
    for name, table in tables.items():
        if not table:
            raise OutputError(f"Element {name!r} has no columns; leave it out.")
        count = splat_count if name == "vertex" else len(next(iter(table.values())))
        elements.append((name, count, [(n, _type(n, c.dtype, c.ndim)) for n, c in table.items()]))
    return header(render_tag.tagged(splats.comments, splats.render_mode), elements)


def header(comments: Sequence[str], elements: Iterable[ElementRows]) -> bytes:
    """Build the header of a binary little-endian PLY file.

    Args:
        comments: Comment lines without their keyword.
        elements: For each element its name, number of rows and (name, PLY type) of each property,
            in the file's order.

    Raises:
        OutputError: A name or comment is not allowed in a header, or the header would be too long.
    """
    lines = [b"ply", b"format binary_little_endian 1.0", *(_comment(text) for text in comments)]
    for name, count, properties in elements:
        lines.append(b"element %s %d" % (_word(name), count))
        lines += [b"property %s %s" % (kind.encode(), _word(n)) for n, kind in properties]
    text = b"\n".join([*lines, b"end_header", b""])
    if len(text) > MAX_HEADER_BYTES:
        raise OutputError(
            f"The header would have {len(text)} bytes, and no more than {MAX_HEADER_BYTES} can"
            " be read back; shorten the comments."
        )
    return text


def _comment(text: str) -> bytes:
    return b"comment " + encode(one_line(text)) if text else b"comment"


def _word(name: str) -> bytes:
    word = encode(name)
    if word.split() != [word]:
        raise OutputError(f"The name {name!r} is empty or holds a space; rename it.")
    return word


def check_columns(layout: Layout) -> None:
    """Refuse extra columns whose type or name PLY does not allow.

    Args:
        layout: The columns of a model.

    Raises:
        OutputError: There is one.
    """
    refuse_own_names(name for name, _ in layout.extras)
    for name, code in layout.extras:
        _type(name, np.dtype(code), 1)
        _word(name)


def refuse_own_names(extras: Iterable[str]) -> None:
    """Refuse extra columns with the name of one that every model has.

    Args:
        extras: The names of the extra columns.

    Raises:
        OutputError: There is one.
    """
    if clash := [name for name in extras if columns.is_known(name)]:
        raise OutputError(f"The extra column {clash[0]!r} has a splat's own name; rename it.")


def _type(name: str, dtype: "np.dtype[Any]", dimensions: int) -> str:
    known = TYPE_NAMES.get(dtype.str[1:])
    if known is None or dimensions != 1:
        shape = f" of {dimensions} dimensions" if dimensions != 1 else ""
        raise OutputError(
            f"Column {name!r} is {dtype}{shape}, which PLY cannot hold; convert it to one"
            f" of {', '.join(sorted(TYPE_NAMES.values()))}."
        )
    return known


def _row(table: Mapping[str, Array]) -> "np.dtype[Any]":
    """Return the dtype of a packed little-endian row."""
    return np.dtype([(n, "<" + c.dtype.str[1:], c.shape[1:]) for n, c in table.items()])


def _filled(buffer: Array, table: Mapping[str, Array], part: slice) -> memoryview:
    """Fill the buffer with some rows and return their bytes, valid until it is filled again."""
    rows = buffer[: len(next(iter(table.values()))[part])]
    for name, column in table.items():
        rows[name] = column[part]
    return rows.view(np.uint8).data

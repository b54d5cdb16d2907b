"""Reading 3DGS `.ply` files: any encoding, any column order, by name."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nanogs._types import Array
from nanogs.errors import FormatError
from nanogs.formatting import counted
from nanogs.io import columns, compressed_ply, render_tag
from nanogs.io.files import BLOCK_ROWS
from nanogs.io.findings import Finding
from nanogs.io.info import FileInfo
from nanogs.io.parts import Column, ColumnReader, Packed, Rows
from nanogs.io.ply_header import TYPE_NAMES, Element, Header, header_notes, printable, read_header
from nanogs.io.ply_rows import Block, check_body, iter_blocks, iter_span
from nanogs.splats import ExtraElement, Splats

_WIDE = ("f8", "i4", "u4")  # types of a centre that float32 does not hold exactly
_TOKEN = 120  # bytes that a number of text takes while it is read: as text, number and value


def read(path: Path) -> Splats:
    """Read a `.ply` file, or a compressed one under either name.

    Raises:
        FormatError: The file cannot be read, is damaged, or holds something that cannot be kept.
    """
    header = _checked(path)
    if compressed_ply.is_compressed(header):
        return compressed_ply.read(header)
    vertex = _Vertex(header)
    elements = {
        element.name: np.empty(element.count, element.dtype())
        for element in header.elements
        if element is not vertex.element and element.properties and not element.lists()
    }
    for block in iter_blocks(header):
        if block.element is vertex.element:
            vertex.put(block)
        else:
            elements[block.element.name][block.rows] = block.values
    return vertex.splats([ExtraElement(name, rows) for name, rows in elements.items()])


def stream(path: Path) -> Iterator[Splats]:
    """The model block by block, so that no more than a block is held; a compressed one whole.

    Every block has the file's tags and comments, and its further elements without their rows.

    Raises:
        FormatError: As for `read`.
    """
    header = _checked(path)
    if compressed_ply.is_compressed(header):
        yield compressed_ply.read(header)
        return
    own = header.element("vertex")
    elements = [
        ExtraElement(element.name, np.empty(0, element.dtype()))
        for element in header.elements
        if element is not own and element.properties and not element.lists()
    ]
    for block in iter_blocks(header):
        if block.element is own:
            rows = len(block.values)
            vertex = _Vertex(header, rows=rows)
            vertex.put(Block(own, slice(0, rows), block.values))
            yield vertex.splats(elements)


def rows(path: Path) -> Rows | None:
    """The file to be read in parts, unless it is one of text.

    Raises:
        FormatError: As for `inspect`.
    """
    header = _checked(path)
    if header.encoding == "ascii":
        return None
    return compressed_ply.Chunks(header) if compressed_ply.is_compressed(header) else _Body(header)


def packed(path: Path) -> Packed | None:
    """A file of text to be unpacked: its rows in binary; None for others.

    Raises:
        FormatError: As for `inspect`.
    """
    header = _checked(path)
    text = header.encoding == "ascii" and not compressed_ply.is_compressed(header)
    return _Text(header) if text else None


class _Text:
    """The rows of a file of text."""

    def __init__(self, header: Header) -> None:
        self._header, self._vertex = header, _Vertex(header, rows=0)
        element = self._vertex.element
        self._row = element.dtype()
        self.columns = {"vertex": Column("|u1", (element.count, self._row.itemsize))}
        widest = max(len(each.properties) for each in header.elements)
        self.memory = BLOCK_ROWS * widest * _TOKEN

    def unpack(self, _notes: list[str]) -> Iterator[Array]:
        """The one column; see `Packed`."""
        for block in iter_blocks(self._header):
            if block.element is self._vertex.element:
                yield block.values.view(np.uint8).reshape(-1, self._row.itemsize)

    def read(self, columns: ColumnReader, start: int, stop: int) -> Splats:
        """Some rows; see `Packed`."""
        vertex = _Vertex(self._header, rows=stop - start)
        for at in range(start, stop, BLOCK_ROWS):
            rows = columns("vertex", at, min(at + BLOCK_ROWS, stop)).view(self._row)[:, 0]
            span = slice(at - start, at - start + len(rows))
            vertex.put(Block(vertex.element, span, rows))
        return vertex.splats([])


@dataclass(frozen=True, slots=True)
class _Body:
    """The rows of a binary file."""

    header: Header

    def read(self, start: int, stop: int) -> Splats:
        vertex = _Vertex(self.header, rows=stop - start)
        for block in iter_span(self.header, vertex.element, start, stop):
            vertex.put(block)
        return vertex.splats([])


def inspect(path: Path) -> FileInfo:
    """Describe a `.ply` file from its header.

    Raises:
        FormatError: As for `read`, except for what only the rows show.
    """
    header = _checked(path)
    if compressed_ply.is_compressed(header):
        return compressed_ply.inspect(header)
    vertex = _Vertex(header, rows=0)
    return FileInfo(
        path=path,
        format="ply",
        encoding=header.encoding,
        file_bytes=header.file_bytes,
        splats=vertex.element.count,
        sh_degree=vertex.degree,
        double_means=vertex.means_dtype == np.float64,
        properties=described(vertex.element),
        extras=tuple(name for name in vertex.element.names if not columns.is_known(name)),
        elements=tuple((e.name, e.count) for e in header.elements if e is not vertex.element),
        render_mode=render_tag.render_mode(header.comments),
        comments=header.printable_comments(),
    )


def described(element: Element) -> tuple[tuple[str, str], ...]:
    """(name, PLY type) of each property."""
    return tuple((p.name, TYPE_NAMES[p.code] if p.code else "list") for p in element.properties)


def _checked(path: Path) -> Header:
    """The header of a file that holds splats, its counts checked against the file's size."""
    header = read_header(path)
    vertex = header.element("vertex")
    if vertex is None:
        names = ", ".join(repr(printable(e.name)) for e in header.elements[:8]) or "none"
        raise FormatError(
            f"{path} has no element 'vertex' (its elements: {names}), so it holds no splats;"
            " export the splats."
        )
    if vertex.count == 0:
        raise FormatError(f"{path}: element 'vertex' has no rows; export a model with splats.")
    check_body(header)
    return header


class _Vertex:
    """The arrays of `Splats`, filled block by block from the vertex rows."""

    def __init__(self, header: Header, *, rows: int | None = None) -> None:
        element = header.element("vertex")
        assert element is not None  # noqa: S101 - `_checked` made sure
        self.header, self.element = header, element
        where = f"{header.path}: element 'vertex'"
        columns.check_required(element.names, where)
        self.degree = columns.sh_degree(element.names, where)
        self.codes = {prop.name: str(prop.code) for prop in element.properties}
        wide = any(self.codes[name] in _WIDE for name in columns.MEANS)
        self.means_dtype = np.dtype(np.float64 if wide else np.float32)
        self.overflowed: dict[str, int] = {}
        self.targets: dict[str, Array] = {}
        self._allocate(element.count if rows is None else rows)

    def _allocate(self, n: int) -> None:
        self.means = np.empty((n, 3), self.means_dtype)
        self.log_scales = np.empty((n, 3), np.float32)
        self.quats = np.empty((n, 4), np.float32)
        self.opacity_logits = np.empty(n, np.float32)
        self.sh = np.empty((n, (self.degree + 1) ** 2, 3), np.float32)
        self.extras = {
            name: np.empty(n, code)
            for name, code in self.codes.items()
            if not columns.is_known(name)
        }
        self._map_columns()

    def _map_columns(self) -> None:
        """Name the view that each column of the file is copied to."""
        targets = self.targets
        for array, names in (
            (self.means, columns.MEANS),
            (self.log_scales, columns.SCALES),
            (self.quats, columns.QUATS),
            (self.sh[:, 0], columns.BASE_COLOUR),
        ):
            targets.update((name, array[:, i]) for i, name in enumerate(names))
        targets[columns.OPACITY] = self.opacity_logits
        for i, name in enumerate(columns.rest_names(self.degree)):
            coefficient, channel = columns.sh_place(i, self.degree)
            targets[name] = self.sh[:, coefficient, channel]
        targets.update(self.extras)

    def put(self, block: Block) -> None:
        for name, target in self.targets.items():
            source = block.values[name]
            with np.errstate(over="ignore"):
                target[block.rows] = source
            if self.codes[name] == "f8" and target.dtype == np.float32:
                lost = np.isinf(target[block.rows]) & np.isfinite(source)
                if lost.any():
                    self.overflowed[name] = self.overflowed.get(name, 0) + int(lost.sum())

    def splats(self, elements: list[ExtraElement]) -> Splats:
        comments = [*self.header.comments, *self.header.obj_info]
        return Splats(
            means=self.means,
            log_scales=self.log_scales,
            quats=self.quats,
            opacity_logits=self.opacity_logits,
            sh=self.sh,
            extras=self.extras,
            render_mode=render_tag.render_mode(comments),
            comments=comments,
            elements=elements,
            notes=[*self._conversions(), *header_notes(self.header)],
        )

    def _conversions(self) -> list[str]:
        notes: list[str] = []
        changed = [
            name
            for name, target in self.targets.items()
            if self.codes[name] != target.dtype.str[1:] and name not in columns.MEANS
        ]
        if changed:
            kinds = ", ".join(sorted({TYPE_NAMES[self.codes[name]] for name in changed}))
            notes.append(
                f"{counted(len(changed), f'{kinds} column')} became float: {_some(changed)}."
            )
        for name, count in self.overflowed.items():
            quoted = repr(name).replace("{", "{{").replace("}", "}}")
            text = f"{{:value|values}} of {quoted} beyond float became infinite."
            notes.append(Finding(text, count))
        return notes


def _some(names: list[str]) -> str:
    return ", ".join(names[:6]) + (", …" if len(names) > 6 else "")

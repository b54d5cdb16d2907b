"""Reading 3DGS `.ply` files: any encoding, any column order, by name."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from nanogs._types import Array
from nanogs.errors import FormatError
from nanogs.findings import Finding
from nanogs.formatting import counted
from nanogs.io import columns, render_tag
from nanogs.io.files import BLOCK_ROWS
from nanogs.io.info import FileInfo
from nanogs.io.parts import Column, ColumnReader, FileSource, Packed
from nanogs.io.ply import compressed_read
from nanogs.io.ply.header import TYPE_NAMES, Element, Header, header_notes, printable, read_header
from nanogs.io.ply.rows import Block, check_body, iter_blocks, iter_span
from nanogs.splats import ExtraElement, Splats

_WIDE = ("f8", "i4", "u4")  # types of a centre that float32 does not hold exactly
_TOKEN = 120  # bytes that a number of text takes while it is read: as text, number and value


def open_ply(path: Path) -> FileSource:
    """A `.ply` file, or a compressed one under either name.

    Raises:
        FormatError: The file cannot be read, is damaged, or holds something that cannot be kept.
    """
    header = _checked(path)
    if compressed_read.is_compressed(header):
        return compressed_read.open_compressed(header)
    return (_Text if header.encoding == "ascii" else _Binary)(header)


class _Ply(FileSource):
    """The rows of a file, and its further elements."""

    def __init__(self, header: Header) -> None:
        super().__init__(header.path)
        self._header, self._vertex = header, _Vertex(header, rows=0)
        vertex = self._vertex
        self._kept = [
            element
            for element in header.elements
            if element is not vertex.element and element.properties and not element.lists()
        ]
        self.elements = tuple((element.name, element.count) for element in self._kept)
        self.info = FileInfo(
            path=header.path,
            format="ply",
            encoding=header.encoding,
            file_bytes=header.file_bytes,
            splats=vertex.element.count,
            sh_degree=vertex.degree,
            double_means=vertex.means_dtype == np.float64,
            properties=described(vertex.element),
            extras=tuple(name for name in vertex.element.names if not columns.is_known(name)),
            elements=tuple((e.name, e.count) for e in header.elements if e is not vertex.element),
            render_mode=render_tag.render_mode(header.all_comments),
            render_tag=render_tag.described(header.all_comments),
            comments=header.printable_comments(),
        )

    def _rows(self, blocks: Iterable[Block], count: int) -> Splats:
        """The splats of blocks with so many rows in all; elements come without theirs."""
        vertex = _Vertex(self._header, rows=count)
        for block in blocks:
            vertex.put(block)
        return vertex.splats([ExtraElement(e.name, np.empty(0, e.dtype())) for e in self._kept])

    def _filled(self, elements: dict[str, Array]) -> Iterator[Block]:
        """The rows of all splats; those of elements go to arrays."""
        for block in iter_blocks(self._header):
            if block.element is self._vertex.element:
                yield block
            else:
                elements[block.element.name][block.rows] = block.values

    def load(self) -> Splats:
        """The whole model, from one pass over the file."""
        found = {e.name: np.empty(e.count, e.dtype()) for e in self._kept}
        splats = self._rows(self._filled(found), self.count)
        return replace(splats, elements=[ExtraElement(n, rows) for n, rows in found.items()])

    def read_elements(self) -> tuple[ExtraElement, ...]:
        """The further elements; see `Source`."""
        found = {e.name: np.empty(e.count, e.dtype()) for e in self._kept}
        for _ in self._filled(found) if found else ():
            pass
        return tuple(ExtraElement(name, rows) for name, rows in found.items())


class _Binary(_Ply):
    """The rows of a binary file."""

    def _span(self, start: int, stop: int) -> Splats:
        """Some rows; see `Source`."""
        blocks = iter_span(self._header, self._vertex.element, start, stop)
        return self._rows(blocks, stop - start)


class _Text(_Ply, Packed):
    """The rows of a file of text, which are unpacked to binary ones."""

    def __init__(self, header: Header) -> None:
        super().__init__(header)
        self._row = self._vertex.element.dtype()
        self.stored = {"vertex": Column("|u1", (self.count, self._row.itemsize))}
        self.memory = BLOCK_ROWS * max(len(e.properties) for e in header.elements) * _TOKEN

    def unpack(self, _notes: list[str]) -> Iterator[Array]:
        """The one column; see `Packed`."""
        for block in iter_blocks(self._header):
            if block.element is self._vertex.element:
                yield block.values.view(np.uint8).reshape(-1, self._row.itemsize)

    def decode(self, columns: ColumnReader, start: int, stop: int) -> Splats:
        """Some rows; see `Packed`."""
        return self._rows(self._blocks(columns, start, stop), stop - start)

    def _blocks(self, columns: ColumnReader, start: int, stop: int) -> Iterator[Block]:
        for at in range(start, stop, BLOCK_ROWS):
            rows = columns("vertex", at, min(at + BLOCK_ROWS, stop)).view(self._row)[:, 0]
            span = slice(at - start, at - start + len(rows))
            yield Block(self._vertex.element, span, rows)


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
        comments = self.header.all_comments
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

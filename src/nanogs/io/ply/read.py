"""Reading 3DGS `.ply` files in any encoding; columns are found by name, in any order."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from nanogs import parallel
from nanogs._types import Array
from nanogs.activations import smooth
from nanogs.errors import FormatError
from nanogs.findings import became_infinite
from nanogs.formatting import counted
from nanogs.io import columns, render_tag
from nanogs.io.info import FileInfo
from nanogs.io.parts import Column, ColumnReader, FileSource, Packed
from nanogs.io.ply import compressed_read
from nanogs.io.ply.header import TYPE_NAMES, Element, Header, header_notes, read_header
from nanogs.io.ply.rows import Block, check_body, iter_blocks, iter_span, read_element
from nanogs.io.texts import printable
from nanogs.slices import BLOCK_ROWS, slices
from nanogs.splats import ExtraElement, RenderMode, Splats

_WIDE = ("f8", "i4", "u4")  # types of a centre that float32 does not hold exactly
_PART_ROWS = BLOCK_ROWS // 4  # rows that a thread reads at once; its allocator keeps that memory
_SPANS = 64  # parts of a file that threads read; each opens the file, and has a buffer of its own
_TOKEN = 120  # bytes of memory per number of a text file: as token, as Python float, in the array


def open_ply(path: Path) -> FileSource:
    """Open a `.ply` file, plain or compressed, whichever suffix it has.

    Raises:
        FormatError: The file cannot be read, is damaged, or holds something that cannot be kept.
    """
    header = _checked(path)
    if compressed_read.is_compressed(header):
        return compressed_read.open_compressed(header)
    return (TextPly if header.encoding == "ascii" else _Binary)(header)


class _Ply(FileSource):
    """Base class of plain PLY files: metadata, and the elements besides the splats."""

    def __init__(self, header: Header) -> None:
        super().__init__(header.path)
        self._header, self._vertex = header, _Vertex(header, rows=0)
        vertex = self._vertex
        self._kept = [
            element
            for element in header.elements
            if element is not vertex.element and element.is_table
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
            extras=tuple(vertex.extras),
            elements=tuple((e.name, e.count) for e in header.elements if e is not vertex.element),
            render_mode=vertex.render_mode,
            render_tag=(
                render_tag.TWO_SCALES if vertex.flat else render_tag.described(header.all_comments)
            ),
            comments=header.printable_comments(),
        )
        self.columns = replace(self.info.layout, comments=tuple(header.all_comments))

    def _no_rows(self) -> list[ExtraElement]:
        """Return the further elements without their rows."""
        return [ExtraElement(e.name, np.empty(0, e.dtype())) for e in self._kept]


class _Binary(_Ply):
    """A binary PLY file, of which any rows are read directly."""

    def _span(self, start: int, stop: int) -> Splats:
        """Read rows `start` to `stop`, on several threads; see `Source.read`."""
        vertex, element = _Vertex(self._header, rows=stop - start), self._vertex.element
        span = max(_PART_ROWS, -(-(stop - start) // _SPANS))

        def read(part: slice) -> None:
            first, last = start + part.start, start + part.stop
            for block in iter_span(self._header, element, first, last, _PART_ROWS):
                rows = slice(part.start + block.rows.start, part.start + block.rows.stop)
                vertex.put(replace(block, rows=rows))

        parallel.for_each(slices(stop - start, span), read)
        return vertex.splats(self._no_rows())

    def read_elements(self) -> tuple[ExtraElement, ...]:
        """Read the further elements; see `Source.read_elements`."""
        return tuple(ExtraElement(e.name, read_element(self._header, e)) for e in self._kept)


class TextPly(_Ply, Packed):
    """An ASCII PLY file, whose rows are converted to binary ones by `unpack`."""

    def __init__(self, header: Header) -> None:
        super().__init__(header)
        self._row = self._vertex.element.dtype()
        self.stored = {"vertex": Column("|u1", (self.count, self._row.itemsize))}
        self.memory = BLOCK_ROWS * max(len(e.properties) for e in header.elements) * _TOKEN

    def _rows(self, blocks: Iterable[Block], count: int) -> Splats:
        """Collect blocks with `count` rows in total; further elements come without their rows."""
        vertex = _Vertex(self._header, rows=count)
        for block in blocks:
            vertex.put(block)
        return vertex.splats(self._no_rows())

    def _filled(self, elements: dict[str, Array]) -> Iterator[Block]:
        """Yield the blocks of splats; write the rows of further elements to `elements`."""
        for block in iter_blocks(self._header):
            if block.element is self._vertex.element:
                yield block
            else:
                elements[block.element.name][block.rows] = block.values

    def load(self) -> Splats:
        """Read the whole model, in one pass over the file."""
        found = {e.name: np.empty(e.count, e.dtype()) for e in self._kept}
        splats = self._rows(self._filled(found), self.count)
        return replace(splats, elements=[ExtraElement(n, rows) for n, rows in found.items()])

    def read_elements(self) -> tuple[ExtraElement, ...]:
        """Read the further elements; see `Source.read_elements`."""
        found = {e.name: np.empty(e.count, e.dtype()) for e in self._kept}
        for _ in self._filled(found) if found else ():
            pass
        return tuple(ExtraElement(name, rows) for name, rows in found.items())

    def unpack(self, _notes: list[str]) -> Iterator[Array]:
        """Yield the only column: the vertex rows as bytes; see `Packed.unpack`."""
        for block in iter_blocks(self._header):
            if block.element is self._vertex.element:
                yield block.values.view(np.uint8).reshape(-1, self._row.itemsize)

    def decode(self, columns: ColumnReader, start: int, stop: int) -> Splats:
        """Decode rows `start` to `stop`; see `Packed.decode`."""
        return self._rows(self._blocks(columns, start, stop), stop - start)

    def _blocks(self, columns: ColumnReader, start: int, stop: int) -> Iterator[Block]:
        for at in range(start, stop, BLOCK_ROWS):
            rows = columns("vertex", at, min(at + BLOCK_ROWS, stop)).view(self._row)[:, 0]
            span = slice(at - start, at - start + len(rows))
            yield Block(self._vertex.element, span, rows)


def described(element: Element) -> tuple[tuple[str, str], ...]:
    """Return (name, PLY type) of each property."""
    return tuple((p.name, TYPE_NAMES[p.code] if p.code else "list") for p in element.properties)


def _checked(path: Path) -> Header:
    """Read the header of a file of splats, and check its counts against the size of the file."""
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
    if not compressed_read.is_compressed(header):  # before the faces of a mesh are refused
        columns.scale_names(vertex.names, f"{path}: {header.place(vertex)}")
    check_body(header)
    return header


class _Vertex:
    """The arrays of `Splats`, filled block by block from the vertex rows."""

    def __init__(self, header: Header, *, rows: int) -> None:
        element = header.element("vertex")
        assert element is not None  # noqa: S101 - `_checked` made sure
        self.header, self.element = header, element
        where = f"{header.path}: {header.place(element)}"
        self.scales = columns.scale_names(element.names, where)
        self.flat = len(self.scales) < 3
        self.smoothed = columns.SMOOTHING in element.names and not self.flat
        self.degree = columns.sh_degree(element.names, where)
        self.codes = {prop.name: str(prop.code) for prop in element.properties}
        wide = any(self.codes[name] in _WIDE for name in columns.MEANS)
        self.means_dtype = np.dtype(np.float64 if wide else np.float32)
        # Number of values that became infinite, by column and first row of the block.
        self.overflowed: dict[tuple[str, int], int] = {}
        self.targets: dict[str, Array] = {}
        self.arrays: list[tuple[Sequence[str], Array]] = []  # each with the names of its columns
        self._allocate(rows)

    def _allocate(self, n: int) -> None:
        self.means = np.empty((n, 3), self.means_dtype)
        self.log_scales = np.empty((n, 3), np.float32)
        self.quats = np.empty((n, 4), np.float32)
        self.opacity_logits = np.empty(n, np.float32)
        if self.flat:
            self.log_scales[:, 2] = -np.inf
        self.sh = np.empty((n, (self.degree + 1) ** 2, 3), np.float32)
        self.extras = {
            name: np.empty(n, code)
            for name, code in self.codes.items()
            if not columns.is_known(name) and not (self.smoothed and name == columns.SMOOTHING)
        }
        self.widths = np.empty(n if self.smoothed else 0, np.float32)
        self._map_columns()

    def _map_columns(self) -> None:
        """For each column of the file, set the array view that it is copied to."""
        self.arrays = [
            (columns.MEANS, self.means),
            (self.scales, self.log_scales[:, : len(self.scales)]),
            (columns.QUATS, self.quats),
            (columns.BASE_COLOUR, self.sh[:, 0]),
            (columns.rest_names(self.degree), self.sh[:, 1:].transpose(0, 2, 1)),
        ]
        for names, array in self.arrays:
            self.targets.update(columns.by_column(names, array))
        self.targets[columns.OPACITY] = self.opacity_logits
        if self.smoothed:
            self.targets[columns.SMOOTHING] = self.widths
        self.targets.update(self.extras)

    @cached_property
    def _copies(self) -> tuple[list[tuple[Any, str, Array]], dict[str, Array]]:
        """Plan of copying: arrays whose columns are adjacent in the rows, and single columns.

        Returns:
            For each array with adjacent columns: a dtype of the rows with these columns as its only
            field, the name of the field, and the array. Then the target of each other column.
        """
        rows: Any = self.element.dtype(self.header.order)
        together, alone = [], dict(self.targets)
        for names, array in self.arrays:
            if not names:
                continue
            kind, start = rows.fields[names[0]][:2]
            if kind.newbyteorder("=") == array.dtype and all(
                rows.fields[name][:2] == (kind, start + i * kind.itemsize)
                for i, name in enumerate(names)
            ):
                row: Any = {"names": [names[0]], "formats": [(kind, array.shape[1:])]}
                row |= {"offsets": [start], "itemsize": rows.itemsize}
                together.append((np.dtype(row), names[0], array))
                for name in names:
                    del alone[name]
        return together, alone

    def put(self, block: Block) -> None:
        together, alone = self._copies
        for row, name, array in together:
            _copy(block.values.view(row)[name], array[block.rows])
        for name, target in alone.items():
            source = block.values[name]
            with np.errstate(over="ignore"):
                target[block.rows] = source
            if self.codes[name] == "f8" and target.dtype == np.float32:
                lost = np.isinf(target[block.rows]) & np.isfinite(source)
                if lost.any():
                    self.overflowed[name, block.rows.start] = int(lost.sum())

    @property
    def render_mode(self) -> RenderMode:
        """The render mode: that of flat splats if they are, whatever the comments state."""
        if self.flat:
            return RenderMode.SURFEL
        return render_tag.render_mode(self.header.all_comments)

    def splats(self, elements: list[ExtraElement]) -> Splats:
        """Return the model, when all rows are there; may be called once."""
        if self.smoothed:
            parallel.for_each(slices(len(self.widths)), self._smooth)
        return Splats(
            means=self.means,
            log_scales=self.log_scales,
            quats=self.quats,
            opacity_logits=self.opacity_logits,
            sh=self.sh,
            extras=self.extras,
            render_mode=self.render_mode,
            comments=self.header.all_comments,
            elements=elements,
            notes=[*self._conversions(), *header_notes(self.header)],
        )

    def _smooth(self, rows: slice) -> None:
        smooth(self.log_scales[rows], self.opacity_logits[rows], self.widths[rows])

    def _conversions(self) -> list[str]:
        notes = [render_tag.THIRD_SCALE] if self.flat else []
        if self.smoothed:
            notes.append(
                f"The smoothing filter of Mip-Splatting ({columns.SMOOTHING}) was applied to scales"
                " and opacities, as viewers need it."
            )
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
        notes += [became_infinite(name, count) for name, count in self._overflows().items()]
        return notes

    def _overflows(self) -> dict[str, int]:
        """Sum the values of each column that became infinite, columns in order of appearance."""
        counts: dict[str, int] = {}
        order = list(self.targets)
        for name, start in sorted(self.overflowed, key=lambda at: (at[1], order.index(at[0]))):
            counts[name] = counts.get(name, 0) + self.overflowed[name, start]
        return counts


def _copy(values: Array, out: Array) -> None:
    """Copy (R, C) values column by column, or (R, 3, C) values channel by channel."""
    for channel in range(out.shape[1]) if out.ndim == 3 else [...]:
        out[:, channel] = values[:, channel]


def _some(names: list[str]) -> str:
    return ", ".join(names[:6]) + (", …" if len(names) > 6 else "")

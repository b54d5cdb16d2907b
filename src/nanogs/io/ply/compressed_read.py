"""Reading PlayCanvas' `.compressed.ply`: 16 bytes per splat, in chunks of 256 with common bounds.

Layout: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/ply/
Positions and log-scales are quantised to 11-10-11 bits between the chunk's bounds, colours to 8
bits, rotations to the three smaller components in 10 bits each; an optional element `sh` holds one
byte per coefficient.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from nanogs._types import F64, U32, Array
from nanogs.activations import base_colour, logit
from nanogs.errors import FormatError
from nanogs.formatting import counted
from nanogs.io import columns, render_tag
from nanogs.io.info import FileInfo
from nanogs.io.parts import FileSource, Whole
from nanogs.io.ply.header import TYPE_NAMES, Element, Header, header_notes
from nanogs.io.ply.rows import iter_blocks, iter_span, read_element
from nanogs.io.rotations import whole_quats
from nanogs.slices import BLOCK_ROWS
from nanogs.splats import ExtraElement, Splats, empty_arrays

CHUNK_ROWS = 256
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
BOUNDS = [f"{end}_{axis}" for end in ("min", "max") for axis in "xyz"]
BOUNDS += [f"{end}_scale_{axis}" for end in ("min", "max") for axis in "xyz"]
COLOUR_BOUNDS = [f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"]
_OWN = ("chunk", "vertex", "sh")


def is_compressed(header: Header) -> bool:
    """Whether the header has this layout, independently of the file's name."""
    vertex = header.element("vertex")
    packed = vertex is not None and "packed_position" in vertex.names and "x" not in vertex.names
    return packed and header.element("chunk") is not None


def open_compressed(header: Header) -> FileSource:
    """Open a compressed file whose header and size have been checked.

    Raises:
        FormatError: An element does not have the properties or rows of this layout.
    """
    return (_Text if header.encoding == "ascii" else _Chunks)(header)


class _Chunks(FileSource):
    """A binary compressed file, of which any rows are read directly."""

    def __init__(self, header: Header) -> None:
        super().__init__(header.path)
        self._header, self._degree = header, _check(header)
        vertex = _element(header, "vertex")
        self.elements = tuple((e.name, e.count) for e in _kept(header) if e.name not in _OWN)
        self.info = FileInfo(
            path=header.path,
            format="compressed.ply",
            encoding=header.encoding,
            file_bytes=header.file_bytes,
            splats=vertex.count,
            sh_degree=self._degree,
            properties=tuple((p.name, TYPE_NAMES[str(p.code)]) for p in vertex.properties),
            extras=tuple(name for name in vertex.names if name not in PACKED),
            elements=tuple((e.name, e.count) for e in header.elements if e.name not in _OWN),
            render_mode=render_tag.render_mode(header.all_comments),
            render_tag=render_tag.described(header.all_comments),
            comments=header.printable_comments(),
        )
        self.columns = replace(self.info.layout, comments=tuple(header.all_comments))

    def read_elements(self) -> tuple[ExtraElement, ...]:
        """Read the further elements; see `Source.read_elements`."""
        others = [e for e in _kept(self._header) if e.name not in _OWN]
        return tuple(ExtraElement(e.name, read_element(self._header, e)) for e in others)

    def load(self) -> Splats:
        """Read the whole model, in one pass over the file."""
        rows = {e.name: np.empty(e.count, e.dtype()) for e in _kept(self._header)}
        for block in iter_blocks(self._header):
            rows[block.element.name][block.rows] = block.values
        return _splats(self._header, rows, self._degree)

    def _span(self, start: int, stop: int) -> Splats:
        """Read rows `start` to `stop` and the chunks that hold them; see `Source.read`."""
        first = start // CHUNK_ROWS
        spans = dict.fromkeys(("vertex", "sh") if self._degree else ("vertex",), (start, stop))
        spans["chunk"] = first, -(-stop // CHUNK_ROWS)
        rows = {e.name: np.empty(0, e.dtype()) for e in _kept(self._header)}
        for name, (low, high) in spans.items():
            element = _element(self._header, name)
            rows[name] = np.empty(high - low, element.dtype())
            for block in iter_span(self._header, element, low, high):
                rows[name][block.rows] = block.values
        return _splats(self._header, rows, self._degree, start - first * CHUNK_ROWS)


class _Text(Whole, _Chunks):
    """A compressed file in ASCII encoding, which is loaded whole."""

    def read_elements(self) -> tuple[ExtraElement, ...]:
        """Read the further elements; see `Source.read_elements`."""
        return tuple(self.load().elements) if self.elements else ()


def _splats(header: Header, rows: dict[str, Array], degree: int, skipped: int = 0) -> Splats:
    """Decode some rows of the file to `Splats`.

    Args:
        header: The header of the file.
        rows: The rows of each element by its name.
        degree: SH degree.
        skipped: Rows of the first chunk that precede the first vertex row.
    """
    comments = header.all_comments
    vertex = rows["vertex"]
    return Splats(
        **decoded(rows, degree, skipped),
        extras={
            name: vertex[name].copy()
            for name in _element(header, "vertex").names
            if name not in PACKED
        },
        render_mode=render_tag.render_mode(comments),
        comments=comments,
        elements=[ExtraElement(name, r) for name, r in rows.items() if name not in _OWN],
        notes=header_notes(header),
    )


def _element(header: Header, name: str) -> Element:
    return next(element for element in header.elements if element.name == name)


def _kept(header: Header) -> list[Element]:
    return [e for e in header.elements if e.is_table]


def _check(header: Header) -> int:
    """Check that the elements of the layout match each other, and return the SH degree."""
    chunk, vertex = _element(header, "chunk"), _element(header, "vertex")
    _check_types(header, vertex, list(PACKED), "u4")
    _check_types(header, chunk, BOUNDS, "f4")
    if any(name in chunk.names for name in COLOUR_BOUNDS):
        _check_types(header, chunk, COLOUR_BOUNDS, "f4")
    needed = -(-vertex.count // CHUNK_ROWS)
    if chunk.count != needed:
        needs = counted(vertex.count, "splat needs", "splats need")
        raise _error(header, f"{needs} {counted(needed, 'chunk')}, not {chunk.count:,}")
    sh = header.element("sh")
    if sh is None:
        return 0
    degree = columns.sh_degree(sh.names, f"{header.path}: element 'sh'")
    _check_types(header, sh, columns.rest_names(degree), "u1")
    if sh.count != vertex.count:
        raise _error(
            header, f"'sh' has {counted(sh.count, 'row')} for {counted(vertex.count, 'splat')}"
        )
    if len(sh.names) != len(columns.rest_names(degree)):
        raise _error(header, "element 'sh' has properties other than f_rest")
    return degree


def _check_types(header: Header, element: Element, names: list[str], code: str) -> None:
    codes = {prop.name: prop.code for prop in element.properties}
    for name in names:
        if codes.get(name) != code:
            kind = TYPE_NAMES[code]
            raise _error(header, f"element {element.name!r} needs a property {name} of type {kind}")


def _error(header: Header, what: str) -> FormatError:
    return FormatError(f"{header.path} (compressed PLY): {what}; export the file again.")


def decoded(rows: dict[str, Array], degree: int, skipped: int) -> dict[str, Any]:
    """Decode the arrays of `Splats`, computed in float64 block by block and rounded once.

    Args:
        rows: The rows of each element, by its name.
        degree: SH degree.
        skipped: Number of rows of their first chunk before these.
    """
    n = len(rows["vertex"])
    out = empty_arrays(n, degree)
    with np.errstate(invalid="ignore", over="ignore"):  # bounds may be NaN, infinite or huge
        for start in range(0, n, BLOCK_ROWS):
            span = slice(start, min(start + BLOCK_ROWS, n))
            vertex = rows["vertex"][span]
            chunk = rows["chunk"][(skipped + np.arange(span.start, span.stop)) // CHUNK_ROWS]
            out["means"][span] = _between(chunk, "{}_{}", "xyz", _unit_11_10_11(vertex[PACKED[0]]))
            out["quats"][span] = _quats(vertex[PACKED[1]])
            out["log_scales"][span] = _between(
                chunk, "{}_scale_{}", "xyz", _unit_11_10_11(vertex[PACKED[2]])
            )
            rgba = _unit_8888(vertex[PACKED[3]])
            out["opacity_logits"][span] = logit(rgba[:, 3])
            out["sh"][span, 0] = base_colour(_colour(chunk, rgba[:, :3]))
            if degree:
                out["sh"][span, 1:] = _higher(rows["sh"][span], degree)
    return out


def _unit_11_10_11(packed: U32) -> F64:
    """Unpack three numbers from 0 to 1 of 11, 10 and 11 bits, the first uppermost, (R, 3)."""
    parts = (packed >> 21) / 2047.0, (packed >> 11 & 1023) / 1023.0, (packed & 2047) / 2047.0
    return np.stack(parts, axis=1)


def _unit_8888(packed: U32) -> F64:
    """Unpack four numbers from 0 to 1 of 8 bits each, the first uppermost, (R, 4)."""
    return np.stack([(packed >> shift & 255) / 255.0 for shift in (24, 16, 8, 0)], axis=1)


def _between(chunk: Array, pattern: str, axes: str, t: F64) -> F64:
    """Interpolate between the bounds of each row's chunk.

    Args:
        chunk: (R,) the chunk of each row.
        pattern: Name of a bound, to be formatted with "min" or "max" and an axis.
        axes: A letter for each column.
        t: (R, 3), 0 at the lower bound and 1 at the upper one.
    """
    low, high = (
        np.stack([chunk[pattern.format(end, axis)].astype(np.float64) for axis in axes], axis=1)
        for end in ("min", "max")
    )
    result: F64 = low * (1 - t) + high * t
    return result


def _colour(chunk: Array, rgb: F64) -> F64:
    """Dequantise colours: between the chunk's bounds, or, in older files without them, 0 to 1."""
    names = chunk.dtype.names or ()
    return _between(chunk, "{}_{}", "rgb", rgb) if "min_r" in names else rgb


def _quats(packed: U32) -> F64:
    """Decode quaternions, (R, 4) wxyz; the top two bits are the index of the left-out component."""
    small = np.stack([packed >> shift & 1023 for shift in (20, 10, 0)], axis=1)
    return whole_quats((small / 1023.0 - 0.5) * np.sqrt(2.0), packed >> 30)


def _higher(sh: Array, degree: int) -> F64:
    """Decode the higher coefficients, (R, K - 1, 3).

    A byte stands for the middle of one of 256 steps over [-4, 4]; 0 and 255 are exactly the ends.
    """
    stored = np.stack([sh[name] for name in columns.rest_names(degree)], axis=1)
    unit = (stored + 0.5) / 256
    unit[stored == 0] = 0
    unit[stored == 255] = 1
    result: F64 = ((unit - 0.5) * 8).reshape(len(sh), 3, -1).transpose(0, 2, 1)
    return result

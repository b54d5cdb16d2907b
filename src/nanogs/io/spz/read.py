"""Reading `.spz` (Niantic), versions 1 to 4; the containers are in `header`.

How the columns decode, from https://github.com/nianticlabs/spz (MIT; src/cc/load-spz.cc): a
log-scale is byte / 16 - 10, a base colour (byte / 255 - 0.5) / 0.15 as SH coefficient, a higher
coefficient (byte - 128) / 128. A rotation is xyz as byte / 127.5 - 1 with w the positive rest up
to version 2; from version 3 on, the two top bits of the u32 tell the largest part of xyzw, and the
others follow in order from the top, a sign bit and 9 bits of magnitude over [0, sqrt(1/2)] each.

The specification has y up and z backwards, but few files say so and most converters copy as we do,
axes as they are. A frame that a file does state is told (`FileSource.frame`). Alpha 0 and 255
become -inf and +inf, as in every 8-bit format here.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np

from nanogs._types import F32, F64, I32, U8, Array
from nanogs.io.files import BLOCK_ROWS
from nanogs.io.info import FileInfo
from nanogs.io.parts import Column, ColumnReader, Packed
from nanogs.io.rotations import whole_quats
from nanogs.io.section import whole_file
from nanogs.io.spz.body import body_pieces, read_records, stated_frame, window_bytes
from nanogs.io.spz.header import ANTIALIASED, LAST_GZIP, Header, read_header
from nanogs.io.spz.records import elements_of
from nanogs.splats import ExtraElement, RenderMode, Splats, empty_arrays
from nanogs.stored import logit

COLOUR_SCALE = 0.15
SCALE_STEPS, SCALE_LOW = 16, -10.0
SH_STEPS = 128
MAGNITUDE = 511  # of 9 bits; stands for sqrt(1/2), which no part but the largest exceeds

_PIECES = 8 << 20  # bytes: packed and unpacked ones, and buffers
_BYTES = np.arange(256)
_ALPHAS = logit(_BYTES / 255).astype(np.float32)
_COLOURS = ((_BYTES / 255 - 0.5) / COLOUR_SCALE).astype(np.float32)
_SCALES = (_BYTES / SCALE_STEPS + SCALE_LOW).astype(np.float32)
_SH = ((_BYTES - 128) / SH_STEPS).astype(np.float32)


def open_spz(path: Path) -> "SpzSource":
    """An `.spz` file of version 1 to 4, axes as stored.

    Raises:
        FormatError: The file cannot be read, is damaged, or is no model of splats.
    """
    return SpzSource(path, read_header(whole_file(path)))


class SpzSource(Packed):
    """The columns of a file, or of SPZ data in another one, as they are stored, inflated.

    Args:
        path: The file.
        header: Of the data.
    """

    def __init__(self, path: Path, header: Header) -> None:
        super().__init__(path)
        self._header = header
        self._widths = header.columns()
        self.stored = {n: Column("|u1", (header.count, w)) for n, w in self._widths.items()}
        # Records of older versions follow the columns; those are not unpacked for them.
        records = read_records(header) if header.version > LAST_GZIP else {}
        self._elements = elements_of(records, header.count)
        self.elements = tuple((each.name, len(each.rows)) for each in self._elements)
        self.info = FileInfo(
            path=path,
            format="spz",
            encoding=_encoding(header),
            file_bytes=header.file_bytes,
            splats=header.count,
            sh_degree=header.degree,
            properties=_properties(header),
            elements=self.elements,
            render_mode=_render_mode(header),
            render_tag=f"the antialiased flag of its header, {header.flags & ANTIALIASED}",
        )

    @cached_property
    def frame(self) -> str:
        """The frame that a record states; of a gzip stream, all of it is inflated for that."""
        return stated_frame(self._header)

    @cached_property
    def memory(self) -> int:
        """The decoder's window, and some pieces."""
        return window_bytes(self._header) + _PIECES

    def unpack(self, notes: list[str]) -> Iterator[Array]:
        """All columns; see `Packed`."""
        pieces = body_pieces(self._header, notes)
        for width in self._widths.values():
            left = self._header.count
            while left:
                piece = np.frombuffer(next(pieces), np.uint8).reshape(-1, width)
                left -= len(piece)
                yield piece
        next(pieces, None)  # what follows the columns is looked at

    def decode(self, columns: ColumnReader, start: int, stop: int) -> Splats:
        """Some rows; see `Packed`."""
        stored = {name: columns(name, start, stop) for name in self._widths}
        elements = [ExtraElement(each.name, each.rows[:0]) for each in self._elements]
        return replace(_decoded(self._header, stored), elements=elements)

    def read_elements(self) -> tuple[ExtraElement, ...]:
        """Extension records of version 4; see `Source`."""
        return self._elements

    def load(self) -> Splats:
        """The whole model."""
        return replace(super().load(), elements=self._elements)


def _decoded(header: Header, columns: Mapping[str, U8]) -> Splats:
    n, coefficients = len(columns["alphas"]), (header.degree + 1) ** 2
    out = empty_arrays(n, header.degree)
    out["opacity_logits"] = _ALPHAS[columns["alphas"][:, 0]]
    for start in range(0, n, BLOCK_ROWS):
        span = slice(start, min(start + BLOCK_ROWS, n))
        block = {name: column[span] for name, column in columns.items()}
        out["means"][span] = _means(block["positions"], header)
        out["log_scales"][span] = _SCALES[block["scales"]]
        out["quats"][span] = (_xyz_quats if header.version <= 2 else _quats)(block["rotations"])
        out["sh"][span, 0] = _COLOURS[block["colours"]]
        if header.degree:
            out["sh"][span, 1:] = _SH[block["sh"]].reshape(-1, coefficients - 1, 3)
    return Splats(**out, render_mode=_render_mode(header))


def _properties(header: Header) -> tuple[tuple[str, str], ...]:
    """Name and type of each stored column, as `FileInfo` has them."""
    position = "float16" if header.version == 1 else "int24"
    rotation = "uchar" if header.version <= 2 else "uint"
    types = {"positions": position, "rotations": rotation}
    return tuple((name, types.get(name, "uchar")) for name in header.columns())


def _encoding(header: Header) -> str:
    """How the columns are packed, as `FileInfo` says it."""
    if header.version > LAST_GZIP:
        return "zstd"
    return "gzip" if header.gzip else "binary_little_endian"


def _render_mode(header: Header) -> RenderMode:
    """The model's properties as the flags have them."""
    return RenderMode.MIP if header.flags & ANTIALIASED else RenderMode.DEFAULT


def _means(stored: U8, header: Header) -> F32 | F64:
    """(R, 3) scene units."""
    if header.version == 1:
        return stored.view("<f2").astype(np.float32)
    result: F64 = np.ldexp(whole_numbers(stored).astype(np.float64), -header.fraction_bits)
    return result


def whole_numbers(stored: U8) -> I32:
    """(R, 3) of (R, 9): centres as whole numbers of 24 bits."""
    # The three bytes become the upper ones of an int32; shifting it back extends the sign.
    wide = np.zeros((len(stored), 3, 4), np.uint8)
    wide[:, :, 1:] = stored.reshape(-1, 3, 3)
    numbers: I32 = wide.view("<i4")[:, :, 0] >> 8
    return numbers


def _xyz_quats(stored: U8) -> F64:
    """(R, 4) wxyz: w is what is left of unit length."""
    xyz = stored / 127.5 - 1
    w = np.sqrt(np.maximum(0, 1 - (xyz**2).sum(axis=1)))
    return np.column_stack([w, xyz])


def _quats(stored: U8) -> F64:
    """(R, 4) wxyz: the two top bits say which part of xyzw was the largest and is left out."""
    packed = np.ascontiguousarray(stored).view("<u4")[:, 0]
    parts = np.stack([packed >> shift & 1023 for shift in (20, 10, 0)], axis=1)
    small = np.sqrt(0.5) * (parts & MAGNITUDE) / MAGNITUDE
    small = np.where(parts > MAGNITUDE, -small, small)
    return whole_quats(small, packed >> 30)[:, [3, 0, 1, 2]]

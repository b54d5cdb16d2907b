"""Reading `.spz` (Niantic), versions 1 to 4; the containers are in `header`.

Decoding of the columns, from https://github.com/nianticlabs/spz (MIT; src/cc/load-spz.cc): a
log-scale is byte / 16 - 10, a base colour (byte / 255 - 0.5) / 0.15 as SH coefficient, a higher
coefficient (byte - 128) / 128. Up to version 2 a rotation is xyz as byte / 127.5 - 1, with w the
non-negative value that gives unit length. From version 3 on, the two top bits of the u32 are the
index of the largest component of xyzw; the others follow in order from the top, each a sign bit and
9 bits of magnitude over [0, sqrt(1/2)].

The specification has y up and z backwards, but few files state it, and most converters copy the
axes unchanged, as nanogs does. A frame that a file does state is in `FileSource.frame`. Alpha 0 and
255 become logits of -inf and +inf, as in every 8-bit format here.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np

from nanogs._types import F32, F64, I32, U8, Array
from nanogs.activations import BYTE_LOGITS
from nanogs.io.info import FileInfo
from nanogs.io.parts import Column, ColumnReader, Packed
from nanogs.io.rotations import whole_quats, with_w
from nanogs.io.section import whole_file
from nanogs.io.spz.body import body_pieces, read_records, stated_frame, window_bytes
from nanogs.io.spz.header import ANTIALIASED, LAST_GZIP, Header, read_header
from nanogs.io.spz.records import elements_of
from nanogs.slices import BLOCK_ROWS
from nanogs.splats import ExtraElement, RenderMode, Splats, empty_arrays

COLOUR_SCALE = 0.15
SCALE_STEPS, SCALE_LOW = 16, -10.0
SH_STEPS = 128
# The largest 9-bit magnitude; it encodes sqrt(1/2), which only the largest component can exceed.
MAGNITUDE = 511

_PIECES = 8 << 20  # memory in bytes for compressed and decompressed pieces, and buffers
_BYTES = np.arange(256)
COLOURS = ((_BYTES / 255 - 0.5) / COLOUR_SCALE).astype(np.float32)
LOG_SCALES = (_BYTES / SCALE_STEPS + SCALE_LOW).astype(np.float32)
_SH = ((_BYTES - 128) / SH_STEPS).astype(np.float32)


def open_spz(path: Path) -> "SpzSource":
    """Open an `.spz` file of version 1 to 4, with axes as stored.

    Raises:
        FormatError: The file cannot be read, is damaged, or is no model of splats.
    """
    return SpzSource(path, read_header(whole_file(path)))


class SpzSource(Packed):
    """The source of an `.spz` file, or of SPZ data inside another file.

    The stored bytes of all columns are decompressed once and decoded when rows are read.

    Args:
        path: The file.
        header: The header of the SPZ data.
    """

    def __init__(self, path: Path, header: Header) -> None:
        super().__init__(path)
        self._header = header
        self._widths = header.columns()
        self.stored = {n: Column("|u1", (header.count, w)) for n, w in self._widths.items()}
        # In older versions the records follow the columns, which would have to be decompressed.
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
        """The coordinate frame stated by a record, or ""; a gzip stream is decompressed whole."""
        return stated_frame(self._header)

    @cached_property
    def memory(self) -> int:
        """Bytes of memory that decompression takes: the decoder's window, and some pieces."""
        return window_bytes(self._header) + _PIECES

    def unpack(self, notes: list[str]) -> Iterator[Array]:
        """Yield all columns decompressed, in file order; see `Packed`."""
        pieces = body_pieces(self._header, notes)
        for width in self._widths.values():
            left = self._header.count
            while left:
                piece = np.frombuffer(next(pieces), np.uint8).reshape(-1, width)
                left -= len(piece)
                yield piece
        next(pieces, None)  # makes the generator check the data after the columns

    def decode(self, columns: ColumnReader, start: int, stop: int) -> Splats:
        """Decode rows `start` to `stop`; see `Packed`."""
        stored = {name: columns(name, start, stop) for name in self._widths}
        elements = [ExtraElement(each.name, each.rows[:0]) for each in self._elements]
        return replace(_decoded(self._header, stored), elements=elements)

    def read_elements(self) -> tuple[ExtraElement, ...]:
        """Return the extension records of version 4; see `Source`."""
        return self._elements

    def load(self) -> Splats:
        """Read the whole model, with its extension records."""
        return replace(super().load(), elements=self._elements)


def _decoded(header: Header, columns: Mapping[str, U8]) -> Splats:
    n, coefficients = len(columns["alphas"]), (header.degree + 1) ** 2
    out = empty_arrays(n, header.degree)
    out["opacity_logits"] = BYTE_LOGITS[columns["alphas"][:, 0]]
    for start in range(0, n, BLOCK_ROWS):
        span = slice(start, min(start + BLOCK_ROWS, n))
        block = {name: column[span] for name, column in columns.items()}
        out["means"][span] = _means(block["positions"], header)
        out["log_scales"][span] = LOG_SCALES[block["scales"]]
        out["quats"][span] = (_xyz_quats if header.version <= 2 else _quats)(block["rotations"])
        out["sh"][span, 0] = COLOURS[block["colours"]]
        if header.degree:
            out["sh"][span, 1:] = _SH[block["sh"]].reshape(-1, coefficients - 1, 3)
    return Splats(**out, render_mode=_render_mode(header))


def _properties(header: Header) -> tuple[tuple[str, str], ...]:
    """Return the name and the type of each stored column, for `FileInfo`."""
    position = "float16" if header.version == 1 else "int24"
    rotation = "uchar" if header.version <= 2 else "uint"
    types = {"positions": position, "rotations": rotation}
    return tuple((name, types.get(name, "uchar")) for name in header.columns())


def _encoding(header: Header) -> str:
    """Return the name of the columns' compression, for `FileInfo`."""
    if header.version > LAST_GZIP:
        return "zstd"
    return "gzip" if header.gzip else "binary_little_endian"


def _render_mode(header: Header) -> RenderMode:
    """Return the render mode that the header's antialiased flag states."""
    return RenderMode.MIP if header.flags & ANTIALIASED else RenderMode.DEFAULT


def _means(stored: U8, header: Header) -> F32 | F64:
    """Decode the centres of R splats to (R, 3) scene units."""
    if header.version == 1:
        return stored.view("<f2").astype(np.float32)
    result: F64 = np.ldexp(whole_numbers(stored).astype(np.float64), -header.fraction_bits)
    return result


def whole_numbers(stored: U8) -> I32:
    """Unpack (R, 9) bytes to the (R, 3) signed 24-bit integers of the centres."""
    # The three bytes become the upper ones of an int32; shifting it right extends the sign.
    wide = np.zeros((len(stored), 3, 4), np.uint8)
    wide[:, :, 1:] = stored.reshape(-1, 3, 3)
    numbers: I32 = wide.view("<i4")[:, :, 0] >> 8
    return numbers


def _xyz_quats(stored: U8) -> F64:
    """Decode the rotations of versions 1 and 2 to (R, 4) wxyz; w follows from unit length."""
    return with_w(stored / 127.5 - 1)


def _quats(stored: U8) -> F64:
    """Decode the rotations of versions 3 and 4 to (R, 4) wxyz.

    The two top bits are the index in xyzw of the largest component, which is not stored.
    """
    packed = np.ascontiguousarray(stored).view("<u4")[:, 0]
    parts = np.stack([packed >> shift & 1023 for shift in (20, 10, 0)], axis=1)
    small = np.sqrt(0.5) * (parts & MAGNITUDE) / MAGNITUDE
    small = np.where(parts > MAGNITUDE, -small, small)
    return whole_quats(small, packed >> 30)[:, [3, 0, 1, 2]]

"""The `.spz` containers (Niantic): reading the header, sizes of columns, bounded decompression.

Layout, from https://github.com/nianticlabs/spz (MIT; README.md, src/cc/load-spz.cc,
extensions/README.md), little-endian throughout:

- Versions 1 to 3 are one gzip stream: `NGSP`, u32 version, u32 count, u8 SH degree, u8 fraction
  bits, u8 flags, u8 zero; the columns; extension records if flag 0x2 is set. Some tools write the
  same without gzip.
- Version 4 starts with 32 plain bytes: the same up to the flags, u8 number of streams, u32 offset
  of the table of contents, 12 zeros. Extension records are between header and table; the table
  has the compressed and the uncompressed size (u64 each) of every stream; the streams follow it up
  to the end of the file, one zstd stream per column and none for an empty column.
- Columns, each for all splats: positions (3 x float16 in version 1, else 3 x signed 24-bit fixed
  point with the header's fraction bits), alphas u8, colours 3 x u8, log-scales 3 x u8, rotations
  (3 x u8 up to version 2, else u32), SH of degree 1 and up, u8 each, coefficient-major, RGB last.
- Flags: 0x1 antialiased, 0x2 extension records (u32 type, u32 length, payload). The record
  0xADBE0003 has a u32, the coordinate frame of all stored values: 0 for the usual one, y up and z
  backwards, and 1 to 16 for those of `RECORDED_FRAMES` (extensions/cc/coordinate-system-adobe.cc).
  The viewer Spark sets 0x80 for a tree of levels of detail, where splats of different levels
  overlap and opacities have another meaning (https://github.com/sparkjsdev/spark).
"""

import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from nanogs.errors import FormatError
from nanogs.io.files import check_expansion, damaged, splat_bytes, unreadable
from nanogs.io.section import Section
from nanogs.splats import MAX_SH_DEGREE

SUFFIX = ".spz"
MAGIC = b"NGSP"
LEGACY_HEADER = struct.Struct("<4sIIBBBB")
HEADER = struct.Struct("<4sIIBBBBI12x")
TOC_ENTRY = struct.Struct("<QQ")
FRAME_RECORD, CAMERA_RECORD = 0xADBE0003, 0xADBE0002
RECORD = struct.Struct("<II")
# Frame names by record number minus 1; "forwards" (f) here means away from the viewer.
RECORDED_FRAMES = (
    "ldb", "rdb", "lub", "rub", "ldf", "rdf", "luf", "ruf",
    "lfd", "rfd", "lfu", "rfu", "lbd", "rbd", "lbu", "rbu",
)  # fmt: skip
ANTIALIASED, EXTENSIONS, LOD_TREE = 0x1, 0x2, 0x80
MAX_FRACTION_BITS = 24
LAST_GZIP = 3  # the last version that is a single gzip stream
VERSION_SHORT_ROTATIONS = 2  # the last one with 3-byte rotations
VERSION_WITH_FRAME = 4  # the one that can state a frame

GZIP = b"\x1f\x8b"
_CHUNK = 1 << 20


@dataclass(frozen=True, slots=True)
class Header:
    """The validated header of an `.spz` file.

    Attributes:
        section: Where the SPZ data is: usually a whole file.
        version: 1 to 4.
        count: Number of splats, 1 or more.
        degree: SH degree, 0 to 4.
        fraction_bits: Bits after the binary point of a fixed-point coordinate.
        flags: Bit flags, see the module's docstring.
        streams: Number of zstd streams; 0 before version 4.
        toc: Offset of the table of contents; 0 before version 4.
        gzip: Whether the file is one gzip stream.
    """

    section: Section
    version: int
    count: int
    degree: int
    fraction_bits: int
    flags: int
    streams: int = 0
    toc: int = 0
    gzip: bool = field(default=False, kw_only=True)

    @property
    def path(self) -> Path:
        """Path of the file, for messages."""
        return self.section.path

    @property
    def file_bytes(self) -> int:
        """Size in bytes of the SPZ data, header included."""
        return self.section.size

    def columns(self) -> dict[str, int]:
        """Return the bytes per splat of each column, in file order, without empty columns."""
        return column_widths(self.version, self.degree)


def column_widths(version: int, degree: int) -> dict[str, int]:
    """Return the bytes per splat of each column, in file order."""
    widths = {
        "positions": 6 if version == 1 else 9,
        "alphas": 1,
        "colours": 3,
        "scales": 3,
        "rotations": 3 if version <= VERSION_SHORT_ROTATIONS else 4,
    }
    if degree:
        widths["sh"] = 3 * ((degree + 1) ** 2 - 1)
    return widths


def read_header(section: Section) -> Header:
    """Read the header of a file, or of SPZ data inside another one, and check it against the size.

    Raises:
        FormatError: The file cannot be read, is no `.spz` file, or its header is damaged.
    """
    path = section.path
    with opened(section) as file:
        start = file.read(4)
        file.seek(0)
        if start[:2] == GZIP:
            fields = _unpack(path, LEGACY_HEADER, Inflater(path, file).read(LEGACY_HEADER.size))
            header = Header(section, *fields[1:6], gzip=True)
        elif start == MAGIC:
            header = _plain_header(section, file.read(HEADER.size))
        else:
            raise FormatError(
                f"{path} starts neither like gzip nor with NGSP, so it is no .spz file; check"
                " what it is."
            )
    _check(header)
    return header


def _plain_header(section: Section, data: bytes) -> Header:
    """Parse the header of version 4, or of an older version without gzip."""
    fields = _unpack(section.path, LEGACY_HEADER, data[: LEGACY_HEADER.size])
    if 1 <= fields[1] <= LAST_GZIP:
        return Header(section, *fields[1:6])
    return Header(section, *_unpack(section.path, HEADER, data)[1:])


@contextmanager
def opened(section: Section) -> Iterator[BinaryIO]:
    """Open SPZ data for reading; errors of reading and decompression become `FormatError`.

    Raises:
        FormatError: Reading or decompressing inside the `with` block failed.
    """
    from zstandard import ZstdError

    try:
        with section.opened() as file:
            yield file
    except (zlib.error, ZstdError) as error:
        raise FormatError(
            f"{section.path} is damaged ({error}); export or download it again."
        ) from None
    except OSError as error:
        raise unreadable(section.path, error) from error


def _unpack(path: Path, layout: struct.Struct, data: bytes) -> tuple[int, ...]:
    if len(data) < layout.size or data[:4] != MAGIC:
        raise FormatError(f"{path} has no whole NGSP header; export or download it again.")
    return layout.unpack(data)


def _check(header: Header) -> None:
    """Refuse field values that are not allowed, and counts that the file's size contradicts."""
    if not 1 <= header.version <= (LAST_GZIP if header.gzip else 4):
        kind = "gzip" if header.gzip else "plain"
        raise FormatError(
            f"{header.path}: version {header.version} in a {kind} header, but nanogs reads .spz"
            " of versions 1 to 3, and of version 4 without gzip; export it as one of these."
        )
    if header.degree > MAX_SH_DEGREE or header.fraction_bits > MAX_FRACTION_BITS:
        raise damaged(
            header.path,
            f"SH degree {header.degree} with {header.fraction_bits} fraction bits, where at most"
            f" {MAX_SH_DEGREE} and {MAX_FRACTION_BITS} are possible",
        )
    if header.flags & LOD_TREE:
        raise FormatError(
            f"{header.path} holds a tree of levels of detail, whose splats overlap; export the"
            " full model."
        )
    if header.count == 0:
        raise FormatError(f"{header.path} holds no splats; export a model with splats.")
    model_bytes = header.count * splat_bytes(header.degree)
    check_expansion(str(header.path), model_bytes, header.file_bytes)


class Inflater:
    """A decompressor for a gzip file that never holds more output than was requested."""

    def __init__(self, path: Path, file: BinaryIO) -> None:
        self.path, self.file = path, file
        self.inflate = zlib.decompressobj(wbits=31)

    def read(self, size: int) -> bytes:
        """Return the next `size` bytes, or fewer only at the end, where the checksum is verified.

        Raises:
            FormatError: The file ends within the stream.
        """
        out = bytearray()
        while len(out) < size and not self.inflate.eof:
            data = self.inflate.unconsumed_tail or self.file.read(_CHUNK)
            piece = self.inflate.decompress(data, size - len(out))
            if not data and not piece and not self.inflate.eof:
                raise FormatError(f"{self.path} is cut short; export or download it again.")
            out += piece
        return bytes(out)

    def trailing(self) -> bool:
        """Return whether bytes follow the gzip stream, once it has been read to its end."""
        return bool(self.inflate.unused_data or self.file.read(1))

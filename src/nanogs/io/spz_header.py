"""The containers of `.spz` (Niantic): header, columns, and the bytes inside, with bounds on both.

Layout, from https://github.com/nianticlabs/spz (MIT; README.md, src/cc/load-spz.cc,
extensions/README.md), little-endian throughout:

- Versions 1 to 3 are one gzip stream: `NGSP`, u32 version, u32 count, u8 SH degree, u8 fraction
  bits, u8 flags, u8 zero; the columns; extension records if flag 0x2 is set.
- Version 4 starts with 32 plain bytes: the same up to the flags, u8 number of streams, u32 offset
  of the table of contents, 12 zeros. Extension records lie between header and table; the table
  has the compressed and the plain size (u64 each) of every stream; the streams, one zstd column
  each and none for an empty column, follow it up to the end of the file.
- Columns, each for all splats: positions (3 x float16 in version 1, else 3 x signed 24-bit fixed
  point with the header's fraction bits), alphas u8, colours 3 x u8, log-scales 3 x u8, rotations
  (3 x u8 up to version 2, else u32), SH of degree 1 and up, u8 each, coefficient-major, RGB last.
- Flags: 0x1 antialiased, 0x2 extension records (u32 type, u32 length, payload). Spark, a viewer,
  sets 0x80 for a tree of levels of detail, whose rows overlap and whose opacities mean another
  thing (https://github.com/sparkjsdev/spark).
"""

import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from nanogs._types import U8
from nanogs.errors import FormatError
from nanogs.io.files import check_expansion, input_size, splat_bytes, unreadable
from nanogs.splats import MAX_SH_DEGREE

MAGIC = b"NGSP"
LEGACY_HEADER = struct.Struct("<4sIIBBBB")
HEADER = struct.Struct("<4sIIBBBBI12x")
TOC_ENTRY = struct.Struct("<QQ")
ANTIALIASED, EXTENSIONS, LOD_TREE = 0x1, 0x2, 0x80
MAX_FRACTION_BITS = 24

_GZIP = b"\x1f\x8b"
_CHUNK = 1 << 20
_MAX_EXTENSIONS = 1 << 20
_MAX_WINDOW = 1 << 27
_KNOWN_RECORDS = {0xADBE0002: "limits of the camera", 0xADBE0003: "coordinate system"}


@dataclass(frozen=True, slots=True)
class Header:
    """The header of an `.spz` file, checked.

    Attributes:
        path: The file.
        file_bytes: Its size.
        version: 1 to 4.
        count: Splats, 1 or more.
        degree: SH degree, 0 to 4.
        fraction_bits: Bits behind the binary point of a coordinate.
        flags: As above.
        streams: Number of zstd streams; 0 before version 4.
        toc: Offset of the table of contents; 0 before version 4.
    """

    path: Path
    file_bytes: int
    version: int
    count: int
    degree: int
    fraction_bits: int
    flags: int
    streams: int = 0
    toc: int = 0

    def columns(self) -> dict[str, int]:
        """Bytes a splat of each column, in the file's order; those of no bytes left out."""
        return column_widths(self.version, self.degree)

    def body_bytes(self) -> int:
        """Bytes of all columns."""
        return self.count * sum(self.columns().values())


def column_widths(version: int, degree: int) -> dict[str, int]:
    """Bytes a splat of each column, in the file's order."""
    widths = {
        "positions": 6 if version == 1 else 9,
        "alphas": 1,
        "colours": 3,
        "scales": 3,
        "rotations": 3 if version <= 2 else 4,
    }
    if degree:
        widths["sh"] = 3 * ((degree + 1) ** 2 - 1)
    return widths


def read_header(path: Path) -> Header:
    """The header of a file, checked against the file's size.

    Raises:
        FormatError: The file cannot be read, is no `.spz` file, or its header is damaged.
    """
    size = input_size(path)
    with _opened(path) as file:
        start = file.read(4)
        file.seek(0)
        if start[:2] == _GZIP:
            fields = _unpack(path, LEGACY_HEADER, _Inflater(path, file).read(LEGACY_HEADER.size))
            header = Header(path, size, *fields[1:6])
        elif start == MAGIC:
            fields = _unpack(path, HEADER, file.read(HEADER.size))
            header = Header(path, size, *fields[1:])
        else:
            raise FormatError(
                f"{path} starts neither like gzip nor with NGSP, so it is no .spz file; check"
                " what it is."
            )
    _check(header, legacy=start != MAGIC)
    return header


def read_body(header: Header) -> tuple[dict[str, U8], list[str]]:
    """The columns, and notes on what beside them was left out.

    Returns:
        (N, width) uint8 of each column by name, and the notes.

    Raises:
        FormatError: The file cannot be read, or holds more or less than its header counts.
    """
    with _opened(header.path) as file:
        body, records = (_plain if header.version < 4 else _streams)(header, file)
    columns, at = {}, 0
    for name, width in header.columns().items():
        end = at + width * header.count
        columns[name] = np.frombuffer(body, np.uint8, end - at, at).reshape(-1, width)
        at = end
    return columns, _extension_notes(header, records)


@contextmanager
def _opened(path: Path) -> Iterator[BinaryIO]:
    """The file, with everything that reading and expanding it may raise as a `FormatError`."""
    from zstandard import ZstdError

    try:
        with path.open("rb") as file:
            yield file
    except (zlib.error, ZstdError) as error:
        raise FormatError(f"{path} is damaged ({error}); export or download it again.") from None
    except OSError as error:
        raise unreadable(path, error) from error


def _unpack(path: Path, layout: struct.Struct, data: bytes) -> tuple[int, ...]:
    if len(data) < layout.size or data[:4] != MAGIC:
        raise FormatError(f"{path} has no whole NGSP header; export or download it again.")
    return layout.unpack(data)


def _check(header: Header, *, legacy: bool) -> None:
    """Refuse values that no such file has, and counts that the file's size contradicts."""
    if not (1 <= header.version <= 3 if legacy else header.version == 4):
        kind = "gzip" if legacy else "plain"
        raise FormatError(
            f"{header.path}: version {header.version} in a {kind} header, but nanogs reads .spz"
            " of versions 1 to 3 in gzip and of version 4; export it as one of these."
        )
    if header.degree > MAX_SH_DEGREE or header.fraction_bits > MAX_FRACTION_BITS:
        raise _damaged(
            header,
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


def _damaged(header: Header, what: str) -> FormatError:
    return FormatError(f"{header.path} is damaged: {what}; export or download it again.")


class _Inflater:
    """The bytes inside a gzip file, never more at a time than asked for."""

    def __init__(self, path: Path, file: BinaryIO) -> None:
        self.path, self.file = path, file
        self.inflate = zlib.decompressobj(wbits=31)

    def read(self, size: int) -> bytes:
        """The next bytes; fewer than asked for only at the end, whose checksum is then checked.

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
        """Whether anything follows the stream, once that has been read to its end."""
        return bool(self.inflate.unused_data or self.file.read(1))


def _plain(header: Header, file: BinaryIO) -> tuple[bytearray, bytes]:
    """The columns of versions 1 to 3, and the extension records after them."""
    inflater = _Inflater(header.path, file)
    inflater.read(LEGACY_HEADER.size)
    body = _drain(inflater.read, header.body_bytes())
    if len(body) < header.body_bytes():
        raise _damaged(header, f"the columns end before {header.count:,} splats")
    allowed = _MAX_EXTENSIONS if header.flags & EXTENSIONS else 0
    records = inflater.read(allowed + 1)
    if len(records) > allowed:
        raise _damaged(header, f"more data than {header.count:,} splats have")
    if inflater.trailing():
        raise _damaged(header, "something follows its compressed data")
    return body, records


def _drain(read: Callable[[int], bytes], size: int) -> bytearray:
    """Up to `size` bytes; memory grows with what there is, not with what was promised."""
    out = bytearray()
    while len(out) < size and (piece := read(min(_CHUNK, size - len(out)))):
        out += piece
    return out


def _streams(header: Header, file: BinaryIO) -> tuple[bytearray, bytes]:
    """The columns of version 4 one after the other, and the extension records."""
    sizes = _contents(header, file)
    file.seek(HEADER.size)
    records = file.read(header.toc - HEADER.size) if header.flags & EXTENSIONS else b""
    file.seek(header.toc + len(sizes) * TOC_ENTRY.size)
    body = bytearray()
    for (name, width), size in zip(header.columns().items(), sizes, strict=True):
        expected = width * header.count
        column = _expand(file.read(size), expected)
        if len(column) != expected:
            raise _damaged(header, f"its {name} do not expand to {expected:,} bytes")
        body += column
    return body, records


def _contents(header: Header, file: BinaryIO) -> list[int]:
    """The compressed size of each stream, everything in the table checked."""
    expected = [width * header.count for width in header.columns().values()]
    end = header.toc + len(expected) * TOC_ENTRY.size
    if header.streams != len(expected) or header.toc < HEADER.size or end > header.file_bytes:
        raise _damaged(header, f"a table of {header.streams} streams at byte {header.toc}")
    file.seek(header.toc)
    entries = list(TOC_ENTRY.iter_unpack(file.read(end - header.toc)))
    if len(entries) != len(expected) or [plain for _, plain in entries] != expected:
        raise _damaged(header, "the sizes of its streams do not fit its count of splats")
    if end + sum(packed for packed, _ in entries) != header.file_bytes:
        raise _damaged(header, "its streams do not end where the file does")
    return [packed for packed, _ in entries]


def _expand(data: bytes, size: int) -> bytearray:
    """What a zstd stream expands to, but at most one byte more than `size`."""
    import zstandard

    reader = zstandard.ZstdDecompressor(max_window_size=_MAX_WINDOW).stream_reader(
        data, read_across_frames=True
    )
    return _drain(reader.read, size + 1)


def _extension_notes(header: Header, records: bytes) -> list[str]:
    """A note that names the extension records, whose payload is not carried."""
    names, at = [], 0
    while at + 8 <= len(records):
        kind, length = struct.unpack_from("<II", records, at)
        names.append(_KNOWN_RECORDS.get(kind, f"0x{kind:08X}"))
        at += 8 + length
    if at != len(records):
        raise _damaged(header, "an extension record is cut short")
    if not names:
        return []
    return [f"Extension records of the .spz file were left out: {', '.join(names)}."]

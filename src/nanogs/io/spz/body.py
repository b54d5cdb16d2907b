"""Contents of an `.spz` file: columns and extension records, decompressed piece by piece.

The file layout is described in `header`. Never more is decompressed than the header's count of
splats allows.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from itertools import accumulate
from typing import TYPE_CHECKING, BinaryIO

from nanogs.formatting import counted
from nanogs.frames import Y_UP
from nanogs.io.files import damaged
from nanogs.io.spz.header import (
    CAMERA_RECORD,
    EXTENSIONS,
    FRAME_RECORD,
    HEADER,
    LAST_GZIP,
    LEGACY_HEADER,
    RECORD,
    RECORDED_FRAMES,
    TOC_ENTRY,
    Header,
    Inflater,
    opened,
)

if TYPE_CHECKING:
    from zstandard import ZstdDecompressionReader

_CHUNK = 1 << 20
_MAX_EXTENSIONS = 1 << 20
_MAX_WINDOW = 1 << 27
_NUMBER = 4  # bytes of the number of a coordinate frame
_FRAME_HEADER = 18  # bytes of the largest possible zstd frame header
_KNOWN_RECORDS = {CAMERA_RECORD: "limits of the camera"}


def body_pieces(header: Header, notes: list[str]) -> Iterator[bytes]:
    """Yield the decompressed columns in file order, in pieces of whole rows of at most a megabyte.

    Args:
        header: The header of the file.
        notes: List to which notes about left-out extension records are appended.

    Raises:
        FormatError: The file cannot be read, or holds more or less than its header counts.
    """
    with opened(header.section) as file:
        yield from (_plain if header.version <= LAST_GZIP else _streams)(header, file, notes)


def window_bytes(header: Header) -> int:
    """Return the window size in bytes that decompressing the columns needs.

    For zstd, it is the largest that the first frame of any stream states, within a limit.

    Raises:
        FormatError: The file cannot be read, or a stream is damaged.
    """
    import zstandard

    if header.version <= LAST_GZIP:
        return 1 << 15  # of gzip
    largest = 0
    with opened(header.section) as file:
        for _, at, size in _places(header, file):
            file.seek(at)
            frame = zstandard.get_frame_parameters(file.read(min(size, _FRAME_HEADER)))
            largest = max(largest, min(frame.window_size, _MAX_WINDOW))
    return largest


def _plain(header: Header, file: BinaryIO, notes: list[str]) -> Iterator[bytes]:
    """Yield the columns of versions 1 to 3, then read the extension records that follow them."""
    inflater = Inflater(header.path, file) if header.gzip else None
    plain = inflater or file
    for piece, size in _plain_pieces(header, plain):
        if len(piece) < size:
            raise damaged(header.path, f"the columns end before {counted(header.count, 'splat')}")
        yield piece
    allowed = _MAX_EXTENSIONS if header.flags & EXTENSIONS else 0
    records = plain.read(allowed + 1)
    if len(records) > allowed:
        expected = counted(header.count, "splat has", "splats have")
        raise damaged(header.path, f"more data than {expected}")
    if inflater and inflater.trailing():
        raise damaged(header.path, "something follows its data")
    notes += _extension_notes(header, records)


def _plain_pieces(header: Header, plain: "BinaryIO | Inflater") -> Iterator[tuple[bytes, int]]:
    """Yield each piece of the columns of versions 1 to 3, with its expected number of bytes.

    A piece is shorter than expected where the data ends early; the caller checks this.
    """
    plain.read(LEGACY_HEADER.size)
    for width in header.columns().values():
        for size in _pieces(header, width):
            yield plain.read(size), size


def _pieces(header: Header, width: int) -> Iterator[int]:
    """Yield the size in bytes of each piece of a column with `width` bytes per splat."""
    step = _CHUNK // width
    for start in range(0, header.count, step):
        yield width * min(step, header.count - start)


def _streams(header: Header, file: BinaryIO, notes: list[str]) -> Iterator[bytes]:
    """Yield the columns of version 4, then read the extension records, which precede them."""
    places = _places(header, file)
    for (name, width), (_, at, size) in zip(header.columns().items(), places, strict=True):
        short = damaged(header.path, f"its {name} do not expand to {width * header.count:,} bytes")
        with header.section.part(at, size).opened() as packed:
            reader = _expander(packed)
            for wanted in _pieces(header, width):
                piece = _drain(reader.read, wanted)
                if len(piece) < wanted:
                    raise short
                yield piece
            if reader.read(1):
                raise short
    file.seek(HEADER.size)
    records = file.read(header.toc - HEADER.size) if header.flags & EXTENSIONS else b""
    notes += _extension_notes(header, records)


def _drain(read: Callable[[int], bytes], size: int) -> bytes:
    """Read `size` bytes, or fewer only at the end of the data."""
    out = bytearray()
    while len(out) < size and (piece := read(size - len(out))):
        out += piece
    return bytes(out)


def _places(header: Header, file: BinaryIO) -> list[tuple[str, int, int]]:
    """Return the column name, byte offset and compressed size of each stream."""
    sizes = _contents(header, file)
    ends = accumulate(sizes, initial=header.toc + len(sizes) * TOC_ENTRY.size)
    return list(zip(header.columns(), ends, sizes, strict=False))


def _contents(header: Header, file: BinaryIO) -> list[int]:
    """Check the table of contents and return the compressed size of each stream."""
    expected = [width * header.count for width in header.columns().values()]
    end = header.toc + len(expected) * TOC_ENTRY.size
    if header.streams != len(expected) or header.toc < HEADER.size or end > header.file_bytes:
        raise damaged(header.path, f"a table of {header.streams} streams at byte {header.toc}")
    file.seek(header.toc)
    entries = list(TOC_ENTRY.iter_unpack(file.read(end - header.toc)))
    if len(entries) != len(expected) or [plain for _, plain in entries] != expected:
        raise damaged(header.path, "the sizes of its streams do not fit its count of splats")
    if end + sum(packed for packed, _ in entries) != header.file_bytes:
        raise damaged(header.path, "its streams do not end where the file does")
    return [packed for packed, _ in entries]


def _expander(packed: BinaryIO) -> "ZstdDecompressionReader":
    import zstandard

    decompressor = zstandard.ZstdDecompressor(max_window_size=_MAX_WINDOW)
    return decompressor.stream_reader(packed, read_across_frames=True)


def read_records(header: Header) -> dict[int, bytes]:
    """Return the payload of each extension record, by its type number.

    In versions 1 to 3 the records follow the columns, so all columns are decompressed first, piece
    by piece.

    Raises:
        FormatError: The file cannot be read, or a record is cut short.
    """
    if not header.flags & EXTENSIONS:
        return {}
    with opened(header.section) as file:
        if header.version > LAST_GZIP:
            file.seek(HEADER.size)
            records = file.read(max(header.toc - HEADER.size, 0))
        else:
            records = _tail(header, file)
    return _records(header, records)


def stated_frame(header: Header) -> str:
    """Return the coordinate frame stated by an extension record, such as "rub", or "" if none.

    Raises:
        FormatError: As for `read_records`, or the record names no known frame.
    """
    return _frame_in(header, read_records(header))


def _frame_in(header: Header, records: dict[int, bytes]) -> str:
    """Return the coordinate frame stated by one of the records, or "" if none does."""
    payload = records.get(FRAME_RECORD)
    if payload is None:
        return ""
    number = int.from_bytes(payload, "little")
    if len(payload) != _NUMBER or number > len(RECORDED_FRAMES):
        raise damaged(header.path, "its record of the coordinate system names an unknown one")
    return RECORDED_FRAMES[number - 1] if number else Y_UP


def _tail(header: Header, file: BinaryIO) -> bytes:
    """Read the extension records of versions 1 to 3, which follow the columns."""
    plain = Inflater(header.path, file) if header.gzip else file
    for _ in _plain_pieces(header, plain):
        pass
    return plain.read(_MAX_EXTENSIONS + 1)


def frame_record(frame: str) -> bytes:
    """Encode the extension record that states a frame, one of `RECORDED_FRAMES`."""
    number = RECORDED_FRAMES.index(frame) + 1
    return RECORD.pack(FRAME_RECORD, _NUMBER) + number.to_bytes(_NUMBER, "little")


def _records(header: Header, records: bytes) -> dict[int, bytes]:
    """Parse extension records into payloads by type; of two of the same type, the last counts."""
    return dict(_each_record(header, records))


def _each_record(header: Header, records: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield the type and the payload of each extension record."""
    at = 0
    while at + RECORD.size <= len(records):
        kind, length = RECORD.unpack_from(records, at)
        at += RECORD.size
        yield kind, records[at : at + length]
        at += length
    if at != len(records):
        raise damaged(header.path, "an extension record is cut short")


def _extension_notes(header: Header, records: bytes) -> list[str]:
    """Return a note that names the extension records that are dropped.

    Versions 1 to 3 lose all of them except the frame; version 4 loses those before another one of
    the same type.
    """
    found = Counter(kind for kind, _ in _each_record(header, records))
    _frame_in(header, _records(header, records))  # raises if the record of the frame is invalid
    if header.version > LAST_GZIP:
        kinds = [kind for kind, times in found.items() if times > 1]
    else:
        kinds = [kind for kind in found if kind != FRAME_RECORD]
    if not kinds:
        return []
    names = ", ".join(_KNOWN_RECORDS.get(kind, f"0x{kind:08X}") for kind in kinds)
    return [f"Extension records of the .spz file were left out: {names}."]

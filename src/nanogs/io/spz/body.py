"""Contents of an `.spz` file: columns and extension records, inflated a piece at a time.

The layout is in `header`. No more is ever inflated than the header's count allows.
"""

from collections.abc import Callable, Iterator
from itertools import accumulate
from typing import TYPE_CHECKING, BinaryIO

from nanogs.formatting import counted
from nanogs.frames import Y_UP
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
    damaged,
    opened,
)

if TYPE_CHECKING:
    from zstandard import ZstdDecompressionReader

_CHUNK = 1 << 20
_MAX_EXTENSIONS = 1 << 20
_MAX_WINDOW = 1 << 27
_NUMBER = 4  # bytes of a frame's number
_FRAME_HEADER = 18  # bytes of the largest of zstd
_KNOWN_RECORDS = {CAMERA_RECORD: "limits of the camera"}


def body_pieces(header: Header, notes: list[str]) -> Iterator[bytes]:
    """The columns one after the other, in pieces of whole rows, a megabyte at most.

    Args:
        header: Of the file.
        notes: Gets what beside the columns was left out.

    Raises:
        FormatError: The file cannot be read, or holds more or less than its header counts.
    """
    with opened(header.section) as file:
        yield from (_plain if header.version <= LAST_GZIP else _streams)(header, file, notes)


def window_bytes(header: Header) -> int:
    """Bytes that a decoder of the columns holds, as the first frame of each stream states it.

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
    """The columns of versions 1 to 3; the extension records come after them."""
    inflater = Inflater(header.path, file) if header.gzip else None
    plain = inflater or file
    for piece, size in _plain_pieces(header, plain):
        if len(piece) < size:
            raise damaged(header, f"the columns end before {counted(header.count, 'splat')}")
        yield piece
    allowed = _MAX_EXTENSIONS if header.flags & EXTENSIONS else 0
    records = plain.read(allowed + 1)
    if len(records) > allowed:
        raise damaged(header, f"more data than {counted(header.count, 'splat has', 'splats have')}")
    if inflater and inflater.trailing():
        raise damaged(header, "something follows its data")
    notes += _extension_notes(header, records)


def _plain_pieces(header: Header, plain: "BinaryIO | Inflater") -> Iterator[tuple[bytes, int]]:
    """The columns of versions 1 to 3 in pieces as they are, and the bytes each should have."""
    plain.read(LEGACY_HEADER.size)
    for width in header.columns().values():
        for size in _pieces(header, width):
            yield plain.read(size), size


def _pieces(header: Header, width: int) -> Iterator[int]:
    """Bytes of the pieces of a column."""
    step = _CHUNK // width
    for start in range(0, header.count, step):
        yield width * min(step, header.count - start)


def _streams(header: Header, file: BinaryIO, notes: list[str]) -> Iterator[bytes]:
    """The columns of version 4; the extension records come before them."""
    places = _places(header, file)
    for (name, width), (_, at, size) in zip(header.columns().items(), places, strict=True):
        short = damaged(header, f"its {name} do not expand to {width * header.count:,} bytes")
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
    """Up to `size` bytes; fewer only at the end."""
    out = bytearray()
    while len(out) < size and (piece := read(size - len(out))):
        out += piece
    return bytes(out)


def _places(header: Header, file: BinaryIO) -> list[tuple[str, int, int]]:
    """Name, offset and compressed size of each stream."""
    sizes = _contents(header, file)
    ends = accumulate(sizes, initial=header.toc + len(sizes) * TOC_ENTRY.size)
    return list(zip(header.columns(), ends, sizes, strict=False))


def _contents(header: Header, file: BinaryIO) -> list[int]:
    """The compressed size of each stream, everything in the table checked."""
    expected = [width * header.count for width in header.columns().values()]
    end = header.toc + len(expected) * TOC_ENTRY.size
    if header.streams != len(expected) or header.toc < HEADER.size or end > header.file_bytes:
        raise damaged(header, f"a table of {header.streams} streams at byte {header.toc}")
    file.seek(header.toc)
    entries = list(TOC_ENTRY.iter_unpack(file.read(end - header.toc)))
    if len(entries) != len(expected) or [plain for _, plain in entries] != expected:
        raise damaged(header, "the sizes of its streams do not fit its count of splats")
    if end + sum(packed for packed, _ in entries) != header.file_bytes:
        raise damaged(header, "its streams do not end where the file does")
    return [packed for packed, _ in entries]


def _expander(packed: BinaryIO) -> "ZstdDecompressionReader":
    import zstandard

    decompressor = zstandard.ZstdDecompressor(max_window_size=_MAX_WINDOW)
    return decompressor.stream_reader(packed, read_across_frames=True)


def read_records(header: Header) -> dict[int, bytes]:
    """The payload of each extension record by its kind.

    Of versions 1 to 3 all columns are unpacked on the way, a piece at a time.

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
    """The frame that a record states, such as "rub"; empty where none does.

    Raises:
        FormatError: As for `read_records`, or there is no such frame.
    """
    return _frame_in(header, read_records(header))


def _frame_in(header: Header, records: dict[int, bytes]) -> str:
    """The frame that one of the records states; empty where none does."""
    payload = records.get(FRAME_RECORD)
    if payload is None:
        return ""
    number = int.from_bytes(payload, "little")
    if len(payload) != _NUMBER or number > len(RECORDED_FRAMES):
        raise damaged(header, "its record of the coordinate system names none")
    return RECORDED_FRAMES[number - 1] if number else Y_UP


def _tail(header: Header, file: BinaryIO) -> bytes:
    """The extension records of versions 1 to 3, which follow the columns."""
    plain = Inflater(header.path, file) if header.gzip else file
    for _ in _plain_pieces(header, plain):
        pass
    return plain.read(_MAX_EXTENSIONS + 1)


def frame_record(frame: str) -> bytes:
    """The record that states a frame, one of `RECORDED_FRAMES`."""
    number = RECORDED_FRAMES.index(frame) + 1
    return RECORD.pack(FRAME_RECORD, _NUMBER) + number.to_bytes(_NUMBER, "little")


def _records(header: Header, records: bytes) -> dict[int, bytes]:
    """The payload of each extension record by its kind; of twins the last one counts."""
    found, at = {}, 0
    while at + RECORD.size <= len(records):
        kind, length = RECORD.unpack_from(records, at)
        at += RECORD.size
        found[kind] = records[at : at + length]
        at += length
    if at != len(records):
        raise damaged(header, "an extension record is cut short")
    return found


def _extension_notes(header: Header, records: bytes) -> list[str]:
    """A note that names the extension records whose payload is not carried: of old versions all."""
    found = _records(header, records)
    _frame_in(header, found)  # which refuses a record that names none
    kinds = [kind for kind in found if kind != FRAME_RECORD]
    if not kinds or header.version > LAST_GZIP:
        return []
    names = ", ".join(_KNOWN_RECORDS.get(kind, f"0x{kind:08X}") for kind in kinds)
    return [f"Extension records of the .spz file were left out: {names}."]

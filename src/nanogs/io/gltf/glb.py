"""The containers of glTF: binary (`.glb`), whose chunks are JSON and a buffer, and text (`.gltf`).

https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html, sections 3.6 (binary data) and 4 (GLB).
Which of the two a file is follows from its first bytes, not from its name. The `data:` URIs of a
text file, most of its bytes, are skipped when its JSON is read, because the size of JSON is
limited; rows are later decoded directly from the file.
"""

import re
import struct
from pathlib import Path
from typing import BinaryIO

from nanogs.errors import FormatError
from nanogs.io.files import damaged, input_size, reading
from nanogs.io.gltf.document import DATA, Document, SkippedUri, check_length, parsed
from nanogs.io.section import Section

MAGIC = b"glTF"
JSON_CHUNK, BODY_CHUNK = b"JSON", b"BIN\0"
_CHUNK = struct.Struct("<I4s")
_OPENING = b'"data:'
_KEY = re.compile(rb'"uri"\s*:\s*"$')
_LONG = 256  # bytes; URIs up to this length stay in the JSON
_PIECE = 1 << 20  # bytes


def read_document(path: Path) -> Document:
    """Read the JSON of a glTF file and locate its buffers.

    Raises:
        FormatError: The file cannot be read, is damaged, or its JSON is too long.
    """
    size = input_size(path)
    with reading(path) as file:
        start = file.read(64)
        file.seek(0)
        if start.lstrip().startswith(b"{"):
            return _read_text(path, file)
        return _read_glb(path, file, size)


def _read_text(path: Path, file: BinaryIO) -> Document:
    rest, lifted = _lift(path, file)
    root = parsed(path, rest)
    version = root.part("asset").text("version", "2.0")
    if version.partition(".")[0] != "2":
        raise FormatError(f"{path}: nanogs reads glTF 2.0, not {version!a}; export it as 2.0.")
    return Document(path, root, lifted=lifted)


def _lift(path: Path, file: BinaryIO) -> tuple[bytes, dict[str, SkippedUri]]:
    """Read the text of a file with a placeholder for every long `data:` URI.

    Returns:
        The text, and the location of each skipped URI by its placeholder.

    Raises:
        FormatError: The text without the URIs is too long.
    """
    rest, lifted = bytearray(), dict[str, SkippedUri]()
    held, place = b"", 0  # bytes read but not processed, and their offset in the file
    begin, escaped = -1, False  # of the URI being skipped; -1 outside of one
    while piece := file.read(_PIECE):
        held += piece
        at = 0
        while True:
            if begin < 0:
                found = held.find(_OPENING, at)
                # The last bytes may be the start of an opening: they are kept for the next piece.
                end = max(len(held) - len(_OPENING) + 1, at) if found < 0 else found + 1
                rest += held[at:end]
                at = end
                if found < 0:
                    break
                if _KEY.search(rest[-_LONG:]) is None:  # another string, such as a comment
                    continue
                begin, escaped = place + at, False
            end = held.find(b'"', at)
            if end < 0 and place + len(held) - begin <= _LONG:
                break  # it may turn out short: keep it in `held` until its end is read
            text = held[at : end if end >= 0 else len(held)]
            escaped |= b"\\" in text
            at += len(text)
            if end < 0:
                break
            if (length := place + at - begin) > _LONG:
                name = f"{DATA}{len(lifted)}"
                lifted[name] = SkippedUri(begin, length, escaped)
                rest += name.encode()
            else:
                rest += text
            begin = -1
        held, place = held[at:], place + at
        check_length(path, len(rest))
    return bytes(rest + held), lifted


def _read_glb(path: Path, file: BinaryIO, size: int) -> Document:
    _check_header(path, file.read(12), size)
    length, kind = _chunk(path, file.read(_CHUNK.size), file.tell(), size)
    if kind != JSON_CHUNK:
        raise damaged(path, f"its first chunk is {kind!r} and not JSON")
    check_length(path, length)
    root = parsed(path, file.read(length))
    at = file.tell()
    length, kind = 0, BODY_CHUNK
    if at < size:
        length, kind = _chunk(path, file.read(_CHUNK.size), at + _CHUNK.size, size)
    if kind != BODY_CHUNK:  # an unknown chunk, which is to be ignored
        length = 0
    return Document(path, root, Section(path, at + _CHUNK.size, length))


def _check_header(path: Path, header: bytes, size: int) -> None:
    if header[:4] != MAGIC:
        raise FormatError(
            f"{path} does not begin with 'glTF', nor is it JSON, so it is no glTF file; give it the"
            " suffix of its real format."
        )
    if len(header) < 12:
        raise damaged(path, "it ends inside its header")
    version, length = struct.unpack("<II", header[4:])
    if version != 2:
        raise FormatError(f"{path}: nanogs reads glTF 2.0, not {version}; export it as 2.0.")
    if length != size:
        raise damaged(path, f"its header says {length} bytes, but it has {size}")


def _chunk(path: Path, header: bytes, at: int, size: int) -> tuple[int, bytes]:
    """Return the length and type of a chunk whose contents begin at offset `at` of the file."""
    if len(header) < _CHUNK.size:
        raise damaged(path, "it ends inside the header of a chunk")
    length, kind = _CHUNK.unpack(header)
    if at + length > size:
        raise damaged(path, f"it is cut short: a chunk has only {size - at} of its {length} bytes")
    return length, kind

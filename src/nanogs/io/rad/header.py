"""The layout of `.rad` (Spark); reading and checking its headers before any splat is decoded.

The format as Spark reads and writes it (https://github.com/sparkjsdev/spark,
rust/spark-lib/src/rad.rs, splat_encode.rs and src/SplatPager.ts), little-endian throughout:

- `RAD0`, u32 length, JSON of that length, zeros up to a multiple of 8 bytes; then the chunks. The
  JSON has `version` 1, `type` "gsplat", `count`, `maxSh` (0 if missing), `lodTree`, `chunkSize`,
  `allChunkBytes`, and `chunks`, each with `offset`, from the end of this header, and `bytes`; or
  with the `filename` of a separate file beside this one. `splatEncoding` has value ranges for the
  textures of a viewer, `shCodeCount` is explained below, `comment` is free text.
- A chunk is `RADC`, u32 length, JSON, zeros as above, u64 `payloadBytes`, and the payload. The JSON
  has `version` 1, `base` (the number of rows before it), `count`, `payloadBytes` and `properties`,
  each with its `offset` in the payload, a multiple of 8, `bytes`, `encoding`, and `compression`
  "gz", which is deflate without a header, or none. A streaming viewer expects 65,536 rows in each
  chunk but the last.
- Properties: `center`, `alpha`, `rgb` (0.5 plus 0.282 times the coefficient), `scales` (linear),
  `orientation`, and `sh1`, `sh2`, `sh3`, one for each SH band: coefficient-major, RGB last. In
  place of bands there may be `sh_label`, the index of an entry in the palettes `sh1_code`,
  `sh2_code` and `sh3_code`, which are in the first chunk; `shCodeCount` is the number of entries.
- Encodings hold all rows of the first component, then of the second: `f32`, `f16`; `f32_lebytes`
  and `f16_lebytes`, the lowest bytes of all components first; `r8`, from `min` to `max`; `s8`,
  signed, 127 for `max`; `r8_delta` and `s8_delta`, each byte minus the one before; `ln_f16`, a
  logarithm; `ln_0r8`, 0 for a scale of zero and 1 to 255 for logarithms from `min` to `max`; `u16`;
  `u32`. An orientation is xyz as `f32` or `f16`, with the non-negative w that gives unit length, or
  `oct88r8`, row by row: an octahedral rotation axis in two bytes, and an angle from 0 to pi.
- Level-of-detail tree: `child_count` (u16) and `child_start` (u32) give the rows that represent the
  same part of the scene as this one, but finer. Row 0 is the root, children come after their
  parents, leaves have none: the leaves are the model. An alpha above 1 means a splat with a wide,
  opaque middle; see `values`.
"""

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nanogs.errors import FormatError
from nanogs.formatting import listed
from nanogs.io.files import check_expansion, damaged, reading, splat_bytes, unreadable
from nanogs.io.json_fields import integer, numbers, parse, plain_name, refused, rows, table
from nanogs.io.section import Section, whole_file
from nanogs.io.texts import is_utf8

MAGIC, CHUNK_MAGIC = b"RAD0", b"RADC"
VERSION = 1
MAX_DEGREE = 3
CHUNK_ROWS = 1 << 16  # rows per chunk that a streaming viewer expects
START = struct.Struct("<4sI")
PAYLOAD = struct.Struct("<Q")

BANDS = ("sh1", "sh2", "sh3")
CODES = ("sh1_code", "sh2_code", "sh3_code")
LABEL = "sh_label"
CHILD_COUNT, CHILD_START = "child_count", "child_start"
_PLAIN = ("center", "alpha", "rgb", "scales", "orientation")
_KNOWN = frozenset((*_PLAIN, *BANDS, *CODES, LABEL, CHILD_COUNT, CHILD_START))
MAX_JSON = 1 << 20  # the viewer's limit; a chunk takes some 50 bytes
_MAX_CHUNK_JSON = 1 << 16
_MAX_ROWS = 1 << 32
_RANGED = frozenset(("r8", "r8_delta", "ln_0r8"))
_SIGNED = frozenset(("s8", "s8_delta"))


@dataclass(frozen=True, slots=True)
class Property:
    """The location and encoding of a column of a chunk.

    Attributes:
        name: Name of the property, see the module's docstring.
        encoding: Name of the encoding, see the module's docstring.
        section: The stored bytes.
        packed: Whether they are compressed by deflate.
        low: The value of the lowest code, for encodings with a range.
        high: The value of the highest code, for encodings with a range or a sign.
    """

    name: str
    encoding: str
    section: Section
    packed: bool
    low: float = 0.0
    high: float = 0.0

    @property
    def where(self) -> str:
        """The file and the column, for messages."""
        return f"{self.section.path}, {self.name}"


@dataclass(frozen=True, slots=True)
class Chunk:
    """A chunk of consecutive rows.

    Attributes:
        count: Number of rows, 1 or more.
        properties: Columns by name.
    """

    count: int
    properties: Mapping[str, Property]


@dataclass(frozen=True, slots=True)
class Header:
    """The validated header of a file and of its chunks.

    Attributes:
        path: The file.
        files: The file, and the separate files of its chunks.
        file_bytes: Total size of all of these.
        count: Number of rows, 1 or more; of a tree all its nodes.
        degree: SH degree, 0 to 3.
        tree: Whether the rows form a level-of-detail tree.
        codes: Number of entries in the palette of higher SH coefficients; 0 without a palette.
        comment: The free text; None if there is none.
        chunks: The chunks, in order of their rows.
    """

    path: Path
    files: tuple[Path, ...]
    file_bytes: int
    count: int
    degree: int
    tree: bool
    codes: int
    comment: str | None
    chunks: tuple[Chunk, ...]


def read_header(path: Path) -> Header:
    """Read and check the headers of a file and of all its chunks.

    Raises:
        FormatError: It cannot be read, is no `.rad` file, or is damaged.
    """
    whole = whole_file(path)
    data, end = _description(whole, MAGIC, MAX_JSON)
    where = str(path)
    _check_version(data, where)
    if data.get("type") != "gsplat":
        raise refused(f"{where}, type", 'must be "gsplat"')
    count = integer(data.get("count"), f"{where}, count", 1, _MAX_ROWS)
    degree = integer(data.get("maxSh") or 0, f"{where}, maxSh", 0, MAX_DEGREE)
    tree = data.get("lodTree") or False
    if not isinstance(tree, bool):
        raise refused(f"{where}, lodTree", "must be true or false")
    entries = rows(data.get("chunks"), f"{where}, chunks")
    sections = _sections(whole, end, entries)
    files = tuple(dict.fromkeys((path, *(section.path for section in sections))))
    size = whole.size + sum(s.size for s in sections if s.path != path)
    check_expansion(where, count * splat_bytes(degree), size)
    codes = integer(data.get("shCodeCount") or 0, f"{where}, shCodeCount", 0, count)
    comment = data.get("comment")
    if comment is not None and not (isinstance(comment, str) and is_utf8(comment)):
        raise refused(f"{where}, comment", "must be text")
    chunks, base = [], 0
    for section in sections:
        chunks.append(_chunk(section, base, count, bool(codes) and base == 0))
        _check_columns(chunks[-1], section, degree, tree=tree, codes=bool(codes), first=base == 0)
        base += chunks[-1].count
    if base != count:
        raise damaged(where, f"its chunks hold {base:,} of {count:,} rows")
    return Header(path, files, size, count, degree, tree, codes, comment, tuple(chunks))


def _description(section: Section, magic: bytes, limit: int) -> tuple[dict[str, Any], int]:
    """Read the JSON at the start of a file or chunk; return it and its end, padding included."""
    where = str(section.path)
    try:
        with section.opened() as file:
            start = file.read(START.size)
            if len(start) < START.size or start[:4] != magic:
                raise _no_start(where, start, magic)
            length = START.unpack(start)[1]
            if length > min(limit, section.size - START.size):
                raise damaged(where, f"a description of {length:,} bytes")
            data = parse(file.read(length), where)
    except OSError as error:
        raise unreadable(section.path, error) from error
    return data, START.size + padded(length)


def _no_start(where: str, start: bytes, magic: bytes) -> FormatError:
    if magic == CHUNK_MAGIC:
        return damaged(where, "there is no chunk where its header says that one begins")
    if start[:4] == CHUNK_MAGIC:
        return FormatError(f"{where} is one chunk of a .rad model; name the .rad file itself.")
    return FormatError(
        f"{where} does not start with RAD0, so it is no .rad file; check what it is."
    )


def _check_version(data: dict[str, Any], where: str) -> None:
    if data.get("version") != VERSION:
        raise refused(f"{where}, version", f"is not {VERSION}, the only one that nanogs reads")


def named_files(path: Path) -> list[Path]:
    """Return the separate files of the chunks, which need not be there yet.

    Raises:
        FormatError: The file cannot be read, or its header is damaged.
    """
    data, _ = _description(whole_file(path), MAGIC, MAX_JSON)
    found = []
    for number, entry in enumerate(rows(data.get("chunks"), f"{path}, chunks")):
        where = f"{path}, chunks[{number}]"
        if (name := _separate_file(table(entry, where), where)) is not None:
            found.append(path.parent / name)
    return found


def _separate_file(given: dict[str, Any], where: str) -> str | None:
    """Return the name of a chunk's own file; None for a chunk in the file itself."""
    name = given.get("filename")
    return None if name is None else plain_name(name, where)


def _sections(whole: Section, end: int, entries: Sequence[object]) -> list[Section]:
    """Return the section of each chunk, after checking that chunks do not overlap."""
    found: list[Section] = []
    at, names = end, set[str]()
    for number, entry in enumerate(entries):
        where = f"{whole.path}, chunks[{number}]"
        given = table(entry, where)
        if (name := _separate_file(given, where)) is not None:
            if name in names:
                raise refused(where, f"names {name} twice")
            names.add(name)
            found.append(whole_file(whole.path.parent / name))
            continue
        size = integer(given.get("bytes"), f"{where}, bytes", START.size, whole.size)
        start = end + integer(given.get("offset"), f"{where}, offset", 0, whole.size)
        if start < at or start + size > whole.size:
            raise damaged(where, "it lies outside of the file or in another chunk")
        found.append(whole.part(start, size))
        at = start + size
    return found


def _chunk(section: Section, base: int, count: int, palette: bool) -> Chunk:
    """Read and check the header of a chunk that begins with row `base`."""
    where = str(section.path)
    data, end = _description(section, CHUNK_MAGIC, _MAX_CHUNK_JSON)
    _check_version(data, where)
    if integer(data.get("base"), f"{where}, base", 0, _MAX_ROWS) != base:
        raise damaged(where, f"a chunk does not begin with row {base:,}")
    held = integer(data.get("count"), f"{where}, count of a chunk", 1, count)
    with reading(section.path) as file:
        file.seek(section.start + end)
        length = file.read(PAYLOAD.size)
    start = end + PAYLOAD.size
    size = PAYLOAD.unpack(length)[0] if len(length) == PAYLOAD.size else -1
    if not 0 <= size <= section.size - start or size != data.get("payloadBytes"):
        raise damaged(where, "a chunk is cut short, or states two sizes")
    payload = section.part(start, size)
    found: dict[str, Property] = {}
    at = 0
    for entry in rows(data.get("properties"), f"{where}, properties"):
        one = _property(payload, table(entry, f"{where}, properties"), at)
        if one.name in found or (one.name in CODES and not palette):
            raise refused(one.where, "must not be in this chunk")
        found[one.name] = one
        at = one.section.start + one.section.size - payload.start
    return Chunk(held, found)


def _property(payload: Section, given: dict[str, Any], at: int) -> Property:
    """Parse the entry of a column, which must begin at byte `at` of the payload or later."""
    name, encoding = given.get("property"), given.get("encoding")
    where = f"{payload.path}, properties"
    if not isinstance(name, str) or name not in _KNOWN:
        raise FormatError(
            f"{where} has {str(name)[:40]!r}, which nanogs does not know; leave it out when"
            " exporting."
        )
    where = f"{payload.path}, {name}"
    size = integer(given.get("bytes"), f"{where}, bytes", 0, payload.size)
    start = integer(given.get("offset"), f"{where}, offset", 0, payload.size)
    if start < at or start + size > payload.size:
        raise damaged(where, "it lies outside of its chunk or in another property")
    if (packing := given.get("compression")) not in (None, "gz"):
        raise refused(where, f"is packed as {str(packing)[:40]!r}, which nanogs does not read")
    if not isinstance(encoding, str):
        raise refused(where, "has no encoding")
    section, packed = payload.part(start, size), packing is not None
    low = high = 0.0
    if encoding in _RANGED:
        low, high = numbers([given.get("min"), given.get("max")], f"{where}, min and max", 2)
    elif encoding in _SIGNED:
        (high,) = numbers([given.get("max")], f"{where}, max", 1)
    return Property(name, encoding, section, packed, float(low), float(high))


def _check_columns(
    chunk: Chunk, section: Section, degree: int, *, tree: bool, codes: bool, first: bool
) -> None:
    """Refuse a chunk that lacks columns which the file's header implies, or has others."""
    needed = [*_PLAIN]
    if degree:
        needed += [LABEL, *(CODES[:degree] if first else ())] if codes else BANDS[:degree]
    needed += [CHILD_COUNT, CHILD_START] if tree else ()
    if lacking := [name for name in needed if name not in chunk.properties]:
        raise damaged(str(section.path), f"a chunk lacks {listed(lacking, 'and')}")
    if spare := [name for name in chunk.properties if name not in needed]:
        raise damaged(
            str(section.path),
            f"a chunk has {listed(spare, 'and')}, which the file's header does not mention",
        )


def padded(size: int) -> int:
    """Round a size up to a multiple of 8."""
    return size + 7 & ~7

"""Parsing the header of a PLY file: its elements and comments, and the offset of the body."""

import re
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO

import numpy as np

from nanogs.errors import FormatError
from nanogs.formatting import counted
from nanogs.io import render_tag
from nanogs.io.files import input_size, reading
from nanogs.io.texts import decode, printable

MAX_HEADER_BYTES = 1 << 20
ENCODINGS = ("ascii", "binary_little_endian", "binary_big_endian")
# Both spellings of every scalar type, with numpy's type code.
TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2",
    "int": "i4", "uint": "u4", "float": "f4", "double": "f8",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
TYPE_NAMES = {code: name for name, code in reversed(TYPES.items())}
_COUNT = re.compile(rb"[0-9]{1,18}")


@dataclass(frozen=True, slots=True)
class Property:
    """A property of an element: its name, and its numpy type code, or None for a list."""

    name: str
    code: str | None


@dataclass(slots=True)
class Element:
    """A PLY element: a table of rows that all have the same properties."""

    name: str
    count: int
    properties: list[Property] = field(default_factory=list)

    @property
    def names(self) -> list[str]:
        """Property names in the file's order."""
        return [prop.name for prop in self.properties]

    def lists(self) -> list[str]:
        """Return the names of the list properties."""
        return [prop.name for prop in self.properties if prop.code is None]

    @property
    def is_table(self) -> bool:
        """Whether it has properties, and no lists: only such rows can be kept as an array."""
        return bool(self.properties) and not self.lists()

    def dtype(self, order: str = "=") -> np.dtype[np.void]:
        """Return the packed row as a structured dtype of the byte order `<`, `>` or `=`."""
        return _row(order, tuple(self.properties))


@lru_cache(maxsize=8)  # computed once, though a model is read in hundreds of parts
def _row(order: str, properties: tuple[Property, ...]) -> np.dtype[np.void]:
    return np.dtype([(prop.name, f"{order}{prop.code}") for prop in properties])


@dataclass(slots=True)
class Header:
    """A parsed header.

    Attributes:
        path: The file.
        file_bytes: Its size.
        encoding: One of `ENCODINGS`; empty until the line "format" is parsed.
        elements: In the order of the file.
        comments: Lines without their keyword.
        obj_info: Lines of that keyword, which some tools write in place of comments.
        size: Offset of the body, bytes.
        separator: Between the values of a row of text; None for white space.
    """

    path: Path
    file_bytes: int
    encoding: str = ""
    elements: list[Element] = field(default_factory=list)
    comments: list[str] = field(default_factory=list)
    obj_info: list[str] = field(default_factory=list)
    size: int = 0
    separator: bytes | None = None
    # Names of elements, and with them of their properties: a search for each line would be slow.
    _names: set[tuple[str, ...]] = field(default_factory=set, repr=False)

    def element(self, name: str) -> Element | None:
        """Return the element of that name, or None."""
        return next((element for element in self.elements if element.name == name), None)

    def place(self, element: Element) -> str:
        """Return an element as messages name it; the rows of a `.csv` are the only ones there."""
        return "the table" if self.separator else f"element {element.name!r}"

    def is_new(self, *names: str) -> bool:
        """Whether no element, or property of an element, has this name; it counts as taken then."""
        new = names not in self._names
        self._names.add(names)
        return new

    @property
    def order(self) -> str:
        """Byte order of the rows that are read, in numpy's notation; native for text files."""
        return {"ascii": "=", "binary_big_endian": ">"}.get(self.encoding, "<")

    @property
    def all_comments(self) -> list[str]:
        """The comments, then the `obj_info` lines, which are kept as comments too."""
        return [*self.comments, *self.obj_info]

    def printable_comments(self) -> tuple[str, ...]:
        """Return the comments without lone surrogates: as Latin-1 if they are not UTF-8."""
        return tuple(printable(comment) for comment in self.comments)


def header_notes(header: Header) -> list[str]:
    """Return notes on parts of the header that `Splats` holds in another form, or not at all."""
    notes = render_tag.contradiction(header.all_comments)
    if header.obj_info:
        one, more = "obj_info line was kept as a comment", "obj_info lines were kept as comments"
        notes.append(f"{counted(len(header.obj_info), one, more)}.")
    for element in header.elements:
        if element.count == 0 and not element.is_table:
            notes.append(f"The empty element {printable(element.name)!r} was left out.")
    return notes


def read_header(path: Path) -> Header:
    """Parse the header of a PLY file.

    Raises:
        FormatError: The file cannot be read, is not a PLY, or its header is damaged.
    """
    header = Header(path, input_size(path))
    with reading(path) as file:
        _parse(header, file)
    if not header.encoding:
        raise FormatError(f"{path}: the header has no 'format' line; export the file again.")
    return header


def _parse(header: Header, file: BinaryIO) -> None:
    if file.readline(16).rstrip() != b"ply":
        raise FormatError(
            f"{header.path} does not begin with the line 'ply', so it is not a PLY file;"
            " give it the suffix of its real format."
        )
    number = 1
    while True:
        number += 1
        line = file.readline(MAX_HEADER_BYTES)
        header.size = file.tell()
        if not line.endswith(b"\n") or header.size > MAX_HEADER_BYTES:
            raise _endless(header, number)
        if line.split() == [b"end_header"]:
            return
        _Line(header, number, line).apply()


def _endless(header: Header, number: int) -> FormatError:
    if header.size < header.file_bytes or header.size > MAX_HEADER_BYTES:
        return FormatError(
            f"{header.path}: no 'end_header' line within the first {MAX_HEADER_BYTES} bytes;"
            " the file is damaged, export it again."
        )
    return FormatError(
        f"{header.path} ends inside its header (line {number}, byte {header.size}) before an"
        " 'end_header' line; export or download it again."
    )


class _Line:
    """A line of the header, which `apply` parses and adds to the header."""

    def __init__(self, header: Header, number: int, line: bytes) -> None:
        self.header, self.number = header, number
        text = line[:-1].rstrip(b"\r")
        self.words = text.split()
        # Only one separator is removed: further spaces belong to the text of a comment.
        keyword = self.words[0] if self.words else b""
        self.rest = decode(text.lstrip()[len(keyword) :][1:])

    def apply(self) -> None:
        if not self.words:
            return
        keyword = self.words[0]
        if keyword == b"comment":
            self.header.comments.append(self.rest)
        elif keyword == b"obj_info":
            self.header.obj_info.append(self.rest)
        elif keyword == b"format":
            self._format()
        elif keyword == b"element":
            self._element()
        elif keyword == b"property":
            self._property()
        else:
            raise self.error(f"unknown keyword {_quote(keyword)}")

    def error(self, what: str) -> FormatError:
        return FormatError(
            f"{self.header.path}, header line {self.number}: {what};"
            " correct the header or export the file again."
        )

    def _format(self) -> None:
        if self.header.encoding:
            raise self.error("a second 'format' line")
        if (
            len(self.words) != 3
            or self.words[2] != b"1.0"
            or decode(self.words[1]) not in ENCODINGS
        ):
            known = ", ".join(ENCODINGS)
            raise self.error(f"the format must be one of {known}, version 1.0")
        self.header.encoding = decode(self.words[1])

    def _element(self) -> None:
        if len(self.words) != 3:
            raise self.error("an element needs a name and a count")
        name = decode(self.words[1])
        if not self.header.is_new(name):
            raise self.error(f"a second element {_quote(self.words[1])}")
        if not _COUNT.fullmatch(self.words[2]):
            raise self.error(
                f"element {_quote(self.words[1])} has the impossible count {_quote(self.words[2])}"
            )
        self.header.elements.append(Element(name, int(self.words[2])))

    def _property(self) -> None:
        if not self.header.elements:
            raise self.error("a property before any element")
        is_list = self.words[1:2] == [b"list"]
        if len(self.words) != (5 if is_list else 3):
            raise self.error("a property needs a type and a name")
        for word in self.words[2:4] if is_list else self.words[1:2]:
            if decode(word) not in TYPES:
                raise self.error(
                    f"unknown type {_quote(word)} of property {_quote(self.words[-1])}"
                )
        element, name = self.header.elements[-1], decode(self.words[-1])
        if not self.header.is_new(element.name, name):
            raise self.error(f"a second property {_quote(self.words[-1])} of {element.name!r}")
        element.properties.append(Property(name, None if is_list else TYPES[decode(self.words[1])]))


def _quote(word: bytes) -> str:
    text = printable(decode(word))
    return repr(text if len(text) <= 40 else text[:40] + "…")

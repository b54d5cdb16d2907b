"""A parser for OpenUSD text layers, `.usda`, that is sufficient to find prims and their attributes.

Grammar: https://github.com/PixarAnimationStudios/OpenUSD, pxr/usd/sdf. A layer is its metadata in
parentheses and prims; a prim holds attributes, `type name = value`, and further prims. Values are
located but not parsed: arrays of numbers, which are most of a file, are skipped in one step.
Contents composed from other layers, from variants or from time samples are not supported.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from nanogs.errors import FormatError
from nanogs.io.files import damaged
from nanogs.io.json_fields import refused

_TOKEN = re.compile(
    rb'"""[^"\\]*(?:(?:\\.|"(?!""))[^"\\]*)*"""'
    rb"|'''[^'\\]*(?:(?:\\.|'(?!''))[^'\\]*)*'''"
    rb'|"[^"\\\n]*(?:\\.[^"\\\n]*)*"'
    rb"|'[^'\\\n]*(?:\\.[^'\\\n]*)*'"
    rb"|<[^<>\n]*>|@[^@\n]*@|[\[\](){}=,;]|[^\s\[\](){}=,;\"'<>@#]+",
    re.DOTALL,
)
START = b"#usda 1."
_SPACE = re.compile(rb"\s*")
_OPEN, _CLOSE = {b"(": b")", b"[": b"]", b"{": b"}"}, (b")", b"]", b"}")
_PRIM = (b"def", b"over", b"class")
_MOST_DEPTH = 100
_NUMBERS = re.compile(rb"(?:half|float|double|int|point3[fhd]|quat[fhd]|color3[fhd])[234]?")

Span = tuple[int, int]


@dataclass(frozen=True, slots=True)
class Prim:
    """A prim of a layer.

    Attributes:
        kind: Its type, such as `Xform`; empty without one.
        name: Its name.
        parent: The prim that it is in; None at the top level.
        abstract: Whether it is a `class` or in one: others inherit from it, and it is not drawn.
        values: Start and end byte of each attribute's value in the file, by name; without the
            brackets of an array.
    """

    kind: str
    name: str
    parent: "Prim | None"
    abstract: bool
    values: dict[str, Span] = field(default_factory=dict)

    def depth(self) -> int:
        """Number of prims around it."""
        count, prim = 0, self.parent
        while prim is not None:
            count, prim = count + 1, prim.parent
        return count


@dataclass(frozen=True, slots=True)
class Layer:
    """The prims and the metadata of a layer.

    Attributes:
        path: The file.
        text: Its bytes.
        metadata: Simple values by name, such as `upAxis`, without quotes.
        prims: All prims, nested ones included, in the order of the file.
    """

    path: Path
    text: bytes
    metadata: Mapping[str, str]
    prims: tuple[Prim, ...]

    def error(self, what: str) -> FormatError:
        """Return the error for an invalid layer."""
        return FormatError(f"{self.path}: {what}; export it again.")


def read_layer(path: Path, text: bytes) -> Layer:
    """Parse a layer and find its prims.

    Raises:
        FormatError: It is not a USD text file, is damaged, or is cut short.
    """
    if not text.startswith(START):
        raise FormatError(
            f"{path} does not begin with '#usda 1.', so it is not a USD text file; convert it with"
            " OpenUSD's usdcat, or give it the suffix of its real format."
        )
    return _Parser(path, text).layer()


class _Parser:
    """A parser that passes over the text once, from start to end."""

    def __init__(self, path: Path, text: bytes) -> None:
        self._path, self._text, self._at = path, text, 0
        self._prims: list[Prim] = []
        self._metadata: dict[str, str] = {}

    def layer(self) -> Layer:
        """Parse the whole layer."""
        inside: Prim | None = None
        words: list[bytes] = []
        while token := self._next():
            if token in _PRIM:
                inside, words = self._prim(token, inside), []
            elif token == b"}":
                if inside is None:
                    raise self._damaged("a } has no matching {")
                inside, words = inside.parent, []
            elif token == b"=" and words:
                self._value(inside, words)
                words = []
            elif token == b"(" and inside is None and not self._prims:
                self._read_metadata()
            elif token == b"[" and self._peek() == b"]":  # an array type, such as float3[]
                self._next()
                words.append(b"[]")
            elif token in _OPEN:
                self._skip(token)
            else:
                words.append(token)
                del words[:-4]  # the most in a declaration: custom uniform type name
        if inside is not None:
            raise self._damaged(f"it ends inside the prim {inside.name[:40]!a}")
        return Layer(self._path, self._text, self._metadata, tuple(self._prims))

    def _prim(self, specifier: bytes, parent: Prim | None) -> Prim:
        """Parse the head of a prim after its specifier, up to its opening brace."""
        kind, name = "", self._next()
        if not name.startswith((b'"', b"'")):
            kind, name = name.decode("utf-8", "replace"), self._next()
        abstract = specifier == b"class" or (parent is not None and parent.abstract)
        prim = Prim(kind, _plain(name), parent, abstract)
        opening = self._next()
        if opening == b"(":
            self._skip(opening)
            opening = self._next()
        if opening != b"{" or prim.depth() > _MOST_DEPTH:
            where = f"{self._path}: the prim {prim.name[:40]!a}"
            raise refused(where, "has no body, or is nested too deeply")
        self._prims.append(prim)
        return prim

    def _value(self, prim: Prim | None, words: list[bytes]) -> None:
        """Record the byte range of a value and skip it."""
        array = len(words) > 2 and words[-2] == b"[]" and _NUMBERS.fullmatch(words[-3])
        opening, start = self._next(), self._at
        if opening == b"[" and array:
            end = self._text.find(b"]", start)
            if end < 0:
                raise self._damaged("an array has no end")
            self._at = end + 1
        elif opening in _OPEN:
            self._skip(opening)
            end = self._at - 1
        else:
            start, end = start - len(opening), start
        if prim is not None:
            prim.values[words[-1].decode("utf-8", "replace")] = start, end

    def _read_metadata(self) -> None:
        """Read the metadata of the layer; values in brackets are skipped."""
        name = b""
        while (token := self._next()) != b")":
            if token == b"=":
                value = self._next()
                if value in _OPEN:
                    self._skip(value)
                else:
                    self._metadata[name.decode("utf-8", "replace")] = _plain(value)
            elif token in _OPEN:
                self._skip(token)
            elif not token:
                raise self._damaged("its metadata has no end")
            name = token

    def _skip(self, opening: bytes) -> None:
        """Skip to behind the bracket that matches an opening one."""
        waiting = [_OPEN[opening]]
        while waiting:
            token = self._next()
            if token in _OPEN:
                waiting.append(_OPEN[token])
            elif token in _CLOSE and token != waiting.pop():
                raise self._damaged("its brackets do not match")
            elif not token:
                raise self._damaged("a bracket has no end")

    def _peek(self) -> bytes:
        at = self._at
        token = self._next()
        self._at = at
        return token

    def _next(self) -> bytes:
        """Return the next token (word, string or punctuation); empty at the end of the text."""
        while True:
            space = _SPACE.match(self._text, self._at)
            self._at = space.end() if space else self._at
            if self._text[self._at : self._at + 1] != b"#":
                break
            line = self._text.find(b"\n", self._at)
            self._at = len(self._text) if line < 0 else line
        if self._at == len(self._text):
            return b""
        found = _TOKEN.match(self._text, self._at)
        if found is None:
            raise refused(f"{self._path}: byte {self._at}", "begins unknown syntax")
        self._at = found.end()
        return found[0]

    def _damaged(self, what: str) -> FormatError:
        return damaged(self._path, what)


def _plain(token: bytes) -> str:
    """Return the text of a token, without quotes."""
    return token.decode("utf-8", "replace").strip("\"'")

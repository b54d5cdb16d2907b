"""A glTF document: checked access to its JSON objects, and to the accessors into its buffers.

https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html. A buffer is in the file itself, in a
`data:` URI, or in a file of the same folder or below it; nothing else is ever read.
"""

import base64
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from nanogs._types import F64
from nanogs.errors import FormatError
from nanogs.io.files import damaged, input_size, reading
from nanogs.io.gltf.rows import Accessor
from nanogs.io.json_fields import integer, numbers, referenced_path, refused, rows, table
from nanogs.io.section import Section

# Parsed JSON takes up to 25 times the memory of its text; that of a splat file has some 10 KB.
MAX_JSON_BYTES = 4 << 20
DATA = "data:"
_LONGEST_HEAD = 256  # bytes of a `data:` URI that are searched for its media type and comma
_KINDS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


@dataclass(frozen=True, slots=True)
class JsonObject:
    """An object of the JSON, with methods that read its fields by type.

    Attributes:
        path: The file.
        where: The path of the object within the JSON, for messages.
        data: The parsed object.
    """

    path: Path
    where: str
    data: dict[str, Any]

    def error(self, what: str) -> FormatError:
        """Return the error that this object is invalid."""
        return refused(f"{self.path}: {self.where}", what)

    def _at(self, key: str) -> str:
        return f"{self.path}: {self.where}.{key}"

    def integer(self, key: str, default: int | None = None) -> int:
        """Return a field that is a count or an index.

        Raises:
            FormatError: It is missing without a default, or is not an integer of 0 or more.
        """
        return integer(self.data.get(key, default), self._at(key), 0)

    def text(self, key: str, default: str = "") -> str:
        """Return a field that is a string, or the default if it is missing.

        Raises:
            FormatError: It is not a string.
        """
        value = self.data.get(key, default)
        if not isinstance(value, str):
            raise refused(self._at(key), "must be a text")
        return value

    def part(self, key: str) -> "JsonObject":
        """Return a field that is an object, or an empty object if it is missing.

        Raises:
            FormatError: It is not an object.
        """
        value = table(self.data.get(key, {}), self._at(key))
        return JsonObject(self.path, f"{self.where}.{key}", value)

    def items(self, key: str) -> list[Any]:
        """Return a field that is an array, or an empty array if it is missing.

        Raises:
            FormatError: It is not an array.
        """
        return rows(self.data.get(key, []), self._at(key))

    def indices(self, key: str) -> list[int]:
        """Return a field that is an array of indices.

        Raises:
            FormatError: It is not an array, or holds something else.
        """
        return [integer(value, self._at(key), 0) for value in self.items(key)]

    def at(self, key: str, index: int) -> "JsonObject":
        """Return the object at an index of an array field.

        Raises:
            FormatError: The array is too short, or its element there is not an object.
        """
        values = self.items(key)
        if index >= len(values) or not isinstance(values[index], dict):
            raise self.error(f"has no object {index} in {key!r}, but refers to it")
        return JsonObject(self.path, f"{key}[{index}]", values[index])

    def numbers(self, key: str, default: tuple[float, ...]) -> F64:
        """Return an array of as many finite numbers as the default has.

        Raises:
            FormatError: The field is anything else.
        """
        return numbers(self.data.get(key, list(default)), self._at(key), len(default))


@dataclass(frozen=True, slots=True)
class SkippedUri:
    """The location of a `data:` URI that was skipped when the JSON was read.

    Attributes:
        start: Its byte offset in the file.
        size: Its size in bytes.
        escaped: Whether it contains a backslash, which some writers put before a slash.
    """

    start: int
    size: int
    escaped: bool


@dataclass(frozen=True, slots=True)
class Document:
    """The JSON of a file, and the locations of its buffers.

    Attributes:
        path: The file.
        root: The root object of the JSON.
        body: The binary chunk of the file, used for the buffer without a URI; None in a text file.
        lifted: The skipped `data:` URIs, by the placeholder that replaces each in the JSON.
    """

    path: Path
    root: JsonObject
    body: Section | None = None
    lifted: dict[str, SkippedUri] = field(default_factory=dict)
    _buffers: dict[int, Section] = field(default_factory=dict)

    @property
    def file_bytes(self) -> int:
        """Total size in bytes of the file and of the files of the buffers used so far."""
        return sum(map(input_size, self.paths()))

    def paths(self) -> list[Path]:
        """Return the file and the files of the buffers used so far."""
        return [*dict.fromkeys([self.path, *(each.path for each in self._buffers.values())])]

    def named_files(self) -> list[Path]:
        """Return the files of all buffers that have one of their own; they need not exist.

        Raises:
            FormatError: One is outside the file's folder.
        """
        count = len(self.root.items("buffers"))
        found = [self._own_file(self.root.at("buffers", number)) for number in range(count)]
        return list(dict.fromkeys(path for path in found if path is not None))

    def buffers(self) -> dict[int, Section]:
        """Return the buffers used so far, by their index."""
        return self._buffers

    def accessor(self, index: int, components: int) -> Accessor:
        """Return an accessor of `components` numbers per row, after checking counts and offsets.

        Raises:
            FormatError: It has another type, is sparse or without a buffer view, or leads outside
                its buffer.
        """
        part = self.root.at("accessors", index)
        kind = _KINDS.get(part.integer("componentType"))
        if kind is None or _COMPONENTS.get(part.text("type")) != components:
            raise part.error(f"needs {components} components of 8 or 16 bits or of type float")
        if "bufferView" not in part.data or "sparse" in part.data:
            raise part.error("is sparse or without a buffer view, which nanogs does not read")
        view = self.root.at("bufferViews", part.integer("bufferView"))
        buffer, start, end = self._span(view)
        width = components * np.dtype(kind).itemsize
        stride = view.integer("byteStride", width)
        count = part.integer("count")
        offset = start + part.integer("byteOffset", 0)
        if count < 1 or stride < width or offset + (count - 1) * stride + width > end:
            raise part.error(f"with {count} rows does not fit into its buffer view")
        normalized = part.data.get("normalized") is True
        step = stride if count > 1 else width  # a single row may state any stride
        return Accessor(count, components, kind, normalized, buffer, offset, step, (start, end))

    def view(self, index: int) -> Section:
        """Return the section of a file that a buffer view covers.

        Raises:
            FormatError: There is no such view, or it leads outside its buffer.
        """
        buffer, start, end = self._span(self.root.at("bufferViews", index))
        return self._buffers[buffer].part(start, end - start)

    def _span(self, view: JsonObject) -> tuple[int, int, int]:
        """Return the buffer index of a buffer view, and its start and end in bytes there."""
        if packed := [name for name in view.part("extensions").data if "compression" in name]:
            raise view.error(f"is packed with {packed[0]}, which nanogs does not read")
        number = view.integer("buffer")
        buffer = self.root.at("buffers", number)
        if number not in self._buffers:
            self._buffers[number] = self._located(buffer, first=number == 0)
        start, length = view.integer("byteOffset", 0), view.integer("byteLength")
        if start + length > min(buffer.integer("byteLength"), self._buffers[number].size):
            raise view.error("does not fit into its buffer")
        return number, start, start + length

    def _located(self, buffer: JsonObject, *, first: bool) -> Section:
        """Return the section of the file that holds a buffer, or its decoded bytes."""
        if (path := self._own_file(buffer)) is not None:
            return Section(path, 0, input_size(path))
        if not (uri := buffer.text("uri")):
            if self.body is None or not first:
                raise buffer.error("has no URI")
            return self.body
        if (lifted := self.lifted.get(uri)) is not None:
            return _skipped_uri_section(self.path, buffer, lifted)
        data = _decoded(buffer, uri.encode("utf-8", "replace"))
        return Section(self.path, 0, len(data), data)

    def _own_file(self, buffer: JsonObject) -> Path | None:
        """Return the file that holds only this buffer; None if it is in the document."""
        uri = buffer.text("uri")
        if not uri or uri.startswith(DATA):  # as placeholders of skipped URIs do too
            return None
        return referenced_path(self.path.parent, uri, f"{self.path}: {buffer.where}.uri")


def _skipped_uri_section(path: Path, buffer: JsonObject, lifted: SkippedUri) -> Section:
    """Return the bytes of a skipped `data:` URI: in the file, decoded later unless escaped."""
    with reading(path) as file:
        file.seek(lifted.start)
        if lifted.escaped:
            data = _decoded(buffer, file.read(lifted.size))
            return Section(path, 0, len(data), data)
        before = len(_head(buffer, file.read(min(lifted.size, _LONGEST_HEAD)))) + 1
        file.seek(lifted.start + lifted.size - 2)
        padding = file.read(2).count(b"=")
    groups, rest = divmod(lifted.size - before, 4)
    if rest:
        raise buffer.error("has a data: URI that is damaged")
    return Section(path, 0, 3 * groups - padding, text=lifted.start + before)


def _head(buffer: JsonObject, uri: bytes) -> bytes:
    """Return the part of a `data:` URI before its comma, which has to end with ";base64"."""
    head, comma, _ = uri.partition(b",")
    if not comma or not head.endswith(b";base64"):
        raise buffer.error("has a data: URI that is not in base64")
    return head


def _decoded(buffer: JsonObject, uri: bytes) -> bytes:
    """Decode the payload of a `data:` URI."""
    payload = uri[len(_head(buffer, uri)) + 1 :]
    try:
        return base64.b64decode(payload.replace(b"\\/", b"/"), validate=True)
    except ValueError:
        raise buffer.error("has a data: URI that is damaged") from None


def check_length(path: Path, size: int) -> None:
    """Refuse JSON of more than `MAX_JSON_BYTES`.

    Raises:
        FormatError: It is longer.
    """
    if size > MAX_JSON_BYTES:
        raise FormatError(
            f"{path}: its JSON has {size} bytes, and nanogs reads up to {MAX_JSON_BYTES}; export"
            " the splats alone."
        )


def parsed(path: Path, text: bytes) -> JsonObject:
    """Parse the JSON of a document and return its root object.

    Raises:
        FormatError: It is not valid JSON, or not an object.
    """
    try:
        data = json.loads(text.decode("utf-8"), parse_constant=_refuse)
    except (ValueError, RecursionError) as error:
        reason = str(error) if isinstance(error, json.JSONDecodeError) else type(error).__name__
        raise damaged(path, f"its JSON cannot be read ({reason})") from None
    if not isinstance(data, dict):
        raise damaged(path, "its JSON is no object")
    return JsonObject(path, "glTF", data)


def _refuse(name: str) -> NoReturn:
    raise ValueError(name)

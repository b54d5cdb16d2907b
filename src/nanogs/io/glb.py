"""The container of binary glTF (`.glb`): its chunks, its JSON, and the accessors into its buffer.

https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html, sections 3.6 (binary data) and 4 (GLB).
Nothing outside the file is ever read.
"""

import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from nanogs._types import F64
from nanogs.errors import FormatError
from nanogs.io.files import input_size, unreadable
from nanogs.io.glb_rows import Accessor

MAGIC = b"glTF"
JSON_CHUNK, BODY_CHUNK = b"JSON", b"BIN\0"
# Python takes up to 25 times a JSON text's size; those of splats have some 10 KB.
MAX_JSON_BYTES = 4 << 20
_CHUNK = struct.Struct("<I4s")
_KINDS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_AGAIN = "export or download it again."


@dataclass(frozen=True, slots=True)
class Part:
    """An object in the JSON chunk, and where it stands there, for messages."""

    path: Path
    where: str
    data: dict[str, Any]

    def error(self, what: str) -> FormatError:
        """The error that something about this object is not as it must be."""
        return FormatError(f"{self.path}: {self.where} {what}; {_AGAIN}")

    def integer(self, key: str, default: int | None = None) -> int:
        """A number that counts something or is an index.

        Raises:
            FormatError: It is missing without a default, or no integer from 0 on.
        """
        value = self.data.get(key, default)
        if type(value) is not int or value < 0:
            raise self.error(f"has no count or index {key!r}, but {_shown(value)}")
        return value

    def text(self, key: str, default: str = "") -> str:
        """A string, or the default where there is none.

        Raises:
            FormatError: It is no string.
        """
        value = self.data.get(key, default)
        if not isinstance(value, str):
            raise self.error(f"has no text {key!r}, but {_shown(value)}")
        return value

    def part(self, key: str) -> "Part":
        """An object; an empty one where there is none.

        Raises:
            FormatError: It is no object.
        """
        value = self.data.get(key, {})
        if not isinstance(value, dict):
            raise self.error(f"has no object {key!r}, but {_shown(value)}")
        return Part(self.path, f"{self.where}.{key}", value)

    def items(self, key: str) -> list[Any]:
        """An array; an empty one where there is none.

        Raises:
            FormatError: It is no array.
        """
        value = self.data.get(key, [])
        if not isinstance(value, list):
            raise self.error(f"has no array {key!r}, but {_shown(value)}")
        return value

    def indices(self, key: str) -> list[int]:
        """An array of indices.

        Raises:
            FormatError: It is no array, or holds something else.
        """
        values = self.items(key)
        for value in values:
            if type(value) is not int or value < 0:
                raise self.error(f"has {_shown(value)} among the indices {key!r}")
        return values

    def at(self, key: str, index: int) -> "Part":
        """The object at an index of an array.

        Raises:
            FormatError: The array is too short, or holds something else there.
        """
        values = self.items(key)
        if index >= len(values) or not isinstance(values[index], dict):
            raise self.error(f"has no object {index} in {key!r}, which is referred to")
        return Part(self.path, f"{key}[{index}]", values[index])

    def numbers(self, key: str, default: tuple[float, ...]) -> F64:
        """As many finite numbers as the default has.

        Raises:
            FormatError: There are others.
        """
        values = self.data.get(key, list(default))
        good = isinstance(values, list) and len(values) == len(default)
        if not good or not all(type(value) in (int, float) for value in values):
            raise self.error(f"needs {len(default)} numbers {key!r}")
        try:
            array = np.array(values, np.float64)
        except OverflowError:
            array = np.full(len(default), np.inf)
        if not np.isfinite(array).all():
            raise self.error(f"needs finite numbers {key!r}")
        return array


def _shown(value: object) -> str:
    text = ascii(value)
    return text if len(text) <= 40 else text[:40] + "..."


@dataclass(frozen=True, slots=True)
class Glb:
    """A file's JSON and where its buffer lies."""

    path: Path
    file_bytes: int
    root: Part
    body_at: int
    body_bytes: int

    def accessor(self, index: int, components: int) -> Accessor:
        """An accessor of rows of so many numbers, every count and offset checked.

        Raises:
            FormatError: It has another type, lies elsewhere, or leads outside the buffer.
        """
        part = self.root.at("accessors", index)
        kind = _KINDS.get(part.integer("componentType"))
        if kind is None or _COMPONENTS.get(part.text("type")) != components:
            raise part.error(f"needs {components} components of 8 or 16 bits or of type float")
        if "bufferView" not in part.data or "sparse" in part.data:
            raise part.error("is sparse or without a buffer view, which nanogs does not read")
        view = self.root.at("bufferViews", part.integer("bufferView"))
        start, end = self._span(view)
        width = components * np.dtype(kind).itemsize
        stride = view.integer("byteStride", width)
        count = part.integer("count")
        offset = start + part.integer("byteOffset", 0)
        if count < 1 or stride < width or offset + (count - 1) * stride + width > end:
            raise part.error(f"with {count} rows does not fit into its buffer view")
        normalized = part.data.get("normalized") is True
        return Accessor(count, components, kind, normalized, offset, stride, (start, end))

    def _span(self, view: Part) -> tuple[int, int]:
        """First byte of a buffer view in the file, and the one after its last."""
        if packed := [name for name in view.part("extensions").data if "compression" in name]:
            raise view.error(f"is packed with {packed[0]}, which nanogs does not read")
        number = view.integer("buffer")
        buffer = self.root.at("buffers", number)
        if number or "uri" in buffer.data:
            raise FormatError(
                f"{self.path}: {buffer.where} lies outside the .glb file, and nanogs follows no"
                " references; export it with everything in one file."
            )
        start, length = view.integer("byteOffset", 0), view.integer("byteLength")
        if start + length > min(buffer.integer("byteLength"), self.body_bytes):
            raise view.error("does not fit into its buffer")
        return self.body_at + start, self.body_at + start + length


def read_glb(path: Path) -> Glb:
    """Read the headers and the JSON of a file.

    Raises:
        FormatError: The file cannot be read, is damaged, or its JSON is too long.
    """
    size = input_size(path)
    try:
        with path.open("rb") as file:
            _check_header(path, file.read(12), size)
            length, kind = _chunk(path, file.read(_CHUNK.size), file.tell(), size)
            if kind != JSON_CHUNK:
                raise _damaged(path, f"its first chunk is {kind!r} and not JSON")
            if length > MAX_JSON_BYTES:
                raise FormatError(
                    f"{path}: its JSON has {length} bytes, and nanogs reads up to"
                    f" {MAX_JSON_BYTES}; export the splats alone."
                )
            root = Part(path, "glTF", _parsed(path, file.read(length)))
            at = file.tell()
            length, kind = 0, BODY_CHUNK
            if at < size:
                length, kind = _chunk(path, file.read(_CHUNK.size), at + _CHUNK.size, size)
    except OSError as error:
        raise unreadable(path, error) from error
    if kind != BODY_CHUNK:  # an unknown chunk, which is to be ignored
        length = 0
    return Glb(path, size, root, at + _CHUNK.size, length)


def _damaged(path: Path, what: str) -> FormatError:
    return FormatError(f"{path}: {what}; {_AGAIN}")


def _check_header(path: Path, header: bytes, size: int) -> None:
    if header[:4] != MAGIC:
        raise FormatError(
            f"{path} does not begin with 'glTF', so it is no .glb file; give it the suffix of its"
            " real format."
        )
    if len(header) < 12:
        raise _damaged(path, "it ends inside its header")
    version, length = struct.unpack("<II", header[4:])
    if version != 2:
        raise FormatError(f"{path}: nanogs reads glTF 2.0, not {version}; export it as 2.0.")
    if length != size:
        raise _damaged(path, f"its header says {length} bytes, but it has {size}")


def _chunk(path: Path, header: bytes, at: int, size: int) -> tuple[int, bytes]:
    """Length and type of a chunk whose contents begin at a byte of the file."""
    if len(header) < _CHUNK.size:
        raise _damaged(path, "it ends inside the header of a chunk")
    length, kind = _CHUNK.unpack(header)
    if at + length > size:
        raise _damaged(path, f"it is cut short: {size - at} of a chunk's {length} bytes are there")
    return length, kind


def _parsed(path: Path, text: bytes) -> dict[str, Any]:
    try:
        data = json.loads(text.decode("utf-8"), parse_constant=_refuse)
    except (ValueError, RecursionError) as error:
        reason = str(error) if isinstance(error, json.JSONDecodeError) else type(error).__name__
        raise _damaged(path, f"its JSON cannot be read ({reason})") from None
    if not isinstance(data, dict):
        raise _damaged(path, "its JSON is no object")
    return data


def _refuse(name: str) -> NoReturn:
    raise ValueError(name)

"""Writing `.glb` and `.gltf` with KHR_gaussian_splatting: float32 columns, one primitive of points.

For the specification see `read`. The numbers stay in the frame of the model; the node's rotation,
half a turn about z, leads to glTF's frame, y-up. `COLOR_0` shows the base colours to viewers
without support for splats. The JSON is padded to the length that the longest numbers would take, so
that the size of a file depends only on its number of splats.

A `.gltf`, which is text, holds its buffer as a `data:` URI: a second file beside it could exist
without the first one, or belong to another model.
"""

import json
import struct
from base64 import b64encode
from collections.abc import Iterable, Iterator
from functools import partial
from typing import Any, BinaryIO

import numpy as np

from nanogs._types import F32, Array
from nanogs.activations import SH_C0
from nanogs.errors import OutputError
from nanogs.io import activated, limits
from nanogs.io.by_column import Encoder, encoded_columns
from nanogs.io.generator import GENERATOR
from nanogs.io.gltf.document import MAX_JSON_BYTES
from nanogs.io.gltf.glb import BODY_CHUNK, JSON_CHUNK, MAGIC
from nanogs.io.gltf.primitives import MAX_DEGREE, attribute, coefficients
from nanogs.io.gltf.read import COLOUR_SPACE, COMMENTS_KEY, MODE_KEY
from nanogs.io.gltf.scene import EXTENSION, HALF_TURN
from nanogs.io.texts import as_utf8, one_line
from nanogs.source import Source, source_of
from nanogs.splats import RenderMode, Splats

_FLOAT, _BYTE = 5126, 5121
_KINDS = {_FLOAT: "<f4", _BYTE: "u1"}
_VERTICES = 34962  # the target of a buffer view with vertex attributes
_MAX_BYTES = (1 << 32) - 1
_URI = "data:application/octet-stream;base64,"
_LONGEST = -2.2250738585072014e-308  # no float has a longer text


def write(model: Splats | Source, file: BinaryIO) -> None:
    """Write a `.glb`, holding only some rows in memory; rotations are normalised.

    Raises:
        OutputError: A splat holds a value that glTF cannot, a comment a line break, or the file
            would be too large.
        OSError: The system refuses to write.
    """
    source = source_of(model)
    low, high = _bounds(source, ".glb")
    first, count = source.read(0, 1), source.count
    file_bytes(first, count)  # raises if the file would be too large
    text = _text(_document(first, count, low, high)).ljust(_json_bytes(first))
    file.writelines(head(text, count * _row_bytes(first)))
    file.writelines(_body(source, first))


def write_text(model: Splats | Source, file: BinaryIO) -> None:
    """Write a `.gltf` in the same way, with its buffer in a `data:` URI.

    Raises:
        OutputError: As for `write`.
        OSError: The system refuses to write.
    """
    source = source_of(model)
    low, high = _bounds(source, ".gltf")
    first, count = source.read(0, 1), source.count
    size = text_bytes(first, count)
    text = _text(_document(first, count, low, high, _URI))
    before, uri, after = text.rpartition(_URI.encode())  # the last: comments may contain it too
    file.write(before + uri)
    rest = b""
    for block in _body(source, first):
        data = rest + block
        whole = len(data) - len(data) % 3
        file.write(b64encode(data[:whole]))
        rest = data[whole:]
    file.write(b64encode(rest))
    file.write(after.ljust(size - len(before + uri) - _encoded_bytes(count * _row_bytes(first))))


def _body(source: Source, first: Splats) -> Iterator[bytes]:
    """Yield the buffer in pieces."""
    encoders = [partial(_encoded, encode, kind) for _, encode, kind, *_ in _attributes(first)]
    for column in encoded_columns(source, encoders):
        yield from column


def _encoded_bytes(size: int) -> int:
    """Return the number of base64 characters for `size` bytes."""
    return (size + 2) // 3 * 4


def head(text: bytes, body_bytes: int) -> Iterator[bytes]:
    """Yield the bytes of a `.glb` file before its buffer.

    Args:
        text: The JSON, padded to a multiple of 4 bytes.
        body_bytes: Size of the buffer, a multiple of 4.
    """
    yield MAGIC + struct.pack("<II", 2, 12 + 8 + len(text) + 8 + body_bytes)
    yield struct.pack("<I", len(text)) + JSON_CHUNK + text
    yield struct.pack("<I", body_bytes) + BODY_CHUNK


def file_bytes(splats: Splats, count: int) -> int:
    """Return the `.glb` file size in bytes of a model like this one with `count` splats.

    Args:
        splats: The model that the SH degree, the render mode and the comments are taken from.
        count: Number of splats, 1 or more.

    Raises:
        OutputError: The comments are too long, or the file would be too large for `.glb`.
    """
    size = 12 + 8 + _json_bytes(splats) + 8 + count * _row_bytes(splats)
    if size > _MAX_BYTES:
        raise OutputError(
            f"{count} splats would take {size} bytes, and a .glb file cannot have more than"
            f" {_MAX_BYTES}; write fewer splats or another format."
        )
    return size


def text_bytes(splats: Splats, count: int) -> int:
    """Return the `.gltf` file size in bytes; see `file_bytes`.

    Raises:
        OutputError: The comments are too long, or the file would be too large.
    """
    size = _json_bytes(splats) + len(_URI) + len(',"uri":""')
    size += _encoded_bytes(count * _row_bytes(splats))
    if size > _MAX_BYTES:
        raise OutputError(
            f"{count} splats would take {size} bytes of text; write fewer splats, or a .glb, which"
            " takes a quarter less."
        )
    return size


def losses(splats: Splats, suffix: str = ".glb") -> tuple[str, ...]:
    """Name what the file leaves out, one sentence each."""
    found = limits.left_out(splats, suffix, comments=False, max_degree=MAX_DEGREE)
    return (*found, *limits.rounded(splats, suffix))


def _bounds(source: Source, suffix: str) -> tuple[list[float], list[float]]:
    """Return the minimum and maximum of the centres, after checking that all can be stored."""
    blocks = limits.storable(source, suffix)
    corners = [(block.means.min(axis=0), block.means.max(axis=0)) for block in blocks]
    low, high = map(np.array, zip(*corners, strict=True))
    low, high = low.min(axis=0).astype(np.float32), high.max(axis=0).astype(np.float32)
    return low.tolist(), high.tolist()


def _encoded(encode: Encoder, component: int, block: Splats) -> Array:
    return np.ascontiguousarray(encode(block), _KINDS[component])


def _json_bytes(splats: Splats) -> int:
    """Return the padded size of the JSON for any count: a multiple of 4, as chunks must be."""
    longest = [_LONGEST] * 3
    size = len(_text(_document(splats, _MAX_BYTES, longest, longest))) + 3 & ~3
    limits.refuse_long_json(size, MAX_JSON_BYTES)
    return size


def _text(document: dict[str, Any]) -> bytes:
    text = json.dumps(document, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return text.encode("utf-8")


def _attributes(splats: Splats) -> Iterator[tuple[str, Encoder, int, str, int]]:
    """Yield name, encoder, component type, type and bytes per splat of each column, in order."""
    yield "POSITION", lambda part: part.means, _FLOAT, "VEC3", 12
    yield "COLOR_0", _fallback, _BYTE, "VEC4", 4
    yield attribute("ROTATION"), _xyzw, _FLOAT, "VEC4", 16
    yield attribute("SCALE"), activated.scales, _FLOAT, "VEC3", 12
    yield attribute("OPACITY"), _opacities, _FLOAT, "SCALAR", 4
    for index, name in enumerate(coefficients(min(splats.sh_degree, MAX_DEGREE))):
        yield name, partial(_coefficient, index), _FLOAT, "VEC3", 12


def _row_bytes(splats: Splats) -> int:
    return sum(size for *_, size in _attributes(splats))


def _coefficient(index: int, part: Splats) -> Array:
    return part.sh[:, index]


def _xyzw(part: Splats) -> Array:
    return activated.unit_quats(part)[:, [1, 2, 3, 0]]


def _opacities(part: Splats) -> F32:
    return part.opacities().astype(np.float32)


def _fallback(part: Splats) -> Array:
    """Return (R, 4) uint8 RGBA for `COLOR_0`, which is linear: decoded base colour, and alpha."""
    srgb = np.clip(part.sh[:, 0].astype(np.float64) * SH_C0 + 0.5, 0, 1)
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    rgba = np.column_stack([linear, _opacities(part)])
    return np.floor(rgba * 255 + 0.5).astype(np.uint8)


def _document(
    splats: Splats, count: int, low: list[float], high: list[float], uri: str = ""
) -> dict[str, Any]:
    """Return the JSON of a model of `count` splats, with the buffer last."""
    columns = list(_attributes(splats))
    accessors: list[dict[str, Any]] = []
    views = []
    offset = 0
    for index, (_, _, component, kind, size) in enumerate(columns):
        views.append(
            {"buffer": 0, "byteOffset": offset, "byteLength": count * size, "target": _VERTICES}
        )
        accessor = {"bufferView": index, "componentType": component, "count": count, "type": kind}
        accessors.append(accessor | ({"normalized": True} if component == _BYTE else {}))
        offset += count * size
    accessors[0] |= {"min": low, "max": high}
    drawn = {"projection": "perspective", "sortingMethod": "cameraDistance"}
    primitive = primitive_of((name for name, *_ in columns), drawn)
    if extras := _extras(splats):
        primitive["extras"] = extras
    buffer = {"byteLength": offset} | ({"uri": uri} if uri else {})
    arrays = {"accessors": accessors, "bufferViews": views, "buffers": [buffer]}
    return document_of(primitive, {"extensionsUsed": [EXTENSION]}, {"rotation": HALF_TURN}) | arrays


def primitive_of(names: Iterable[str], splatting: dict[str, Any]) -> dict[str, Any]:
    """Return the JSON of a primitive of splats.

    Args:
        names: Names of its attributes; the first has the first accessor, and so on.
        splatting: Fields of its extension besides the kernel and the colour space.
    """
    kernel = {"kernel": "ellipse", "colorSpace": COLOUR_SPACE}
    return {
        "mode": 0,
        "attributes": {name: index for index, name in enumerate(names)},
        "extensions": {EXTENSION: kernel | splatting},
    }


def document_of(
    primitive: dict[str, Any], extensions: dict[str, list[str]], placed: dict[str, Any]
) -> dict[str, Any]:
    """Return the JSON of a document with one primitive, without accessors, views and buffers.

    Args:
        primitive: The primitive of splats.
        extensions: The extensions used and required, by JSON key.
        placed: The transform of the node, as its JSON fields.
    """
    return {
        "asset": {"version": "2.0", "generator": GENERATOR},
        **extensions,
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **placed}],
        "meshes": [{"primitives": [primitive]}],
    }


def _extras(splats: Splats) -> dict[str, Any]:
    extras: dict[str, Any] = {}
    if splats.render_mode is not RenderMode.DEFAULT:
        extras[MODE_KEY] = splats.render_mode.value
    if splats.comments:
        extras[COMMENTS_KEY] = [as_utf8(one_line(text)) for text in splats.comments]
    return extras

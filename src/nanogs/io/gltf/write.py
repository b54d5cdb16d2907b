"""Writing `.glb` with KHR_gaussian_splatting: float32 columns, one primitive of points.

The specification is named in `read`. The numbers stay in the frame of the model; the node turns
them by half a turn about z into glTF's, y-up. `COLOR_0` shows the base colours to viewers that
know no splats. The JSON is padded to what the longest numbers would take, so that the size of a
file follows from the count of its splats.
"""

import json
import struct
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, BinaryIO

import numpy as np

from nanogs._types import F32, Array
from nanogs._version import __version__
from nanogs.errors import OutputError
from nanogs.io import limits
from nanogs.io.files import BLOCK_ROWS
from nanogs.io.gltf.document import MAX_JSON_BYTES
from nanogs.io.gltf.glb import BODY_CHUNK, JSON_CHUNK, MAGIC
from nanogs.io.gltf.primitives import MAX_DEGREE, attribute, coefficients
from nanogs.io.gltf.read import COLOUR_SPACE, COMMENTS_KEY, MODE_KEY
from nanogs.io.gltf.scene import EXTENSION, HALF_TURN
from nanogs.io.ply.header import printable
from nanogs.splats import RenderMode, Splats
from nanogs.stored import SH_C0

_FLOAT, _BYTE = 5126, 5121
_KINDS = {_FLOAT: "<f4", _BYTE: "u1"}
_VERTICES = 34962  # the target of a buffer view with vertex attributes
_MAX_BYTES = (1 << 32) - 1
_LONGEST = -2.2250738585072014e-308  # no float has more digits
_Encoder = Callable[[Splats], Array]
"""Values of an attribute for a block of rows."""


def write(splats: Splats, file: BinaryIO) -> None:
    """Write a model; rotations are written with unit length.

    Raises:
        OutputError: A splat holds a value that glTF cannot, or the file would be too large.
        OSError: The system refuses to write.
    """
    limits.refuse_unstorable(splats, ".glb")
    size = file_bytes(splats, len(splats))
    low, high = (edge.astype(np.float32).tolist() for edge in _bounds(splats))
    text = _text(_document(splats, len(splats), low, high)).ljust(_json_bytes(splats))
    file.write(MAGIC + struct.pack("<II", 2, size))
    file.write(struct.pack("<I", len(text)) + JSON_CHUNK + text)
    file.write(struct.pack("<I", len(splats) * _row_bytes(splats)) + BODY_CHUNK)
    for _, encode, component, *_ in _attributes(splats):
        file.writelines(
            np.ascontiguousarray(encode(part), _KINDS[component]).data for part in _parts(splats)
        )


def file_bytes(splats: Splats, count: int) -> int:
    """Bytes of the file of a model of `count` splats that is like this one in all else.

    Args:
        splats: What the degree, the render mode and the comments are taken from.
        count: Splats, 1 or more.

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


def losses(splats: Splats) -> tuple[str, ...]:
    """Name what the file leaves out, one sentence each."""
    found = limits.left_out(splats, ".glb", comments=False, max_degree=MAX_DEGREE)
    return (*found, *limits.rounded(splats, ".glb"))


def _parts(splats: Splats) -> Iterator[Splats]:
    """The model in blocks of rows, which are views."""
    names = ("means", "log_scales", "quats", "opacity_logits", "sh")
    for start in range(0, len(splats), BLOCK_ROWS):
        span = slice(start, start + BLOCK_ROWS)
        yield Splats(**{name: getattr(splats, name)[span] for name in names})


def _bounds(splats: Splats) -> tuple[F32, F32]:
    return splats.means.min(axis=0), splats.means.max(axis=0)


def _json_bytes(splats: Splats) -> int:
    """The JSON's size, the same for every count: a multiple of 4, as chunks must be."""
    longest = [_LONGEST] * 3
    size = len(_text(_document(splats, _MAX_BYTES, longest, longest))) + 3 & ~3
    if size > MAX_JSON_BYTES:
        raise OutputError(
            f"The JSON would have {size} bytes, and no more than {MAX_JSON_BYTES} can be read"
            " back; shorten the comments."
        )
    return size


def _text(document: dict[str, Any]) -> bytes:
    text = json.dumps(document, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return text.encode("utf-8")


def _attributes(splats: Splats) -> Iterator[tuple[str, _Encoder, int, str, int]]:
    """Name, encoder, component type, type and bytes a splat of each column, in file order."""
    yield "POSITION", lambda part: part.means, _FLOAT, "VEC3", 12
    yield "COLOR_0", _fallback, _BYTE, "VEC4", 4
    yield attribute("ROTATION"), _xyzw, _FLOAT, "VEC4", 16
    yield attribute("SCALE"), Splats.scales, _FLOAT, "VEC3", 12
    yield attribute("OPACITY"), Splats.opacities, _FLOAT, "SCALAR", 4
    for index, name in enumerate(coefficients(min(splats.sh_degree, MAX_DEGREE))):
        yield name, partial(_coefficient, index), _FLOAT, "VEC3", 12


def _row_bytes(splats: Splats) -> int:
    return sum(size for *_, size in _attributes(splats))


def _coefficient(index: int, part: Splats) -> Array:
    return part.sh[:, index]


def _xyzw(part: Splats) -> Array:
    return part.unit_quats()[:, [1, 2, 3, 0]]


def _fallback(part: Splats) -> Array:
    """(R, 4) uint8: the base colour decoded from sRGB, as `COLOR_0` is linear, and alpha."""
    srgb = np.clip(part.sh[:, 0].astype(np.float64) * SH_C0 + 0.5, 0, 1)
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    rgba = np.column_stack([linear, part.opacities()])
    return np.floor(rgba * 255 + 0.5).astype(np.uint8)


def _document(splats: Splats, count: int, low: list[float], high: list[float]) -> dict[str, Any]:
    """The JSON of a model of so many splats."""
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
    primitive: dict[str, Any] = {
        "mode": 0,
        "attributes": {name: index for index, (name, *_) in enumerate(columns)},
        "extensions": {
            EXTENSION: {
                "kernel": "ellipse",
                "colorSpace": COLOUR_SPACE,
                "projection": "perspective",
                "sortingMethod": "cameraDistance",
            }
        },
    }
    if extras := _extras(splats):
        primitive["extras"] = extras
    return {
        "asset": {"version": "2.0", "generator": f"nanogs {__version__}"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": HALF_TURN}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }


def _extras(splats: Splats) -> dict[str, Any]:
    extras: dict[str, Any] = {}
    if splats.render_mode is not RenderMode.DEFAULT:
        extras[MODE_KEY] = splats.render_mode.value
    if splats.comments:
        extras[COMMENTS_KEY] = [printable(text) for text in splats.comments]
    return extras

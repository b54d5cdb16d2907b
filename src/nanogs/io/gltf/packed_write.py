"""Writing `.glb` whose splats are packed as SPZ: KHR_gaussian_splatting_compression_spz_2.

Specification: https://github.com/KhronosGroup/glTF, extensions/2.0/Khronos, a draft. It is the only
encoding of splats that CesiumJS draws (as of 1.145), so where the two disagree this follows
CesiumJS: the SPZ data is in the frame of the mesh, whereas by the draft it would be rotated by half
a turn about y. The attributes are those that the draft names; their accessors have no data of their
own.
"""

import io
import json
from dataclasses import replace
from typing import Any, BinaryIO

import numpy as np

from nanogs.io import limits
from nanogs.io.gltf.primitives import MAX_DEGREE, PACKED, attribute, coefficients
from nanogs.io.gltf.scene import EXTENSION, TO_PLY
from nanogs.io.gltf.write import document_of, head, primitive_of
from nanogs.io.spz import write as spz_write
from nanogs.io.spz.unstorable import losses as spz_losses
from nanogs.splats import Splats

_SUFFIX = ".glb"
_FLOAT, _BYTE = 5126, 5121
# A matrix because CesiumJS reads no other transform here.
_HALF_TURN = TO_PLY.astype(int).ravel().tolist()


def write(splats: Splats, file: BinaryIO) -> None:
    """Write a model with SH degree up to 3; `losses` names what the file cannot hold.

    Raises:
        OutputError: A value is NaN or infinite, or a centre is too far out; nothing has been
            written then.
        OSError: The system refuses to write.
    """
    splats = splats.with_sh_degree(MAX_DEGREE)
    packed = io.BytesIO()
    spz_write.write(replace(splats, elements=()), packed, version=spz_write.DEFAULT_VERSION)
    body = _padded(packed.getvalue(), b"\0")
    document = _document(splats, len(packed.getvalue()))
    text = _padded(json.dumps(document, separators=(",", ":"), allow_nan=False).encode(), b" ")
    file.writelines([*head(text, len(body)), body])


def losses(splats: Splats) -> tuple[str, ...]:
    """Name what the file leaves out or clamps, one sentence each."""
    cut = splats.with_sh_degree(MAX_DEGREE)
    found = spz_losses(cut, records=False, suffix=_SUFFIX)
    if cut.sh_degree == splats.sh_degree:
        return found
    return (limits.degree_left_out(_SUFFIX, MAX_DEGREE), *found)


def _padded(data: bytes, fill: bytes) -> bytes:
    return data + fill * (-len(data) % 4)


def _document(splats: Splats, size: int) -> dict[str, Any]:
    """Return the JSON of a model whose SPZ data has `size` bytes."""
    low, high = splats.means.min(axis=0), splats.means.max(axis=0)
    bounds = {"min": low.astype(np.float32).tolist(), "max": high.astype(np.float32).tolist()}
    columns: list[tuple[str, int, str, dict[str, Any]]] = [
        ("POSITION", _FLOAT, "VEC3", bounds),
        ("COLOR_0", _BYTE, "VEC4", {"normalized": True}),
        (attribute("ROTATION"), _FLOAT, "VEC4", {}),
        (attribute("SCALE"), _FLOAT, "VEC3", {}),
        *((name, _FLOAT, "VEC3", {}) for name in coefficients(splats.sh_degree)[1:]),
    ]
    splatting = {"extensions": {PACKED: {"bufferView": 0}}}
    extensions = {key: [EXTENSION, PACKED] for key in ("extensionsUsed", "extensionsRequired")}
    primitive = primitive_of((name for name, *_ in columns), splatting)
    accessors = [
        {"componentType": component, "count": len(splats), "type": kind} | more
        for _, component, kind, more in columns
    ]
    return document_of(primitive, extensions, {"matrix": _HALF_TURN}) | {
        "accessors": accessors,
        "bufferViews": [{"buffer": 0, "byteLength": size}],
        "buffers": [{"byteLength": size}],
    }

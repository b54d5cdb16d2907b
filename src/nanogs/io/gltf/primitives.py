"""The splats of one glTF primitive: in accessors, or packed as SPZ.

Packed splats follow KHR_gaussian_splatting_compression_spz_2, a draft, as CesiumJS reads it: the
SPZ data is in the frame of the mesh; see `packed_write`. The draft before it had another name and
the same layout.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from nanogs._types import F64
from nanogs.activations import logit
from nanogs.io.gltf.colours import to_display
from nanogs.io.gltf.document import Document, JsonObject
from nanogs.io.gltf.rows import Accessor, BufferReader
from nanogs.io.gltf.scene import EXTENSION, PlacedPrimitive, put_placed
from nanogs.io.info import FileInfo
from nanogs.io.spz import read as spz
from nanogs.io.spz.header import read_header
from nanogs.pose import Pose
from nanogs.slices import BLOCK_ROWS

MAX_DEGREE = 3
PACKED = "KHR_gaussian_splatting_compression_spz_2"
PACKED_NAMES = (PACKED, "KHR_gaussian_splatting_compression_spz")
_POINTS = 0
_TYPE_NAMES = {"i1": "char", "u1": "uchar", "<i2": "short", "<u2": "ushort", "<f4": "float"}


def attribute(name: str) -> str:
    """Return the full name of an attribute of the extension."""
    return f"{EXTENSION}:{name}"


def coefficients(degree: int) -> list[str]:
    """Return the names of the SH attributes up to a degree, in the order of `Splats.sh`."""
    return [
        attribute(f"SH_DEGREE_{level}_COEF_{n}")
        for level in range(degree + 1)
        for n in range(2 * level + 1)
    ]


@dataclass(frozen=True, slots=True)
class Rows:
    """A primitive whose splats are in accessors, one per attribute; rows can be read at random.

    Attributes:
        pose: Transform from the primitive to the frame of `.ply` files.
        linear: Whether its colours are linear light.
        accessors: Accessors by attribute name.
        info: The description of its splats.
    """

    pose: Pose
    linear: bool
    accessors: dict[str, Accessor]
    info: FileInfo

    def holds_logarithms(self, body: BufferReader) -> bool:
        """Return whether any scale is negative, so that scales are stored as logarithms."""
        scales = self.accessors[attribute("SCALE")]
        for start in range(0, scales.count, BLOCK_ROWS):
            if (scales.values(body, start, min(start + BLOCK_ROWS, scales.count)) < 0).any():
                return True
        return False

    def decode(self, body: BufferReader, out: dict[str, Any], first: int, logarithms: bool) -> None:
        """Fill the arrays of `out` with the rows from `first` on, block by block."""
        count = len(out["means"])
        for start in range(0, count, BLOCK_ROWS):
            span = slice(start, min(start + BLOCK_ROWS, count))

            def block(name: str, span: slice = span) -> F64:
                accessor = self.accessors[name]
                values = accessor.values(body, first + span.start, first + span.stop)
                return accessor.decoded(values)

            means, quats = block("POSITION"), block(attribute("ROTATION"))[:, [3, 0, 1, 2]]
            scales = block(attribute("SCALE"))
            for i, name in enumerate(coefficients(self.info.sh_degree)):
                out["sh"][span, i] = block(name)
            out["opacity_logits"][span] = logit(block(attribute("OPACITY"))[:, 0])
            part = {name: array[span] for name, array in out.items()}
            _place(self, part, means, quats, scales if logarithms else np.log(scales))


@dataclass(frozen=True, slots=True)
class Packed:
    """A primitive whose splats are packed as SPZ; they are read all at once.

    Attributes:
        pose: Transform from the primitive to the frame of `.ply` files.
        linear: Whether its colours are linear light.
        source: The SPZ data.
    """

    pose: Pose
    linear: bool
    source: spz.SpzSource

    @property
    def info(self) -> FileInfo:
        """The description of its splats."""
        return self.source.info

    def decode_all(self, out: dict[str, Any]) -> tuple[str, ...]:
        """Fill the arrays of `out` with all rows and return the notes about them."""
        splats = self.source.load()
        out["sh"][:, : splats.sh.shape[1]] = splats.sh
        out["opacity_logits"][:] = splats.opacity_logits
        stored = (splats.means, splats.quats, splats.log_scales)
        for start in range(0, len(splats), BLOCK_ROWS):
            span = slice(start, start + BLOCK_ROWS)
            part = {name: array[span] for name, array in out.items()}
            _place(self, part, *(column[span].astype(np.float64) for column in stored))
        if not splats.elements:
            return tuple(splats.notes)
        names = ", ".join(element.name for element in splats.elements)
        return (*splats.notes, f"Extension records of the packed splats were left out: {names}.")


Primitive = Rows | Packed


def primitive_of(document: Document, placed: PlacedPrimitive, linear: bool) -> Primitive:
    """Make a primitive of splats ready for reading, after checking it against the file.

    Raises:
        FormatError: Something is missing, refers outside of the file, or is contradictory.
    """
    splatting = placed.primitive.part("extensions").part(EXTENSION)
    packed = [name for name in splatting.part("extensions").data if "compression" in name]
    if packed and (len(packed) > 1 or packed[0] not in PACKED_NAMES):
        raise placed.primitive.error(
            f"is packed with {packed[0][:80]!a}, which nanogs does not read"
        )
    if placed.primitive.integer("mode", 4) != _POINTS:
        raise placed.primitive.error("with splats must have mode 0, points")
    if packed:
        view = splatting.part("extensions").part(packed[0]).integer("bufferView")
        source = spz.SpzSource(document.path, read_header(document.view(view)))
        return Packed(placed.pose, linear, source)
    return _rows(document, placed, linear)


def _rows(document: Document, placed: PlacedPrimitive, linear: bool) -> Rows:
    """Return an unpacked primitive, its attributes checked against each other and the file."""
    attributes = placed.primitive.part("attributes")
    degree = _degree(attributes)
    sizes = {"POSITION": 3, attribute("ROTATION"): 4, attribute("SCALE"): 3}
    sizes |= {attribute("OPACITY"): 1} | dict.fromkeys(coefficients(degree), 3)
    if missing := [name for name in sizes if name not in attributes.data]:
        raise attributes.error(f"lacks {missing[0]}")
    accessors = {
        name: document.accessor(attributes.integer(name), size) for name, size in sizes.items()
    }
    if len({accessor.count for accessor in accessors.values()}) > 1:
        raise attributes.error("have different counts")
    info = FileInfo(
        path=document.path,
        format="glb",
        encoding="binary_little_endian",
        file_bytes=0,
        splats=accessors["POSITION"].count,
        sh_degree=degree,
        properties=tuple((name, _TYPE_NAMES[each.kind]) for name, each in accessors.items()),
    )
    return Rows(placed.pose, linear, accessors, info)


def _degree(attributes: JsonObject) -> int:
    """Return the highest SH degree with any attribute; that none is missing is checked later."""
    for degree in range(MAX_DEGREE, 0, -1):
        names = set(coefficients(degree)) - set(coefficients(degree - 1))
        if names & set(attributes.data):
            return degree
    return 0


def _place(
    primitive: Primitive, out: dict[str, Any], means: F64, quats: F64, log_scales: F64
) -> None:
    """Fill rows with the transformed geometry; convert and rotate the SH coefficients in place."""
    if primitive.linear:
        out["sh"][:] = to_display(out["sh"])
    put_placed(out, primitive.pose, means, quats, log_scales)

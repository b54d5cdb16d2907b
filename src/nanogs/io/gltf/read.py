"""Reading glTF with KHR_gaussian_splatting: linear scales and alpha, rotations xyzw, y-up.

Specification: https://github.com/KhronosGroup/glTF, extensions/2.0/Khronos/KHR_gaussian_splatting,
ratified in 2026; docs/formats.md compares every property with it. Scales are linear and not
negative there; earlier drafts stored logarithms, which files in the wild still hold. Node
transforms are applied, and the scene is turned into the frame of `.ply` files, half a turn about z
from glTF's. The render mode and the comments of a PLY file, for which the extension has no field,
are kept in the primitive's `extras`.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from nanogs._types import F64
from nanogs.errors import FormatError
from nanogs.findings import invalid_opacities
from nanogs.formatting import counted
from nanogs.io.files import check_expansion, splat_bytes
from nanogs.io.gltf import rows as gltf_rows
from nanogs.io.gltf.colours import LINEAR
from nanogs.io.gltf.document import Document, JsonObject
from nanogs.io.gltf.glb import read_document
from nanogs.io.gltf.primitives import (
    MAX_DEGREE,
    PACKED_NAMES,
    Packed,
    Primitive,
    Rows,
    attribute,
    coefficients,
    primitive_of,
)
from nanogs.io.gltf.scene import EXTENSION, placed_splats
from nanogs.io.info import FileInfo
from nanogs.io.parts import FileSource, Whole
from nanogs.io.texts import is_line, is_utf8
from nanogs.splats import RenderMode, Splats, empty_arrays

COLOUR_SPACE = "srgb_rec709_display"
MODE_KEY, COMMENTS_KEY = "SplatRenderMode", "comments"
_UNDERSTOOD = (EXTENSION, *PACKED_NAMES, "KHR_mesh_quantization")
_IGNORED = "KHR_materials_"  # splats have no material
_DERIVED = ("COLOR_0", "NORMAL")  # for viewers without support for splats
_LOGARITHMS = (
    "Some scales are negative, so all were read as logarithms, as in early drafts of the extension."
)
# The names of the two colour spaces in drafts; without a name they meant the first.
_DISPLAYED = (COLOUR_SPACE, "BT.709", "BT.709-srgb", "BT.709-sRGB")
_LINEAR = (LINEAR, "lin_rec709_scene", "BT.709-linear", "linear")
# The values that the extension defines, which are also the defaults.
_USUAL = {"kernel": "ellipse", "projection": "perspective", "sortingMethod": "cameraDistance"}


@dataclass(slots=True)
class _Scene:
    """All splat primitives of a file, with their comments, render modes and notes."""

    document: Document
    primitives: list[Primitive] = field(default_factory=list)
    comments: list[str] = field(default_factory=list)
    modes: set[RenderMode] = field(default_factory=set)
    tag: str = ""  # the field of the file that states the render mode, for `FileInfo`
    notes: list[str] = field(default_factory=list)

    @property
    def count(self) -> int:
        return sum(primitive.info.splats for primitive in self.primitives)

    @property
    def degree(self) -> int:
        return max(primitive.info.sh_degree for primitive in self.primitives)

    @property
    def mode(self) -> RenderMode:
        return min(self.modes, key=list(RenderMode).index)

    @property
    def packed(self) -> bool:
        return any(isinstance(primitive, Packed) for primitive in self.primitives)


def open_gltf(path: Path, above: F64 | None = None) -> FileSource:
    """Open the splats of a `.glb` or `.gltf` file, in the order of its primitives.

    Args:
        path: The file.
        above: (4, 4) float64: transform from the file's frame to that of an enclosing scene, both y
            up; the identity by default.

    Raises:
        FormatError: The file cannot be read, is damaged, holds no splats or only such as are
            packed in an unknown way, or refers to files elsewhere; or a transform mirrors or shears
            the splats.
    """
    scene = _scene(path, np.eye(4) if above is None else above)
    return (_Packed if scene.packed else _Rows)(scene)


def named_files(path: Path) -> list[Path]:
    """Return the files of the buffers of a `.glb` or `.gltf` file, which need not be there yet.

    Raises:
        FormatError: The file cannot be read, is damaged, or refers to files elsewhere.
    """
    return read_document(path).named_files()


class _Rows(FileSource):
    """A source of the splats of all primitives, for files in which none are packed."""

    def __init__(self, scene: _Scene) -> None:
        super().__init__(scene.document.path)
        self._scene = scene
        self.info = replace(
            scene.primitives[0].info,
            path=self.path,
            format="gltf" if scene.document.body is None else "glb",
            file_bytes=scene.document.file_bytes,
            splats=scene.count,
            sh_degree=scene.degree,
            render_mode=scene.mode,
            render_tag=scene.tag,
            comments=tuple(scene.comments),
        )

    @cached_property
    def _logarithms(self) -> bool:
        with self._body() as body, np.errstate(invalid="ignore"):
            plain = [each for each in self._scene.primitives if isinstance(each, Rows)]
            return any(each.holds_logarithms(body) for each in plain)

    @property
    def files(self) -> Sequence[Path]:
        """The file, and the files of its buffers; see `FileSource`."""
        path = self.path
        return (path, *(p for p in self._scene.document.paths() if p != path))

    @property
    def packed(self) -> bool:
        """Whether some of its splats are packed as SPZ; see `FileSource`."""
        return self._scene.packed

    @contextmanager
    def _body(self) -> Iterator[gltf_rows.BufferReader]:
        document = self._scene.document
        with gltf_rows.opened(document.path, document.buffers()) as body:
            yield body

    def _span(self, start: int, stop: int) -> Splats:
        """Read rows `start` to `stop`, which must be all if any are packed; see `Source`."""
        scene, n = self._scene, stop - start
        out = empty_arrays(n, scene.degree)
        out["sh"][:] = 0
        notes = list(scene.notes)
        first = 0
        # The file may hold any bits: NaN, infinity, zero scales.
        with self._body() as body, np.errstate(all="ignore"):
            for primitive in scene.primitives:
                end = first + primitive.info.splats
                low, high = max(start, first), min(stop, end)
                part = {name: array[low - start : high - start] for name, array in out.items()}
                if isinstance(primitive, Packed):
                    notes += primitive.decode_all(part)
                elif low < high:
                    primitive.decode(body, part, low - first, self._logarithms)
                first = end
        notes += [_LOGARITHMS] if self._logarithms else []
        notes += invalid_opacities(int(np.isnan(out["opacity_logits"]).sum()))
        return Splats(
            **out, render_mode=scene.mode, comments=scene.comments, notes=list(dict.fromkeys(notes))
        )


class _Packed(Whole, _Rows):
    """A source of the splats of all primitives, for files in which some are packed as SPZ."""

    def load(self) -> Splats:
        """Read all splats."""
        return super(Whole, self)._span(0, self.count)  # of `_Rows`


def _scene(path: Path, above: F64) -> _Scene:
    """Read the splat primitives of a file, checking every count against the file's size."""
    document = read_document(path)
    for name in document.root.items("extensionsRequired"):
        if name not in _UNDERSTOOD and not str(name).startswith(_IGNORED):
            # A draft has the splats in an extension of its own; without it nothing would be left.
            own = "splat" in str(name) and EXTENSION not in document.root.items("extensionsUsed")
            raise FormatError(
                f"{path} requires the extension {ascii(name)[:80]}, which nanogs does not read;"
                f" export it {f'with {EXTENSION} instead' if own else 'without'}."
            )
    placed, others = placed_splats(document, above)
    scene = _Scene(document)
    for each in placed:
        linear = _colour_space(scene, each.primitive)
        primitive = primitive_of(document, each, linear)
        scene.primitives.append(primitive)
        _describe(scene, each.primitive, primitive.info)
        _check_memory(scene)
    for node in {each.node.where: each.node for each in placed}.values():
        names = node.part("extensions").data  # such as EXT_mesh_gpu_instancing, which repeats it
        scene.notes += [f"The extension {name[:80]!a} of a node was left out." for name in names]
    if len(scene.modes) > 1:
        scene.notes.append(f"The primitives have several render modes; {scene.mode} was taken.")
    if others:
        left = counted(others, "primitive of a mesh was", "primitives of meshes were")
        scene.notes.append(f"{left} left out.")
    return scene


def _check_memory(scene: _Scene) -> None:
    """Refuse a model that is much larger than its file, because accessors may share bytes."""
    size, model = scene.document.file_bytes, scene.count * splat_bytes(scene.degree)
    if scene.packed:
        check_expansion(str(scene.document.path), model, size)
    elif model > 4 * size:
        raise scene.document.root.error(
            f"describes {counted(scene.count, 'splat')}, more than four times as much as its"
            f" {counted(size, 'byte holds', 'bytes hold')}"
        )


def _colour_space(scene: _Scene, primitive: JsonObject) -> bool:
    """Return whether the colours of a primitive are linear light, and note a conversion."""
    splatting = primitive.part("extensions").part(EXTENSION)
    space = splatting.text("colorSpace", COLOUR_SPACE)
    if space in _LINEAR:
        scene.notes.append(
            f"Colours in linear light ({space}) were converted to display colours ({COLOUR_SPACE}),"
            " in which splats are blended."
        )
    elif space not in _DISPLAYED:
        scene.notes.append(f"The colour space {space[:40]!a} is unknown: read as {COLOUR_SPACE}.")
    return space in _LINEAR


def _describe(scene: _Scene, primitive: JsonObject, info: FileInfo) -> None:
    """Add a primitive's render mode, comments and unsupported properties to the scene.

    Args:
        scene: Changed in place.
        primitive: The JSON of the primitive.
        info: The description of its splats.
    """
    splatting = primitive.part("extensions").part(EXTENSION)
    for key, usual in _USUAL.items():
        if (value := splatting.text(key, usual)) != usual:
            scene.notes.append(f"The {key} {value[:40]!a} is unknown and was read as {usual}.")
    others = [name for name in splatting.part("extensions").data if name not in PACKED_NAMES]
    scene.notes += [f"The extension {name[:80]!a} of splats was left out." for name in others]
    known = {"POSITION", attribute("ROTATION"), attribute("SCALE"), attribute("OPACITY")}
    known |= {*coefficients(MAX_DEGREE), *_DERIVED}
    left_out = [name for name in primitive.part("attributes").data if name not in known]
    scene.notes += [f"The attribute {name[:40]!a} was left out." for name in left_out]
    extras = primitive.data.get("extras")
    extras = extras if isinstance(extras, dict) else {}  # the specification allows any JSON here
    stated = extras.get(MODE_KEY, info.render_mode)
    known_mode = stated in list(RenderMode)
    if not known_mode:
        scene.notes.append(f"The render mode {ascii(stated)[:40]} is unknown and was left out.")
    if known_mode and MODE_KEY in extras:
        scene.tag = f"{MODE_KEY} in the extras of its splats"
    scene.tag = scene.tag or info.render_tag
    scene.modes.add(RenderMode(stated) if known_mode else RenderMode.DEFAULT)
    comments = extras.get(COMMENTS_KEY)
    if isinstance(comments, list):
        lines = [text for text in comments if _is_line(text)]
        scene.comments += lines
        if len(lines) < len(comments):
            scene.notes.append("Comments that are not one line of text were left out.")


def _is_line(text: object) -> bool:
    return isinstance(text, str) and is_line(text) and is_utf8(text)

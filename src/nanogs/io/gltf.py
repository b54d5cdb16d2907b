"""Reading `.glb` with KHR_gaussian_splatting: linear scales and alpha, rotations xyzw, y-up.

Specification: https://github.com/KhronosGroup/glTF, extensions/2.0/Khronos/KHR_gaussian_splatting,
the release candidate of 2026 (its editorial review is pull request 2567). Scales are linear and
not negative there; drafts before it stored logarithms, which files in the wild still hold. A scene
is turned into the frame of `.ply` files, half a turn about z from glTF's, its node transforms
applied. The render mode and the comments of a PLY file, for which the extension has no place,
travel in the primitive's `extras`.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np

from nanogs._types import F64
from nanogs.errors import FormatError
from nanogs.io.compressed_ply import logit
from nanogs.io.files import BLOCK_ROWS, splat_bytes, unreadable
from nanogs.io.findings import Finding
from nanogs.io.glb import Glb, Part, read_glb
from nanogs.io.glb_rows import Accessor, Body
from nanogs.io.gltf_scene import EXTENSION, Placed, Pose, placed_splats
from nanogs.io.info import FileInfo
from nanogs.io.parts import Rows
from nanogs.splats import RenderMode, Splats, empty_arrays

MAX_DEGREE = 3
COLOUR_SPACE = "srgb_rec709_display"
MODE_KEY, COMMENTS_KEY = "SplatRenderMode", "comments"
_UNDERSTOOD = (EXTENSION, "KHR_mesh_quantization")
_DERIVED = ("COLOR_0", "NORMAL")  # for viewers that know no splats
_POINTS = 0
_LOGARITHMS = "Scales are negative, so they were read as logarithms, as early drafts had."
_TYPE_NAMES = {"i1": "char", "u1": "uchar", "<i2": "short", "<u2": "ushort", "<f4": "float"}


def attribute(name: str) -> str:
    """The name of one of the extension's attributes."""
    return f"{EXTENSION}:{name}"


def coefficients(degree: int) -> list[str]:
    """Names of the attributes with the coefficients up to a degree, in the order of `Splats.sh`."""
    return [
        attribute(f"SH_DEGREE_{level}_COEF_{n}")
        for level in range(degree + 1)
        for n in range(2 * level + 1)
    ]


@dataclass(frozen=True, slots=True)
class _Primitive:
    """One primitive of splats: its accessors by attribute."""

    pose: Pose
    accessors: dict[str, Accessor]
    degree: int

    @property
    def count(self) -> int:
        return self.accessors["POSITION"].count


@dataclass(slots=True)
class _Scene:
    """All primitives of a file, and what is to be said about them."""

    glb: Glb
    primitives: list[_Primitive] = field(default_factory=list)
    comments: list[str] = field(default_factory=list)
    modes: set[RenderMode] = field(default_factory=set)
    notes: list[str] = field(default_factory=list)

    @property
    def count(self) -> int:
        return sum(primitive.count for primitive in self.primitives)

    @property
    def degree(self) -> int:
        return max(primitive.degree for primitive in self.primitives)

    @property
    def mode(self) -> RenderMode:
        return min(self.modes, key=list(RenderMode).index)


def read(path: Path) -> Splats:
    """Read the splats of a `.glb` file, one primitive after the other.

    Raises:
        FormatError: The file cannot be read, is damaged, holds no splats or only compressed ones,
            or refers to other files.
    """
    scene = _scene(path)
    return _Rows(scene).read(0, scene.count)


def rows(path: Path) -> Rows:
    """The file to be read in parts.

    Raises:
        FormatError: As for `read`.
    """
    return _Rows(_scene(path))


class _Rows:
    """The splats of all primitives, one after the other."""

    def __init__(self, scene: _Scene) -> None:
        self._scene = scene
        with _body(scene.glb.path) as body, np.errstate(invalid="ignore"):
            self._logarithms = _hold_logarithms(scene.primitives, body)

    def read(self, start: int, stop: int) -> Splats:
        """Some rows; see `Rows`."""
        scene, n = self._scene, stop - start
        out = empty_arrays(n, scene.degree)
        out["sh"][:] = 0
        first = 0
        # Whatever bits there are: NaN, infinity, zero scales.
        with _body(scene.glb.path) as body, np.errstate(all="ignore"):
            for primitive in scene.primitives:
                end = first + primitive.count
                low, high = max(start, first), min(stop, end)
                if low < high:
                    part = {name: array[low - start : high - start] for name, array in out.items()}
                    _decode(primitive, body, part, low - first, self._logarithms)
                first = end
        notes = list(scene.notes)
        if self._logarithms:
            notes.append(
                "Scales are negative, so they were read as logarithms, as early drafts had."
            )
        if wrong := int(np.isnan(out["opacity_logits"]).sum()):
            notes.append(Finding("{} opacities are not from 0 to 1 and became NaN.", wrong))
        return Splats(**out, render_mode=scene.mode, comments=scene.comments, notes=notes)


@contextmanager
def _body(path: Path) -> Iterator[Body]:
    try:
        with path.open("rb", buffering=0) as file:
            yield Body(path, cast("BinaryIO", file))
    except OSError as error:
        raise unreadable(path, error) from error


def inspect(path: Path) -> FileInfo:
    """Describe a `.glb` file from its JSON.

    Raises:
        FormatError: As for `read`.
    """
    scene = _scene(path)
    accessors = scene.primitives[0].accessors
    return FileInfo(
        path=path,
        format="glb",
        encoding="binary_little_endian",
        file_bytes=scene.glb.file_bytes,
        splats=scene.count,
        sh_degree=scene.degree,
        double_means=False,
        properties=tuple((name, _TYPE_NAMES[a.kind]) for name, a in accessors.items()),
        extras=(),
        elements=(),
        render_mode=scene.mode,
        comments=tuple(scene.comments),
    )


def _scene(path: Path) -> _Scene:
    """The primitives of a file, every count in it checked against the file's size."""
    glb = read_glb(path)
    for name in glb.root.items("extensionsRequired"):
        if name not in _UNDERSTOOD:
            raise FormatError(
                f"{path} requires the extension {ascii(name)[:80]}, which nanogs does not read;"
                " export it without."
            )
    placed, others = placed_splats(glb)
    scene = _Scene(glb)
    for each in placed:
        scene.primitives.append(_primitive(glb, each))
        _describe(scene, each.primitive)
        _check_memory(scene)
    if len(scene.modes) > 1:
        scene.notes.append(f"The primitives have several render modes; {scene.mode} was taken.")
    if others:
        scene.notes.append(f"{others} primitives of meshes were left out.")
    scene.notes = list(dict.fromkeys(scene.notes))
    return scene


def _check_memory(scene: _Scene) -> None:
    """Accessors may share their bytes; what comes of it must stay in proportion to the file."""
    if scene.count * splat_bytes(scene.degree) > 4 * scene.glb.file_bytes:
        raise scene.glb.root.error(
            f"describes {scene.count} splats, more than four times as much as its"
            f" {scene.glb.file_bytes} bytes hold"
        )


def _primitive(glb: Glb, placed: Placed) -> _Primitive:
    """Check the attributes of a primitive against each other and against the file."""
    primitive = placed.primitive
    splatting = primitive.part("extensions").part(EXTENSION)
    if packed := [name for name in splatting.part("extensions").data if "compression" in name]:
        raise FormatError(
            f"{glb.path} packs its splats with {packed[0][:80]!a}, which nanogs does not read;"
            " export them uncompressed."
        )
    if primitive.integer("mode", 4) != _POINTS:
        raise primitive.error("with splats must be of mode 0, points")
    attributes = primitive.part("attributes")
    degree = _degree(attributes)
    sizes = {"POSITION": 3, attribute("ROTATION"): 4, attribute("SCALE"): 3}
    sizes |= {attribute("OPACITY"): 1} | dict.fromkeys(coefficients(degree), 3)
    if missing := [name for name in sizes if name not in attributes.data]:
        raise attributes.error(f"lacks {missing[0]}")
    accessors = {name: glb.accessor(attributes.integer(name), size) for name, size in sizes.items()}
    if len({accessor.count for accessor in accessors.values()}) > 1:
        raise attributes.error("have different counts")
    return _Primitive(placed.pose, accessors, degree)


def _degree(attributes: Part) -> int:
    """The highest degree of which there is an attribute; that none is missing is checked later."""
    for degree in range(MAX_DEGREE, 0, -1):
        names = set(coefficients(degree)) - set(coefficients(degree - 1))
        if names & set(attributes.data):
            return degree
    return 0


def _describe(scene: _Scene, primitive: Part) -> None:
    """What a primitive says about itself beside its numbers."""
    splatting = primitive.part("extensions").part(EXTENSION)
    kernel, space = splatting.text("kernel", "ellipse"), splatting.text("colorSpace", COLOUR_SPACE)
    if kernel != "ellipse":
        scene.notes.append(f"The kernel {kernel[:40]!a} is unknown and was read as ellipse.")
    if space != COLOUR_SPACE:
        scene.notes.append(f"The colour space {space[:40]!a} is not carried: {COLOUR_SPACE} now.")
    known = {"POSITION", attribute("ROTATION"), attribute("SCALE"), attribute("OPACITY")}
    known |= {*coefficients(MAX_DEGREE), *_DERIVED}
    left_out = [name for name in primitive.part("attributes").data if name not in known]
    if left_out:
        scene.notes.append(f"The attribute {left_out[0][:40]!a} was left out.")
    extras = primitive.data.get("extras")
    extras = extras if isinstance(extras, dict) else {}  # may be anything, by specification
    mode = extras.get(MODE_KEY, RenderMode.DEFAULT)
    known_mode = mode in list(RenderMode)
    if not known_mode:
        scene.notes.append(f"The render mode {ascii(mode)[:40]} is unknown and was not carried.")
    scene.modes.add(RenderMode(mode) if known_mode else RenderMode.DEFAULT)
    comments = extras.get(COMMENTS_KEY)
    if isinstance(comments, list):
        scene.comments += [text for text in comments if _is_line(text)]


def _is_line(text: object) -> bool:
    return isinstance(text, str) and "\n" not in text and not text.endswith("\r")


def _hold_logarithms(primitives: Sequence[_Primitive], body: Body) -> bool:
    """Whether some scale is below 0, which linear ones are not."""
    for primitive in primitives:
        scales = primitive.accessors[attribute("SCALE")]
        for start in range(0, scales.count, BLOCK_ROWS):
            if (scales.values(body, start, min(start + BLOCK_ROWS, scales.count)) < 0).any():
                return True
    return False


def _decode(
    primitive: _Primitive, body: Body, out: dict[str, Any], first: int, logarithms: bool
) -> None:
    """Fill arrays with rows of one primitive, from a first one on, block by block."""
    pose = None if primitive.pose.is_identity() else primitive.pose
    count = len(out["means"])
    for start in range(0, count, BLOCK_ROWS):
        span = slice(start, min(start + BLOCK_ROWS, count))

        def block(name: str, span: slice = span) -> F64:
            accessor = primitive.accessors[name]
            return accessor.decoded(accessor.values(body, first + span.start, first + span.stop))

        means, quats = block("POSITION"), block(attribute("ROTATION"))[:, [3, 0, 1, 2]]
        scales = block(attribute("SCALE"))
        scales = scales if logarithms else np.log(scales)
        for i, name in enumerate(coefficients(primitive.degree)):
            out["sh"][span, i] = block(name)
        if pose:
            means, quats = pose.means(means), pose.quats(quats)
            scales = scales + np.log(pose.scale)
            out["sh"][span] = pose.harmonics(out["sh"][span])
        out["means"][span], out["quats"][span], out["log_scales"][span] = means, quats, scales
        out["opacity_logits"][span] = logit(block(attribute("OPACITY"))[:, 0])

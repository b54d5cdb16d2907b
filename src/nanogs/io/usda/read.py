"""Reading OpenUSD text files, `.usda`: prims of type ParticleField3DGaussianSplat.

For the schema see `write`. Transforms of a prim and of its ancestors are applied, and the stage is
turned into the frame of `.ply` files, from y up or from z up.
"""

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from nanogs._types import F32, F64
from nanogs.activations import logit, rotation_about
from nanogs.errors import FormatError
from nanogs.findings import invalid_opacities, negative_scales
from nanogs.formatting import counted
from nanogs.io.files import input_size, reading
from nanogs.io.gltf.scene import Z_UP, pose_of, put_placed
from nanogs.io.info import FileInfo
from nanogs.io.parts import Whole
from nanogs.io.usda.text import Layer, Prim, read_layer
from nanogs.pose import Pose
from nanogs.slices import BLOCK_ROWS
from nanogs.source import joined_rows
from nanogs.splats import MAX_SH_DEGREE, Splats

PRIM = "ParticleField3DGaussianSplat"
DEGREE = "radiance:sphericalHarmonicsDegree"
COEFFICIENTS = "radiance:sphericalHarmonicsCoefficients"
_WIDTHS = {"positions": 3, "orientations": 4, "scales": 3, "opacities": 1, COEFFICIENTS: 3}
_BRACKETS = bytes.maketrans(b"(),[]\r\n\t", b" " * 8)
_PIECE = 1 << 20  # bytes of an array that are parsed at a time


@dataclass(frozen=True, slots=True)
class _Field:
    """A prim of splats, with the byte range of each array in the text, its count and degree."""

    prim: Prim
    spans: dict[str, tuple[int, int]]
    count: int
    degree: int


class UsdaFile(Whole):
    """The source of a `.usda` file: the splats of all its prims, in the order of the file."""

    @cached_property
    def info(self) -> FileInfo:
        """The file's description, from its syntax alone: no arrays are parsed."""
        layer = _layer(self.path)
        fields = list(_fields(layer))
        return FileInfo(
            path=self.path,
            format="usda",
            encoding="ascii",
            file_bytes=len(layer.text),
            splats=sum(each.count for each in fields),
            sh_degree=max(each.degree for each in fields),
            properties=tuple((name, "float") for name in _WIDTHS),
        )

    def load(self) -> Splats:
        """Read the whole model.

        Raises:
            FormatError: The file cannot be read, is damaged, holds no splats, or a transform
                mirrors, flattens or shears them.
        """
        layer = _layer(self.path)
        return joined_rows([_decoded(layer, each) for each in _fields(layer)])


def _layer(path: Path) -> Layer:
    input_size(path)
    with reading(path) as file:
        return read_layer(path, file.read())


def _fields(layer: Layer) -> Iterator[_Field]:
    found = False
    for prim in layer.prims:
        if prim.kind == PRIM and not prim.abstract:
            found = True
            yield _field(layer, prim)
    if not found:
        raise FormatError(
            f"{layer.path} holds no {PRIM}, so it has no splats; export the splats themselves."
        )


def _field(layer: Layer, prim: Prim) -> _Field:
    """Find the arrays of a prim, by their names or those in half precision, such as `scalesh`."""
    spans = {}
    for name in _WIDTHS:
        span = prim.values.get(name) or prim.values.get(f"{name}h")
        if span is None:
            raise layer.error(f"the prim {prim.name[:40]!a} lacks {name}")
        spans[name] = span
    degree = float(_numbers(layer, prim, DEGREE, 1)[0]) if DEGREE in prim.values else 3.0
    if degree not in range(MAX_SH_DEGREE + 1):
        raise layer.error(f"{DEGREE} of {prim.name[:40]!a} is not from 0 to {MAX_SH_DEGREE}")
    count = layer.text.count(b"(", *spans["positions"])
    if count == 0:
        raise layer.error(f"the prim {prim.name[:40]!a} holds no splats")
    return _Field(prim, spans, count, int(degree))


def _decoded(layer: Layer, given: _Field) -> Splats:
    """Decode the splats of one prim, in the frame of `.ply` files."""
    columns = {name: _column(layer, given, name) for name in _WIDTHS}
    out: dict[str, Any] = {
        "means": columns["positions"],
        "log_scales": columns["scales"],
        "quats": columns["orientations"],
        "opacity_logits": columns["opacities"][:, 0],
        "sh": columns[COEFFICIENTS],
    }
    pose = pose_of(_to_stage(layer, given.prim), layer.error)
    notes = negative_scales(int((columns["scales"] < 0).any(axis=1).sum()))
    with np.errstate(all="ignore"):
        for start in range(0, given.count, BLOCK_ROWS):
            _decode({name: array[start : start + BLOCK_ROWS] for name, array in out.items()}, pose)
    notes += invalid_opacities(int(np.isnan(out["opacity_logits"]).sum()))
    # Values of each splat beyond the schema are primvars.
    left_out = [name for name in given.prim.values if name.startswith("primvars:")]
    notes += [f"The attribute {name[:40]!a} was left out." for name in left_out]
    return Splats(**out, notes=notes)


def _decode(rows: dict[str, F32], pose: Pose) -> None:
    """Convert stored values of some rows to those of `Splats`, in place."""
    means, quats = rows["means"].astype(np.float64), rows["quats"].astype(np.float64)
    log_scales = np.log(rows["log_scales"].astype(np.float64))
    rows["opacity_logits"][:] = logit(rows["opacity_logits"].astype(np.float64))
    put_placed(rows, pose, means, quats, log_scales)


def _column(layer: Layer, given: _Field, name: str) -> F32:
    """Parse an array of a prim to (N, width), or (N, K, 3) for the SH coefficients.

    The arrays are of floats, so each number is the nearest one in single precision. The text is
    parsed in pieces, because each takes several times its size.
    """
    with np.errstate(over="ignore"):
        pieces = _pieces(layer.text, *given.spans[name])
        parts = [_parsed(layer, piece, name).astype(np.float32) for piece in pieces]
    numbers = np.concatenate(parts)
    each = _WIDTHS[name] * ((given.degree + 1) ** 2 if name == COEFFICIENTS else 1)
    if len(numbers) != given.count * each:
        raise layer.error(
            f"{name} of {given.prim.name[:40]!a} has {counted(len(numbers), 'number')}, where"
            f" {counted(given.count, 'splat has', 'splats have')} {given.count * each:,}"
        )
    shape = (-1, 3) if name == COEFFICIENTS else (_WIDTHS[name],)
    return numbers.reshape(given.count, *shape)


def _numbers(layer: Layer, prim: Prim, name: str, count: int) -> F64:
    """Parse an attribute that must have `count` finite numbers."""
    numbers = _parsed(layer, layer.text[slice(*prim.values[name])], name)
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise layer.error(f"{name} of {prim.name[:40]!a} needs {count} finite numbers")
    return numbers


def _pieces(text: bytes, start: int, end: int) -> Iterator[bytes]:
    """Yield a range of bytes in pieces that end with a comma; at least one, which may be empty."""
    while end - start > _PIECE:
        stop = text.rfind(b",", start, start + _PIECE) + 1 or end
        yield text[start:stop]
        start = stop
    yield text[start:end]


def _parsed(layer: Layer, text: bytes, name: str) -> F64:
    """Parse all numbers of a value into one flat array, ignoring brackets."""
    text = text.translate(_BRACKETS)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # NumPy only warns of text after the last number
            return np.fromstring(text, np.float64, sep=" ") if text.strip() else np.empty(0)
    except (ValueError, DeprecationWarning):
        raise layer.error(f"{name} holds something that is not a number") from None


def _to_stage(layer: Layer, prim: Prim) -> F64:
    """Return the (4, 4) float64 transform from a prim to the stage, y up."""
    up = layer.metadata.get("upAxis", "Y")
    if up not in ("Y", "Z"):
        raise layer.error(f"its upAxis must be Y or Z, not {up[:40]!a}")
    matrix = np.eye(4)
    inner: Prim | None = prim
    while inner is not None:
        with np.errstate(all="ignore"):  # overflow is refused by `pose_of`
            matrix = _local(layer, inner) @ matrix
        inner = inner.parent
    return Z_UP.T @ matrix if up == "Z" else matrix


def _local(layer: Layer, prim: Prim) -> F64:
    """Return the (4, 4) local transform of a prim; the last operation listed is applied first."""
    span = prim.values.get("xformOpOrder")
    text = layer.text[slice(*span)].decode("utf-8", "replace") if span else ""
    matrix = np.eye(4)
    for entry in filter(None, (part.strip(" \t\r\n\"'[]") for part in text.split(","))):
        operation = _OPERATIONS.get(entry.partition(":")[2].partition(":")[0])
        if not entry.startswith("xformOp:") or operation is None or entry not in prim.values:
            raise layer.error(f"the transform {entry[:40]!a} of {prim.name[:40]!a} is not known")
        width, make = operation
        matrix = matrix @ make(_numbers(layer, prim, entry, width))
    return matrix


def _translation(numbers: F64) -> F64:
    matrix = np.eye(4)
    matrix[:3, 3] = numbers
    return matrix


def _rotation(axis: int, degrees: F64) -> F64:
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_about(axis, np.radians(degrees[0]))
    return matrix


# Number of arguments of each operation, and its matrix; USD matrices act on row vectors.
_OPERATIONS: dict[str, tuple[int, Callable[[F64], Any]]] = {
    "translate": (3, _translation),
    "scale": (3, lambda numbers: np.diag([*numbers, 1.0])),
    "transform": (16, lambda numbers: numbers.reshape(4, 4).T),
    **{f"rotate{name}": (1, partial(_rotation, axis)) for axis, name in enumerate("XYZ")},
}

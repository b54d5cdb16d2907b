"""Decoding the columns of `.rad` to values of splats, and encoding; `header` lists the encodings.

A damaged file may hold any bits, so callers silence NumPy's floating-point warnings.

Alphas above 1 are an extension of Spark, for coarse splats that represent many: with D the stored
number, a = min(4 D - 3, 5) and k = exp((a² - 1) / e), such a splat covers 1 - (1 - g)^k where an
opaque one of its size covers g. Here it becomes an opaque splat with its scales multiplied by the
cube root of k, as Spark draws it with `lodInflate` (rust/spark-lib/src/tsplat.rs,
src/shaders/splatVertex.glsl).
"""

import zlib
from dataclasses import dataclass

import numpy as np

from nanogs._types import F32, F64, U8, Array
from nanogs.errors import FormatError
from nanogs.io.files import reading
from nanogs.io.rad.header import Property
from nanogs.io.rotations import Rounding, with_w

MOST_STEPS = 254  # steps of a logarithm in a byte, because byte 0 is a scale of zero
_RIM = 1e-6  # distance from the rim of the unfolded octahedron that is due to rounding
_BYTE_SLACK = 1.5 / 255  # rounding of an alpha of 1 that is stored as a byte over 0 to 2
_PLANES = ("f32_lebytes", "f16_lebytes")
_DTYPES = {
    "f32": "<f4", "f32_lebytes": "<f4", "f16": "<f2", "f16_lebytes": "<f2", "ln_f16": "<f2",
    "r8": "u1", "r8_delta": "u1", "s8": "u1", "s8_delta": "u1", "ln_0r8": "u1",
    "oct88r8": "u1", "u16": "<u2", "u32": "<u4",
}  # fmt: skip
TYPE_NAMES = {"<f4": "float", "<f2": "float16", "u1": "uchar", "<u2": "ushort", "<u4": "uint"}
_FLOATS = ("f32", "f16", "f32_lebytes", "f16_lebytes")
_ALLOWED = {
    "center": _FLOATS,
    "alpha": ("f32", "f16", "r8"),
    "rgb": ("f32", "f16", "r8", "r8_delta"),
    "scales": ("f32", "ln_f16", "ln_0r8"),
    "orientation": ("f32", "f16", "oct88r8"),
    "sh_label": ("u16", "u32"),
    "child_count": ("u16",),
    "child_start": ("u32",),
}
_BAND = ("f32", "f16", "r8", "r8_delta", "s8", "s8_delta")


def type_name(encoding: str) -> str:
    """Return the name of an encoding's type, for `FileInfo`."""
    return TYPE_NAMES[_DTYPES[encoding]]


def check_encoding(column: Property) -> None:
    """Refuse an encoding that the format does not allow for a column.

    Raises:
        FormatError: The encoding is not allowed.
    """
    if column.encoding not in _ALLOWED.get(column.name, _BAND):
        raise FormatError(
            f"{column.where} is encoded as {column.encoding[:40]!r}, which nanogs does not read;"
            " export the model again."
        )


def components(column: Property, count: int, width: int) -> Array:
    """Decode a column to (count, width) float64, or int64 for the encodings `u16` and `u32`.

    Bytes with a range or a sign are mapped to their values; logarithms stay logarithms.

    Args:
        column: The column.
        count: Number of rows.
        width: Components per row.

    Raises:
        FormatError: It cannot be read, or has another size than expected.
    """
    stored = _unpacked(column, count, width)
    if column.encoding in ("u16", "u32"):
        return stored.astype(np.int64)
    values = stored.astype(np.float64)
    if column.encoding in ("r8", "r8_delta"):
        return values / 255 * (column.high - column.low) + column.low
    if column.encoding in ("s8", "s8_delta"):
        signed: F64 = stored.view(np.int8) / 127.0 * column.high
        return signed
    return values


def _unpacked(column: Property, count: int, width: int) -> Array:
    """Read a column as (count, width) numbers of its stored type, with deltas summed up."""
    check_encoding(column)
    dtype = np.dtype(_DTYPES[column.encoding])
    data = _bytes(column, count * width * dtype.itemsize)
    if column.encoding in _PLANES:
        planes = data.reshape(dtype.itemsize, width, count)
        return np.ascontiguousarray(planes.transpose(2, 1, 0)).view(dtype)[..., 0]
    if column.encoding == "oct88r8":
        return data.reshape(count, width)
    parts = data.view(dtype).reshape(width, count)
    if column.encoding.endswith("_delta"):
        parts = np.cumsum(parts, axis=1, dtype=np.uint8)
    return np.ascontiguousarray(parts.T)


def _bytes(column: Property, expected: int) -> U8:
    """Read and decompress the bytes of a column, which must be as many as expected."""
    section = column.section
    with reading(section.path) as file:
        file.seek(section.start)
        data = file.read(section.size)
    if column.packed:
        inflate = zlib.decompressobj(-zlib.MAX_WBITS)
        try:
            data = inflate.decompress(data, expected + 1)
        except zlib.error as error:
            raise FormatError(
                f"{column.where} is damaged ({error}); export or download it again."
            ) from None
    if len(data) != expected:
        raise FormatError(
            f"{column.where} does not hold the {expected:,} bytes that its rows take; export or"
            " download it again."
        )
    return np.frombuffer(data, np.uint8)


@dataclass(frozen=True, slots=True)
class Shapes:
    """Opacity logits and log-scales of R splats, with alphas above 1 converted.

    Attributes:
        logits: (R,) float64.
        log_scales: (R, 3) float64.
        negative: Number of splats with a negative scale, which became NaN.
        widened: Number of splats with an alpha above 1, which became opaque and larger.
    """

    logits: F64
    log_scales: F64
    negative: int
    widened: int


def shapes(alphas: F64, scales: F64, *, logarithms: bool) -> Shapes:
    """Compute opacity logits and log-scales from stored alphas and scales.

    Args:
        alphas: (R,) as stored; for those above 1 see the module's docstring.
        scales: (R, 3) as stored.
        logarithms: Whether the scales are logarithms already.
    """
    logs: F64 = scales.copy() if logarithms else np.log(scales)
    wide = alphas > 1 + _BYTE_SLACK
    spread = np.minimum(4 * alphas[wide] - 3, 5)
    logs[wide] += ((spread**2 - 1) / np.e / 3)[:, None]
    logits: F64 = -np.log(1 / np.where(alphas > 1, 1, alphas) - 1)
    negative = 0 if logarithms else int((scales < 0).any(axis=1).sum())
    return Shapes(logits, logs, negative, int(wide.sum()))


def log_steps(column: Property, count: int) -> F64:
    """Decode scales of the encoding `ln_0r8` to (count, 3) logarithms; -inf for a scale of zero.

    Raises:
        FormatError: As for `components`.
    """
    stored = _unpacked(column, count, 3)
    step = (column.high - column.low) / MOST_STEPS
    table: F64 = np.arange(-1, 255, dtype=np.float64) * step + column.low
    table[0] = -np.inf
    values: F64 = table[stored]
    return values


def rotations(column: Property, count: int) -> F64:
    """Decode rotations to (count, 4) wxyz.

    Raises:
        FormatError: As for `components`.
    """
    parts = components(column, count, 3)
    if column.encoding != "oct88r8":
        return with_w(parts)
    return decode_oct88r8(parts)


def decode_oct88r8(codes: Array) -> F64:
    """Decode (R, 3) bytes of `oct88r8` to (R, 4) wxyz."""
    axis, half = octahedral_axes(codes[:, :2] / 127.5 - 1), codes[:, 2] / 255 * (np.pi / 2)
    return np.column_stack([np.cos(half), axis * np.sin(half)[:, None]])


def octahedral_axes(points: F64) -> F64:
    """Map (R, 2) points of the unfolded octahedron, in [-1, 1], to (R, 3) unit vectors."""
    z = 1 - np.abs(points).sum(axis=1)
    folded = points - np.where(points >= 0, 1, -1) * np.maximum(-z, 0)[:, None]
    axes = np.column_stack([folded, z])
    unit: F64 = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    return unit


def octahedral_points(axes: F64) -> F64:
    """Map (R, 3) non-zero vectors to (R, 2) points of the unfolded octahedron.

    On the lower half, two points of the rim stand for the same vector of x or y zero; of these the
    positive one is taken, also where rounding has left something of that zero.
    """
    points = axes[:, :2] / np.abs(axes).sum(axis=1, keepdims=True)
    outer = (1 - np.abs(points[:, ::-1])) * np.where(points > -_RIM, 1, -1)
    unfolded: F64 = np.where(axes[:, 2:] < 0, outer, points)
    return unfolded


def encode_oct88r8(quats: F64) -> U8:
    """Encode (R, 4) unit wxyz with w of 0 or more as `oct88r8`, (R, 3) bytes.

    Several codes may stand for one rotation: those of a null rotation, or on the rim of the
    unfolded octahedron. The bytes are those that the decoded rotation gives.
    """
    return _nearest_oct88r8(decode_oct88r8(_nearest_oct88r8(quats)))


def _nearest_oct88r8(quats: F64) -> U8:
    sine = np.linalg.norm(quats[:, 1:], axis=1)
    angle = 2 * np.arctan2(sine, quats[:, 0])
    # The axis of a null rotation is arbitrary; others need no unit length here.
    axes = np.where(sine[:, None] < 1e-12, (1.0, 0.0, 0.0), quats[:, 1:])
    out = np.empty((len(quats), 3), np.uint8)
    out[:, :2] = np.rint((octahedral_points(axes) + 1) * 127.5)
    out[:, 2] = np.rint(angle / np.pi * 255)
    return out


OCT88R8 = Rounding(
    lambda xyz: decode_oct88r8(
        encode_oct88r8(np.column_stack([np.sqrt(1 - (xyz**2).sum(axis=1)), xyz]))
    )[:, 1:],
    error=0.0081,
)
"""How `oct88r8` rounds rotations of less than a right angle."""


def by_component(values: Array) -> bytes:
    """Return the bytes of (R, C) values in component-major order."""
    return np.ascontiguousarray(values.T).tobytes()


def by_byte(values: F32) -> bytes:
    """Encode (R, C) values as `f32_lebytes`: the lowest bytes of all components first."""
    wide = np.ascontiguousarray(values.T).astype("<f4", copy=False)
    return np.ascontiguousarray(np.moveaxis(wide[..., None].view(np.uint8), -1, 0)).tobytes()


def differences(values: U8) -> U8:
    """Return the differences of (R, C) bytes to the row before, modulo 256."""
    return np.diff(values, axis=0, prepend=np.zeros((1, values.shape[1]), np.uint8))

"""`.splat` (antimatter15): 32 bytes per splat, no header, linear scales, no view dependence.

Layout: https://github.com/antimatter15/splat - position and scale 3 x float32 each, colour and
alpha 4 x uint8, rotation wxyz as 4 x uint8 with 128 for zero.
"""

from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from nanogs._types import F32, U8, Array
from nanogs.activations import SH_C0, alphas, base_colour, logit, rounded_bytes
from nanogs.errors import FormatError
from nanogs.findings import negative_scales
from nanogs.formatting import counted
from nanogs.io import activated, limits
from nanogs.io.files import input_size, reading
from nanogs.io.format import Format
from nanogs.io.info import FileInfo
from nanogs.io.parts import FileSource, row_blocks
from nanogs.source import Source, source_of
from nanogs.splats import Splats, empty_arrays

_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])
_SUFFIX = ".splat"
_OTHERS = (b"ply\n", b"ply\r", b"PK\x03\x04")
_GZIP = b"\x1f\x8b\x08"  # and a byte of flags
_BYTE_SLACK = 1 / 64  # largest error of a unit quaternion's length after rounding to four bytes
_PROPERTIES = (("position", "float"), ("scale", "float"), ("rgba", "uchar"), ("rotation", "uchar"))


class SplatFile(FileSource):
    """A `.splat` file; a scale of zero becomes -inf, alpha 0 becomes -inf and 255 +inf.

    Raises:
        FormatError: It cannot be read, or is not a whole number of rows.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        n = _count(path)
        self.info = FileInfo(
            path=path,
            format="splat",
            encoding="binary_little_endian",
            file_bytes=n * _ROW.itemsize,
            splats=n,
            sh_degree=0,
            properties=_PROPERTIES,
        )

    def _span(self, start: int, stop: int) -> Splats:
        """Read rows `start` to `stop`; see `Source.read`."""
        n = stop - start
        out = empty_arrays(n, 0)
        negative = 0
        for span, block in row_blocks(self.path, _ROW, start * _ROW.itemsize, n):
            negative += _decode(block, out, span)
        return Splats(**out, notes=negative_scales(negative))


def _decode(rows: Array, out: dict[str, Any], span: slice) -> int:
    """Decode one block and return the number of its rows that have a negative scale."""
    out["means"][span] = rows["mean"]
    with np.errstate(divide="ignore", invalid="ignore"):
        out["log_scales"][span] = np.log(rows["scale"].astype(np.float64))
    rgba = rows["rgba"] / 255.0
    out["sh"][span, 0] = base_colour(rgba[:, :3])
    out["opacity_logits"][span] = logit(rgba[:, 3])
    out["quats"][span] = _decoded_rotations(rows["quat"])
    return int((rows["scale"] < 0).any(axis=1).sum())


def _count(path: Path) -> int:
    rows, rest = divmod(input_size(path), _ROW.itemsize)
    with reading(path) as file:
        start = file.read(4)
    # Of any length, a file of another format would be read as splats. The first coordinate would be
    # less than 1e-19 and not 0.
    if start.startswith(_OTHERS) or (start.startswith(_GZIP) and start[3:4] < b"\x20"):
        raise FormatError(
            f"{path} begins like a file of another format, so it is no .splat file; give it the"
            " suffix of its real format."
        )
    if rest:
        raise FormatError(
            f"{path}: {counted(rest, 'byte follows', 'bytes follow')} row {rows:,} of"
            f" {_ROW.itemsize} bytes each, so it is cut short or no .splat file;"
            " export or download it again."
        )
    return rows


def write(model: Splats | Source, file: BinaryIO) -> None:
    """Write a model in its own order, block by block; `losses` names what the file cannot hold.

    Raises:
        OutputError: A value is NaN or infinite; nothing has been written then.
        OSError: The system refuses to write.
    """
    limits.refuse_unstorable(model, _SUFFIX)
    file.writelines(_encode(block).tobytes() for block in source_of(model).blocks())


def file_bytes(_splats: Splats, count: int) -> int:
    """Compute the size in bytes of the file of a model of `count` splats."""
    return count * _ROW.itemsize


def losses(splats: Splats) -> tuple[str, ...]:
    """Return a sentence for each thing that the file leaves out or clamps."""
    out = limits.left_out(splats, _SUFFIX, max_degree=0)
    out += limits.lost_mode(splats, _SUFFIX)
    out += limits.clamped(
        np.abs(splats.sh[:, 0]) > 0.5 / SH_C0 * (1 + 1 / 255),
        f"base colours outside 0 to 1, the range of {_SUFFIX}",
    )
    return (*out, *limits.rounded(splats, _SUFFIX))


def _encode(splats: Splats) -> Array:
    """Encode splats as (R,) packed rows."""
    out = np.empty(len(splats), _ROW)
    out["mean"] = splats.means
    out["scale"] = activated.scales(splats)
    out["rgba"][:, :3] = rounded_bytes((splats.sh[:, 0] * np.float64(SH_C0) + 0.5) * 255)
    out["rgba"][:, 3] = rounded_bytes(alphas(splats.opacity_logits) * 255)
    out["quat"] = _rotation_bytes(splats.quats)
    return out


def _decoded_rotations(codes: U8) -> F32:
    """Return the quaternions, (R, 4), of their bytes."""
    return (codes.astype(np.float32) - np.float32(128)) / np.float32(128)


def _rotation_bytes(quats: F32) -> U8:
    """Encode quaternions, (R, 4), normalised but for those that bytes already hold as unit ones.

    These are kept, so that reading and writing a file again does not change it.
    """
    wide = quats.astype(np.float64)
    length = np.linalg.norm(wide, axis=1, keepdims=True)
    unit = np.where(length == 0, (1, 0, 0, 0), wide / np.where(length == 0, 1, length))
    kept = rounded_bytes(wide * 128 + 128)
    decoded = np.linalg.norm(_decoded_rotations(kept), axis=1, keepdims=True)
    near = (np.abs(decoded - 1) < _BYTE_SLACK) & (np.abs(length - 1) < 2 * _BYTE_SLACK)
    result: U8 = np.where(near, kept, rounded_bytes(unit * 128 + 128))
    return result


FORMATS = (
    Format(_SUFFIX, SplatFile, write, file_bytes, losses, streams=True, max_degree=0, rounds=True),
)

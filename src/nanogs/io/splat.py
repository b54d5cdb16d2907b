"""Reading `.splat` (antimatter15): 32 bytes a splat, no header, linear scales, no view dependence.

Layout: https://github.com/antimatter15/splat - position and scale 3 x float32 each, colour and
alpha 4 x uint8, rotation wxyz as 4 x uint8 with 128 for zero.
"""

from pathlib import Path
from typing import Any

import numpy as np

from nanogs._types import Array
from nanogs.errors import FormatError
from nanogs.io.compressed_ply import base_colour, logit
from nanogs.io.files import BLOCK_ROWS, input_size, unreadable
from nanogs.io.info import FileInfo
from nanogs.splats import RenderMode, Splats

_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])
_PROPERTIES = (("position", "float"), ("scale", "float"), ("rgba", "uchar"), ("rotation", "uchar"))


def read(path: Path) -> Splats:
    """Read a `.splat` file; a scale of zero becomes -inf, alpha 0 and 255 become ∓inf.

    Raises:
        FormatError: The file cannot be read, or is not a whole number of rows.
    """
    n = _count(path)
    try:
        rows = np.memmap(path, _ROW, "r", shape=(n,))
    except OSError as error:
        raise unreadable(path, error) from error
    out: dict[str, Any] = {
        "means": np.empty((n, 3), np.float32),
        "log_scales": np.empty((n, 3), np.float32),
        "quats": np.empty((n, 4), np.float32),
        "opacity_logits": np.empty(n, np.float32),
        "sh": np.empty((n, 1, 3), np.float32),
    }
    negative = 0
    for start in range(0, n, BLOCK_ROWS):
        negative += _decode(rows[start : start + BLOCK_ROWS], out, start)
    notes = [f"{negative} splats have a negative scale, which became NaN."] if negative else []
    return Splats(**out, notes=notes)


def _decode(rows: Array, out: dict[str, Any], start: int) -> int:
    """Decode one block; how many of its rows have a negative scale."""
    span = slice(start, start + len(rows))
    out["means"][span] = rows["mean"]
    with np.errstate(divide="ignore", invalid="ignore"):
        out["log_scales"][span] = np.log(rows["scale"].astype(np.float64))
    rgba = rows["rgba"] / 255.0
    out["sh"][span, 0] = base_colour(rgba[:, :3])
    out["opacity_logits"][span] = logit(rgba[:, 3])
    out["quats"][span] = (rows["quat"].astype(np.float32) - 128) / 128
    return int((rows["scale"] < 0).any(axis=1).sum())


def inspect(path: Path) -> FileInfo:
    """Describe a `.splat` file from its size.

    Raises:
        FormatError: As for `read`.
    """
    n = _count(path)
    return FileInfo(
        path=path,
        format="splat",
        encoding="binary_little_endian",
        file_bytes=n * _ROW.itemsize,
        splats=n,
        sh_degree=0,
        double_means=False,
        properties=_PROPERTIES,
        extras=(),
        elements=(),
        render_mode=RenderMode.DEFAULT,
        comments=(),
    )


def _count(path: Path) -> int:
    rows, rest = divmod(input_size(path), _ROW.itemsize)
    if rest:
        raise FormatError(
            f"{path}: {rest} bytes follow row {rows} of {_ROW.itemsize} bytes each, so it is cut"
            " short or no .splat file; export or download it again."
        )
    return rows

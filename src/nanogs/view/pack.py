"""Encoding of models for a page: `.spz`, in units relative to the first view.

SPZ is compact, and the viewer decodes it itself, while the images of a `.sog` are decoded by the
browser, which may change their colours. SPZ limits log-scales to -10 to 5.94 and stores centres as
fixed-point numbers. The page therefore has units of its own, in which the first camera is 8 from
its target: both limits are then far outside the range that is visible on a screen.
"""

import dataclasses
import io
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from nanogs._types import F64, F
from nanogs.errors import ModelError
from nanogs.formatting import counted, undrawn
from nanogs.io import load
from nanogs.io.html import RANGE_OF
from nanogs.io.spz import write as spz_write
from nanogs.io.spz.packing import BEST
from nanogs.io.spz.read import SCALE_LOW
from nanogs.io.spz.unstorable import losses
from nanogs.splats import RenderMode, Splats
from nanogs.views.opening import Opening

DISTANCE = 8.0  # from the first camera to its target, units of the page
# Units of the page. Splats farther from the target are moved to this distance and scaled to look
# the same from the target; orbiting the target shows no visible parallax at this distance.
FARTHEST = 128 * DISTANCE
_QUICK = 1  # compression level of libdeflate
MAX_DEGREE = 3  # highest SH degree of the viewer


@dataclass(frozen=True, slots=True)
class Packed:
    """A model in a page.

    Attributes:
        data: An `.spz` file in units of the page.
        mip: Whether it must be drawn like a model trained with antialiasing.
        notes: Differences between the model and the page, one sentence each.
    """

    data: bytes
    mip: bool
    notes: tuple[str, ...]


def pack(splats: Splats, start: Opening, *, quick: bool = False) -> Packed:
    """Encode a model for a page.

    Args:
        splats: The model.
        start: The first view; all models of a page share it.
        quick: Compress at the fastest level, for a page served on the same machine.

    Raises:
        ModelError: No splat is finite.
    """
    notes: list[str] = []
    finite = splats.finite()
    if not finite.any():
        raise ModelError("The model holds no finite splat; there is nothing to show.")
    if not finite.all():
        splats = splats.take(finite)
        notes.append(f"{undrawn(int((~finite).sum()))}.")
    if splats.sh_degree > MAX_DEGREE:
        splats = splats.with_sh_degree(MAX_DEGREE)
        notes.append(f"Spherical harmonics above degree {MAX_DEGREE} are not shown.")
    placed, far = _place(splats, start)
    if far:
        notes.append(
            f"{counted(far, 'splat')} farther than {FARTHEST / DISTANCE:.0f} times the first"
            " distance, shown at that."
        )
    file = io.BytesIO()
    spz_write.write(placed, file, gzip_level=_QUICK if quick else BEST)
    mip = splats.render_mode is RenderMode.MIP
    return Packed(file.getvalue(), mip, (*notes, *losses(placed, range_of=RANGE_OF)))


def unpack(packed: Packed, start: Opening) -> Splats:
    """Read a model back from its encoding for a page, and return it in scene units.

    Args:
        packed: The model, encoded.
        start: The first view that it was encoded for.

    Raises:
        OutputError: The system refuses a temporary file.
    """
    splats, unit = load(io.BytesIO(packed.data), format=".spz"), _unit(start)
    return dataclasses.replace(
        splats,
        means=(splats.means.astype(np.float64) / unit + start.target).astype(np.float32),
        log_scales=(splats.log_scales - math.log(unit)).astype(np.float32),
    )


def _place(splats: Splats, start: Opening) -> tuple[Splats, int]:
    """Convert a model to units of the page; drop data that is not drawn, and move far splats.

    Returns:
        The model, and the number of splats that were moved to `FARTHEST`.
    """
    means = in_page(splats.means, start)
    distance = np.linalg.norm(means, axis=1)
    far = distance > FARTHEST
    factors = np.where(far, FARTHEST / np.where(far, distance, 1), 1)[:, None]
    # The least log-scale is about a hundredth of a pixel; raising scales to it needs no note.
    log_scales = np.maximum(splats.log_scales + np.log(_unit(start) * factors), SCALE_LOW)
    placed = dataclasses.replace(
        splats,
        means=(means * factors).astype(np.float32),
        log_scales=log_scales.astype(np.float32),
        extras={},
        comments=(),
        elements=(),
        notes=(),
    )
    return placed, int(far.sum())


def camera_in_page(start: Opening) -> dict[str, Any]:
    """Return the first camera in the viewer's form, in units of the page."""
    [position] = in_page(start.position[None], start)
    return {
        "position": position.tolist(),
        "target": [0.0, 0.0, 0.0],
        "up": start.up.tolist(),
        "lens": start.tangent,
        "near": start.near,
    }


def in_page(points: F, start: Opening) -> F64:
    """Convert points (N, 3) from scene units to units of the page, with the target as origin."""
    placed: F64 = (points.astype(np.float64) - start.target) * _unit(start)
    return placed


def _unit(start: Opening) -> float:
    """Return the units of the page in a scene unit."""
    return DISTANCE / start.distance

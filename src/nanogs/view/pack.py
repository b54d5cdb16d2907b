"""Models as a page holds them: `.spz`, moved and scaled to what the viewer begins with.

SPZ is compact, and the viewer decodes it itself, while the pictures of a `.sog` pass through the
browser, which may change their colours. Its log-scales end at -10 and 5.94 and its centres are
fixed-point numbers, so the page has units of its own, in which the viewer's camera starts 8 from
what it turns about: then both ends lie far beyond what a screen shows.
"""

import dataclasses
import io
from dataclasses import dataclass
from typing import Any

import numpy as np

from nanogs._types import F64, F
from nanogs.errors import ModelError
from nanogs.formatting import counted, undrawn
from nanogs.io.spz import write as spz_write
from nanogs.io.spz.packing import BEST
from nanogs.io.spz.read import SCALE_LOW
from nanogs.splats import RenderMode, Splats
from nanogs.views.opening import Opening

DISTANCE = 8.0  # from the first camera to its target, units of the page
# Units of the page. What lies farther is drawn at this distance, as large as it looks from the
# target: turning about it moves nothing there by as much as the eye could tell.
FARTHEST = 128 * DISTANCE
_QUICK = 1  # of libdeflate's levels
MAX_DEGREE = 3  # of spherical harmonics, in the viewer


@dataclass(frozen=True, slots=True)
class Packed:
    """A model in a page.

    Attributes:
        data: An `.spz` file in units of the page.
        mip: Whether it must be drawn as a model trained with antialiasing.
        notes: What the page does not show as it is, one sentence each.
    """

    data: bytes
    mip: bool
    notes: tuple[str, ...]


def pack(splats: Splats, start: Opening, *, quick: bool = False) -> Packed:
    """Encode a model for a page.

    Args:
        splats: The model.
        start: Where the page begins; all models of a page share it.
        quick: Pack hardly anything, for a page of a server on the same machine.

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
    return Packed(file.getvalue(), mip, (*notes, *spz_write.losses(placed)))


def _place(splats: Splats, start: Opening) -> tuple[Splats, int]:
    """The model in units of the page, without what is not drawn, and how many were pulled in."""
    unit = DISTANCE / start.distance
    means = in_page(splats.means, start)
    distance = np.linalg.norm(means, axis=1)
    far = distance > FARTHEST
    factors = np.where(far, FARTHEST / np.where(far, distance, 1), 1)[:, None]
    # Thinner than the least log-scale is a hundredth of a pixel, and said of no model.
    log_scales = np.maximum(splats.log_scales + np.log(unit * factors), SCALE_LOW)
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
    """The first camera as the viewer takes it, in units of the page."""
    [position] = in_page(start.position[None], start)
    return {
        "position": position.tolist(),
        "target": [0.0, 0.0, 0.0],
        "up": start.up.tolist(),
        "lens": start.lens,
        "near": start.near,
    }


def in_page(points: F, start: Opening) -> F64:
    """(N, 3) float64: points in scene units, in units of the page around the first target."""
    placed: F64 = (points.astype(np.float64) - start.target) * (DISTANCE / start.distance)
    return placed

"""Stage `units`: the scale and Morton grid that all blocks share, from evenly spread rows."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from nanogs._types import F64, U64
from nanogs.errors import NONE_USABLE, ModelError
from nanogs.method.activation import scene_origin
from nanogs.method.nodes import (
    activate_nodes,
    immense_weight,
    prominence,
    thinnest_axis,
    typical_weight,
)
from nanogs.method.order import code_box, codes_in
from nanogs.method.viewers import MOST_VIEWERS, Dilation, Viewers, estimate_dilation, viewers_at
from nanogs.pipeline.job.rows import sample
from nanogs.pipeline.options.settings import Settings
from nanogs.pipeline.tasks.unpack import Unpacked
from nanogs.raster.camera import Camera, pick_evenly
from nanogs.splats import Splats


@dataclass(frozen=True, slots=True)
class Units:
    """Measures that all blocks of a scene share, so that positions and errors of any two compare.

    Attributes:
        origin: Subtracted from the centres, scene units.
        anchors: x, y, z relative to the origin, and radius, of each anchor of `Dilation`.
        per_radius: As in `Dilation`.
        places: Positions of a user's cameras, relative to the origin, as in `Viewers`; empty
            without.
        apart: As in `Viewers`.
        thinnest: Thinnest axis of any node, scene units.
        prominence: Of a typical splat, square scene units; weights are divided by it.
        immense: Prominence that a splat counts as at most for the mean of all, square scene units.
        corner: Lowest corner of the box of the Morton grid, relative to the origin.
        width: Of that box, scene units.
    """

    origin: tuple[float, ...]
    anchors: tuple[tuple[float, ...], ...]
    per_radius: float
    places: tuple[tuple[float, ...], ...]
    apart: float
    thinnest: float
    prominence: float
    immense: float
    corner: tuple[float, ...]
    width: float

    def to_dict(self) -> dict[str, Any]:
        """Return plain data; floats keep every digit in JSON."""
        return asdict(self)

    def centre(self) -> F64:
        """Return (3,) the origin."""
        return np.array(self.origin)

    def dilation(self) -> Dilation:
        """Return the dilation that rasterisers add to splats."""
        rows = np.array(self.anchors)
        return Dilation(np.ascontiguousarray(rows[:, :3]), rows[:, 3].copy(), self.per_radius)

    def viewers(self) -> Dilation | Viewers:
        """Return where viewers stand: at a user's cameras, or as the model suggests."""
        return Viewers(np.array(self.places), self.apart) if self.places else self.dilation()

    def codes(self, splats: Splats) -> U64:
        """Compute (N,) the Morton codes of the centres."""
        return codes_in(splats.means - self.centre(), np.array(self.corner), self.width)


def units_of(data: Mapping[str, Any]) -> Units:
    """Rebuild units from the data of `to_dict` after a round trip through JSON."""
    fixed: dict[str, Any] = {key: tuple(v) if isinstance(v, list) else v for key, v in data.items()}
    for name in ("anchors", "places"):
        fixed[name] = tuple(map(tuple, data[name]))
    return Units(**fixed)


def find_units(settings: Settings, unpacked: Unpacked | None = None) -> Units:
    """Compute the units from a sample of the rows of all inputs.

    Args:
        settings: The job.
        unpacked: The files that have been unpacked, if any.

    Raises:
        FormatError: They cannot be read.
        ModelError: No splat among them is usable.
    """
    some = sample(settings, unpacked)
    if len(some) == 0:
        raise ModelError(NONE_USABLE)
    origin = scene_origin(some.means)
    means = some.means - origin
    dilation = estimate_dilation(
        means, some.opacities(), some.render_mode, settings.parameters.pixels
    )
    thinnest = thinnest_axis(some.scales(), means, dilation.least)
    nodes = activate_nodes(some, np.arange(len(some)), origin, dilation, thinnest)
    cameras = settings.asked.given()
    given_viewers = viewers_of(cameras, origin, means) if cameras else None
    prominences = prominence(nodes.coverages, nodes.means, given_viewers or dilation)
    typical = typical_weight(prominences)
    corner, width = code_box(means)
    return Units(
        origin=tuple(map(float, origin)),
        anchors=tuple(map(tuple, np.column_stack((dilation.anchors, dilation.radii)).tolist())),
        per_radius=dilation.per_radius,
        places=tuple(map(tuple, given_viewers.places.tolist())) if given_viewers else (),
        apart=given_viewers.apart if given_viewers else 0.0,
        thinnest=thinnest,
        prominence=typical if typical > 0 else 1.0,
        immense=immense_weight(prominences),
        corner=tuple(map(float, corner)),
        width=width,
    )


def viewers_of(cameras: Sequence[Camera], origin: F64, means: F64) -> Viewers:
    """Return viewers at the positions of a user's cameras.

    Args:
        cameras: One at least.
        origin: (3,) subtracted from centres, scene units.
        means: (N, 3) float64, N >= 1, splats of the model, relative to the origin.
    """
    places = np.array([camera.position for camera in pick_evenly(cameras, MOST_VIEWERS)])
    return viewers_at(places - origin, means)

"""The views that the user asked for, as plain data that a job can store as JSON."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from nanogs.pipeline.options.cameras import AUTO
from nanogs.raster.camera import DILATION, Camera
from nanogs.raster.lens import Lens

if TYPE_CHECKING:
    from nanogs.views.cameras import Cameras


@dataclass(frozen=True, slots=True)
class RequestedViews:
    """The views that the user asked for: a named way to find cameras, or given cameras.

    Attributes:
        source: "auto", or another name in `views.cameras.FOUND`.
        up: Up direction for views that are found, or None.
        cameras: Given cameras as JSON; if there are any, no views are found.
    """

    source: str = AUTO
    up: tuple[float, ...] | None = None
    cameras: tuple[str, ...] = ()

    def given(self) -> list[Camera]:
        """Parse the given cameras."""
        return [camera_of(json.loads(text)) for text in self.cameras]


AUTOMATIC = RequestedViews()


def requested_views(cameras: "Cameras | None", up: Sequence[float] | None) -> RequestedViews:
    """Check the views asked for; a file of cameras is read now, so that no worker needs it.

    Args:
        cameras: A name in `views.cameras.FOUND`, a file or folder, or cameras; None for automatic.
        up: Up direction for views that are found, or None.

    Raises:
        NanogsError: A file holds no cameras, or `up` is no direction, or is beside given cameras.
    """
    direction = None
    if up is not None:
        from nanogs.views.automatic import unit_up

        unit_up(up)
        direction = tuple(map(float, up))
    if cameras is None:
        return RequestedViews(up=direction)
    from nanogs.views.cameras import known_cameras

    found = known_cameras(cameras, up)
    if isinstance(found, str):
        return RequestedViews(found, direction)
    return RequestedViews(cameras=tuple(json.dumps(plain_camera(camera)) for camera in found))


def plain_camera(camera: Camera) -> dict[str, Any]:
    """Convert a camera to plain data for JSON, without loss; see `camera_of` for the inverse."""
    names = ("width", "height", "fx", "fy", "cx", "cy", "name", "near")
    plain = {name: getattr(camera, name) for name in names}
    plain["world_to_camera"] = camera.world_to_camera.tolist()
    if camera.lens is not None:
        plain["lens"] = asdict(camera.lens)
    if camera.whole is not None:
        plain["whole"] = list(camera.whole)
    if camera.changed_by:
        plain["changed_by"] = camera.changed_by
    if camera.dilation != DILATION:
        plain["dilation"] = camera.dilation
    return plain


def camera_of(data: Mapping[str, Any]) -> Camera:
    """Restore a camera from the plain data of `plain_camera`."""
    fixed: dict[str, Any] = {**data, "world_to_camera": np.array(data["world_to_camera"])}
    if "lens" in data:
        fixed["lens"] = Lens(**{name: _fixed(value) for name, value in data["lens"].items()})
    if "whole" in data:
        fixed["whole"] = _fixed(data["whole"])
    return Camera(**fixed)


def _fixed(value: Any) -> Any:  # noqa: ANN401 - what JSON holds
    return tuple(value) if isinstance(value, list) else value

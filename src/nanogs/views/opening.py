"""The initial camera of a viewer, all of an object or a view in a room, and its orbit centre."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nanogs._types import F64
from nanogs.raster.camera import Camera
from nanogs.splats import Splats
from nanogs.views import inside
from nanogs.views.automatic import INSIDE_FOV, ORBIT_FOV, Kind, Survey, survey
from nanogs.views.occupancy import build_grid
from nanogs.views.orbit import overview
from nanogs.views.poses import view_hits

SHORTEST = 0.1  # least distance of the camera from its target, over the core's radius


@dataclass(frozen=True, slots=True, eq=False)
class Opening:
    """An initial camera without an image size, and the point that it orbits.

    Attributes:
        position: (3,) float64, position of the camera, scene units.
        target: (3,) float64, the point that it orbits, in the centre of the image, scene units.
        up: (3,) float64, unit.
        tangent: That of half the field of view along the shorter side of the image.
        near: Distance of the near plane over that of the target.
    """

    position: F64
    target: F64
    up: F64
    tangent: float
    near: float

    @property
    def distance(self) -> float:
        """Distance of the camera from the target, scene units, more than 0."""
        return float(np.linalg.norm(self.target - self.position))


def opening_for(
    splats: Splats, view: Kind | Camera = "auto", up: Sequence[float] | F64 | None = None
) -> Opening:
    """Choose the initial camera for a model.

    Args:
        splats: The model.
        view: A camera to start from, or the kind of view, as for `automatic.automatic_cameras`.
        up: (3,) direction in scene coordinates; found from the model by default.

    Raises:
        ModelError: No splat is visible.
        OptionError: An argument is out of range.
    """
    if isinstance(view, Camera):
        scene = survey(splats, "orbit", up)
        pose = view.world_to_camera @ scene.turn.T  # in the model's own frame, as below
        tangent = min(view.width / view.fx, view.height / view.fy) / 2
        return _opening(scene, pose, tangent, view.near, _ahead(pose, scene.core.centre))
    scene = survey(splats, view, up)
    angle = ORBIT_FOV if scene.kind == "orbit" else INSIDE_FOV
    tangent = float(np.tan(np.radians(angle / 2)))
    square = np.full(2, tangent)
    if scene.kind == "orbit":
        pose, near = overview(scene.orbit, square)
        return _opening(scene, pose, tangent, near, _ahead(pose, scene.orbit.centre))
    first = np.zeros(1, np.int64)
    [(pose, near)] = inside.poses(scene.sampled, scene.core, square, first)
    return _opening(scene, pose, tangent, near, _depth(scene, pose, square))


def _opening(scene: Survey, pose: F64, tangent: float, near: float, distance: float) -> Opening:
    """Convert a pose (4, 4) in the model's own frame to an opening in scene coordinates."""
    distance = max(distance, SHORTEST * scene.core.radius)
    pose = pose @ scene.turn
    position: F64 = -pose[:3, :3].T @ pose[:3, 3]
    target: F64 = position + distance * pose[2, :3]
    return Opening(position, target, scene.turn[2, :3], tangent, near / distance)


def _ahead(pose: F64, point: F64) -> float:
    """Return the depth of a point (3,) in a camera, scene units; negative behind it."""
    return float(pose[2, :3] @ point + pose[2, 3])


def _depth(scene: Survey, pose: F64, tangents: F64) -> float:
    """Return the median distance at which the rays of a view in a room end, scene units."""
    core = scene.core
    grid = build_grid(scene.sampled, core.centre, inside.GRID_HALF * core.radius)
    (hits,) = view_hits(grid, [pose], tangents, inside.REACH * core.radius)
    seen = hits[np.isfinite(hits)]
    return float(np.median(seen)) if len(seen) else core.radius

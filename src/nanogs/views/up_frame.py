"""The frame in which cameras are placed around a model, and the range of their elevations.

`frame_from_up` is for a model whose up direction is known or assumed. `frame_from_model` finds it
from the model alone, independent of its orientation: from a ground, from walls, or from a disc of
land. If there is no evidence, cameras are placed all around.
"""

from dataclasses import dataclass

import numpy as np

from nanogs._types import F64
from nanogs.views.heading import (
    WeightedPoints,
    model_frame,
    principal_frame,
    seen_from,
    without_surroundings,
)
from nanogs.views.inside import is_room
from nanogs.views.occupancy import Core, SplatSample, find_core, quantiles
from nanogs.views.up import LEAD, Surfaces, ground, surfaces_of

# Range of elevations, radians above the horizon; from lower, a ground would be seen from beneath.
UPRIGHT = (float(np.radians(-15)), float(np.radians(30)))
ALL_AROUND = (-np.pi / 2, np.pi / 2)

SAMPLE = 15_000  # most splats whose normals are used
SHARPNESS = 0.85  # cosine above which a normal counts for a direction, with increasing weight
ROUNDS = 12  # iterations that move a direction to where normals cluster
SAME = 0.95  # cosine from which two directions are the same
GROUND = 0.15  # least share of the area in a ground
WALLS = 3  # number of pairs of opposite walls of a room
# Land is a disc: limits of the ratio of each variance to the next larger one, at most and at least.
THINNEST, ROUNDEST = 0.5, 0.7


@dataclass(frozen=True, slots=True)
class CameraFrame:
    """A frame and a range of elevations.

    Attributes:
        frame: (3, 3) float64, rows are two level axes and up, right-handed.
        band: Lowest and highest elevation of cameras around the model, radians.
    """

    frame: F64
    band: tuple[float, float]


def frame_from_up(body: WeightedPoints, up: F64) -> CameraFrame:
    """Return the frame and elevations for a model whose up direction (3,), unit, is known."""
    return CameraFrame(model_frame(body, up), UPRIGHT)


def frame_from_model(sampled: SplatSample, *, room: bool) -> CameraFrame:
    """Find the frame from the model alone; turning the model turns the frame.

    Args:
        sampled: The model.
        room: Whether the model may be a room.
    """
    body = without_surroundings(sampled)
    frame = principal_frame(body)
    seen = seen_from(sampled, frame)  # makes computations along axes turn with the model
    core = find_core(seen)
    surfaces = surfaces_of(seen, core)
    flats = _flat_directions(surfaces)
    up = _ground_up(surfaces, flats)
    if up is None and room:
        up = _room_up(seen, core, surfaces, flats)
    if up is None:
        up = _land_up(surfaces)
    return CameraFrame(frame, ALL_AROUND) if up is None else frame_from_up(body, up @ frame)


def _flat_directions(surfaces: Surfaces) -> list[F64]:
    """Find the unit directions (3,) around which normals cluster, those of the most area first."""
    rows = slice(None, None, -(-len(surfaces.normals) // SAMPLE))
    normals, areas = surfaces.normals[rows], surfaces.areas[rows]
    spread = np.linalg.eigh((normals * areas[:, None]).T @ normals)[1].T[::-1]
    found: list[F64] = []
    for start in (*np.eye(3), *spread):
        direction = _gathered(normals, areas, start)
        if all(abs(direction @ other) < SAME for other in found):
            found.append(direction)
    return sorted(found, key=surfaces.lying, reverse=True)


def _gathered(normals: F64, areas: F64, direction: F64) -> F64:
    """Move a direction (3,) to the nearest cluster of normals, whose sign does not matter."""
    for _ in range(ROUNDS):
        weights = areas * np.maximum(np.abs(normals @ direction) - SHARPNESS, 0)
        if not weights.any():
            break
        nearest = np.linalg.eigh((normals * weights[:, None]).T @ normals)[1][:, 2]
        direction = nearest if nearest @ direction >= 0 else -nearest
    return direction


def _ground_up(surfaces: Surfaces, flats: list[F64]) -> F64 | None:
    """Return the direction away from a ground, or None if there is no clear one."""
    both = [sign * direction for direction in flats for sign in (1.0, -1.0)]
    grounds = [ground(surfaces, up) for up in both]
    *_, second, best = sorted(grounds)
    if best < max(GROUND, LEAD * second):
        return None
    return both[grounds.index(best)]


def _room_up(seen: SplatSample, core: Core, surfaces: Surfaces, flats: list[F64]) -> F64 | None:
    """Return up in a room, normal to floor and ceiling, or None if it is no room.

    These are taken to be the largest walls, and the floor is the side with more of the contents.
    """
    for up in flats[:WALLS]:
        if is_room(seen, core, up):
            low, middle, high = quantiles(surfaces.points @ up, surfaces.areas, 0.01, 0.5, 0.99)
            return up if middle - low <= high - middle else -up
    return None


def _land_up(surfaces: Surfaces) -> F64 | None:
    """Return the normal of a disc of land, towards the longer tail of heights; None if none."""
    centred = surfaces.points - surfaces.areas @ surfaces.points
    moments, axes = np.linalg.eigh((centred * surfaces.areas[:, None]).T @ centred)
    if moments[0] > THINNEST * moments[1] or moments[1] < ROUNDEST * moments[2]:
        return None
    up: F64 = axes[:, 0]
    return up if surfaces.areas @ (centred @ up) ** 3 >= 0 else -up

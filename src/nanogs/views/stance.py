"""How a model stands: a frame for its cameras, and from how low and high they may look.

`upright` is for a model whose up is known or taken for granted. `own_stance` looks at the model
alone, and the same way however it is turned: at a ground, at walls, at a disc of land; where
nothing tells what is up, every direction is as good as any other and cameras stand all around.
"""

from dataclasses import dataclass

import numpy as np

from nanogs._types import F64
from nanogs.views.heading import Body, body_of, model_frame, principal_frame, seen_from
from nanogs.views.inside import is_room
from nanogs.views.occupancy import Core, Matter, find_core, quantiles
from nanogs.views.up import LEAD, Surfaces, ground, surfaces_of

# Radians above the horizon; lower, a ground would be seen from beneath.
UPRIGHT = (float(np.radians(-15)), float(np.radians(30)))
ALL_AROUND = (-np.pi / 2, np.pi / 2)

SAMPLE = 15_000  # splats whose normals are looked at
SHARPNESS = 0.85  # cosine from which a normal counts as one of a direction's, the more the nearer
ROUNDS = 12  # of moving a direction to where normals gather
SAME = 0.95  # cosine of directions that are one
GROUND = 0.15  # share of the area that tells a ground
WALLS = 3  # pairs of them in a room
# Land is a disc: variances over the next larger one.
THINNEST, ROUNDEST = 0.5, 0.7


@dataclass(frozen=True, slots=True)
class Stance:
    """A frame and a band of elevations.

    Attributes:
        frame: (3, 3) float64, two level directions and up in its rows, right-handed.
        band: Lowest and highest elevation of cameras around the model, radians.
    """

    frame: F64
    band: tuple[float, float]


def upright(body: Body, up: F64) -> Stance:
    """The stance of a model of which up (3,), unit, is known."""
    return Stance(model_frame(body, up), UPRIGHT)


def own_stance(matter: Matter, *, room: bool) -> Stance:
    """The stance that the model itself shows; turning the model turns it.

    Args:
        matter: The model.
        room: Whether it may be a room.
    """
    body = body_of(matter)
    frame = principal_frame(body)
    seen = seen_from(matter, frame)  # what looks along axes now turns with the model
    core = find_core(seen)
    surfaces = surfaces_of(seen, core)
    flats = _flat_directions(surfaces)
    up = _ground_up(surfaces, flats)
    if up is None and room:
        up = _room_up(seen, core, surfaces, flats)
    if up is None:
        up = _land_up(surfaces)
    return Stance(frame, ALL_AROUND) if up is None else upright(body, up @ frame)


def _flat_directions(surfaces: Surfaces) -> list[F64]:
    """Unit directions (3,) around which normals gather, those of the most area first."""
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
    """A direction (3,) moved to the nearest one around which normals, of either sign, gather."""
    for _ in range(ROUNDS):
        weights = areas * np.maximum(np.abs(normals @ direction) - SHARPNESS, 0)
        if not weights.any():
            break
        nearest = np.linalg.eigh((normals * weights[:, None]).T @ normals)[1][:, 2]
        direction = nearest if nearest @ direction >= 0 else -nearest
    return direction


def _ground_up(surfaces: Surfaces, flats: list[F64]) -> F64 | None:
    """Away from a ground that is clearly one."""
    both = [sign * direction for direction in flats for sign in (1.0, -1.0)]
    grounds = [ground(surfaces, up) for up in both]
    *_, second, best = sorted(grounds)
    if best < max(GROUND, LEAD * second):
        return None
    return both[grounds.index(best)]


def _room_up(seen: Matter, core: Core, surfaces: Surfaces, flats: list[F64]) -> F64 | None:
    """Up in a room: across its largest walls, floor and ceiling, away from where things stand."""
    for up in flats[:WALLS]:
        if is_room(seen, core, up):
            low, middle, high = quantiles(surfaces.points @ up, surfaces.areas, 0.01, 0.5, 0.99)
            return up if middle - low <= high - middle else -up
    return None


def _land_up(surfaces: Surfaces) -> F64 | None:
    """Across a disc of land, to where the longer tail of its heights is."""
    centred = surfaces.points - surfaces.areas @ surfaces.points
    moments, axes = np.linalg.eigh((centred * surfaces.areas[:, None]).T @ centred)
    if moments[0] > THINNEST * moments[1] or moments[1] < ROUNDEST * moments[2]:
        return None
    up: F64 = axes[:, 0]
    return up if surfaces.areas @ (centred @ up) ** 3 >= 0 else -up

"""Cameras inside a room: in free space, facing dense parts, at several distances."""

from dataclasses import dataclass

import numpy as np

from nanogs._types import F64, I64, Bool
from nanogs.activations import rotation_about
from nanogs.views.occupancy import Core, SplatSample, build_grid, capped, quantiles
from nanogs.views.poses import UP, level_frame, look_along, low_discrepancy, view_hits

SLAB = 0.08  # thickness of a wall over the size of the room
WALL_SHARE = 0.55  # least share of a room's area in its six walls; a sphere has 0.48
FACE_SHARE = 0.06  # least share of a room's area in a wall for it to count
FACES = 4  # least number of walls of a room: one may be open, the ceiling unseen
GROUND_SHARE = 0.5  # share of the walls' area above which a face is the ground of an open scene
FEWEST = 50  # least splats of a room: most of fewer could be near the faces of a box by chance
CONTENT = 0.02  # least share of a room's area well inside it; a closed box has none
TURNS = 18  # number of angles tried within a quarter turn
SAMPLE = 6_000  # splats that a box is fitted to; shares are accurate to a hundredth
TRIES = 16  # number of poses tried for one view
ENOUGH = 0.7  # share of rays that should hit something; requiring more would narrow the choice
KEEP_OFF = 0.12  # least distance of a camera from a wall over the size of the room
CLEARANCE = 0.12  # distance over the room's radius below which splats block the view
NEAR = 0.01  # near plane over the core's radius
GRID_HALF = 1.3  # half-width of the grid in core radii
REACH = 2.5  # length of rays in core radii


@dataclass(frozen=True, slots=True)
class Box:
    """A box turned about the vertical that holds the core's area except 1 % at each face.

    Attributes:
        frame: (3, 3) float64, directions of its edges as rows, the last one up.
        low: (3,) float64, its lower corner in that frame, scene units.
        high: (3,) float64, its upper corner in that frame, scene units.
        faces: (6,) float64, share of the area in the slab at each face.
        content: Share of the area outside slabs of twice that thickness.
    """

    frame: F64
    low: F64
    high: F64
    faces: F64
    content: float


def is_room(sampled: SplatSample, core: Core, up: F64) -> bool:
    """Return whether four walls or more hold most of the area, and some area is well inside."""
    if len(core.rows) < FEWEST:
        return False
    box = fit_box(sampled, core, up)
    area = box.faces.sum()
    walled = area > WALL_SHARE and (box.faces > FACE_SHARE).sum() >= FACES
    return bool(walled and box.faces.max() < GROUND_SHARE * area and box.content > CONTENT)


def fit_box(sampled: SplatSample, core: Core, up: F64) -> Box:
    """Fit the box whose slabs hold the most area, over angles of a quarter turn about `up`."""
    rows = core.rows[:: -(-len(core.rows) // SAMPLE)]
    areas = capped(sampled.areas[rows])
    areas = areas if areas.any() else np.ones(len(areas))
    frame = level_frame(up)
    boxes = []
    for angle in np.arange(TURNS) * (np.pi / 2 / TURNS):
        turned = rotation_about(2, -angle) @ frame
        boxes.append(_box(sampled.points[rows], areas, turned))
    return max(boxes, key=lambda box: float(box.faces.sum()))


def _box(points: F64, areas: F64, frame: F64) -> Box:
    local = points @ frame.T
    low, high = np.array([quantiles(column, areas, 0.01, 0.99) for column in local.T]).T
    size = np.where(high > low, high - low, 1)
    place = (local - low) / size

    def share(rows: Bool) -> float:
        return float(areas[rows].sum() / areas.sum())

    # A corner is assigned to one wall only, so that shares do not sum to more than the area.
    outward = np.abs(place - 0.5)
    axis = outward.argmax(axis=1)
    outermost = outward.max(axis=1)
    in_slab, upper = outermost > 0.5 - SLAB, place[np.arange(len(place)), axis] > 0.5
    faces = [share(in_slab & (axis == a) & (upper == s)) for a in range(3) for s in (False, True)]
    return Box(frame, low, high, np.array(faces), share(outermost < 0.5 - 2 * SLAB))


def poses(sampled: SplatSample, core: Core, tangents: F64, numbers: I64) -> list[tuple[F64, float]]:
    """Compute the (4, 4) world-to-camera matrix and near plane of each view.

    Each view is the best of its own block of poses in a low-discrepancy sequence, so that views of
    different numbers have no poses in common.

    Args:
        sampled: The model.
        core: The room.
        tangents: (2,) float64, tangents of half the fields of view.
        numbers: (n,) int64, numbers of the views in the sequence, 0 or more.
    """
    grid = build_grid(sampled, core.centre, GRID_HALF * core.radius)
    box = fit_box(sampled, core, UP)
    views = []
    for number in numbers.tolist():
        tries = low_discrepancy(number * TRIES + np.arange(TRIES), 5)
        candidates = [_candidate(box, one) for one in tries]
        scores = _scores(view_hits(grid, candidates, tangents, REACH * core.radius), core.radius)
        views.append((candidates[int(np.argmax(scores))], NEAR * core.radius))
    return views


def _candidate(box: Box, draw: F64) -> F64:
    """Make a pose from five numbers in [0, 1): three for the position, heading, pitch."""
    inner = KEEP_OFF + (1 - 2 * KEEP_OFF) * draw[:3]
    inner[2] = 0.3 + 0.5 * draw[2]  # neither near the floor nor near the ceiling
    position = (box.low + inner * (box.high - box.low)) @ box.frame
    heading, pitch = 2 * np.pi * draw[3], np.radians(-25 + 35 * draw[4])
    level = np.array([np.cos(heading), np.sin(heading)]) * np.cos(pitch)
    direction = np.array([*level, np.sin(pitch)]) @ box.frame
    return look_along(position, direction, box.frame[2])


def _scores(hits: F64, radius: float) -> F64:
    """Score P poses by (P, R) the distances at which their rays are stopped, scene units.

    The score is high if most rays hit something, none very near, and the view is deep.
    """
    seen = np.isfinite(hits).mean(axis=1)
    blocked = (hits < CLEARANCE * radius).mean(axis=1)
    cramped = (hits < 3 * CLEARANCE * radius).mean(axis=1)
    depth = np.median(np.minimum(hits, radius), axis=1) / radius
    scores: F64 = np.minimum(seen, ENOUGH) - 4 * blocked - cramped + 0.5 * depth
    return scores

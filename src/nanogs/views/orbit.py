"""Cameras around a model without its strays: some near it, some far.

A view that the densest part fills shows little of its surroundings, but most views of a scene are
of its surroundings. So these cameras look at the median of the core, at distances from where it is
cropped to where it leaves a margin, and evenly over a band of elevations.
"""

from dataclasses import dataclass

import numpy as np

from nanogs._types import F64, I64
from nanogs.views.occupancy import Core, Grid, SplatSample, build_grid, quantiles
from nanogs.views.poses import UP, level_frame, look_at, low_discrepancy, view_hits

GRID_HALF = 4.0  # half-width of the grid in radii: contains almost all orbits
HELD = 0.9  # share of the core's alpha within the radius
# Distances over that at which the radius just fits the image: it then appears 1.4 times
# as large as the image, or 0.7 times.
NEAREST, FARTHEST = 0.5**0.5, 2**0.5
# Azimuth, elevation and distance, as above, of a view of everything: it shows the broad side and
# some of the narrow one.
OVERVIEW = (np.radians(60), np.radians(12), 1.6)
STEEPEST = 1.2  # highest elevation, radians, of a camera raised over an obstacle
TOO_NEAR = 0.45  # share of the distance to the centre within which a stopped ray counts as blocked
ACCEPTED = 0.1  # share of blocked rays that is accepted
NEAR = 0.05  # near plane over the distance to the centre: skips floaters near the camera
FINEST = 1e-9  # least radius over the coordinates of the centre, for the precision of float64 poses
# Factor of the distance, and radians to raise the elevation, tried in turn if a view is blocked.
DETOURS = ((1, 0), (0.85, 0), (0.85, 0.25), (0.7, 0.25), (0.7, 0.5), (0.5, 0.5), (1, 1.1))


@dataclass(frozen=True, slots=True)
class Orbit:
    """The point that cameras around a model look at, and the obstacles in their way.

    Attributes:
        centre: (3,) float64, the point that they look at, scene units.
        radius: Distance from it that holds most of the model, scene units.
        grid: The model's occupancy around it.
    """

    centre: F64
    radius: float
    grid: Grid


def find_orbit(sampled: SplatSample, core: Core) -> Orbit:
    """Find what cameras around a model look at.

    Args:
        sampled: The model.
        core: The model without strays.
    """
    centre, radius = _focus(sampled, core)
    return Orbit(centre, radius, build_grid(sampled, centre, GRID_HALF * radius))


def poses(
    orbit: Orbit, tangents: F64, numbers: I64, band: tuple[float, float]
) -> list[tuple[F64, float]]:
    """Compute the (4, 4) world-to-camera matrix and near plane of cameras of the orbit.

    Args:
        orbit: What they look at.
        tangents: (2,) float64, tangents of half the fields of view.
        numbers: (n,) int64, members of the sequence of directions.
        band: Lowest and highest elevation, radians.
    """
    # Even and odd numbers are half a step apart in one sequence.
    turn, lift, pull = low_discrepancy(numbers / 2, 3).T
    lowest, highest = np.sin(band)
    elevation = np.arcsin(lowest + lift * (highest - lowest))  # uniform over the band's area
    distance = NEAREST * (FARTHEST / NEAREST) ** pull * orbit.radius / tangents.min()
    places = zip((2 * np.pi * turn).tolist(), elevation.tolist(), distance.tolist(), strict=True)
    return [_unblocked(orbit, tangents, *place) for place in places]


def overview(orbit: Orbit, tangents: F64) -> tuple[F64, float]:
    """Return the pose and near plane of a view of the whole model; the arguments are as above."""
    azimuth, elevation, distance = OVERVIEW
    distance *= orbit.radius / float(tangents.min())
    return _unblocked(orbit, tangents, azimuth, elevation, distance)


def _focus(sampled: SplatSample, core: Core) -> tuple[F64, float]:
    """Find the centre of the orbit, (3,), and the radius around it that holds 90 % of the core.

    The centre is the median and not the middle of the extent, which a tall object on a wide ground
    would lift off the ground that most of the views should show.
    """
    points, alphas = sampled.points[core.rows], sampled.alphas[core.rows]
    centre = np.array([quantiles(column, alphas, 0.5)[0] for column in points.T])
    extent = np.linalg.norm(sampled.arms[core.rows], axis=2).max(axis=1)
    radius = quantiles(np.linalg.norm(points - centre, axis=1) + extent, alphas, HELD)[0]
    if radius == 0:
        radius = core.radius
    return centre, max(radius, FINEST * float(np.abs(centre).max()))


def _unblocked(
    orbit: Orbit, tangents: F64, azimuth: float, elevation: float, distance: float
) -> tuple[F64, float]:
    """Return pose and near plane of the first unblocked camera of a few, or the least blocked.

    Those tried are ever nearer or higher.
    """
    frame = level_frame(UP)
    tried: list[tuple[float, F64, float]] = []
    for pull, climb in DETOURS:
        lift = max(elevation, min(elevation + climb, STEEPEST))
        level = np.array([np.cos(azimuth), np.sin(azimuth)]) * np.cos(lift)
        away = pull * distance
        position = orbit.centre + away * (np.array([*level, np.sin(lift)]) @ frame)
        pose = look_at(position, orbit.centre, frame[2])
        (hits,) = view_hits(orbit.grid, [pose], tangents, away)
        blocked = float((hits < TOO_NEAR * away).mean()) + (not orbit.grid.free(position))
        tried.append((blocked, pose, NEAR * away))
        if blocked <= ACCEPTED:
            break
    _, pose, near = min(tried, key=lambda one: one[0])
    return pose, near

"""Cameras around all of a model but its strays: some near it, some far.

A view that the densest part fills shows little of what surrounds it, and most views of a scene are
of its surroundings. So these look at the middle of the matter, from distances at which it is cut
off to such at which it leaves room, and from all elevations of a band alike.
"""

import numpy as np

from nanogs._types import F64, I64
from nanogs.views.occupancy import Core, Grid, Matter, build_grid, quantiles
from nanogs.views.poses import level_frame, look_at, low_discrepancy, view_hits

GRID_HALF = 4.0  # half-width of the grid in radii: orbits lie about inside
HELD = 0.9  # share of the matter within the radius
# Times the distance at which the radius just fits the image: it then appears 1.4 times
# as large as the image, or 0.7 times.
NEAREST, FARTHEST = 0.5**0.5, 2**0.5
# Azimuth, elevation and distance, as above, of a view of everything: the broad side and some of the
# narrow one.
OVERVIEW = (np.radians(60), np.radians(12), 1.6)
STEEPEST = 1.2  # radians, for a camera raised over an obstacle
TOO_NEAR = 0.45  # of the distance to the centre: what stops rays before blocks the view
ACCEPTED = 0.1  # share of blocked rays that is good enough
NEAR = 0.05  # near plane over the distance to the centre: skips floaters at the lens
FINEST = 1e-9  # radius over the coordinates of the centre: what poses in doubles can tell
# Share of the distance and radians to climb, tried in turn where something blocks.
DETOURS = ((1, 0), (0.85, 0), (0.85, 0.25), (0.7, 0.25), (0.7, 0.5), (0.5, 0.5), (1, 1.1))


def poses(
    matter: Matter, core: Core, up: F64, lens: F64, numbers: I64, band: tuple[float, float]
) -> list[tuple[F64, float]]:
    """(4, 4) world-to-camera and near plane of the orbit's members with these numbers.

    Args:
        matter: The model.
        core: The part of it that is no stray.
        up: (3,) float64, unit.
        lens: (2,) float64, tangents of half the fields of view.
        numbers: (n,) int64, members of the sequence of directions.
        band: Lowest and highest elevation, radians.
    """
    centre, radius = _focus(matter, core)
    grid = build_grid(matter, centre, GRID_HALF * radius)
    # Even and odd numbers are half a step apart in one sequence.
    turn, lift, pull = low_discrepancy(numbers / 2, 3).T
    lowest, highest = np.sin(band)
    elevation = np.arcsin(lowest + lift * (highest - lowest))  # even over the band's area
    distance = NEAREST * (FARTHEST / NEAREST) ** pull * radius / lens.min()
    places = zip((2 * np.pi * turn).tolist(), elevation.tolist(), distance.tolist(), strict=True)
    return [_unblocked(grid, centre, level_frame(up), lens, *place) for place in places]


def overview(matter: Matter, core: Core, up: F64, lens: F64) -> tuple[F64, float, F64]:
    """The pose and near plane of a view of all of the model, and (3,) what it looks at.

    The arguments are those of `poses`.
    """
    centre, radius = _focus(matter, core)
    grid = build_grid(matter, centre, GRID_HALF * radius)
    azimuth, elevation, distance = OVERVIEW
    distance *= radius / float(lens.min())
    pose, near = _unblocked(grid, centre, level_frame(up), lens, azimuth, elevation, distance)
    return pose, near, centre


def _focus(matter: Matter, core: Core) -> tuple[F64, float]:
    """Find where the orbit looks, (3,), and how far from there 90 % of the core reaches.

    The median and not the middle of the extremes, which a tall thing on a wide ground would pull
    off the ground that most of the views should show.
    """
    points, alphas = matter.points[core.rows], matter.alphas[core.rows]
    centre = np.array([quantiles(column, alphas, 0.5)[0] for column in points.T])
    extent = np.linalg.norm(matter.arms[core.rows], axis=2).max(axis=1)
    reach = quantiles(np.linalg.norm(points - centre, axis=1) + extent, alphas, HELD)[0]
    if reach == 0:
        reach = core.radius
    return centre, max(reach, FINEST * float(np.abs(centre).max()))


def _unblocked(
    grid: Grid,
    centre: F64,
    frame: F64,
    lens: F64,
    azimuth: float,
    elevation: float,
    distance: float,
) -> tuple[F64, float]:
    """The first of a few places, ever nearer or higher, with a free view, or the freest."""
    tried: list[tuple[float, F64, float]] = []
    for pull, climb in DETOURS:
        lift = max(elevation, min(elevation + climb, STEEPEST))
        level = np.array([np.cos(azimuth), np.sin(azimuth)]) * np.cos(lift)
        reach = pull * distance
        position = centre + reach * (np.array([*level, np.sin(lift)]) @ frame)
        pose = look_at(position, centre, frame[2])
        hits = view_hits(grid, pose, lens, reach)
        blocked = float((hits < TOO_NEAR * reach).mean()) + (not grid.free(position))
        tried.append((blocked, pose, NEAR * reach))
        if blocked <= ACCEPTED:
            break
    _, pose, near = min(tried, key=lambda one: one[0])
    return pose, near

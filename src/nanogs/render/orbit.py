"""Cameras around a model's dense core."""

import numpy as np

from nanogs._types import F64, I64
from nanogs.render.occupancy import Core, Grid, Matter, build_grid, quantiles
from nanogs.render.poses import level_frame, look_at, low_discrepancy, view_hits

GRID_HALF = 4.0  # half-width of the grid in core radii: orbits lie about inside
HIGHEST = np.radians(55)
LOWEST = np.radians(-20)
LOWEST_ABOVE_GROUND = np.radians(8)
CLOSEST = 0.05  # largest cut of the framing distance
CLOSEST_ABOVE_GROUND = 0.45  # the more to see the things that stand on it
GROUND_SHARE = 0.35
STEEPEST = 1.2  # radians, for a camera raised over an obstacle
TOO_NEAR = 0.45  # of the distance to the centre: what stops rays before blocks the view
ACCEPTED = 0.1  # share of blocked rays that is good enough
NEAR = 0.05  # near plane over the distance to the centre: skips floaters at the lens
MARGIN = 1.05
# Share of the framing distance and radians to climb, tried in turn where something blocks.
DETOURS = ((1.0, 0.0), (0.85, 0.0), (0.85, 0.25), (0.7, 0.25), (0.7, 0.5), (0.5, 0.5))


def poses(matter: Matter, core: Core, up: F64, lens: F64, numbers: I64) -> list[tuple[F64, float]]:
    """(4, 4) world-to-camera and near plane of the orbit's members with these numbers.

    Args:
        matter: The model.
        core: What to look at.
        up: (3,) float64, unit.
        lens: (2,) float64, tangents of half the fields of view.
        numbers: (n,) int64, members of the sequence of directions.
    """
    grid = build_grid(matter, core.centre, GRID_HALF * core.radius)
    ground = _has_ground(matter, core, up)
    low = LOWEST_ABOVE_GROUND if ground else LOWEST
    # Even and odd numbers are half a step apart in one sequence.
    turn, lift, pull = low_discrepancy(numbers / 2, 3).T
    # Even in the sine is even in area on the sphere of directions.
    elevation = np.arcsin(np.sin(low) + lift * (np.sin(HIGHEST) - np.sin(low)))
    nearness = 1 - pull * (CLOSEST_ABOVE_GROUND if ground else CLOSEST)
    places = zip((2 * np.pi * turn).tolist(), elevation.tolist(), nearness.tolist(), strict=True)
    return [_unblocked(matter, core, grid, level_frame(up), lens, *place) for place in places]


def _has_ground(matter: Matter, core: Core, up: F64) -> bool:
    """Whether a layer of a tenth of the core's height holds more than a third of it."""
    heights, alphas = matter.points[core.rows] @ up, matter.alphas[core.rows]
    low, high = quantiles(heights, alphas, 0.01, 0.99)
    counts, _ = np.histogram(heights, bins=20, range=(low, high), weights=alphas)
    layer = np.convolve(counts, [1, 1]).max()
    return bool(layer > GROUND_SHARE * alphas.sum())


def _unblocked(
    matter: Matter,
    core: Core,
    grid: Grid,
    frame: F64,
    lens: F64,
    azimuth: float,
    elevation: float,
    nearness: float,
) -> tuple[F64, float]:
    """The first of a few ever nearer and higher places with a free view, or the freest."""
    tried: list[tuple[float, F64, float]] = []
    for pull, climb in DETOURS:
        lift = max(elevation, min(elevation + climb, STEEPEST))
        level = np.array([np.cos(azimuth), np.sin(azimuth)]) * np.cos(lift)
        direction = np.array([*level, np.sin(lift)]) @ frame
        rotation = look_at(direction, np.zeros(3), frame[2])[:3, :3]
        distance = nearness * pull * _framing_distance(matter, core, rotation, lens)
        position = core.centre + distance * direction
        pose = look_at(position, core.centre, frame[2])
        hits = view_hits(grid, pose, lens, distance)
        blocked = float((hits < TOO_NEAR * distance).mean()) + (not grid.free(position))
        tried.append((blocked, pose, NEAR * distance))
        if blocked <= ACCEPTED:
            break
    _, pose, near = min(tried, key=lambda one: one[0])
    return pose, near


def _framing_distance(matter: Matter, core: Core, rotation: F64, lens: F64) -> float:
    """Distance from the centre at which 99 % of the core lies in the image, with a margin."""
    points = (matter.points[core.rows] - core.centre) @ rotation.T
    extent = 2 * np.linalg.norm(matter.arms[core.rows], axis=2).max(axis=1)
    across = ((np.abs(points[:, :2]) + extent[:, None]) / lens).max(axis=1)
    framed = quantiles(across - points[:, 2], matter.alphas[core.rows], 0.99)[0]
    return MARGIN * max(framed, core.radius)

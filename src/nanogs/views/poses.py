"""Camera poses: low-discrepancy sequences, look-at matrices, and ray casts over a view."""

import numpy as np

from nanogs._types import F64, F
from nanogs.views.occupancy import Grid

RAYS = 9  # rays along each side of a candidate view


def level_frame(up: F64) -> F64:
    """Return a right-handed (3, 3) frame, a function of `up`: rows are two level axes and up."""
    aside = np.eye(3)[np.argmin(np.abs(up))]
    first = np.cross(up, aside)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(up, first), up])


def low_discrepancy(numbers: F, dimensions: int) -> F64:
    """Return (n, dimensions) members in [0, 1) of an additive recurrence: every prefix is even."""
    root = 2.0
    for _ in range(40):  # the root of x^(d+1) = x + 1
        root = (1 + root) ** (1 / (dimensions + 1))
    values: F64 = (0.5 + numbers[:, None] * root ** -np.arange(1.0, dimensions + 1)) % 1.0
    return values


def look_at(position: F64, target: F64, up: F64) -> F64:
    """Return the (4, 4) world-to-camera matrix of a camera at `position` that looks at `target`."""
    return look_along(position, target - position, up)


def look_along(position: F64, direction: F64, up: F64) -> F64:
    """Return the (4, 4) world-to-camera matrix of a camera that looks in a direction.

    If the direction is zero, as between two points that differ by less than their digits show, the
    camera looks in a level one.
    """
    length = np.linalg.norm(direction)
    forward = direction / length if length > 0 else level_frame(up)[0]
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-6:  # looking straight up or down: any heading is valid
        right = level_frame(up)[0]
    right = right / np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ position
    return pose


def _view_rays(pose: F64, tangents: F64) -> F64:
    """Return the (RAYS², 3) unit directions of a regular grid over the image."""
    side = (np.arange(RAYS) + 0.5) / RAYS * 2 - 1
    x, y = np.meshgrid(side * tangents[0], side * tangents[1])
    rays = np.stack([x.ravel(), y.ravel(), np.ones(RAYS * RAYS)], axis=1) @ pose[:3, :3]
    directions: F64 = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return directions


def view_hits(grid: Grid, pose: F64, tangents: F64, reach: float) -> F64:
    """Return the (RAYS²,) distances at which a view's rays are stopped; see `Grid.first_hits`."""
    rays = _view_rays(pose, tangents)
    origin: F64 = -pose[:3, :3].T @ pose[:3, 3]
    return grid.first_hits(np.broadcast_to(origin, rays.shape), rays, reach)

"""Camera poses: low-discrepancy sequences, look-at matrices, and ray casts over a view."""

from collections.abc import Sequence

import numpy as np

from nanogs._types import F64, F
from nanogs.views.occupancy import Grid

UP = np.array([0.0, 0.0, 1.0])  # in the model's own frame
RAYS = 9  # rays along each side of a candidate view
_SIDE = (np.arange(RAYS) + 0.5) / RAYS * 2 - 1
# (RAYS², 3) directions of a regular grid over an image with tangents of 1, in camera space.
_RAYS_OVER = np.stack([np.tile(_SIDE, RAYS), np.repeat(_SIDE, RAYS), np.ones(RAYS * RAYS)], axis=1)


def level_frame(up: F64) -> F64:
    """Return a right-handed (3, 3) frame, a function of `up`: rows are two level axes and up."""
    aside = np.eye(3)[np.argmin(np.abs(up))]
    first = _cross(up, aside)
    first /= np.linalg.norm(first)
    return np.stack([first, _cross(up, first), up])


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
    right = _cross(forward, up)
    if np.linalg.norm(right) < 1e-6:  # looking straight up or down: any heading is valid
        right = level_frame(up)[0]
    right = right / np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, _cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ position
    return pose


def _cross(a: F64, b: F64) -> F64:
    """Return the cross product of two vectors (3,); `np.cross` takes ten times as long for one."""
    return np.array(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


def view_hits(grid: Grid, poses: Sequence[F64], tangents: F64, reach: float) -> F64:
    """Return (P, RAYS²), the distances at which the rays of P views are stopped, scene units.

    See `Grid.first_hits`; one call for many views takes a fraction of the time.

    Args:
        grid: The occupancy grid.
        poses: (4, 4) float64 world-to-camera matrix of each view.
        tangents: (2,) float64, tangents of half the fields of view.
        reach: Length of the rays, scene units.
    """
    over = _RAYS_OVER * np.append(tangents, 1.0)
    rays = np.concatenate([over @ pose[:3, :3] for pose in poses])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    origins = np.repeat([-pose[:3, :3].T @ pose[:3, 3] for pose in poses], RAYS * RAYS, axis=0)
    return grid.first_hits(origins, rays, reach).reshape(len(poses), RAYS * RAYS)

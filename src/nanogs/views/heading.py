"""A model's own frame: however it is turned, its cameras stand in the same places around it.

Nothing here looks at coordinates one by one, so turning the model turns its frames with it. One
that is the same all around has no heading of its own and gets any.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from nanogs._types import F64
from nanogs.views.occupancy import Matter, capped, quantiles
from nanogs.views.poses import level_frame

MEDIAN_SAMPLE = 10_000  # splats of which the median is taken
ROUNDS = 20  # of the geometric median; each brings it nearer by about half
REACH = 4.0  # median distances from the middle; beyond lie surroundings, skies and strays


class Body(NamedTuple):
    """A model without strays and surroundings.

    Attributes:
        points: (n, 3) float64, scene units.
        weights: (n,) float64, their areas, which add up to 1.
    """

    points: F64
    weights: F64


def model_frame(body: Body, up: F64) -> F64:
    """(3, 3): rows are the direction in which the model is longest, the one beside it, and up.

    The first is level, and points where the longer tail of the area lies.

    Args:
        body: The model.
        up: (3,) float64, unit.
    """
    points, weights = body
    basis = level_frame(up)
    longest = _axes(points @ basis[:2].T, weights)[0] @ basis[:2]
    return np.stack([longest, np.cross(up, longest), up])


def principal_frame(body: Body) -> F64:
    """(3, 3): rows are the axes along which the model is longest, next longest and shortest.

    The first two point where the longer tail of the area lies, and the third makes it right-handed.

    Args:
        body: The model.
    """
    first, second, _ = _axes(*body)
    return np.stack([first, second, np.cross(first, second)])


def seen_from(matter: Matter, frame: F64) -> Matter:
    """The model in the coordinates of a frame whose directions are rows."""
    return replace(matter, points=matter.points @ frame.T, arms=matter.arms @ frame.T)


def body_of(matter: Matter) -> Body:
    """The splats within a few median distances of the middle."""
    distances = np.linalg.norm(matter.points - _middle(matter), axis=1)
    rows = np.flatnonzero(distances <= REACH * quantiles(distances, matter.alphas, 0.5)[0])
    weights = capped(matter.areas[rows])
    total = weights.sum()
    even = np.full(len(rows), 1 / len(rows))
    return Body(matter.points[rows], weights / total if total > 0 else even)


def _axes(points: F64, weights: F64) -> F64:
    """(d, d): rows are the principal axes of weighted points (n, d), longest first."""
    centred = points - weights @ points
    axes = np.linalg.eigh((centred * weights[:, None]).T @ centred)[1].T[::-1]
    tails = weights @ (centred @ axes.T) ** 3
    signed: F64 = axes * np.where(tails < 0, -1.0, 1.0)[:, None]
    return signed


def _middle(matter: Matter) -> F64:
    """(3,) the geometric median by alpha (Weiszfeld, 1937): half of the matter may be astray."""
    rows = slice(None, None, -(-len(matter.points) // MEDIAN_SAMPLE))
    points, weights = matter.points[rows], matter.alphas[rows]
    middle: F64 = weights @ points / weights.sum()
    for _ in range(ROUNDS):
        distances = np.linalg.norm(points - middle, axis=1)
        least = 1e-3 * float(np.median(distances))  # one splat must not hold it fast
        if not least > 0:
            break
        pulls = weights / np.maximum(distances, least)
        middle = pulls @ points / pulls.sum()
    return middle

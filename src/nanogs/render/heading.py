"""A model's own frame: however it is turned, its cameras stand in the same places around it."""

from dataclasses import replace

import numpy as np

from nanogs._types import F64
from nanogs.render.occupancy import Matter, capped, quantiles
from nanogs.render.poses import level_frame

ROUNDS = 20  # of the geometric median; each brings it nearer by about half
REACH = 4.0  # median distances from the middle; beyond lie surroundings, skies and strays


def model_frame(matter: Matter, up: F64) -> F64:
    """(3, 3): rows are the direction in which the model is longest, the one beside it, and up.

    The first is level, and points where the longer tail of the area lies. Nothing here looks at
    coordinates one by one, so turning the model turns the frame with it; one that is the same all
    around has no heading of its own and gets any.

    Args:
        matter: The model.
        up: (3,) float64, unit.
    """
    distances = np.linalg.norm(matter.points - _middle(matter), axis=1)
    rows = np.flatnonzero(distances <= REACH * quantiles(distances, matter.alphas, 0.5)[0])
    weights = capped(matter.areas[rows])
    weights = weights / weights.sum() if weights.any() else np.full(len(rows), 1 / len(rows))
    basis = level_frame(up)
    level = matter.points[rows] @ basis[:2].T
    level -= weights @ level
    _, axes = np.linalg.eigh((level * weights[:, None]).T @ level)
    longest = axes[:, 1]
    if weights @ (level @ longest) ** 3 < 0:
        longest = -longest
    first = longest @ basis[:2]
    return np.stack([first, np.cross(up, first), up])


def seen_from(matter: Matter, frame: F64) -> Matter:
    """The model in the coordinates of a frame whose directions are rows."""
    return replace(matter, points=matter.points @ frame.T, arms=matter.arms @ frame.T)


def _middle(matter: Matter) -> F64:
    """(3,) the geometric median by alpha (Weiszfeld, 1937): half of the matter may be astray."""
    weights = matter.alphas
    middle: F64 = weights @ matter.points / weights.sum()
    for _ in range(ROUNDS):
        distances = np.linalg.norm(matter.points - middle, axis=1)
        least = 1e-3 * quantiles(distances, weights, 0.5)[0]  # one splat must not hold it fast
        if not least > 0:
            break
        pulls = weights / np.maximum(distances, least)
        middle = pulls @ matter.points / pulls.sum()
    return middle

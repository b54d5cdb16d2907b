"""A model's own frame: with it, cameras are placed alike around the model in any orientation.

No computation here depends on single coordinates, so turning the model turns its frame with it. A
rotationally symmetric model has no heading of its own and gets an arbitrary one.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from nanogs._types import F64
from nanogs.views.occupancy import SplatSample, capped, quantiles
from nanogs.views.poses import level_frame

MEDIAN_SAMPLE = 10_000  # most splats that the median is taken of
ROUNDS = 20  # iterations of the geometric median; each about halves the error
REACH = 4.0  # radius of the body in median distances; beyond are surroundings, skies and strays


class WeightedPoints(NamedTuple):
    """A model without strays and surroundings.

    Attributes:
        points: (n, 3) float64, scene units.
        weights: (n,) float64, their areas, normalised to a sum of 1.
    """

    points: F64
    weights: F64


def model_frame(body: WeightedPoints, up: F64) -> F64:
    """Return a (3, 3) frame: rows are the longest horizontal axis, the one beside it, and up.

    The first axis points to the side with the longer tail of the area.

    Args:
        body: The model.
        up: (3,) float64, unit.
    """
    points, weights = body
    basis = level_frame(up)
    longest = _axes(points @ basis[:2].T, weights)[0] @ basis[:2]
    return np.stack([longest, np.cross(up, longest), up])


def principal_frame(body: WeightedPoints) -> F64:
    """Return a (3, 3) frame: rows are the principal axes of the model, the longest first.

    The first two point to the side with the longer tail of the area, and the third makes the frame
    right-handed.

    Args:
        body: The model.
    """
    first, second, _ = _axes(*body)
    return np.stack([first, second, np.cross(first, second)])


def seen_from(sampled: SplatSample, frame: F64) -> SplatSample:
    """Transform the sample to a frame whose axes are the rows of `frame`."""
    return replace(sampled, points=sampled.points @ frame.T, arms=sampled.arms @ frame.T)


def without_surroundings(sampled: SplatSample) -> WeightedPoints:
    """Select the splats within a few median distances of the geometric median."""
    distances = np.linalg.norm(sampled.points - _middle(sampled), axis=1)
    rows = np.flatnonzero(distances <= REACH * quantiles(distances, sampled.alphas, 0.5)[0])
    weights = capped(sampled.areas[rows])
    total = weights.sum()
    even = np.full(len(rows), 1 / len(rows))
    return WeightedPoints(sampled.points[rows], weights / total if total > 0 else even)


def _axes(points: F64, weights: F64) -> F64:
    """Return (d, d) principal axes of weighted points (n, d) as rows, longest first."""
    centred = points - weights @ points
    axes = np.linalg.eigh((centred * weights[:, None]).T @ centred)[1].T[::-1]
    tails = weights @ (centred @ axes.T) ** 3
    signed: F64 = axes * np.where(tails < 0, -1.0, 1.0)[:, None]
    return signed


def _middle(sampled: SplatSample) -> F64:
    """Return the (3,) geometric median weighted by alpha (Weiszfeld, 1937).

    It is robust even if up to half of the weight are strays.
    """
    rows = slice(None, None, -(-len(sampled.points) // MEDIAN_SAMPLE))
    points, weights = sampled.points[rows], sampled.alphas[rows]
    middle: F64 = weights @ points / weights.sum()
    for _ in range(ROUNDS):
        distances = np.linalg.norm(points - middle, axis=1)
        least = 1e-3 * float(np.median(distances))  # or one splat could trap the iteration
        if not least > 0:
            break
        pulls = weights / np.maximum(distances, least)
        middle = pulls @ points / pulls.sum()
    return middle

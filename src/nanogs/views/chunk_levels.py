"""The level drawn of each chunk of a streamed SOG, by the rules of the PlayCanvas engine 2.23.

With its default settings, the distance of a chunk is that of its box, and boxes larger than usual
are shrunk (`lodDistanceShrink`); chunks behind the camera count as farther (`lodBehindPenalty`);
and all distances are scaled by the field of view. By distance alone level 1 is drawn from 5 units
on, and each further level from three times the distance of the one before (`switches`). With a
budget all these switching distances are multiplied by one number, which gives the finest levels
that keep the splats of all chunks together within the budget. (The engine reserves a little of it
for texture rows that splats do not fill; this module does not. An environment is not counted.)
"""

import numpy as np

from nanogs._types import F64, I64
from nanogs.raster.camera import Camera
from nanogs.switches import BASE_DISTANCE, HALF_FIELD, MULTIPLIER

NOTHING = -1  # no level of a chunk is drawn: the level for that distance has no splats in it
_SHRINK = 0.75  # share of a side's excess over the usual length that is removed
_BEHIND = 1.5  # factor of the distance for a chunk straight behind the camera
_LEAST = 1e-6  # least distance, scene units, for the logarithm


def chunk_distances(boxes: F64, camera: Camera) -> F64:
    """Compute the (C,) float64 effective distance of each chunk from the camera, scene units.

    Args:
        boxes: (C, 2, 3), the lowest and the highest corner of each chunk, scene units.
        camera: The camera.
    """
    halves = (boxes[:, 1] - boxes[:, 0]) / 2
    usual = np.sort(halves, axis=0)[len(halves) // 2]
    less = _SHRINK * np.maximum(halves - usual, 0)
    nearest = np.clip(camera.position, boxes[:, 0] + less, boxes[:, 1] - less)
    towards = nearest - camera.position
    distances = np.linalg.norm(towards, axis=1)
    along = towards @ camera.world_to_camera[2, :3] / np.maximum(distances, _LEAST)
    behind = 1 + (_BEHIND - 1) * np.maximum(-along, 0)
    field = min(camera.width / camera.fx, camera.height / camera.fy) / 2
    found: F64 = distances * behind * (field / HALF_FIELD)
    return found


def chosen_levels(distances: F64, counts: I64, budget: int | None = None) -> I64:
    """Choose the (C,) int64 level that is drawn of each chunk, or `NOTHING`.

    Args:
        distances: (C,) from `chunk_distances`, scene units.
        counts: (C, L) number of splats of each chunk in each level.
        budget: Most splats of all chunks together; levels are as fine as that allows, and the
            coarsest ones are drawn even if they exceed it. None to choose by distance alone.
    """
    bands = _bands(counts)
    each = np.where(bands == NOTHING, 0, np.take_along_axis(counts, np.maximum(bands, 0), axis=1))
    levels = np.arange(1, counts.shape[1])
    # Logarithm of a chunk's distance over the switching distance of each level.
    passed = np.log(np.maximum(distances, _LEAST) / BASE_DISTANCE)[:, None]
    passed = passed - (levels - 1) * np.log(MULTIPLIER)
    cut = 0.0 if budget is None else _cut(passed, each, budget)
    band = (passed >= cut).sum(axis=1)
    found: I64 = np.take_along_axis(bands, band[:, None], axis=1)[:, 0]
    return found


def _bands(counts: I64) -> I64:
    """Return the (C, L) int64 level to draw in place of each level, which may have no splats.

    An empty level is replaced by the next finer one that has splats, or else by the next coarser
    one; a level coarser than all that have splats is replaced by `NOTHING`.
    """
    levels = np.arange(counts.shape[1])
    some = counts > 0
    finer = np.maximum.accumulate(np.where(some, levels, NOTHING), axis=1)
    coarser = np.minimum.accumulate(np.where(some, levels, len(levels))[:, ::-1], axis=1)[:, ::-1]
    found: I64 = np.where(finer > NOTHING, finer, coarser)
    found[coarser == len(levels)] = NOTHING
    return found


def _cut(passed: F64, counts: I64, budget: int) -> float:
    """Find the threshold on `passed`, above which a level is drawn, that meets a budget.

    Starts from the coarsest level of every chunk, and refines the nearest chunks first.

    Args:
        passed: (C, L - 1) logarithm of each chunk's distance over a level's switching distance.
        counts: (C, L) number of splats that are drawn for each level.
        budget: See `chosen_levels`.
    """
    total = int(counts[:, -1].sum())
    if total >= budget:
        return -np.inf
    order = np.argsort(passed, axis=None, kind="stable")
    steps, added = passed.ravel()[order], (counts[:, :-1] - counts[:, 1:]).ravel()[order]
    for first, more in zip(steps, total + np.cumsum(added), strict=True):
        if more > budget:
            return float(first)
    return np.inf

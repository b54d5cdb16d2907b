"""Which level is drawn of each chunk of a streamed SOG, as the PlayCanvas engine 2.23 chooses.

Facts of its default settings: chunks are as far away as their boxes, of which those larger than
usual are shrunk (`lodDistanceShrink`); those behind the camera count as farther
(`lodBehindPenalty`); and all as nearer or farther by the field of view. By distance alone level 1
comes at 5 units, and each further one three times as far (`switches`). With a budget all these
distances are multiplied by one number: the finest levels for which all chunks together have no more
splats than that. (It keeps a little back for rows of its textures that splats do not fill; here
none is. An environment is not counted.)
"""

import numpy as np

from nanogs._types import F64, I64
from nanogs.raster.camera import Camera
from nanogs.switches import BASE_DISTANCE, HALF_FIELD, MULTIPLIER

NOTHING = -1  # where no level of a chunk is drawn: from so far away it has no splats left
_SHRINK = 0.75  # of what a side is longer than usual
_BEHIND = 1.5  # times as far is what lies straight behind the camera
_LEAST = 1e-6  # scene units, for the logarithm


def chunk_distances(boxes: F64, camera: Camera) -> F64:
    """(C,) float64: how far away each chunk counts as, scene units.

    Args:
        boxes: (C, 2, 3), the lowest and the highest corner of each, scene units.
        camera: Where to look from.
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
    """(C,) int64: the level of each chunk that is drawn, or `NOTHING`.

    Args:
        distances: (C,) as `chunk_distances` gives them, scene units.
        counts: (C, L) splats of each chunk in each level.
        budget: Splats that all chunks may have together; levels are as fine as that allows, but for
            what the coarsest ones have at least. None for levels by distance alone.
    """
    bands = _bands(counts)
    each = np.where(bands == NOTHING, 0, np.take_along_axis(counts, np.maximum(bands, 0), axis=1))
    levels = np.arange(1, counts.shape[1])
    # How many times as far as where a level comes its chunk is; the coarser, the less.
    passed = np.log(np.maximum(distances, _LEAST) / BASE_DISTANCE)[:, None]
    passed = passed - (levels - 1) * np.log(MULTIPLIER)
    cut = 0.0 if budget is None else _cut(passed, each, budget)
    band = (passed >= cut).sum(axis=1)
    found: I64 = np.take_along_axis(bands, band[:, None], axis=1)[:, 0]
    return found


def _bands(counts: I64) -> I64:
    """(C, L) int64: what is drawn of a chunk where a level is due, of which it may have no splats.

    In place of one in between the next finer one is drawn that has some, or else the next coarser
    one; in place of one coarser than all that have some, nothing.
    """
    levels = np.arange(counts.shape[1])
    some = counts > 0
    finer = np.maximum.accumulate(np.where(some, levels, NOTHING), axis=1)
    coarser = np.minimum.accumulate(np.where(some, levels, len(levels))[:, ::-1], axis=1)[:, ::-1]
    found: I64 = np.where(finer > NOTHING, finer, coarser)
    found[coarser == len(levels)] = NOTHING
    return found


def _cut(passed: F64, counts: I64, budget: int) -> float:
    """The number by which logarithms of distances are compared, for a budget.

    From the coarsest level of every chunk on, the nearest are refined first.

    Args:
        passed: (C, L - 1) how far each chunk is beyond where a level comes, as a logarithm.
        counts: (C, L) splats that are drawn where a level is due.
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

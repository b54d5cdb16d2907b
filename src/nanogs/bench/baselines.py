"""Simple baseline methods for comparison.

Each takes a model, a count and a context, and returns exactly that number of splats. Results are
deterministic, and splats that hold a NaN or an infinite value are never chosen.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from nanogs._types import F64, I64
from nanogs.bench.significance import significance
from nanogs.bench.voxel import merge_voxels
from nanogs.errors import ModelError, OptionError
from nanogs.formatting import counted
from nanogs.raster.camera import Camera
from nanogs.splats import Splats


@dataclass(frozen=True, slots=True)
class MethodContext:
    """The inputs of a method other than the model and the count.

    Attributes:
        cameras: Views to learn from, none of which is scored.
        seed: Seed of the random numbers.
        trained: Whether `cameras` are those of the training photographs. If so, presets use them
            too; otherwise presets find views of their own.
    """

    cameras: tuple[Camera, ...] = ()
    seed: int = 0
    trained: bool = False


Method = Callable[[Splats, int, MethodContext], Splats]


def random(splats: Splats, count: int, context: MethodContext) -> Splats:
    """Choose splats uniformly at random; rows stay in order.

    Args:
        splats: N splats.
        count: Splats to deliver.
        context: Its seed is used.

    Raises:
        OptionError: The count is below 1.
        ModelError: Fewer splats than the count are finite.
    """
    rows = _usable(splats, count)
    drawn = np.random.default_rng(context.seed).choice(rows, count, replace=False)
    return splats.take(np.sort(drawn))


def opacity(splats: Splats, count: int, context: MethodContext) -> Splats:  # noqa: ARG001
    """Choose the splats of highest opacity, ties by row; rows stay in order.

    Args:
        splats: N splats.
        count: Splats to deliver.
        context: Not used.

    Raises:
        OptionError: The count is below 1.
        ModelError: Fewer splats than the count are finite.
    """
    rows = _usable(splats, count)
    return splats.take(highest(splats.opacities()[rows], rows, count))


def light_significance(splats: Splats, count: int, context: MethodContext) -> Splats:
    """Choose the splats of highest global significance in the context's views, ties by row.

    Args:
        splats: N splats.
        count: Splats to deliver.
        context: Its cameras are used.

    Raises:
        OptionError: The count is below 1, or the context has no camera.
        ModelError: Fewer splats than the count are finite.
    """
    rows = _usable(splats, count)
    return splats.take(highest(significance(splats, context.cameras)[rows], rows, count))


def voxel(splats: Splats, count: int, context: MethodContext) -> Splats:  # noqa: ARG001
    """Merge splats by the cells of a grid into one each; see `nanogs.bench.voxel`.

    Args:
        splats: N splats.
        count: Splats to deliver.
        context: Not used.

    Raises:
        OptionError: The count is below 1.
        ModelError: Fewer splats than the count are finite.
    """
    return merge_voxels(splats, _usable(splats, count), count)


BASELINES: Mapping[str, Method] = {
    "random": random,
    "opacity": opacity,
    "significance": light_significance,
    "voxel": voxel,
}


def highest(scores: F64, rows: I64, count: int) -> I64:
    """Return (count,) int64: the rows of highest score, ties by row, in ascending order.

    Args:
        scores: (M,) float64, no NaN.
        rows: (M,) int64, ascending.
        count: Rows to choose, at most M.
    """
    best = np.argsort(-scores, kind="stable")[:count]
    return np.sort(rows[best])


def _usable(splats: Splats, count: int) -> I64:
    """Return the (M,) int64 rows of finite splats, after checking that M is at least the count."""
    rows = np.flatnonzero(splats.finite())
    if count < 1:
        raise OptionError(f"The count must be at least 1, not {count}.")
    if count > len(rows):
        finite = counted(len(rows), "splat is", "splats are")
        raise ModelError(f"Only {finite} finite, fewer than the count {count:,}.")
    return rows

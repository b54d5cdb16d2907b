"""Methods to compare with: simple ones that everybody would try first.

Each takes a model, a count and a context, and delivers exactly that count, the same every time,
without ever choosing a splat that holds a NaN or an infinite value.
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
    """The knowledge that a method may have beside the model.

    Attributes:
        cameras: Views to learn from, none of which is scored.
        seed: Seed of whatever is drawn.
        trained: Whether these are those of the training photographs; presets look from there too,
            and else from views of their own.
    """

    cameras: tuple[Camera, ...] = ()
    seed: int = 0
    trained: bool = False


Method = Callable[[Splats, int, MethodContext], Splats]


def random(splats: Splats, count: int, context: MethodContext) -> Splats:
    """Splats drawn at random, each with the same chance; rows stay in order.

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
    """The splats of highest alpha, ties by row; rows stay in order.

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
    """The splats of highest global significance in the context's views, ties by row.

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
    """One splat for each occupied cell of a grid; see `nanogs.bench.voxel`.

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
    """(count,) int64: the rows of highest score, ties by row, in ascending order.

    Args:
        scores: (M,) float64, no NaN.
        rows: (M,) int64, ascending.
        count: Rows to choose, at most M.
    """
    best = np.argsort(-scores, kind="stable")[:count]
    return np.sort(rows[best])


def _usable(splats: Splats, count: int) -> I64:
    """(M,) int64: finite rows, at least as many as the count."""
    rows = np.flatnonzero(splats.finite())
    if count < 1:
        raise OptionError(f"The count must be at least 1, not {count}.")
    if count > len(rows):
        finite = counted(len(rows), "splat is", "splats are")
        raise ModelError(f"Only {finite} finite, fewer than the count {count:,}.")
    return rows

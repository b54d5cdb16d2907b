"""Computation of the cost of drawing a model, summed over blocks of rows in any order."""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from nanogs._types import I32, I64
from nanogs.costs import LARGEST, DrawCost
from nanogs.kernels.covering import cover_tiles
from nanogs.kernels.listing import list_tiles
from nanogs.kernels.project import HIDDEN
from nanogs.progress import PartProgress, ignore_progress
from nanogs.protocol import Protocol
from nanogs.raster.camera import Camera
from nanogs.raster.rendering import prepare, project_rows
from nanogs.source import Source, source_of
from nanogs.splats import Splats
from nanogs.views.streamed import DRAWN_ROWS

SHARE = 0.99  # quantile of the pixels for `DrawCost.most_a_pixel`


def cost_on(
    model: Splats | Source,
    cameras: Sequence[Camera],
    protocol: Protocol,
    on_progress: PartProgress = ignore_progress,
) -> DrawCost:
    """Measure the cost of drawing views; the same for a source and for a model in memory.

    Holds a block of rows, and four bytes for each pixel of all views.

    Args:
        model: The model.
        cameras: The views, one or more.
        protocol: Protocol of the views, for the report.
        on_progress: Progress callback for the rows.

    Raises:
        FormatError: The source cannot be read.
        OptionError: A camera is invalid.
    """
    source = source_of(model)
    counts: list[I32] = [np.zeros((each.height, each.width), np.int32) for each in cameras]
    sizes: Counter[int] = Counter()  # splats by their tile pairs in all views together
    drawn, most = 0, source.count
    for start in range(0, most, DRAWN_ROWS):
        on_progress(start, most)
        block = prepare(source.read(start, min(start + DRAWN_ROWS, most)))
        pairs = np.zeros(len(block), np.int64)
        for camera, covered in zip(cameras, counts, strict=True):
            geometry, _, boxes = project_rows(block, camera, sh_degree=0)
            order = np.flatnonzero(boxes != HIDDEN)
            starts, entries = list_tiles(geometry, boxes, order, camera.width, camera.height)
            cover_tiles(geometry, starts, entries, covered)
            pairs += np.bincount(entries, minlength=len(block))
            drawn += len(order)
        values, times = np.unique(pairs, return_counts=True)
        sizes.update(dict(zip(values.tolist(), times.tolist(), strict=True)))
    on_progress(most, most)
    mean, high = _pixels(counts)
    total = sum(size * times for size, times in sizes.items())
    return DrawCost(
        splats_a_pixel=mean,
        most_a_pixel=high,
        tile_pairs=total / len(cameras),
        largest_share=_largest(sizes, most) / total if total else 0.0,
        drawn=drawn / len(cameras),
        protocol=protocol,
    )


def _pixels(counts: Sequence[I32]) -> tuple[float, int]:
    """Return the mean of the counts of all pixels, and their 99th percentile."""
    seen: I64 = np.zeros(max(int(each.max()) for each in counts) + 1, np.int64)
    for each in counts:
        seen += np.bincount(each.reshape(-1), minlength=len(seen))
    pixels = int(seen.sum())
    high = int(np.searchsorted(np.cumsum(seen), SHARE * pixels))
    return float(seen @ np.arange(len(seen))) / pixels, high


def _largest(sizes: Counter[int], splats: int) -> int:
    """Return the tile pairs of the largest hundredth of the splats, at least of one splat.

    Args:
        sizes: Number of splats by their number of tile pairs.
        splats: Number of splats of the model.
    """
    left, pairs = -int(-splats * LARGEST // 1), 0
    for size in sorted(sizes, reverse=True):
        taken = min(sizes[size], left)
        pairs, left = pairs + taken * size, left - taken
    return pairs

"""Boxes around splats, along the axes of the scene."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from nanogs._types import F64
from nanogs.io.files import BLOCK_ROWS
from nanogs.splats import Splats
from nanogs.stored import rotations


@dataclass(frozen=True, slots=True, eq=False)
class Box:
    """A box between two corners, each (3,) float64, scene units."""

    low: F64
    high: F64


def box_around(splats: Splats, deviations: float) -> Box:
    """The smallest box around the ellipsoids of so many standard deviations.

    Args:
        splats: N splats, N at least 1, all finite.
        deviations: Half the length of an ellipsoid's axes over the standard deviations there.
    """
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for start in range(0, len(splats), BLOCK_ROWS):
        rows = np.arange(start, min(start + BLOCK_ROWS, len(splats)))
        block = splats.take(rows)
        # The covariance's diagonal: the square of half the ellipsoid's width along each axis.
        axes = rotations(block.unit_quats().astype(np.float64)) * block.scales()[:, None, :]
        reach = deviations * np.sqrt((axes**2).sum(axis=2))
        low = np.minimum(low, (block.means - reach).min(axis=0))
        high = np.maximum(high, (block.means + reach).max(axis=0))
    return Box(low, high)


def union(boxes: Iterable[Box]) -> Box:
    """The smallest box around some, at least one."""
    every = list(boxes)
    low = np.min([box.low for box in every], axis=0)
    high = np.max([box.high for box in every], axis=0)
    return Box(low, high)

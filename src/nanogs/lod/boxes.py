"""Boxes around splats, along the axes of the scene.

A box is (2, 3) float64: its lowest and its highest corner, scene units.
"""

from collections.abc import Iterable

import numpy as np

from nanogs._types import F64
from nanogs.io.files import BLOCK_ROWS
from nanogs.splats import Splats
from nanogs.stored import rotations


def box_around(splats: Splats, deviations: float) -> F64:
    """The smallest box around the ellipsoids of so many standard deviations.

    Args:
        splats: N splats, N at least 1, all finite.
        deviations: Half the length of an ellipsoid's axes over the standard deviations there.
    """
    boxes = []
    for start in range(0, len(splats), BLOCK_ROWS):
        rows = np.arange(start, min(start + BLOCK_ROWS, len(splats)))
        block = splats.take(rows)
        # The covariance's diagonal: the square of half the ellipsoid's width along each axis.
        axes = rotations(block.unit_quats().astype(np.float64)) * block.scales()[:, None, :]
        reach = deviations * np.sqrt((axes**2).sum(axis=2))
        boxes.append(
            np.stack([(block.means - reach).min(axis=0), (block.means + reach).max(axis=0)])
        )
    return union(boxes)


def union(boxes: Iterable[F64]) -> F64:
    """The smallest box around some, at least one."""
    every = np.stack(list(boxes))
    return np.stack([every[:, 0].min(axis=0), every[:, 1].max(axis=0)])

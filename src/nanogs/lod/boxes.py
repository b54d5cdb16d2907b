"""Axis-aligned bounding boxes of splats.

A box is (2, 3) float64: its lowest and its highest corner, scene units.
"""

from collections.abc import Iterable

import numpy as np

from nanogs import parallel
from nanogs._types import F64
from nanogs.activations import rotations
from nanogs.slices import BLOCK_ROWS, slices
from nanogs.splats import Splats


def box_around(splats: Splats, deviations: float) -> F64:
    """Return the smallest box around the ellipsoids of N splats.

    Args:
        splats: N splats, N at least 1, all finite.
        deviations: Semi-axes of the ellipsoids, in standard deviations.
    """

    def around(rows: slice) -> F64:
        block = splats.take(rows)
        # The covariance's diagonal has the squared half-width of the ellipsoid along each axis.
        axes = rotations(block.unit_quats().astype(np.float64)) * block.scales()[:, None, :]
        reach = deviations * np.sqrt((axes**2).sum(axis=2))
        return np.stack([(block.means - reach).min(axis=0), (block.means + reach).max(axis=0)])

    return union(parallel.map_ordered(slices(len(splats), BLOCK_ROWS), around))


def union(boxes: Iterable[F64]) -> F64:
    """Return the smallest box around one or more boxes."""
    every = np.stack(list(boxes))
    return np.stack([every[:, 0].min(axis=0), every[:, 1].max(axis=0)])

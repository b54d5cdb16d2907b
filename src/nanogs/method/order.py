"""Morton order of the centres, which keeps spatial neighbours close in memory (Morton 1966)."""

import numpy as np

from nanogs import parallel
from nanogs._types import F64, I64, U64
from nanogs.morton import interleaved_bits
from nanogs.slices import SLICE_STEPS, slices
from nanogs.sorting import stable_order

_BITS = 21  # three axes in 63 bits
_TAIL = 0.01  # share of the centres on either side that does not set the size of the cells


def morton_codes(means: F64) -> U64:
    """Compute the (N,) uint64 Morton codes: interleaved bits of the centres' cubic cells.

    The cells divide a box three times as wide as the central 98 % of the centres; centres outside
    are clamped to its border cells. So a few splats far away do not make the cells so large that
    all others share one.

    Args:
        means: (N, 3) finite, scene units.
    """
    return codes_in(means, *code_box(means))


def code_box(means: F64) -> tuple[F64, float]:
    """Return the box of `morton_codes`: its lowest corner (3,) and its width, scene units.

    Args:
        means: (N, 3) finite, scene units.
    """
    low, high = _quantiles(means, (_TAIL, 1 - _TAIL))
    if not (high > low).any():
        low, high = means.min(axis=0), means.max(axis=0)
    width = float((high - low).max())
    return low - width, 3 * width


def _quantiles(means: F64, shares: tuple[float, ...]) -> F64:
    """Compute (S, 3) float64 quantiles along each axis, bit for bit those of `np.quantile`.

    Needs at least one row and shares below 1. Uses a thread for each axis; a single call of
    `np.quantile` would use only one.
    """
    found = np.empty((len(shares), 3))
    places = [(len(means) - 1) * share for share in shares]
    starts = [int(place) for place in places]
    needed = [rank for start in starts for rank in (start, start + 1) if rank < len(means)]

    def find(axis: int) -> None:
        column = np.partition(means[:, axis], needed)
        for row, (start, place) in enumerate(zip(starts, places, strict=True)):
            found[row, axis] = np.quantile(column[start : start + 2], place - start)

    parallel.for_each(range(3), find)
    return found


def codes_in(means: F64, low: F64, width: float) -> U64:
    """Compute the (N,) uint64 Morton codes in a given box; centres outside are clamped to it.

    Args:
        means: (N, 3) finite, scene units.
        low: (3,) lowest corner, scene units.
        width: Width of the box, scene units; 0 for a point.
    """
    codes: U64 = np.zeros(len(means), dtype=np.uint64)
    if width == 0:
        return codes

    def encode(part: slice) -> None:
        for axis in range(3):
            cells = (means[part, axis] - low[axis]) * ((1 << _BITS) / width)
            cells = np.clip(cells, 0, (1 << _BITS) - 1, out=cells)
            codes[part] |= interleaved_bits(cells.astype(np.uint64), axis)

    parallel.for_each(slices(len(means), SLICE_STEPS), encode)
    return codes


def morton_order(means: F64) -> I64:
    """Return the (N,) int64 rows in Morton order, ties by row.

    Args:
        means: (N, 3) finite, scene units.
    """
    return stable_order(morton_codes(means))

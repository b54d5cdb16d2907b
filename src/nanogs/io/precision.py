"""The precision of quantised values in packed files, balanced between the kinds of values.

One bit less saves an eighth of a byte per splat for every kind of value, but the loss on rendered
views differs much. At equal loss alphas need most steps, then scales, rotations and colours;
centres need more the smaller the splats are.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from nanogs import parallel
from nanogs._types import F64
from nanogs.averages import capped_mean
from nanogs.slices import slices
from nanogs.splats import Splats

FEWEST_BITS, MOST_BITS = 4, 8
MOST_SPARE_BITS = 6  # of the 16 bits of a centre, how many may be dropped at most
_SHARE_OF_SIZE = 0.02  # largest step of centres at 8 bits, relative to the splats' middle axis
_AREA_POWER = 0.75
_LEAST_SIZE = 1e-150  # added to scales, so that neither they nor their squares are zero
_CODES = 256
_AREA_BINS = 2048  # bins of the logarithm to base 2 of areas
_LARGE = 7  # bins above the median from which on the area of a splat counts no more
_VISIBILITY = (1e-3, 1e3)  # smallest and largest weight of a splat, relative to the mean


@dataclass(frozen=True, slots=True)
class Precision:
    """The precision with which each kind of value is quantised.

    Attributes:
        bits: Bits of a component of a rotation, 4 to 8, from which all else follows.
        spare: Bits that are dropped from centres, 0 to 6; None to compute them by `spare_bits`.
    """

    bits: int
    spare: int | None = None

    @property
    def rotation_step(self) -> int:
        """Step between the codes of a component of a rotation that are in use, of 256 codes."""
        return 1 << (MOST_BITS - self.bits)

    @property
    def scale_codes(self) -> int:
        """Number of distinct log-scales: half a bit more than for rotations."""
        return min(_CODES, 3 << (self.bits - 1))

    @property
    def colour_codes(self) -> int:
        """Number of distinct base colours per channel: half a bit less than for rotations."""
        return 3 << (self.bits - 2)

    @property
    def alpha_steps(self) -> int:
        """Number of steps from alpha 0 to 1: a bit more than for rotations.

        A ray passes many splats, so that errors of alphas add up.
        """
        return min(_CODES, 2 << self.bits) - 1

    def spare_bits(self, blocks: Iterable[Splats], steps: Callable[[Splats], F64]) -> int:
        """Compute how many bits to drop from centres: by default more, the larger the splats.

        Args:
            blocks: All splats, in blocks.
            steps: Computes the quantisation step at the centres of R splats, (R, 3) or (1, 1).
        """
        if self.spare is not None:
            return self.spare
        sums = _SumsByArea()
        for block in blocks:
            middle, largest = _larger_scales(block)
            middle, largest = middle + _LEAST_SIZE, largest + _LEAST_SIZE
            with np.errstate(over="ignore"):
                shares = np.minimum(((steps(block) / middle[:, None]) ** 2).mean(axis=1), 1)
            sums.add(middle * largest, block.opacities(), shares)
        share = math.sqrt(sums.mean())
        allowed = _SHARE_OF_SIZE * (1 << (MOST_BITS - self.bits))
        spare = math.floor(math.log2(allowed / max(share, allowed / 2**MOST_SPARE_BITS)))
        return max(spare, 0)


FINEST = Precision(MOST_BITS)


class _SumsByArea:
    """Sums over splats in bins of their area, for a mean weighted by what is seen of them.

    What is seen of a splat is its opacity times its area, which counts up to about 2^`_LARGE`
    medians: splats of a sky are seen from far away, and would outweigh all others.
    """

    def __init__(self) -> None:
        # Numbers of splats; sums of opacities, of these times shares, and both times areas.
        self._bins = np.zeros((5, _AREA_BINS))

    def add(self, areas: F64, opacities: F64, shares: F64) -> None:
        """Add splats: (R,) areas above 0, opacities, and the values to be averaged."""
        places = np.clip(np.log2(areas) + _AREA_BINS // 2, 0, _AREA_BINS - 1).astype(np.int64)
        moved = opacities * shares
        columns = np.ones(len(areas)), opacities, moved, opacities * areas, moved * areas
        for number, values in enumerate(columns):
            self._bins[number] += np.bincount(places, values, _AREA_BINS)

    def mean(self) -> float:
        """Return the weighted mean of the shares; 0 if nothing is seen."""
        numbers, plain, plain_moved, seen, moved = self._bins
        median = int(np.searchsorted(np.cumsum(numbers), numbers.sum() / 2))
        large = min(median + _LARGE, _AREA_BINS - 1)
        area = 2.0 ** (large - _AREA_BINS // 2)
        counted = float(seen[:large].sum() + area * plain[large:].sum())
        total = float(moved[:large].sum() + area * plain_moved[large:].sum())
        return total / counted if counted else 0.0


def visibility(splats: Splats) -> F64:
    """Estimate the weight of a colour error of each splat on rendered views, (N,), clamped.

    Squared errors grow with alpha squared and with the area; large splats are partly hidden, hence
    a power of the area below 1. With these weights, the PSNR of views is several dB higher than
    with equal weights, and 0.1 to 1.3 dB higher than with alpha times area.
    """
    mass = np.empty(len(splats))

    def weigh(rows: slice) -> None:
        some = splats.span(rows.start, rows.stop)
        middle, largest = _larger_scales(some)
        mass[rows] = some.opacities() ** 2 * (middle * largest) ** _AREA_POWER

    parallel.for_each(slices(len(splats)), weigh)
    # So that a few splats of a sky, which are as large as far away, do not make all others equal.
    typical = capped_mean(mass, mass, _VISIBILITY[1]) or 1.0
    return np.clip(mass / typical, *_VISIBILITY)


def _larger_scales(splats: Splats) -> tuple[F64, F64]:
    """Return the middle and the largest scale of each splat, (N,) each."""
    a, b, c = splats.scales().T.astype(np.float64)
    least, most = np.minimum(a, b), np.maximum(a, b)
    return np.maximum(least, np.minimum(most, c)), np.maximum(most, c)

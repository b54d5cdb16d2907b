"""Curves of file size and PSNR over the count, from measured results, to estimate counts."""

import math
from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from nanogs.pipeline.options.target import Goal

RATIOS = (0.05, 0.01, 0.2, 0.5, 0.1, 0.02)  # measured in this order while there are no requests
_GUESS = 0.1  # share of the splats to begin with for a PSNR, if nothing was measured
# Slope of the PSNR, in dB for e times the splats: a typical value of real scenes, and the limits
# for extrapolation, because two results with nearly equal counts could give any slope.
_SLOPE, _FLATTEST, _STEEPEST = 3.5, 1.0, 8.0


@dataclass(frozen=True, slots=True)
class Point:
    """A measured result.

    Attributes:
        count: Number of splats.
        bytes: Bytes of the file.
        psnr: PSNR in dB as `nanogs compare` reports it; infinite if it equals the model.
        coarse: Whether it is a plain cut, which looks a little worse than a full result.
    """

    count: int
    bytes: int
    psnr: float
    coarse: bool


@dataclass(slots=True)
class Curve:
    """The measured sizes and scores of the results of one model, preset and format.

    Attributes:
        available: Number of splats of the model.
        fewest: The smallest count that can be delivered.
        each: Computes the bytes of a file from its count, exactly or approximately.
        exact: Whether `each` is exact.
        points: Measured results, keyed by count and whether they are coarse.
    """

    available: int
    fewest: int
    each: Callable[[int], int]
    exact: bool
    points: dict[tuple[int, bool], Point] = field(default_factory=dict)

    def add(self, point: Point) -> None:
        """Add a measured result."""
        self.points[point.count, point.coarse] = point

    def missing(self) -> int | None:
        """Return the next count to measure while there are no requests; None if all are."""
        for ratio in RATIOS:
            count = max(math.ceil(ratio * self.available), self.fewest)
            if (count, True) not in self.points:
                return count
        return None

    def count_for(self, goal: Goal) -> int:
        """Estimate the count that meets a goal."""
        if goal.count is not None:
            return goal.count
        if goal.size is not None:
            size = goal.size
            return self._last(lambda count: self.bytes_of(count) <= size)
        wanted = goal.psnr or 0.0
        if self.psnr_of(self.available) is None:
            return self._within(_GUESS * self.available)
        return self._last(lambda count: (self.psnr_of(count) or 0.0) <= wanted)

    def bytes_of(self, count: int) -> int:
        """Estimate the bytes of a file from its count; they never fall where the count grows.

        Sizes are interpolated between measured ones; outside, `each` is scaled to the nearest.
        """
        known = {point.count: max(point.bytes, 1) for point in list(self.points.values())}
        if self.exact or not known:
            return self.each(count)
        counts = sorted(known)
        sizes = np.maximum.accumulate([known[each] for each in counts])
        inside = min(max(count, counts[0]), counts[-1])
        size = math.exp(_between(inside, counts, np.log(sizes).tolist()))
        return round(size * (self.each(count) / max(self.each(inside), 1)))

    def psnr_of(self, count: int) -> float | None:
        """Estimate the PSNR in dB of a result from its count; None if nothing was measured.

        Plain cuts give the shape of the curve, and measured full results an offset. Infinite PSNRs,
        such as that of all splats, are ignored: they give no information about smaller results.
        """
        finite = [point for point in list(self.points.values()) if math.isfinite(point.psnr)]
        coarse = {point.count: point.psnr for point in finite if point.coarse}
        fine = {point.count: point.psnr for point in finite if not point.coarse}
        base = coarse or fine
        if not base:
            return None
        counts = sorted(base)
        marks = np.maximum.accumulate([base[each] for each in counts])
        about = _between(count, counts, marks.tolist(), beyond=True)
        if not coarse or not fine:
            return about
        known = sorted(fine)
        gains = [fine[each] - _between(each, counts, marks.tolist(), beyond=True) for each in known]
        return about + _between(count, known, gains)

    def _last(self, holds: Callable[[int], bool]) -> int:
        """Find by bisection the largest count for which a monotonic condition still holds."""
        count = bisect_left(range(1, self.available + 1), True, key=lambda n: not holds(n))
        return self._within(count)

    def _within(self, count: float) -> int:
        return min(max(int(count), self.fewest, 1), self.available)


def _between(
    count: int, counts: Sequence[int], values: Sequence[float], *, beyond: bool = False
) -> float:
    """Interpolate linearly over the logarithm of the count; outside, the nearest value is taken.

    Args:
        count: The count to evaluate at.
        counts: Counts of the known values, ascending.
        values: The known values.
        beyond: Extrapolate instead, with the slope at that end, within limits.
    """
    at, known = math.log(count), [math.log(each) for each in counts]
    if not beyond or known[0] <= at <= known[-1]:
        return float(np.interp(at, known, values))
    end, other = (0, 1) if at < known[0] else (-1, -2)
    slope = _SLOPE
    if len(known) > 1:
        slope = (values[end] - values[other]) / (known[end] - known[other])
    return values[end] + min(max(slope, _FLATTEST), _STEEPEST) * (at - known[end])

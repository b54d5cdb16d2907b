"""Size and PSNR over the count, from what was measured: which count a wish comes to, about."""

import math
from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from nanogs.pipeline.target import Goal

RATIOS = (0.05, 0.01, 0.2, 0.5, 0.1, 0.02)  # which are measured while nobody asks, in this order
_GUESS = 0.1  # of the splats, for a PSNR of which nothing is known
# dB for e times the splats: what real scenes have, and the least and most that is gone on with
# beyond what was measured, where two results that lie close would say anything.
_SLOPE, _FLATTEST, _STEEPEST = 3.5, 1.0, 8.0


@dataclass(frozen=True, slots=True)
class Point:
    """A result that was measured.

    Attributes:
        count: Splats.
        bytes: Of the file.
        psnr: As `nanogs compare` says it, dB; infinite where it equals the model.
        coarse: Whether it is a plain cut, which looks a little worse than what is delivered.
    """

    count: int
    bytes: int
    psnr: float
    coarse: bool


@dataclass(slots=True)
class Curve:
    """Sizes and scores known of the results of one model, preset and format.

    Attributes:
        available: Splats of the model.
        fewest: The least count that can be had.
        each: Bytes of a file of so many splats, about or exactly.
        exact: Whether `each` is exact.
        points: What was measured, by count and whether it is coarse.
    """

    available: int
    fewest: int
    each: Callable[[int], int]
    exact: bool
    points: dict[tuple[int, bool], Point] = field(default_factory=dict)

    def add(self, point: Point) -> None:
        """Learn of a result."""
        self.points[point.count, point.coarse] = point

    def missing(self) -> int | None:
        """The next count to measure while nobody asks; None where all are."""
        for ratio in RATIOS:
            count = max(math.ceil(ratio * self.available), self.fewest)
            if (count, True) not in self.points:
                return count
        return None

    def count_for(self, goal: Goal) -> int:
        """The count that a wish comes to, as far as is known."""
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
        """Bytes of a file of so many splats, about; never fewer for more."""
        known = {point.count: point.bytes for point in list(self.points.values())}
        if self.exact or not known:
            return self.each(count)
        counts = sorted(known)
        factors = [known[each] / max(self.each(each), 1) for each in counts]
        return round(self.each(count) * _between(count, counts, factors))

    def psnr_of(self, count: int) -> float | None:
        """PSNR of a result of so many splats, about, dB; None where nothing is known.

        Plain cuts give the shape; what was measured of delivered results lifts it. A result that
        equals the model, as that of all its splats does, says nothing of smaller ones.
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
        """The largest count of which something holds that stops to hold somewhere."""
        count = bisect_left(range(1, self.available + 1), True, key=lambda n: not holds(n))
        return self._within(count)

    def _within(self, count: float) -> int:
        return min(max(int(count), self.fewest, 1), self.available)


def _between(
    count: int, counts: Sequence[int], values: Sequence[float], *, beyond: bool = False
) -> float:
    """The value at a count: in between linear in its logarithm, else that of the nearest.

    Args:
        count: Where.
        counts: Where values are known, ascending.
        values: These.
        beyond: Go on about as steeply as between the two values at that end.
    """
    at, known = math.log(count), [math.log(each) for each in counts]
    if not beyond or known[0] <= at <= known[-1]:
        return float(np.interp(at, known, values))
    end, other = (0, 1) if at < known[0] else (-1, -2)
    slope = _SLOPE
    if len(known) > 1:
        slope = (values[end] - values[other]) / (known[end] - known[other])
    return values[end] + min(max(slope, _FLATTEST), _STEEPEST) * (at - known[end])

"""The largest count that takes no more to draw than a share of what the original takes.

Two searches of one kind, as for a PSNR: quick results, plain cuts of the forest, lead near the
count; then results are made and measured as they are delivered.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from nanogs.errors import TooSmallError
from nanogs.formatting import counted
from nanogs.pipeline.results import Attempts, Results, T
from nanogs.pipeline.weights import COUNTS
from nanogs.progress import Stage, Tracker
from nanogs.report import DrawProbeReport, StopReason

SPAN = 0.02  # share of what is asked: less by no more than this is near enough
MOST_PROBES = 16
PATIENCE = 5  # probes, after which every second one halves the range that is left
TOLERANCE = 0.005  # counts that differ by no larger share are neighbours: none is tried between
POWER = 0.4  # splats a pixel grow as this power of the count; scenes here: 0.37 to 0.47
POWERS = 0.2, 1.5  # limits of a measured power: beyond them, small unevennesses mislead

_Probe = DrawProbeReport | None


@dataclass(frozen=True, slots=True)
class Found:
    """The count that a search ends with, what it tried, and why it ended."""

    count: int
    probes: tuple[DrawProbeReport, ...]
    stop: StopReason

    @property
    def power(self) -> float:
        """The power of the count as which the share grows, by the two latest counts."""
        return _power(self.probes)


def search_share(
    share_of: Callable[[int], float],
    asked: float,
    fewest: int,
    available: int,
    guess: int,
    power: float = POWER,
    *,
    quick: bool = False,
) -> Found:
    """Look for a count whose share is at most what is asked and at least `SPAN` of it below.

    The share grows with the count but for small unevennesses, nearly in a line where both are
    logarithms. That line is followed; where it does not help, what is between is halved.

    Args:
        share_of: Measures the result of a count, as a share of what the original takes.
        asked: Above 0 and below 1.
        fewest: Smallest count that can be delivered, at least 1.
        available: Splats of the whole model, whose share is 1.
        guess: Count to begin with.
        power: Of the count as which the share grows, where it is known.
        quick: Mark the probes so, and end within `SPAN` on either side.

    Raises:
        TooSmallError: Not even the fewest splats take so little.
    """
    probes: list[DrawProbeReport] = []
    fits: _Probe = None
    over = DrawProbeReport(available, 1.0)
    count = min(max(guess, fewest), max(available - 1, fewest))
    while True:
        probe = DrawProbeReport(count, share_of(count), quick=quick)
        probes.append(probe)
        if probe.share <= asked:
            fits = probe
        else:
            over = probe
        near = asked * (1 - SPAN) <= probe.share <= asked * (1 + SPAN * quick)
        if near:
            return Found(count, tuple(probes), StopReason.TARGET)
        if fits and (stop := _ending(fits, over, len(probes))):
            return Found(fits.count, tuple(probes), stop)
        if fits is None and over.count == fewest:
            raise TooSmallError(
                f"A draw cost of {asked:.2%} is too small: {counted(fewest, 'splat')}, the fewest"
                f" that this model can be made of, take {probe.share:.2%} of what it takes itself."
            )
        power = _power(probes) if len(probes) > 1 else power
        count = _next(fits, over, probe, asked, power, len(probes))
        lowest = fits.count + 1 if fits else fewest
        count = min(max(count, lowest), over.count - 1)


def _ending(fits: DrawProbeReport, over: DrawProbeReport, tried: int) -> StopReason | None:
    """Why a search ends that has found something, but nothing near; None while it goes on."""
    if over.count <= max((1 + TOLERANCE) * fits.count, fits.count + 1):
        return StopReason.STEP
    return None if tried < MOST_PROBES else StopReason.PROBES


def _next(
    fits: _Probe,
    over: DrawProbeReport,
    latest: DrawProbeReport,
    asked: float,
    power: float,
    tried: int,
) -> int:
    """The next count: along the line from the latest; later, each second time, halfway between."""
    aim = asked * (1 - SPAN / 2)
    if fits is None and tried >= MOST_PROBES:
        return 0  # the fewest, which tell whether anything fits
    if fits and tried >= PATIENCE and tried % 2:
        return round(math.sqrt(fits.count * over.count))
    if latest.share <= 0:
        return 2 * latest.count
    factor: float = (aim / latest.share) ** (1 / power)
    return round(latest.count * factor)


def _power(probes: "list[DrawProbeReport] | tuple[DrawProbeReport, ...]") -> float:
    if len(probes) < 2:
        return POWER
    first, second = probes[-2:]
    if min(first.share, second.share) <= 0 or first.count == second.count:
        return POWER
    rise = math.log(second.share / first.share) / math.log(second.count / first.count)
    return min(max(rise, POWERS[0]), POWERS[1])


def meet_cost(
    results: Results[T],
    asked: float,
    share_of: Callable[[T], float],
    quick_share_of: Callable[[T], float],
    progress: Tracker,
) -> tuple[T, Found]:
    """The largest result of a model that is found to take no more to draw than is asked.

    Args:
        results: Of the model.
        asked: Share of what the original takes, above 0 and at most 1.
        share_of: Measures a result as it is delivered, as such a share.
        quick_share_of: Measures one that only leads there.
        progress: Told of each stage.

    Returns:
        The result, and what was tried.

    Raises:
        TooSmallError: Not even the fewest splats take so little.
    """
    available = results.available

    def attempts(some: Results[T], mark: Callable[[T], float]) -> Attempts[T, float]:
        return Attempts(some, mark, lambda share: share <= asked, _measuring, COUNTS, progress)

    progress.begin("search")
    if asked >= 1:
        whole = results.make(available, progress)
        return whole, Found(available, (), StopReason.TARGET)
    limits = results.fewest, available
    guess, power = round(available * asked ** (1 / POWER)), POWER
    probes: tuple[DrawProbeReport, ...] = ()
    if results.looks:
        quick = attempts(results.plain(rounds=0), quick_share_of)
        near = search_share(quick, asked, *limits, guess, quick=True)
        del quick  # and the result that it holds
        probes, guess, power = near.probes, near.count, near.power
        progress.begin("deliver")
    tried = attempts(results, share_of)
    found = search_share(tried, asked, *limits, guess, power)
    return tried.found(), replace(found, probes=probes + found.probes)


def _measuring(_count: int) -> Stage:
    return Stage("measure", 0.1)

"""Search for the largest count whose draw cost is at most a given share of the original's.

As for a PSNR, the same search runs twice: first with quick results, which are plain cuts of the
forest, to get near the count; then with full results, measured as they are delivered.
"""

import math
from collections.abc import Callable, Sequence

from nanogs.costs import DrawCost
from nanogs.errors import TooSmallError
from nanogs.formatting import counted
from nanogs.pipeline.estimates.stage_weights import COUNTS
from nanogs.pipeline.search.files import Files
from nanogs.pipeline.search.results import Attempts, Delivered, Found, Results, T
from nanogs.progress import Stage, Tracker
from nanogs.report import DrawProbeReport, StopReason
from nanogs.scoring.draw_views import DrawViews

NEAR_SHARE = 0.02  # relative tolerance below the share asked for
MOST_PROBES = 16
BISECT_AFTER = 5  # probes, after which every second one bisects the remaining range
TOLERANCE = 0.005  # counts whose relative difference is at most this: none is tried in between
POWER = 0.4  # splats per pixel grow as this power of the count; measured scenes: 0.37 to 0.47
POWERS = 0.2, 1.5  # limits of a measured power: values outside are due to noise

_Probe = DrawProbeReport | None
_Found = Found[DrawProbeReport]


def search_share(
    share_of: Callable[[int], float],
    asked: float,
    fewest: int,
    available: int,
    guess: int,
    power: float = POWER,
    *,
    quick: bool = False,
) -> _Found:
    """Search for a count whose share is between `(1 - NEAR_SHARE) * asked` and `asked`.

    Apart from noise, the share grows with the count, nearly as a straight line in log-log scale.
    The search follows that line; after `BISECT_AFTER` probes every second step bisects instead.

    Args:
        share_of: Measures the draw cost of the result of a count, as a share of the original's.
        asked: The largest allowed share, above 0 and at most 1.
        fewest: Smallest count that can be delivered, at least 1.
        available: Number of splats of the whole model, whose share is 1.
        guess: Count to begin with.
        power: Exponent with which the share grows with the count, if known.
        quick: Mark the probes as quick, and accept a share within `NEAR_SHARE` on either side.

    Raises:
        TooSmallError: Even the fewest splats cost more.
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
        near = asked * (1 - NEAR_SHARE) <= probe.share <= asked * (1 + NEAR_SHARE * quick)
        if near:
            return Found(count, tuple(probes), StopReason.TARGET)
        if fits and (stop := _ending(fits, over, len(probes))):
            return Found(fits.count, tuple(probes), stop)
        if fits is None and over.count == fewest:
            remedy = "allow at least that"
            if probe.share > 1:  # more than can be asked for
                remedy = "splats of the result are larger, so ask for a `ratio` or a `count`"
            raise TooSmallError(
                f"A draw cost of {100 * asked:.4g}% is too small: {counted(fewest, 'splat')}, the"
                f" fewest that this model can be reduced to, cost {probe.share:.2%} of the whole"
                f" model; {remedy}."
            )
        power = _power(probes) if len(probes) > 1 else power
        count = _next(fits, over, probe, asked, power, len(probes))
        lowest = fits.count + 1 if fits else fewest
        count = min(max(count, lowest), over.count - 1)


def _ending(fits: DrawProbeReport, over: DrawProbeReport, tried: int) -> StopReason | None:
    """Return why the search ends with a count whose share is not near; None to continue."""
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
    """Return the next count: on the log-log line, or later, every second time, by bisection."""
    aim = asked * (1 - NEAR_SHARE / 2)
    if fits is None and tried >= MOST_PROBES:
        return 0  # the caller clamps it to `fewest`, which shows whether any count fits
    if fits and tried >= BISECT_AFTER and tried % 2:
        return round(math.sqrt(fits.count * over.count))
    if latest.share <= 0:
        return 2 * latest.count
    factor: float = (aim / latest.share) ** (1 / power)
    return round(latest.count * factor)


def _power(probes: Sequence[DrawProbeReport]) -> float:
    """Return the exponent with which the share grows with the count, from the two latest probes."""
    if len(probes) < 2:
        return POWER
    first, second = probes[-2:]
    if min(first.share, second.share) <= 0 or first.count == second.count:
        return POWER
    rise = math.log(second.share / first.share) / math.log(second.count / first.count)
    return min(max(rise, POWERS[0]), POWERS[1])


def search_draw_cost(
    results: Results[T], asked: float, views: DrawViews, files: Files[T], progress: Tracker
) -> Delivered[T]:
    """Make the largest result that the search finds with a draw cost of at most `asked`.

    Args:
        results: Makes results of the model.
        asked: Share of the original's draw cost, above 0 and at most 1.
        views: The views that the cost is measured on.
        files: Writes full results, which are measured as their files hold them.
        progress: Receives each stage.

    Raises:
        TooSmallError: Even the fewest splats cost more.
    """
    costs: dict[int, DrawCost] = {}  # of full results, by count: each is measured once

    def cost_of(result: T) -> DrawCost:
        count = files.count(result)
        if count not in costs:
            with files.clock.time("measure"), files.stored(files.rounded(result, {}), {}) as small:
                costs[count] = views.cost(small)
        return costs[count]

    def share_of(result: T) -> float:
        return cost_of(result).share_of(views.original)

    def quick_share_of(result: T) -> float:
        with files.clock.time("measure"), files.unwritten(result) as small:
            return views.share(small)

    def attempts(some: Results[T], measure: Callable[[T], float]) -> Attempts[T, float]:
        return Attempts(some, measure, lambda share: share <= asked, _measuring, COUNTS, progress)

    limits = results.fewest, results.available
    guess, power = round(results.available * asked ** (1 / POWER)), POWER
    probes: tuple[DrawProbeReport, ...] = ()
    tried = attempts(results, share_of)
    progress.begin("search")
    if asked >= 1:
        # The whole model meets it, unless its format cannot hold splats as small as some are.
        probes = (DrawProbeReport(results.available, tried(results.available)),)
    elif results.looks:
        quick = attempts(results.plain(rounds=0), quick_share_of)
        near = search_share(quick, asked, *limits, guess, quick=True)
        del quick  # frees the result that it holds
        probes, guess, power = near.probes, near.count, _power(near.probes)
        progress.begin("deliver")
    if tried.best is None:
        found = search_share(tried, asked, *limits, guess, power)
    else:
        probes, found = (), Found(results.available, (), StopReason.TARGET)
    result = tried.found()
    results.verify(result, progress)
    fields = {"draw_probes": probes + found.probes, "stop": found.stop, "cost": cost_of(result)}
    return Delivered(files.rounded(result, {}), fields | {"original_cost": views.original})


def _measuring(_count: int) -> Stage:
    return Stage("measure", 0.1)

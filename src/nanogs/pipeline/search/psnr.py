"""Search for the smallest count that reaches a PSNR, as `nanogs compare` measures it.

Two searches of one kind: quick results, plain cuts of the forest, lead near the count; then results
are made and measured as they are delivered, until one is within `NEAR_DB` above the PSNR asked for.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

from nanogs.pipeline.estimates.stage_weights import COUNTS
from nanogs.pipeline.search.coarseness import coarsest
from nanogs.pipeline.search.packer import PackingForPsnr
from nanogs.pipeline.search.results import Attempts, Delivered, Found, M, Results, T
from nanogs.progress import Stage, Tracker
from nanogs.protocol import VIEWS
from nanogs.report import ProbeReport, StopReason
from nanogs.scoring.held_out import HeldOut
from nanogs.source import Source
from nanogs.splats import Splats

NEAR_DB = 0.3  # dB above what is asked within which a result is near enough
MOST_PROBES = 24
GUESS = 0.1  # share of the splats in the first probe
# Counts that differ by at most this share are neighbours; also the share of splats to be saved.
TOLERANCE = 0.01
BELOW_STEP = 6  # number of counts tried below a step of the PSNR
STRIDE = 0.05  # distance between these, as a share of the count of the step
BISECT_AFTER = 6  # number of probes after which every second one halves the range that is left
USUAL_SLOPE = 3.0  # dB for e times the splats; trained scenes: 2 to 5
SLOPES = 1.0, 10.0  # dB, limits of a measured slope: beyond them, small unevennesses mislead
MOST_LOG_CHANGE = 3.0  # largest change of the log of the count at once, while one side is unknown
FAR = 0.7  # share of the largest count, beyond which the largest is tried at once
HOPELESS_DB = 6.0  # dB that a quick result may lack and delivered results still be tried

_Probe = ProbeReport | None
_Found = Found[ProbeReport]


def search_count(
    psnr_of: Callable[[int], float],
    asked: float,
    fewest: int,
    available: int,
    guess: int,
    slope: float | None = None,
    *,
    quick: bool = False,
) -> _Found:
    """Search for a count whose PSNR is at least `asked` and at most `NEAR_DB` above it.

    PSNR grows with the count but for small unevennesses, and nearly linearly in its logarithm. The
    search extrapolates along that line until one count misses and one reaches `asked`, then
    interpolates between them; if that does not help, it halves the range. If the PSNR steps over
    the whole span, because another candidate is chosen, some counts below the step are tried. A
    PSNR that takes more than 99 % of the splats is out of reach: with all but a few, any can be
    had.

    Args:
        psnr_of: Measures the result of a count, dB.
        asked: dB.
        fewest: Smallest count that can be delivered, at least 1.
        available: Splats of the whole model.
        guess: Count to begin with.
        slope: dB for e times the splats, if it is known.
        quick: Mark the probes so, and end within `NEAR_DB` on either side.
    """
    probes: list[ProbeReport] = []
    misses: _Probe = None
    reaches: _Probe = None
    most = available - max(1, round(TOLERANCE * available))
    count = min(max(guess, fewest), most)
    while fewest <= most:
        probe = ProbeReport(count, psnr_of(count), quick=quick)
        probes.append(probe)
        if probe.psnr < asked:
            misses = probe
        else:
            reaches = probe
        if quick and abs(probe.psnr - asked) <= NEAR_DB:
            return Found(count, tuple(probes), StopReason.TARGET)
        if stop := _ending(misses, reaches, asked, fewest, most, len(probes)):
            found = Found(reaches.count if reaches else available, tuple(probes), stop)
            return _below_step(psnr_of, found, asked, fewest, quick=quick)
        if misses and reaches:
            count = _between(misses, reaches, asked, len(probes))
        else:
            count = _beyond(probes, asked, most, slope)
        lowest = misses.count + 1 if misses else fewest
        count = min(max(count, lowest), reaches.count - 1 if reaches else most)
    return Found(available, (), StopReason.UNREACHED)


def _below_step(
    psnr_of: Callable[[int], float], found: _Found, asked: float, fewest: int, *, quick: bool
) -> _Found:
    """After a search that ended at a step, try counts below it.

    The count found is one within the span after all, or the smallest that reaches `asked`.
    """
    if found.stop is not StopReason.STEP:
        return found
    step = found.count
    for i in range(1, BELOW_STEP + 1):
        count = round(step * (1 - STRIDE * i))
        if count < fewest or any(probe.count == count for probe in found.probes):
            continue
        probe = ProbeReport(count, psnr_of(count), quick=quick)
        found = replace(found, probes=(*found.probes, probe))
        if probe.psnr >= asked:
            found = replace(found, count=count)
        if asked <= probe.psnr <= asked + NEAR_DB:
            return replace(found, stop=StopReason.TARGET)
    return found


def _are_neighbours(misses: ProbeReport, reaches: ProbeReport) -> bool:
    """Whether no count between the two is tried."""
    return reaches.count <= max((1 + TOLERANCE) * misses.count, misses.count + 1)


def _ending(
    misses: _Probe, reaches: _Probe, asked: float, fewest: int, most: int, tried: int
) -> StopReason | None:
    """Return why the search ends, or None if it continues."""
    if reaches and reaches.psnr <= asked + NEAR_DB:
        return StopReason.TARGET
    if reaches and (reaches.count == fewest or (misses and _are_neighbours(misses, reaches))):
        return StopReason.STEP  # the PSNR rises over the whole span between the two
    if misses and misses.count == most:
        return StopReason.UNREACHED
    if tried < MOST_PROBES:
        return None
    return StopReason.PROBES if reaches else StopReason.UNREACHED


def _between(misses: ProbeReport, reaches: ProbeReport, asked: float, tried: int) -> int:
    """Return a count between two, interpolated in the logarithm.

    From `BISECT_AFTER` probes on, every second count is halfway.
    """
    low, high = math.log(misses.count), math.log(reaches.count)
    share = 0.5
    if math.isfinite(reaches.psnr) and (tried < BISECT_AFTER or tried % 2):
        share = (asked + NEAR_DB / 2 - misses.psnr) / (reaches.psnr - misses.psnr)
    return round(math.exp(low + share * (high - low)))


def _beyond(probes: list[ProbeReport], asked: float, most: int, slope: float | None) -> int:
    """Extrapolate a count from the latest one; the largest if that is far up."""
    latest = probes[-1]
    if len(probes) > 1 or slope is None:
        slope = _slope(probes)
    lack = asked + NEAR_DB / 2 - latest.psnr
    step = min(max(lack / slope, -MOST_LOG_CHANGE), MOST_LOG_CHANGE)
    count = round(latest.count * math.exp(step))
    return most if step > 0 and count > FAR * most else count


def _slope(probes: Sequence[ProbeReport]) -> float:
    """Return the slope of the PSNR over the log of the count, dB, from the two latest probes."""
    if len(probes) < 2:
        return USUAL_SLOPE
    first, second = probes[-2:]
    rise = second.psnr - first.psnr
    if not math.isfinite(rise):
        return SLOPES[1]
    return min(max(rise / math.log(second.count / first.count), SLOPES[0]), SLOPES[1])


def search_psnr(pack: PackingForPsnr[T], asked: float, views: HeldOut) -> Delivered[T]:
    """Make the smallest result that the search finds to reach a PSNR, as its file holds it.

    Args:
        pack: Chooses the packing of the model's results.
        asked: dB.
        views: The views that it is measured on.
    """
    results, files, progress = pack.results, pack.files, pack.progress

    def rounded(result: T, coarseness: float) -> T:
        return files.rounded(result, pack.options(result), coarseness)

    def measured(small: T, measure: Callable[[Splats | Source], M]) -> M:
        with files.clock.time("measure"), files.stored(small, pack.options(small)) as stored:
            return measure(stored)

    def psnr_of(result: T, coarseness: float = 1.0) -> float:
        return measured(rounded(result, coarseness), views.psnr)

    result, found = reach_psnr(results, asked, psnr_of, progress, pack, pack.smaller)
    if found.stop is StopReason.UNREACHED:  # the whole model is written, without the packing
        pack.packed = None
    results.verify(result, progress)
    coarseness = 1.0
    if found.stop is not StopReason.UNREACHED and files.curvatures(result) is not None:
        coarseness = coarsest(lambda tried: psnr_of(result, tried) >= asked)
    small = rounded(result, coarseness)
    fields = {"probes": found.probes, "stop": found.stop, "judged": measured(small, views.judge)}
    return Delivered(small, fields | pack.report_fields(result), pack.notes)


def reach_psnr(
    results: Results[T],
    asked: float,
    psnr_of: Callable[[T], float],
    progress: Tracker,
    pack: Callable[[int, float], tuple[Results[T], int]],
    smaller: Callable[[T, T, Callable[[], bool]], bool],
) -> tuple[T, _Found]:
    """Find the smallest result of a model that reaches a PSNR on held-out views.

    The result that is measured is delivered: the result of a count is the same each time.

    Args:
        results: Makes results of the model.
        asked: dB.
        psnr_of: Measures a result on views that are not used for fitting or choosing, dB.
        progress: Notified of each stage.
        pack: Takes the count that quick results lead to, and their slope, dB for e times the
            splats; chooses the packing of the delivered results, and returns a maker of these and
            a count to begin with.
        smaller: Takes the whole model, a result, and a test whether the former reaches the PSNR as
            it would be packed now. Returns whether it does so in a smaller file than the result, by
            the defaults of its format; then it is returned. Asked if a packing was chosen and most
            splats are left.

    Returns:
        The result, and what was tried.
    """

    def attempts(some: Results[T]) -> Attempts[T, float]:
        return Attempts(some, psnr_of, lambda psnr: psnr >= asked, _measuring, COUNTS, progress)

    limits = results.fewest, results.available
    guess, slope = round(GUESS * results.available), None
    probes: tuple[ProbeReport, ...] = ()
    delivered = results
    progress.begin("search")
    if results.looks:
        near = search_count(attempts(results.plain(rounds=0)), asked, *limits, guess, quick=True)
        probes, slope = near.probes, _slope(near.probes)
        if _hopeless(near, asked):
            return _whole(results, near, progress)
        delivered, guess = pack(near.count, slope)
        progress.begin("deliver")
    tried = attempts(delivered)
    found = search_count(tried, asked, *limits, guess, slope)
    found = replace(found, probes=probes + found.probes)
    if tried.best is None:
        return _whole(results, found, progress)
    if delivered is not results and found.count > FAR * results.available:
        whole = results.make(results.available, progress)
        if smaller(whole, tried.best, lambda: psnr_of(whole) >= asked):
            return whole, replace(found, count=results.available, stop=StopReason.STEP)
    return tried.best, found


def _measuring(_count: int) -> Stage:
    return Stage("measure", VIEWS * 0.02)


def _hopeless(near: _Found, asked: float) -> bool:
    """Whether a quick result of even 99 % of the model is far below what is asked."""
    return near.stop is StopReason.UNREACHED and (
        not near.probes or near.probes[-1].psnr < asked - HOPELESS_DB
    )


def _whole(results: Results[T], found: _Found, progress: Tracker) -> tuple[T, _Found]:
    """Return the whole model, because no smaller one reaches what is asked."""
    result = results.make(results.available, progress)
    return result, replace(found, count=results.available, stop=StopReason.UNREACHED)

"""The smallest count that reaches a PSNR on views of the original, by bisection over cuts."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from nanogs.errors import ModelError
from nanogs.progress import Tracker
from nanogs.report import ProbeReport, StageClock, StopReason
from nanogs.simplify.forest_pipeline import Build, deliver
from nanogs.simplify.outcome import Outcome
from nanogs.simplify.stages import delivery_stages, expected_probes
from nanogs.simplify.visibility import OriginalViews, judge, look
from nanogs.splats import Splats

TOLERANCE = 0.01  # the count is found to this share of itself, and exactly below 100
MOST_PROBES = 24  # a billion splats need 12


@dataclass(frozen=True, slots=True)
class Found:
    """The count that a search ends with, what it tried, and why it ended."""

    count: int
    probes: tuple[ProbeReport, ...]
    stop: StopReason


def search_count(
    psnr_of: Callable[[int], float], asked: float, fewest: int, available: int
) -> Found:
    """Bisect the logarithm of the count between one that misses the PSNR and one that reaches it.

    The whole model is what the others are held against: it reaches any PSNR and is not tried.
    PSNR grows with the count but for small unevennesses; where it does not, the result reaches
    what is asked, and a smaller one that does so too may have been passed over.

    Args:
        psnr_of: Measures the result of a count, dB.
        asked: dB.
        fewest: Smallest count that can be delivered, at least 1.
        available: Splats of the whole model.
    """
    misses, reaches = fewest - 1, available
    probes: list[ProbeReport] = []
    while reaches - misses > 1 and reaches > (1 + TOLERANCE) * misses:
        if len(probes) == MOST_PROBES:
            return Found(reaches, tuple(probes), StopReason.PROBES)
        middle = round(math.sqrt(max(misses, 1) * reaches))
        middle = min(max(middle, misses + 1), reaches - 1)
        probes.append(ProbeReport(middle, psnr_of(middle)))
        if probes[-1].psnr >= asked:
            reaches = middle
        else:
            misses = middle
    stop = StopReason.UNREACHED if reaches == available else StopReason.TARGET
    return Found(reaches, tuple(probes), stop)


def reach_psnr(build: Build, asked: float, clock: StageClock, progress: Tracker) -> Outcome:
    """The smallest result of a build that reaches a PSNR on the views it is judged by.

    What is measured is what is delivered: the result of a count is the same each time.

    Args:
        build: The model and its forest.
        asked: dB.
        clock: Gets the seconds of each stage.
        progress: Told of each stage.

    Raises:
        ModelError: Nothing of the model is visible.
    """
    views = build.views or _views_to_judge_by(build, clock, progress)

    def measured(small: Splats) -> float:
        with clock.time("judge"):
            return judge(small, views)[0]

    progress.begin("search")
    tried, splats = 0, len(build.leaves)

    def delivered(count: int) -> Outcome:
        nonlocal tried
        stages = delivery_stages(build.parameters, splats, count)
        probe = progress.within(tried, expected_probes(splats), stages)
        tried += 1
        return deliver(build, count, clock, probe)

    best: list[Outcome] = []  # the latest that reaches it, and so the smallest; one at a time

    def psnr_of(count: int) -> float:
        outcome = delivered(count)
        psnr = measured(outcome.splats)
        if psnr >= asked:
            best[:] = [replace(outcome, achieved_psnr=psnr)]
        return psnr

    found = search_count(psnr_of, asked, build.forest.fewest, build.forest.splats)
    if not best:
        outcome = delivered(found.count)
        best = [replace(outcome, achieved_psnr=measured(outcome.splats))]
    return replace(best[0], probes=found.probes, stop=found.stop)


def _views_to_judge_by(build: Build, clock: StageClock, progress: Tracker) -> OriginalViews:
    """Views of the original for a preset that renders none; its results stay as they are."""
    progress.begin("look")
    with clock.time("look"):
        try:
            return look(build.splats, build.cameras, build.parameters.views, progress.part)
        except ModelError as error:
            raise ModelError(f"The PSNR cannot be measured: {error}") from None

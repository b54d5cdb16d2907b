"""The smallest count that reaches a PSNR as `nanogs compare` measures it.

Two searches of one kind: quick results, plain cuts of the forest, lead near the count; then results
are made and judged as they are delivered, until one lies within `SPAN` above what is asked.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from nanogs.clock import StageClock
from nanogs.pipeline.foreseen import delivery_stages
from nanogs.pipeline.one_block import OneBlock
from nanogs.pipeline.outcome import Outcome
from nanogs.pipeline.run import deliver, plain
from nanogs.pipeline.weights import COUNTS
from nanogs.progress import Stage, Tracker
from nanogs.protocol import VIEWS
from nanogs.report import ProbeReport, StopReason
from nanogs.scoring.held_out import HeldOut
from nanogs.splats import Splats

SPAN = 0.3  # dB above what is asked within which a result is near enough
MOST_PROBES = 24
GUESS = 0.1  # share of the splats to begin with
TOLERANCE = 0.01  # share of a count that is next to it, and of the splats that must be saved
STEPS = 6  # counts that are tried below a step
STRIDE = 0.05  # of its count, how far these are from each other
PATIENCE = 6  # probes after which what is between two counts is halved as well
USUAL_SLOPE = 3.0  # dB for e times the splats; trained scenes: 2 to 5
SLOPES = 1.0, 10.0  # dB, between which a slope that was measured is believed
LEAP = 3.0  # logarithm of the most that a count changes by where one side is open
FAR = 0.7  # share of the most beyond which that is tried at once
HOPELESS = 6.0  # dB that a quick result may lack for the delivered one to be worth a probe

Decode = Callable[[Splats], Splats]
"""A result as the file that it is written to gives it back."""

_Probe = ProbeReport | None


@dataclass(frozen=True, slots=True)
class Found:
    """The count that a search ends with, what it tried, and why it ended."""

    count: int
    probes: tuple[ProbeReport, ...]
    stop: StopReason

    @property
    def slope(self) -> float:
        """Slope of the PSNR over the logarithm of the count, by the two latest counts, dB."""
        return _slope(self.probes)


def search_count(
    psnr_of: Callable[[int], float],
    asked: float,
    fewest: int,
    available: int,
    guess: int,
    slope: float | None = None,
    *,
    quick: bool = False,
) -> Found:
    """Look for a count whose PSNR is at least what is asked and at most `SPAN` above it.

    PSNR grows with the count but for small unevennesses, and nearly in a line over its logarithm.
    That line is followed to both sides of what is asked, and then between them; where it does not
    help, what is between is halved. Where the PSNR steps over the whole span, as another candidate
    is chosen, some counts below the step are tried. A PSNR that takes more than 99 % of the splats
    is out of reach: with all but a few, any can be had.

    Args:
        psnr_of: Measures the result of a count, dB.
        asked: dB.
        fewest: Smallest count that can be delivered, at least 1.
        available: Splats of the whole model.
        guess: Count to begin with.
        slope: dB for e times the splats, where it is known.
        quick: Mark the probes so, and end within `SPAN` on either side.
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
        if quick and abs(probe.psnr - asked) <= SPAN:
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
    psnr_of: Callable[[int], float], found: Found, asked: float, fewest: int, *, quick: bool
) -> Found:
    """A count below a step whose PSNR lies within the span after all, or the least that reaches."""
    if found.stop is not StopReason.STEP:
        return found
    step = found.count
    for i in range(1, STEPS + 1):
        count = round(step * (1 - STRIDE * i))
        if count < fewest or any(probe.count == count for probe in found.probes):
            continue
        probe = ProbeReport(count, psnr_of(count), quick=quick)
        found = replace(found, probes=(*found.probes, probe))
        if probe.psnr >= asked:
            found = replace(found, count=count)
        if asked <= probe.psnr <= asked + SPAN:
            return replace(found, stop=StopReason.TARGET)
    return found


def _is_step(misses: ProbeReport, reaches: ProbeReport, asked: float) -> bool:
    """Whether the PSNR rises over the whole span between counts that are next to each other."""
    near = reaches.count <= max((1 + TOLERANCE) * misses.count, misses.count + 1)
    return near and reaches.psnr > asked + SPAN


def _ending(
    misses: _Probe, reaches: _Probe, asked: float, fewest: int, most: int, tried: int
) -> StopReason | None:
    """Why the search ends, or None while it goes on."""
    if reaches and reaches.psnr <= asked + SPAN:
        return StopReason.TARGET
    if reaches and (reaches.count == fewest or (misses and _is_step(misses, reaches, asked))):
        return StopReason.STEP
    if misses and misses.count == most:
        return StopReason.UNREACHED
    if tried < MOST_PROBES:
        return None
    return StopReason.PROBES if reaches else StopReason.UNREACHED


def _between(misses: ProbeReport, reaches: ProbeReport, asked: float, tried: int) -> int:
    """A count between two: where a line has what is aimed at; later each second time halfway."""
    low, high = math.log(misses.count), math.log(reaches.count)
    share = 0.5
    if math.isfinite(reaches.psnr) and (tried < PATIENCE or tried % 2):
        share = (asked + SPAN / 2 - misses.psnr) / (reaches.psnr - misses.psnr)
    return round(math.exp(low + share * (high - low)))


def _beyond(probes: list[ProbeReport], asked: float, most: int, slope: float | None) -> int:
    """A count along the line from the latest one; the most where that leads far up."""
    latest = probes[-1]
    if len(probes) > 1 or slope is None:
        slope = _slope(probes)
    lack = asked + SPAN / 2 - latest.psnr
    step = min(max(lack / slope, -LEAP), LEAP)
    count = round(latest.count * math.exp(step))
    if step > 0 and count > FAR * most:
        return most
    return count + (1 if step > 0 else -1) if count == latest.count else count


def _slope(probes: "list[ProbeReport] | tuple[ProbeReport, ...]") -> float:
    if len(probes) < 2:
        return USUAL_SLOPE
    (first, second) = probes[-2:]
    rise = second.psnr - first.psnr
    if not math.isfinite(rise):
        return SLOPES[1]
    return min(max(rise / math.log(second.count / first.count), SLOPES[0]), SLOPES[1])


def reach_psnr(
    scene: OneBlock,
    asked: float,
    views: HeldOut,
    decode: Decode,
    clock: StageClock,
    progress: Tracker,
) -> Outcome:
    """The smallest result of a model that is found to reach a PSNR on the views held out.

    What is measured is what is delivered: the result of a count is the same each time.

    Args:
        scene: The model, looked at, and its forest.
        asked: dB.
        views: What the original shows where nothing is learnt from it.
        decode: What becomes of a result in its file.
        clock: Gets the seconds of each stage.
        progress: Told of each stage.
    """
    best: list[Outcome] = []  # the latest that reaches it, and so the smallest; one at a time

    def search(scene: OneBlock, guess: int, slope: float | None = None, *, quick: bool) -> Found:
        tried = 0

        def psnr_of(count: int) -> float:
            nonlocal tried
            stages = delivery_stages(scene.settings.parameters, len(scene.usable), count)
            probe = progress.within(tried, COUNTS, [*stages, Stage("measure", VIEWS * 0.02)])
            tried += 1
            outcome = deliver(scene, count, clock, probe)
            probe.begin("measure")
            with clock.time("measure"):
                psnr = views.psnr(decode(outcome.splats))
            if psnr >= asked:
                best[:] = [outcome]
            return psnr

        forest = scene.forest
        return search_count(psnr_of, asked, forest.fewest, forest.splats, guess, slope, quick=quick)

    guess, slope = round(GUESS * scene.forest.splats), None
    probes: tuple[ProbeReport, ...] = ()
    progress.begin("search")
    if scene.looks:
        near = search(plain(scene, rounds=0), guess, quick=True)
        probes, guess, slope = near.probes, near.count, near.slope
        best.clear()
        if _hopeless(near, asked):
            return _whole(scene, near, clock, progress)
        progress.begin("deliver")
    found = search(scene, guess, slope, quick=False)
    found = replace(found, probes=probes + found.probes)
    if not best:
        return _whole(scene, found, clock, progress)
    return replace(best[0], probes=found.probes, stop=found.stop)


def _hopeless(near: Found, asked: float) -> bool:
    """Whether not even 99 % of the model, quickly made, come near what is asked."""
    return near.stop is StopReason.UNREACHED and (
        not near.probes or near.probes[-1].psnr < asked - HOPELESS
    )


def _whole(scene: OneBlock, found: Found, clock: StageClock, progress: Tracker) -> Outcome:
    """The whole model, as no smaller one reaches what is asked."""
    outcome = deliver(scene, scene.forest.splats, clock, progress)
    return replace(outcome, probes=found.probes, stop=StopReason.UNREACHED)

"""The most splats whose file is no larger than asked, where only writing it tells its size."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from nanogs._types import I32, I64
from nanogs.errors import ModelError, TooSmallError
from nanogs.formatting import counted
from nanogs.pipeline.results import Attempts, Results, T
from nanogs.pipeline.weights import RESULTS, SIZES, write_weight
from nanogs.progress import Stage, Tracker
from nanogs.report import SizeProbeReport, StopReason
from nanogs.splats import Splats
from nanogs.views.occupancy import FAINTEST

# Shares of the size, less what every file of the format has around its splats:
AIM = 0.993  # a probe is put there, so that it is seldom just above
ENOUGH = 0.98  # a file that takes so much of it ends the search
TOLERANCE = 0.01  # share of a count: where one larger by this is too large, the search ends, too
MOST_PROBES = 12
SAMPLE = 8192  # splats of the input that are written for the first guess
HOPELESS = 0.5  # of the file of one splat: a smaller size is refused at once
# Of a count that is too large: the next is at most so much of it, at first and later on.
_STEPS = 0.995, 0.97
_LEAP = 16  # times a count that fits: the next is at most so many

WHOLE_FITS = "The whole model fits into the size asked for; nothing was merged."

Encode = Callable[[Splats], int]
"""Bytes of a model's file, by writing it."""
Probe = SizeProbeReport | None


@dataclass(frozen=True, slots=True)
class Fitted:
    """The largest count found to fit, its bytes, what was tried in order, and why it ended."""

    count: int
    bytes: int
    probes: tuple[SizeProbeReport, ...]
    stop: StopReason = StopReason.TARGET

    def leap(self, size: int, available: int, around: int = 0) -> tuple[str, ...]:
        """A sentence where much of the size is left, mostly as a few splats more take far more."""
        over = min((probe for probe in self.probes if probe.bytes > size), default=None, key=_count)
        if not self.probes or self.count == available:
            return ()
        return little_used(size, self.bytes, over, around)


def part_of(size: float, share: float, around: int) -> float:
    """Bytes that a file takes whose splats take a share of what the size leaves for them.

    Args:
        size: Bytes that the file may have.
        share: Of these, less what is around the splats.
        around: Bytes that every file of the format has around its splats.
    """
    return around + share * (size - around)


def _count(probe: SizeProbeReport) -> int:
    return probe.count


def little_used(size: int, taken: int, over: Probe, around: int = 0) -> tuple[str, ...]:
    """A sentence where a file leaves much of the size, mostly since the next one is too large.

    Args:
        size: Bytes that the file may have.
        taken: Its bytes.
        over: One that is too large, or None where enough others were tried.
        around: Bytes that every file of the format has around its splats.
    """
    if taken >= part_of(size, ENOUGH, around):
        return ()
    more = "enough others were tried to find a larger one"
    if over is not None:
        more = f"one of {counted(over.count, 'splat')} takes {over.bytes:,} B"
    return (f"The file takes {taken / size:.0%} of the size asked for: {more}.",)


def notes_on_known(
    size: int, count: int, available: int, file_bytes: Callable[[int], int]
) -> tuple[str, ...]:
    """A sentence where a size is far from used that a format of known sizes was to fill.

    Args:
        size: Bytes that the file may have.
        count: Its splats.
        available: Splats of the whole model.
        file_bytes: Size of the file for a count.
    """
    if count == available:
        return (WHOLE_FITS,)
    return little_used(size, file_bytes(count), SizeProbeReport(count + 1, file_bytes(count + 1)))


def search_fit(
    bytes_of: Callable[[int], int],
    size: int,
    guess: int,
    fewest: int,
    available: int,
    enough: float | None = None,
    around: int = 0,
) -> Fitted:
    """Interpolate bytes over counts until a file fits and takes most of the size.

    Bytes grow with the count but for small unevennesses, so that a slightly larger count than the
    one found may fit too. They may leap: every other step halves, so that the search does not creep
    towards a leap.

    Args:
        bytes_of: Size of the file of a count, by writing it.
        size: Bytes that it may have.
        guess: Count to begin with.
        fewest: Smallest count that can be delivered, at least 1.
        available: Largest.
        enough: Bytes that are near enough to the size; by default 98 % of it, less what is around.
        around: Bytes that every file of the format has around its splats.

    Raises:
        TooSmallError: Not even the fewest fit.
    """
    probes: list[SizeProbeReport] = []
    fits: Probe = None
    over: Probe = None
    enough = part_of(size, ENOUGH, around) if enough is None else enough
    aim = part_of(size, AIM, around)
    count = min(max(guess, fewest), available)
    while True:
        probe = SizeProbeReport(count, bytes_of(count))
        probes.append(probe)
        if probe.bytes <= size:
            fits = probe
        else:
            over = probe
        if fits is None:
            if count == fewest:
                raise too_small(size, count, probe.bytes)
        elif stop := _stop(fits, over, enough, available, len(probes)):
            return Fitted(fits.count, fits.bytes, tuple(probes), stop)
        count = _next(fits, over, aim, probes)
        count = min(max(count, fewest), available)


def too_small(size: int, fewest: int, needed: int) -> TooSmallError:
    """The error to raise where a file of the fewest splats is larger than the size."""
    if fewest == 1:
        held = "a file of one splat of this model"
    else:
        held = f"a file of {fewest:,} splats, the fewest that this model can be merged to,"
    return TooSmallError(
        f"The size {size:,} B is too small: {held} takes {needed:,} B; allow more."
    )


def _stop(
    fits: SizeProbeReport, over: Probe, enough: float, available: int, tried: int
) -> StopReason | None:
    """Why no count is left that is worth a probe; None where one is."""
    if fits.bytes >= enough or fits.count == available:
        return StopReason.TARGET
    if over is not None and over.count <= max((1 + TOLERANCE) * fits.count, fits.count + 1):
        return StopReason.STEP
    return StopReason.SETTLED if tried >= MOST_PROBES else None


def _next(fits: Probe, over: Probe, aim: float, probes: Sequence[SizeProbeReport]) -> int:
    """The count where the bytes should be those aimed at, just below the size."""
    tried = len(probes)
    if over is None:
        assert fits is not None  # noqa: S101 - one has been tried
        found = min(_along(probes[-2:], aim), _LEAP * fits.count)
        return max(int(found), fits.count + 1)
    if fits is None:
        step = _STEPS[tried > 1] if tried < MOST_PROBES else 0.5  # and so it ends
        return int(min(_along(probes[-2:], aim), over.count * step))
    between = over.count - fits.count
    share = 0.5 if tried % 2 else (aim - fits.bytes) / (over.bytes - fits.bytes)
    return min(max(fits.count + int(share * between), fits.count + 1), over.count - 1)


def _along(probes: Sequence[SizeProbeReport], aim: float) -> float:
    """The count of so many bytes on a line through the latest two; else through one and zero."""
    latest = probes[-1]
    for before in probes[:-1]:
        each = (before.bytes - latest.bytes) / (before.count - latest.count)
        if each > 0:  # bytes of a splat; what is below 0 is noise
            return latest.count - (latest.bytes - aim) / each
    return latest.count * aim / latest.bytes


def first_two(splats: Splats, rows: I32 | I64) -> I32 | I64:
    """(2,) The first row, and the first one that is not transparent (or again the first)."""
    shown = splats.opacities()[rows] > FAINTEST
    return rows[[0, int(shown.argmax())]]


def _least(sample: Splats, encode: Encode) -> int:
    """Bytes of a file of one splat: of one that shows something, where it must."""
    first, shown = first_two(sample, np.arange(len(sample)))
    try:
        return encode(sample.take(np.array([first])))
    except ModelError:  # a page opens on what is to be seen
        return encode(sample.take(np.array([shown])))


def guess_count(sample: Splats, available: int, size: int, encode: Encode, around: int = 0) -> int:
    """A count to begin with, from what some of the model's own splats take.

    Args:
        sample: Some of the usable ones, spread over the model; of them some are taken again.
        available: How many there are in all.
        size: Bytes that the file may have.
        encode: Bytes of a model's file.
        around: Bytes that every file of the format has around its splats.
    """
    least = _least(sample, encode)
    rows = np.arange(0, len(sample), -(-len(sample) // SAMPLE))
    each = (encode(sample.take(rows)) - least) / max(len(rows) - 1, 1)
    count = 1 + int((part_of(size, AIM, around) - least) / each) if each > 0 else available
    return min(max(count, 1), available)


def refuse_hopeless(sample: Splats, size: int, encode: Encode) -> None:
    """Refuse, before anything is computed, a size that is far too small.

    How many bytes the fewest splats take is known exactly once they are made; a splat of the model
    itself takes about as many.

    Args:
        sample: Some usable splats.
        size: Bytes that the file may have.
        encode: Bytes of a model's file, as small as may be.

    Raises:
        TooSmallError: It has room for less than half of one splat's file.
    """
    least = _least(sample, encode)
    if size < HOPELESS * least:
        raise TooSmallError(
            f"The size {size:,} B is too small: a file of one splat of this model takes about"
            f" {least:,} B; allow more."
        )


def fit_size(
    results: Results[T],
    size: int,
    guess: int,
    bytes_of: Callable[[T], int],
    progress: Tracker,
    *,
    near: bool = False,
    around: int = 0,
) -> tuple[T, Fitted]:
    """The largest result of a model that is found to fit, and takes most of the size.

    The count is searched for with plain cuts of the forest, which are quick. Only few results are
    made as they are delivered, chosen by measurement or fitted.

    Args:
        results: Of the model.
        size: Bytes that the file may have.
        guess: Count to begin with.
        bytes_of: Bytes of a result's file.
        progress: Told of each stage.
        near: Whether the guess comes from results as they are delivered, so that nothing else leads
            nearer.
        around: Bytes that every file of the format has around its splats.

    Returns:
        The result, and what was tried.

    Raises:
        TooSmallError: Not even the fewest splats fit.
    """

    def attempts(some: Results[T], expected: int) -> Attempts[T, int]:
        return Attempts(some, bytes_of, lambda found: found <= size, _encoding, expected, progress)

    limits = results.fewest, results.available
    probes: tuple[SizeProbeReport, ...] = ()
    most = enough = part_of(size, ENOUGH, around)
    otherwise = StopReason.TARGET
    if not near:
        progress.begin("search")
        quick = attempts(results.plain(), SIZES)
        found = search_fit(quick, size, guess, *limits, around=around)
        probes, guess = found.probes, found.count
        if found.bytes < enough:  # no count uses up the size, so what this one took is enough
            enough, otherwise = part_of(found.bytes, ENOUGH, around), found.stop
        if not results.looks:
            return quick.found(), found
        del quick  # and the result that it holds
    progress.begin("deliver")
    delivered = attempts(results, RESULTS)
    found = search_fit(delivered, size, guess, *limits, enough, around)
    short = found.bytes < most and found.count < results.available
    stop = otherwise if short and found.stop is StopReason.TARGET else found.stop
    return delivered.found(), replace(found, probes=probes + found.probes, stop=stop)


def _encoding(count: int) -> Stage:
    return Stage("encode", write_weight(".sog", count))

"""Search for the largest count whose file fits a size, for formats of unpredictable file size."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from nanogs._types import I32, I64
from nanogs.errors import ModelError, TooSmallError
from nanogs.formatting import counted
from nanogs.pipeline.estimates.stage_weights import RESULTS, SIZES, write_weight
from nanogs.pipeline.outcome import Outcome
from nanogs.pipeline.search.results import Attempts, Results, T
from nanogs.progress import Stage, Tracker
from nanogs.report import SimplifyReport, SizeProbeReport, StopReason
from nanogs.splats import Splats
from nanogs.views.occupancy import FAINTEST

# `AIM` and `ENOUGH` are shares of the size less the fixed overhead of every file of the format.
AIM = 0.993  # share that a probe aims at, so that it is seldom slightly too large
ENOUGH = 0.98  # share at which a file that fits ends the search
TOLERANCE = 0.01  # the search also ends if a count larger by this share is too large
MOST_PROBES = 12
SIZE_SAMPLE = 8192  # splats of the input that are written for the first guess
HOPELESS_SHARE = 0.5  # share of the size of a one-splat file; anything smaller is refused at once
# After a count that is too large, the next is at most this share of it: at first, later on.
_SHRUNK = 0.995, 0.97
_MOST_TIMES = 16  # while all counts fit, the next is at most this many times the largest

WHOLE_FITS = "The whole model fits into the requested size; nothing was merged."

Encode = Callable[[Splats], int]
"""Writes a model's file and returns its size in bytes."""
Probe = SizeProbeReport | None
Reported = TypeVar("Reported", Outcome, SimplifyReport)


@dataclass(frozen=True, slots=True)
class FittedSize:
    """The largest count found to fit, its bytes, the probes in order, and why the search ended."""

    count: int
    bytes: int
    probes: tuple[SizeProbeReport, ...]
    stop: StopReason = StopReason.TARGET

    def notes(self, size: int, available: int, overhead: int = 0) -> tuple[str, ...]:
        """Return a note if much of the size is unused, mostly because the size jumps there."""
        if not self.probes or self.count == available:
            return ()
        # Plain cuts of fewer splats, which lead the search, can be too large as well.
        larger = [each for each in self.probes if each.bytes > size and each.count > self.count]
        over = min(larger, default=None, key=lambda probe: probe.count)
        return little_used(size, self.bytes, over, overhead)


def target_bytes(size: float, share: float, overhead: int) -> float:
    """Return the bytes of a file whose splats use a share of the size left by the overhead.

    Args:
        size: Largest allowed size of the file in bytes.
        share: Share of `size - overhead` that the splats use.
        overhead: Fixed overhead in bytes of every file of the format.
    """
    return overhead + share * (size - overhead)


def little_used(size: int, taken: int, over: Probe, overhead: int = 0) -> tuple[str, ...]:
    """Return a note if a file leaves much of the size unused, with the reason.

    Args:
        size: Largest allowed size of the file in bytes.
        taken: Bytes of the file.
        over: The smallest file found too large, or None if the search ran out of probes.
        overhead: Fixed overhead in bytes of every file of the format.
    """
    if taken >= target_bytes(size, ENOUGH, overhead):
        return ()
    more = "no larger one was found in the allowed number of tries"
    if over is not None:
        more = f"a file of {counted(over.count, 'splat')} takes {over.bytes:,} B"
    return (f"The file takes only {taken / size:.0%} of the requested size, because {more}.",)


def whole_fits(*, left_out: bool) -> str:
    """Return the note that all splats fit; `left_out` is whether some of their harmonics do not."""
    if left_out:
        return f"Without the harmonics that are left out, {WHOLE_FITS[0].lower()}{WHOLE_FITS[1:]}"
    return WHOLE_FITS


def with_ending_on_known(
    found: Reported,
    size: int,
    count: int,
    available: int,
    file_bytes: Callable[[int], int],
    *,
    left_out: bool,
) -> Reported:
    """Add why a count is the largest that fits, for formats of known file sizes.

    That is `stop`, unless something else ended the work, and a note if all splats fit or if much
    of the size is unused.

    Args:
        found: The result or its report.
        size: Largest allowed size of the file in bytes.
        count: Number of splats in the file.
        available: Number of splats of the whole model.
        file_bytes: Computes the size of the file from the count.
        left_out: Whether harmonics of the model are left out of the file.
    """
    if count == available:
        return replace(found, notes=(*found.notes, whole_fits(left_out=left_out)))
    over = SizeProbeReport(count + 1, file_bytes(count + 1))
    notes: tuple[str, ...] = little_used(size, file_bytes(count), over)
    stop = StopReason.STEP if notes and found.stop is StopReason.TARGET else found.stop
    return replace(found, stop=stop, notes=(*found.notes, *notes))


def search_fit(
    bytes_of: Callable[[int], int],
    size: int,
    guess: int,
    fewest: int,
    available: int,
    enough: float | None = None,
    overhead: int = 0,
) -> FittedSize:
    """Search by interpolation for a count whose file fits and takes most of the size.

    The file size grows with the count apart from noise, so that a slightly larger count than the
    one found may fit too. It may also jump: every second step bisects, because interpolation alone
    would approach a jump in tiny steps.

    Args:
        bytes_of: Writes the file of a count and returns its size.
        size: Largest allowed size of the file in bytes.
        guess: Count to begin with.
        fewest: Smallest count that can be delivered, at least 1.
        available: Largest count.
        enough: Bytes that end the search; by default 98 % of the size less the overhead, plus it.
        overhead: Fixed overhead in bytes of every file of the format.

    Raises:
        TooSmallError: Not even the fewest splats fit.
    """
    probes: list[SizeProbeReport] = []
    fits: Probe = None
    over: Probe = None
    enough = target_bytes(size, ENOUGH, overhead) if enough is None else enough
    aim = target_bytes(size, AIM, overhead)
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
            return FittedSize(fits.count, fits.bytes, tuple(probes), stop)
        count = _next(fits, over, aim, probes)
        count = min(max(count, fewest), available)


def too_small(size: int, fewest: int, needed: int) -> TooSmallError:
    """Make the error to raise if a file of the fewest splats is larger than the size."""
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
    """Return why the search ends, or None if another probe is worthwhile."""
    if fits.bytes >= enough or fits.count == available:
        return StopReason.TARGET
    if over is not None and over.count <= max((1 + TOLERANCE) * fits.count, fits.count + 1):
        return StopReason.STEP
    return StopReason.SETTLED if tried >= MOST_PROBES else None


def _next(fits: Probe, over: Probe, aim: float, probes: Sequence[SizeProbeReport]) -> int:
    """Return the next count to try: where the file should have `aim` bytes."""
    tried = len(probes)
    if over is None:
        assert fits is not None  # noqa: S101 - one count has been tried
        found = min(_along(probes[-2:], aim), _MOST_TIMES * fits.count)
        return max(int(found), fits.count + 1)
    if fits is None:
        shrunk = _SHRUNK[tried > 1] if tried < MOST_PROBES else 0.5  # so that the search ends
        return int(min(_along(probes[-2:], aim), over.count * shrunk))
    between = over.count - fits.count
    share = 0.5 if tried % 2 else (aim - fits.bytes) / (over.bytes - fits.bytes)
    return min(max(fits.count + int(share * between), fits.count + 1), over.count - 1)


def _along(probes: Sequence[SizeProbeReport], aim: float) -> float:
    """Return the count of `aim` bytes on the line through two probes, or through one and zero."""
    latest = probes[-1]
    for before in probes[:-1]:
        each = (before.bytes - latest.bytes) / (before.count - latest.count)
        if each > 0:  # bytes per splat; a negative slope is noise
            return latest.count - (latest.bytes - aim) / each
    return latest.count * aim / latest.bytes


def first_two(splats: Splats, rows: I32 | I64) -> I32 | I64:
    """Return (2,) the first row and the first row that is not transparent (else the first)."""
    shown = splats.opacities()[rows] > FAINTEST
    return rows[[0, int(shown.argmax())]]


def _least(sample: Splats, encode: Encode) -> int:
    """Return the bytes of a file of one splat, a visible one if the format requires it."""
    first, shown = first_two(sample, np.arange(len(sample)))
    try:
        return encode(sample.take(np.array([first])))
    except ModelError:  # a page needs something visible for its first camera
        return encode(sample.take(np.array([shown])))


def guess_count(
    sample: Splats, available: int, size: int, encode: Encode, overhead: int = 0
) -> int:
    """Estimate the count to begin with, from the file size of a sample of the model's splats.

    Args:
        sample: Some of the usable splats, spread over the model; at most `SIZE_SAMPLE` are encoded.
        available: Number of usable splats.
        size: Largest allowed size of the file in bytes.
        encode: Encodes a model and returns the bytes of the file.
        overhead: Fixed overhead in bytes of every file of the format.
    """
    least = _least(sample, encode)
    rows = np.arange(0, len(sample), -(-len(sample) // SIZE_SAMPLE))
    each = (encode(sample.take(rows)) - least) / max(len(rows) - 1, 1)
    count = 1 + int((target_bytes(size, AIM, overhead) - least) / each) if each > 0 else available
    return min(max(count, 1), available)


def refuse_hopeless(sample: Splats, size: int, encode: Encode) -> None:
    """Raise, before anything is computed, if the size is far too small.

    The bytes of the smallest result are known exactly only once it is made; a file of one splat of
    the model itself takes about as many.

    Args:
        sample: Some usable splats.
        size: Largest allowed size of the file in bytes.
        encode: Encodes a model as small as possible and returns the bytes of the file.

    Raises:
        TooSmallError: The size is less than half of a one-splat file.
    """
    least = _least(sample, encode)
    if size < HOPELESS_SHARE * least:
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
    overhead: int = 0,
) -> tuple[T, FittedSize]:
    """Make the largest result that the search finds to fit, one that takes most of the size.

    The count is searched for with plain cuts of the forest, which are quick. Only few full results,
    which are chosen by measurement and fitted, are made.

    Args:
        results: Makes results of the model.
        size: Largest allowed size of the file in bytes.
        guess: Count to begin with.
        bytes_of: Encodes a result and returns the bytes of the file.
        progress: Receives each stage.
        near: Whether the guess comes from full results, so that quick ones cannot improve it.
        overhead: Fixed overhead in bytes of every file of the format.

    Returns:
        The result, and the search that found it.

    Raises:
        TooSmallError: Not even the fewest splats fit.
    """

    def attempts(some: Results[T], expected: int) -> Attempts[T, int]:
        return Attempts(some, bytes_of, lambda found: found <= size, _encoding, expected, progress)

    limits = results.fewest, results.available
    probes: tuple[SizeProbeReport, ...] = ()
    most = enough = target_bytes(size, ENOUGH, overhead)
    otherwise = StopReason.TARGET
    if not near:
        progress.begin("search")
        quick = attempts(results.plain() if results.looks else results, SIZES)
        found = search_fit(quick, size, guess, *limits, overhead=overhead)
        probes, guess = found.probes, found.count
        if found.bytes < enough:  # no count uses up the size: aim for the bytes of this one
            enough, otherwise = target_bytes(found.bytes, ENOUGH, overhead), found.stop
        if not results.looks:
            return quick.found(), found
        del quick  # frees the result that it holds
    progress.begin("deliver")
    delivered = attempts(results, RESULTS)
    found = search_fit(delivered, size, guess, *limits, enough, overhead)
    short = found.bytes < most and found.count < results.available
    stop = otherwise if short and found.stop is StopReason.TARGET else found.stop
    return delivered.found(), replace(found, probes=probes + found.probes, stop=stop)


def _encoding(count: int) -> Stage:
    return Stage("encode", write_weight(".sog", count))

"""Choice of SH degree, palette size and bits for a file of a given size.

A megabyte holds many splats of one colour each, or fewer whose colour depends on the view; only
renders show which looks better. Each packing is tried at a count that about fills the size: a
result is made for it, packed, unpacked and compared with the original on views. The first has the
palette that a plain cut promises most with (see `plain_cuts`). The bits are chosen among its files,
since they hardly depend on the other choices. Lower degrees are measured on the first result as
well; only one that is not far behind gets a result of its own.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

from nanogs.pipeline.search.measured_files import SIZE_TOLERANCE, MeasuredFiles, slope_of
from nanogs.pipeline.search.packing import (
    LARGER_PALETTES,
    OWN_HARMONICS_FIT,
    SMALLER_PALETTES,
    BitValues,
    Packing,
    decibels,
)
from nanogs.report import PackingReport

FIRST_COUNT = 1.2  # over the guess: there is room, because coarser bits are mostly the best
# Like `SIZE_TOLERANCE`, for the bits that are best with a packing: their files are compared
# directly with each other.
BITS_TOLERANCE = 0.03
# dB by which a degree may be behind the best file of the first result, which is not fitted to it,
# and still get a result of its own.
BEHIND_UNFITTED = 1.5
HALVED = 0.5  # share of the loss by packing that is left with the next larger palette, at least
BEHIND = 0.25  # dB by which a packing may be behind the best and still be tried with other bits

MeasureFile = Callable[[Packing], PackingReport]
"""Packs the current result, whose SH degree may be higher than the packing's, and measures it."""
MeasureFiles = Callable[[MeasureFile], list[PackingReport]]
"""Measures some packings of a result with the given function, and returns their reports."""
MakeAndMeasure = Callable[[Packing, int, MeasureFiles], list[PackingReport]]
"""Makes the result with the packing's SH degree and a count, and measures packings of it."""


def choose_packing(
    files: MeasuredFiles, guess: Callable[[Packing], int], make_and_measure: MakeAndMeasure
) -> tuple[Packing, int]:
    """Search for the packing whose file of a given size looks best.

    Args:
        files: The size, what may be chosen, and no file yet; gets those that are measured.
        guess: Estimates how many of the model's own splats fill the size with a packing.
        make_and_measure: Makes a result and measures files of it.

    Returns:
        The packing, and a count that about fills the size with it.
    """
    search = _Search(files, guess, make_and_measure)
    first = best = search.begin()
    if search.own_fit >= OWN_HARMONICS_FIT:
        finest = files.choices.own_per_entry, *LARGER_PALETTES[::-1]
        best = search.climb(first, _with_palettes(first, finest))
    if best is first and first.per_entry is not None:
        best = search.climb(first, _with_palettes(first, _further(first.per_entry)))
    best = search.climb(best, [replace(best, sh_degree=degree) for degree in search.lower_degrees])
    if first.per_entry is not None:  # without palettes, `begin` has compared the bits
        best = search.compare_bits(best)
    count = files.filling_count(files.file(best))
    coarseness = files.choices.coarseness(files.file(best))
    return replace(files.with_derived_options(best), coarseness=coarseness), count


def _with_palettes(packing: Packing, sizes: Sequence[float | None]) -> list[Packing]:
    return [replace(packing, per_entry=per_entry) for per_entry in sizes]


def _further(first: float) -> list[float]:
    """Return the palettes to be tried after the first, which plain cuts promised most with.

    Args:
        first: Splats for each of its entries.
    """
    if first in SMALLER_PALETTES:
        return [each for each in SMALLER_PALETTES if each > first]
    return [each for each in LARGER_PALETTES if each < first]


@dataclass(slots=True)
class _Search:
    """A search for the best packing: it makes results, and compares their files.

    Attributes:
        files: The files that were measured.
        guess: See `choose_packing`.
        make_and_measure: See `choose_packing`.
        lower_degrees: SH degrees to be tried, because they are not far behind with the first
            result, which was not fitted for them.
    """

    files: MeasuredFiles
    guess: Callable[[Packing], int]
    make_and_measure: MakeAndMeasure
    lower_degrees: list[int] = field(default_factory=list)

    def begin(self) -> Packing:
        """Make the first result, and find the best bits for it."""
        first, files = self.files.choices.first, self.files
        count = files.limited((FIRST_COUNT if self.files.choices.bits else 1.0) * self.guess(first))
        reports = self._make(first, count, partial(self._measure_first, first))
        best = files.add(first, [each for each in reports if files.is_packed_as(each, first)])
        near = [each for each in reports if self._is_promising(each, files.file(best))]
        degrees = [each.sh_degree for each in near]
        self.lower_degrees = [degree for degree in degrees if degree < first.sh_degree]
        if first.per_entry is None:
            return self.compare_bits(best)
        return self._make_filling(best) if files.is_far(files.file(best)) else best

    def climb(self, best: Packing, others: Sequence[Packing]) -> Packing:
        """Try packings in order while each is better than the last, and return the best."""
        files = self.files
        for other in others:
            wanted = replace(other, bits=self._bits_for(other, best))
            if self._is_in_vain(wanted, best):
                break
            tried = self._try(wanted)
            if files.value_of(tried) <= files.value_of(best):
                break
            best = tried
        return best

    def compare_bits(self, best: Packing) -> Packing:
        """Find the best bits, making results that fill the size while they may change it.

        One result does not show how much splats gain with each choice of bits: they gain more if
        nearly all of them fit, and hardly anything if bits are coarse. So bits get a result of
        their own as long as the quality that they promise is above that measured for others. If
        only one choice was seen, it stays.
        """
        if self.files.number(best) == 1:
            return best
        best = self.files.with_promising_bits(best, filled=set())
        # A result with a palette takes long: the first one that is not far off is good enough.
        return self._fill_size(best, BITS_TOLERANCE if best.per_entry is None else SIZE_TOLERANCE)

    @property
    def own_fit(self) -> float:
        """Share of all splats that fit with harmonics of their own; 0 if there is no choice."""
        first = self.files.choices.first
        if first.per_entry is None:
            return 0.0
        own = replace(first, per_entry=self.files.choices.own_per_entry)
        return self.guess(own) / self.files.available

    def _bits_for(self, packing: Packing, best: Packing) -> BitValues:
        """Return the bits to try a packing with: about those of the best.

        A smaller palette takes too few bytes for fewer bits of its harmonics to save much. A larger
        one leaves no room for as many as a small one could have.
        """
        if packing.per_entry == best.per_entry:
            return best.bits
        limit = max if (packing.per_entry or 0) > (best.per_entry or 0) else min
        of_harmonics = {
            name: limit(value, self.files.choices.bits[name].search_start)
            for name, value in best.bits
            if self.files.choices.bits[name].of_harmonics
        }
        return tuple((dict(best.bits) | of_harmonics).items())

    def _is_in_vain(self, packing: Packing, best: Packing) -> bool:
        """Whether a larger palette leaves room for so few splats that it cannot gain.

        It is taken to halve what packing loses. Mostly it saves less, because bits lose as well.
        """
        if packing.sh_degree != best.sh_degree or (packing.per_entry or 0) >= (best.per_entry or 0):
            return False
        files, choices, report = self.files, self.files.choices, self.files.file(best)
        gained = decibels(choices.loss(report, HALVED)) - choices.quality(report)
        # The guess may be that much too low, and a gain is not to be missed.
        count = files.limited(FIRST_COUNT * self.guess(packing))
        return gained <= files.slope * math.log(files.filling_count(report) / count)

    def _try(self, packing: Packing) -> Packing:
        """Make results of an SH degree and palette size, if there are none; return the best bits.

        If the first file is far from the size, results follow that fill it.
        """
        files = self.files
        if not files.number(packing):
            measure_files = partial(self._measure_later, packing, only_near=True)
            count = self._expected_count(packing)
            best = files.add(packing, self._make(packing, count, measure_files))
            if files.is_far(files.file(best)):
                if files.number(packing) > 1:
                    self._fill_size(best, SIZE_TOLERANCE)
                else:
                    self._make_filling(best)
        return files.with_best_bits(packing)

    def _expected_count(self, packing: Packing) -> int:
        """Estimate the count that fills the size, from those for the model's own splats."""
        before = self.files.latest
        share = self.guess(packing) / max(self.guess(before), 1)
        return self.files.limited(self.files.filling_count(self.files.file(before)) * share)

    def _make_filling(self, packing: Packing) -> Packing:
        """Make a result again with a count that fills the size, and return the best bits."""
        count = self.files.filling_count(self.files.file(packing))
        packing = self.files.with_derived_options(packing)
        return self.files.add(
            packing, self._make(packing, count, partial(self._measure_later, packing))
        )

    def _fill_size(self, packing: Packing, tolerance: float) -> Packing:
        """Make results that fill the size, each with the bits that promise most by then.

        Args:
            packing: A packing of which several bits were compared.
            tolerance: |log(bytes / size)| up to which a result fills the size.

        Returns:
            The packing with the bits that promise most in the end.
        """
        files, filled = self.files, set[BitValues]()
        while True:
            packing = files.with_promising_bits(packing, filled)
            before = files.file(packing)
            if packing.bits in filled or not files.is_far(before, tolerance):
                return packing
            again = files.with_derived_options(packing)
            reports = self._make(
                again, files.filling_count(before), partial(self._measure_neighbours, again)
            )
            files.add_more(packing, reports, kept=filled)
            filled.add(packing.bits)
            less, more = sorted((before, reports[0]), key=lambda each: each.bytes)
            if more.bytes > (1 + BITS_TOLERANCE) * less.bytes:
                files.slope = max(files.slope, slope_of(self.files.choices, less, more))

    def _make(
        self, packing: Packing, count: int, measure_files: MeasureFiles
    ) -> list[PackingReport]:
        reports = self.make_and_measure(packing, count, measure_files)
        self.files.reports += reports
        return reports

    def _measure_first(self, first: Packing, measure: MeasureFile) -> list[PackingReport]:
        """Measure files of the first result, also with other bits and degrees."""
        report = measure(first)
        reports = [report, *self._measure_bits(first, report, measure)]
        best = max(reports, key=self.files.value)
        packing = replace(first, bits=self.files.bits_of(best))
        for degree in reversed(self.files.choices.degrees[:-1]):
            reports.append(measure(replace(packing, sh_degree=degree)))
            if not self._is_promising(reports[-1], best):
                break
        return reports

    def _measure_later(
        self, packing: Packing, measure: MeasureFile, *, only_near: bool = False
    ) -> list[PackingReport]:
        """Measure the file of a result after the first, and of one with a larger palette others.

        A small palette loses so much that it hides the effect of bits, so other bits are tried
        again with a larger one.

        Args:
            packing: How the result is packed.
            measure: Packs the result and measures the file.
            only_near: Whether other bits are tried only if the file is near the size, since
                otherwise another result is made, and not far behind the best.
        """
        report, files = measure(packing), self.files
        usual = self.files.choices.first.per_entry
        larger = usual is not None and (packing.per_entry is None or packing.per_entry < usual)
        if not larger:
            return [report]
        if only_near and (files.is_far(report) or files.value(report) < files.best_value - BEHIND):
            return [report]
        return [report, *self._measure_bits(packing, report, measure, finer=True)]

    def _measure_neighbours(self, packing: Packing, measure: MeasureFile) -> list[PackingReport]:
        """Measure the file of a result.

        If splats gain much more than was believed, files with one bit more or fewer follow.
        """
        tried = [packing]
        for name, value in packing.bits if self.files.is_steep else ():
            for way in self.files.choices.bits[name].ways(value):
                tried += [packing.with_bits(name, other) for other in way[:1]]
        return [*map(measure, tried)]

    def _measure_bits(
        self, packing: Packing, best: PackingReport, measure: MeasureFile, *, finer: bool = False
    ) -> list[PackingReport]:
        """Measure files with fewer or more bits, as long as each is better than the one before.

        Args:
            packing: How the result is packed.
            best: Its file.
            measure: Packs the result and measures the file.
            finer: Whether more bits are tried before fewer.
        """
        reports = []
        for name, option in self.files.choices.bits.items():
            start = dict(packing.bits)[name]
            for way in option.ways(start, finer=finer):
                for value in way:
                    changed = packing.with_bits(name, value)
                    reports.append(measure(changed))
                    if self.files.value(reports[-1]) <= self.files.value(best):
                        break
                    best, packing = reports[-1], changed
                if dict(packing.bits)[name] != start:
                    break
        return reports

    def _is_promising(self, report: PackingReport, best: PackingReport) -> bool:
        return self.files.value(report) > self.files.value(best) - BEHIND_UNFITTED

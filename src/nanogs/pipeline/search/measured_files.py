"""The files that were measured to choose a packing, and what they promise for a size."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

from nanogs.io.format import PALETTE
from nanogs.pipeline.search.file_size import AIM
from nanogs.pipeline.search.packing import BitValues, Choices, Packing, decibels
from nanogs.report import PackingReport

# Limits of a measured slope, dB of quality for e times the bytes.
LEAST_SLOPE, MOST_SLOPE = 2.0, 40.0
# |log(bytes / size)| up to which a file shows how good one of the right size is.
SIZE_TOLERANCE = 0.12
STEEPER = 1.5  # times the slope that bits were compared with, from which they are compared again


def slope_of(choices: Choices, less: PackingReport, more: PackingReport) -> float:
    """Compute the quality gained by more splats, dB for e times the bytes.

    It is measured from two files that are packed alike.
    """
    wider = math.log(more.bytes / less.bytes)
    rise = choices.quality(more) - choices.quality(less)
    if wider <= 0 or not math.isfinite(rise):
        return MOST_SLOPE
    return min(max(rise / wider, LEAST_SLOPE), MOST_SLOPE)


@dataclass(slots=True)
class MeasuredFiles:
    """The files that were measured, by SH degree and palette size, then by their bits.

    Attributes:
        choices: What may be chosen.
        size: Bytes that a file may have.
        slope: Quality gained by more splats, dB for e times the bytes.
        available: Splats of the whole model.
        reports: All files in the order in which they were measured.
    """

    choices: Choices
    size: int
    slope: float
    available: int
    reports: list[PackingReport] = field(default_factory=list)
    _slope_for_bits: float = math.inf  # that bits were last compared with
    _by_bits: dict[Packing, dict[BitValues, PackingReport]] = field(default_factory=dict)

    def add(self, packing: Packing, reports: Sequence[PackingReport]) -> Packing:
        """Add the files of a result, and return the packing with the best of their bits.

        They replace those of an earlier result of the same SH degree and palette size.
        """
        self._by_bits[_without_precision(packing)] = {self.bits_of(each): each for each in reports}
        if len(reports) > 1:
            self._slope_for_bits = self.slope
        return self.with_best_bits(packing)

    def add_more(
        self, packing: Packing, reports: Sequence[PackingReport], kept: set[BitValues]
    ) -> None:
        """Add the files of another result, but leave those with the bits `kept` as they are."""
        new = {self.bits_of(each): each for each in reports}
        files = self._by_bits[_without_precision(packing)]
        files |= {bits: report for bits, report in new.items() if bits not in kept}

    def number(self, packing: Packing) -> int:
        """Return for how many choices of bits a packing was measured."""
        return len(self._by_bits.get(_without_precision(packing), ()))

    def file(self, packing: Packing) -> PackingReport:
        """Return the file of a packing."""
        return self._by_bits[_without_precision(packing)][packing.bits]

    @property
    def latest(self) -> Packing:
        """The SH degree and palette size that were begun last, with their best bits."""
        return self.with_best_bits([*self._by_bits][-1])

    def with_best_bits(self, packing: Packing) -> Packing:
        """Return a measured packing with the bits of the greatest value."""
        files = self._by_bits[_without_precision(packing)]
        best = max(files, key=lambda bits: self.value(files[bits]))
        return replace(packing, bits=best, derived_options=())

    def with_promising_bits(self, packing: Packing, filled: set[BitValues]) -> Packing:
        """Return a measured packing with the bits that promise most for a result of the size.

        Args:
            packing: The packing.
            filled: Bits with which a result was made to fill the size.
        """
        promise = partial(self._promise, packing, filled)
        return replace(packing, bits=max(self._by_bits[_without_precision(packing)], key=promise))

    def with_derived_options(self, packing: Packing) -> Packing:
        """Return a measured packing for another result of about the same count.

        The options that were derived from its result are fixed in it.
        """
        chosen = {PALETTE, *self.choices.bits}
        derived = [item for item in self.file(packing).options.items() if item[0] not in chosen]
        return replace(packing, derived_options=tuple(derived))

    def bits_of(self, report: PackingReport) -> BitValues:
        """Return the bits that a file was packed with."""
        return tuple((name, report.options[name]) for name in self.choices.bits)

    def is_packed_as(self, report: PackingReport, packing: Packing) -> bool:
        """Whether a file has the SH degree and palette size of a packing, with any bits."""
        palette = packing.options(report.count).get(PALETTE)
        return report.sh_degree == packing.sh_degree and report.options.get(PALETTE) == palette

    def value(self, report: PackingReport) -> float:
        """Return the quality of a file, dB, less what its bytes beyond the size are worth."""
        return self.choices.quality(report) - self.slope * self._excess(report)

    def value_of(self, packing: Packing) -> float:
        """Return the value of a measured packing with its best bits."""
        return self.value(self.file(self.with_best_bits(packing)))

    @property
    def best_value(self) -> float:
        """The value of the best file."""
        return max(self.value(each) for files in self._by_bits.values() for each in files.values())

    def is_far(self, report: PackingReport, tolerance: float = SIZE_TOLERANCE) -> bool:
        """Whether a file is too different to show how good one of the right size is.

        Either its size is far off, or it is a little too large and holds the whole model, of which
        nothing was fitted.
        """
        far = abs(math.log(report.bytes / self.size)) > tolerance
        unfitted = report.count == self.available and report.bytes > self.size
        return (far or unfitted) and self.filling_count(report) != report.count

    def is_whole_larger(self, packing: Packing, size: int) -> bool:
        """Whether a file of the whole model, measured in a packing, is larger than a size."""
        return any(
            each.count == self.available
            and each.bytes > size
            and self.is_packed_as(each, packing)
            and self.bits_of(each) == packing.bits
            for each in self.reports
        )

    def filling_count(self, report: PackingReport) -> int:
        """Return the count whose file about fills the size, if it is packed like this one."""
        return self.limited(report.count * AIM * self.size / report.bytes)

    def limited(self, count: float) -> int:
        """Return a count as a whole number from 1 to the splats of the model."""
        return min(max(int(count), 1), self.available)

    @property
    def is_steep(self) -> bool:
        """Whether splats gain much more than was believed when bits were compared."""
        return self.slope > STEEPER * self._slope_for_bits

    def _promise(self, packing: Packing, filled: set[BitValues], bits: BitValues) -> float:
        """Estimate the best quality, dB, of a result that fills the size with these bits."""
        report = self._by_bits[_without_precision(packing)][bits]
        excess, slope = self._excess(report), self.slope
        if excess > 0 and bits not in filled and packing.per_entry is None:
            slope = LEAST_SLOPE  # the loss from fewer splats is not measured yet
        loss = from_splats = self.choices.loss(report)
        if self.is_steep:  # then what more splats diminish is at most the least loss measured
            with_as_many = (each for each in self.reports if each.count <= report.count)
            from_splats = min(map(self.choices.loss, with_as_many))
        return decibels(loss + from_splats * math.expm1(slope * excess * math.log(10) / 10))

    def _excess(self, report: PackingReport) -> float:
        """Return log(bytes / size) of a file, as far below 0 as more splats can fill the room."""
        return max(math.log(report.bytes / self.size), math.log(report.count / self.available))


def _without_precision(packing: Packing) -> Packing:
    return replace(packing, bits=(), derived_options=(), coarseness=1.0)

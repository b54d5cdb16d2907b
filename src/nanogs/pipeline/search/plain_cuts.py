"""Two plain cuts show how much more splats gain, and with which palette to begin.

A plain cut is quick to make, because nothing of it is fitted or chosen by measurement. How much is
lost if splats share harmonics differs much between models, but hardly between a plain cut and a
result of the same model. So palettes that do not suit a model are left out before results, which
take longer, are made for them.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

from nanogs.pipeline.search.choose_packing import MeasureFile, MeasureFiles
from nanogs.pipeline.search.measured_files import MeasuredFiles, slope_of
from nanogs.pipeline.search.packing import (
    FIRST_PER_ENTRY,
    LARGER_PALETTES,
    SMALLER_PALETTES,
    Choices,
)
from nanogs.report import PackingReport

CUTS = 0.5, 0.8  # shares of the count that fills a size
# dB by which, on a plain cut, the smaller palette may be behind the usual one and still be the
# first, and the larger one must be ahead. A fit to a palette makes good some of what it loses,
# more of it the smaller it is (benchmarks/first_palettes.py).
SMALLER_BEHIND, LARGER_AHEAD = 0.25, 0.7

MeasureCut = Callable[[float, MeasureFiles], list[PackingReport]]
"""Makes the plain cut with a share of the count that fills the size, and measures its files."""


def look_at_cuts(
    choices: Choices, size: int, available: int, measure_cut: MeasureCut
) -> MeasuredFiles:
    """Measure two plain cuts, to begin a search for the packing of a file of a size.

    How much more splats gain is measured without a choice of palette, whose loss would blur it.

    Args:
        choices: What may be chosen.
        size: Bytes that a file may have.
        available: Splats of the whole model.
        measure_cut: Makes a cut and measures its files.

    Returns:
        What more splats gain, and the choices with the palette to try first. The files of the cuts
        are not among the measured ones, because they are worse than those of results.
    """
    first = choices.first
    own = replace(first, per_entry=None)

    def compared(less: PackingReport, more: PackingReport) -> MeasuredFiles:
        return MeasuredFiles(choices, size, slope_of(choices, less, more), available)

    def measure_larger(measure: MeasureFile) -> list[PackingReport]:
        more = measure(own)
        if first.per_entry is None:
            return [more]
        return [more, *measure_palettes(compared(less, more), measure)]

    (less,) = measure_cut(CUTS[0], lambda measure: [measure(own)])
    more, *palettes = measure_cut(CUTS[1], measure_larger)
    files = compared(less, more)
    if palettes:
        files.choices = replace(choices, first_per_entry=first_palette(files, palettes))
    return files


def measure_palettes(files: MeasuredFiles, measure: MeasureFile) -> list[PackingReport]:
    """Measure the larger plain cut with the usual palette, a smaller and perhaps a larger one.

    Args:
        files: The size, what may be chosen, and what more splats gain.
        measure: Packs the cut and measures the file.

    Returns:
        The reports in this order; the last is left out if the smaller palette may be the first.
    """

    def measured(per_entry: float) -> PackingReport:
        return measure(replace(files.choices.first, per_entry=per_entry))

    reports = [measured(FIRST_PER_ENTRY), measured(SMALLER_PALETTES[0])]
    if not _is_small_enough(files, reports):
        reports.append(measured(LARGER_PALETTES[0]))
    return reports


def first_palette(files: MeasuredFiles, reports: Sequence[PackingReport]) -> float:
    """Return the splats for each entry of the palette to try first.

    Args:
        files: As for `measure_palettes`.
        reports: From there.
    """
    if _is_small_enough(files, reports):
        return SMALLER_PALETTES[0]
    usual, _, larger = map(files.value, reports)
    return LARGER_PALETTES[0] if larger > usual + LARGER_AHEAD else FIRST_PER_ENTRY


def _is_small_enough(files: MeasuredFiles, reports: Sequence[PackingReport]) -> bool:
    usual, smaller = map(files.value, reports[:2])
    return smaller >= usual - SMALLER_BEHIND

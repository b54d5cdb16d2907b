"""How the file of a result is packed: SH degree, palette size and bits, and what may be chosen."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from nanogs.io.format import PALETTE, Sharing
from nanogs.method.choose import quality
from nanogs.report import PackingReport

# Splats for each entry of the palette: a usual one, then larger and smaller palettes.
FIRST_PER_ENTRY = 8.0
LARGER_PALETTES, SMALLER_PALETTES = (3.0, 1.5), (32.0, 128.0)
# Share of all splats that must fit by the guess, which is up to 20 % low, for a finer packing to be
# worth the splats that it costs: a larger palette, one in which splats have harmonics of their own,
# more bits, and the most bits. The finest of each kind gains least.
LARGER_PALETTE_FIT, OWN_HARMONICS_FIT = 0.77, 0.92
MORE_BITS_FIT, MOST_BITS_FIT = 0.7, 0.88
# Share of the error of a file, before it is packed, below which packing makes nearly all of it; and
# the coarseness of rounding then.
FEW_SPLATS_MISSED, FINE = 0.2, 0.5
# Share of the error of a result that is only compared which would be left after a whole fit: 0.41
# to 0.88 in trained scenes (benchmarks/brief_fits.py).
ERROR_LEFT = 0.6

BitValues = tuple[tuple[str, int], ...]
"""Options of a format that set its precision, as (name, value)."""


@dataclass(frozen=True, slots=True)
class Packing:
    """The options that results are packed with.

    Attributes:
        sh_degree: Degree of the harmonics that are written.
        per_entry: Number of splats for each entry of the palette of the higher harmonics, or None
            without a choice of palette.
        bits: The format's options that set its precision, as (name, value).
        entries: Largest number of entries that a palette of the format has.
        coarseness: Of rounding by what shows, over the usual one; see `nanogs.io.economical`.
        derived_options: Other options of the format that were derived from one result and are
            reused for another of about the same count: otherwise its file might be of another size
            altogether.
    """

    sh_degree: int
    per_entry: float | None = None
    bits: BitValues = ()
    entries: int = 1 << 16
    derived_options: tuple[tuple[str, int], ...] = ()
    coarseness: float = 1.0

    @property
    def sharing(self) -> Sharing | None:
        """How splats share entries of the palette, or None if there is no choice."""
        if self.per_entry is None or self.sh_degree == 0:
            return None
        return Sharing(self.per_entry, self.entries)

    def with_bits(self, name: str, value: int) -> "Packing":
        """Return the packing with another value of one of `bits`, and without derived options."""
        bits = tuple((dict(self.bits) | {name: value}).items())
        return replace(self, bits=bits, derived_options=())

    def options(self, count: int) -> dict[str, Any]:
        """Return the format's options for a result of `count` splats."""
        palette = {PALETTE: self.sharing.entries(count)} if self.sharing else {}
        return dict(self.bits) | dict(self.derived_options) | palette


@dataclass(frozen=True, slots=True)
class PrecisionOption:
    """An option that sets the precision of a format, as a number of bits; see `WriteOption`.

    Attributes:
        search_start: The value that is tried first, mostly near the best.
        values: All values, ascending.
        without_rendering: The lowest value to use if nothing is rendered.
        of_harmonics: Whether it concerns only harmonics.
    """

    search_start: int
    values: Sequence[int]
    without_rendering: int
    of_harmonics: bool = False

    def ways(self, present: int, *, finer: bool = False) -> tuple[list[int], list[int]]:
        """Return the other values in both directions, each list ordered away from `present`.

        Args:
            present: The value to start from.
            finer: Whether the higher values are the first list.
        """
        fewer = [value for value in self.values if value < present][::-1]
        more = [value for value in self.values if value > present]
        return (more, fewer) if finer else (fewer, more)


@dataclass(frozen=True, slots=True)
class Choices:
    """The degrees, palettes and bits that may be chosen.

    Attributes:
        degrees: Degrees of harmonics that may be written, ascending, at least one.
        palettes: Whether the size of a palette is to be chosen.
        bits: The format's options that set its precision, by name.
        by_psnr: Whether the PSNR alone decides, without the SSIM.
        entries: Largest number of entries that a palette of the format has.
        own_per_entry: `per_entry` of the finest packing, in which splats have harmonics of their
            own: None, without a palette, or 1 if the format always has one.
        first_per_entry: Splats for each entry of the palette that is tried first.
    """

    degrees: Sequence[int]
    palettes: bool
    bits: Mapping[str, PrecisionOption] = field(default_factory=dict)
    by_psnr: bool = False
    entries: int = 1 << 16
    own_per_entry: float | None = None
    first_per_entry: float = FIRST_PER_ENTRY

    @property
    def first(self) -> Packing:
        """The packing tried first: all harmonics, and a palette size that is seldom far off."""
        palette = self.first_per_entry if self.palettes and self.degrees[-1] else None
        bits = tuple((name, each.search_start) for name, each in self.bits.items())
        return Packing(self.degrees[-1], palette, bits, self.entries)

    def quality(self, found: PackingReport) -> float:
        """Return the quality of a file as it would be after a whole fit, dB."""
        return decibels(self.loss(found))

    def loss(self, found: PackingReport, of_packing: float = 1.0) -> float:
        """Return the same as an error, like the mean squared error of a PSNR.

        A whole fit diminishes the error of the result, but not what packing adds.

        Args:
            found: The file.
            of_packing: Share of what packing adds that counts.
        """
        packed, unpacked = self._losses(found)
        return ERROR_LEFT * unpacked + of_packing * (packed - unpacked)

    def coarseness(self, found: PackingReport) -> float:
        """Return how coarsely to round by what shows, over the usual coarseness.

        If nearly all of the error is that of packing, more splats hardly diminish it, so the bytes
        are better spent on finer values. With harmonics much of it is theirs, and they are not
        rounded by what shows.
        """
        if self.by_psnr or found.sh_degree:
            return 1.0
        packed, unpacked = self._losses(found)
        return FINE if unpacked < FEW_SPLATS_MISSED * packed else 1.0

    def _losses(self, found: PackingReport) -> tuple[float, float]:
        """Return the errors of a file and, at most as large, of the result before it is packed."""
        packed = self._loss(found.psnr, found.ssim)
        return packed, min(self._loss(found.unpacked_psnr, found.unpacked_ssim), packed)

    def _loss(self, psnr: float, ssim: float) -> float:
        return math.pow(10, -(psnr if self.by_psnr else quality(psnr, ssim)) / 10)

    @property
    def any(self) -> bool:
        """Whether there is anything to choose."""
        return len(self.degrees) > 1 or self.first.per_entry is not None or bool(self.bits)


def decibels(loss: float) -> float:
    """Return an error, like the mean squared error of a PSNR, as quality in dB."""
    return -10 * math.log10(loss) if loss > 0 else math.inf


def unseen_packing(choices: Choices, guess: Callable[[Packing], int], available: int) -> Packing:
    """Return the packing if nothing is rendered: about the first of a search, or finer.

    Coarse bits and a small palette leave room for more splats, which matter most in a result that
    keeps a small part of the model. Near the whole model, precision gains more than the last
    splats: a larger palette first, then bits; with a palette, further bits gain least.

    Args:
        choices: What may be chosen.
        guess: Estimates how many of the model's own splats fill the size with a packing.
        available: Splats of the whole model.
    """
    bits = tuple((name, each.without_rendering) for name, each in choices.bits.items())
    packing = replace(choices.first, bits=bits)
    own = choices.own_per_entry
    for per_entry in (*LARGER_PALETTES, own) if packing.per_entry is not None else ():
        finer = replace(packing, per_entry=per_entry)
        needed = OWN_HARMONICS_FIT if per_entry == own else LARGER_PALETTE_FIT
        if guess(finer) < needed * available:
            if per_entry != own:
                return packing
            break
        packing = finer
    shared = packing.per_entry != own and choices.first.per_entry is not None
    for name, each in choices.bits.items():
        for value in each.ways(each.without_rendering)[1]:
            finer = packing.with_bits(name, value)
            most = shared or value == each.values[-1]
            needed = MOST_BITS_FIT if most else MORE_BITS_FIT
            if guess(finer) < needed * available:
                return packing
            packing = finer
    return packing

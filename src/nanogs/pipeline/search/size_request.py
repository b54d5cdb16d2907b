"""A request for a file of a given size, and the choices that it leaves open."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from nanogs.io.format import PALETTE, Format, Sharing
from nanogs.pipeline.estimates.memory import LEAST_BYTES
from nanogs.pipeline.search.packing import SMALLER_PALETTES, Choices, Packing, PrecisionOption

Options = Mapping[str, Any]


class SizeRequest(NamedTuple):
    """A request for a file of a given size: what is fixed, apart from what can be chosen.

    Attributes:
        size: Bytes that the file may have.
        known: Its format.
        given: Options of the format that the user gives.
        sh_degree: Of the harmonics that are to be written, or None to choose it.
        by_psnr: Whether the PSNR alone decides what is best.
        looks: Whether the choice is made on views, as in presets that render.
        most: Splats that a writer may hold whole; None for any number.
    """

    size: int
    known: Format
    given: Options
    sh_degree: int | None = None
    by_psnr: bool = False
    looks: bool = True
    most: int | None = None

    def wanted(self, degree: int) -> int:
        """Return the degree to write, if the format can hold it, for a model of an SH degree."""
        return degree if self.sh_degree is None else min(self.sh_degree, degree)

    def choices(self, degree: int) -> Choices:
        """Return the choices that are left open for a model of an SH degree."""
        highest = min(self.wanted(degree), self.known.max_degree)
        degrees: Sequence[int] = [highest]
        if not self.known.readable:
            return Choices(degrees, palettes=False)
        if self.looks and self.sh_degree is None:
            degrees = range(highest + 1)
        bits = {
            name: PrecisionOption(
                option.search_start,
                option.values,
                option.without_rendering or option.search_start,
                option.of_harmonics,
            )
            for name, option in self.known.options.items()
            if option.search_start is not None and name not in self.given
        }
        if not degrees[-1]:
            bits = {name: each for name, each in bits.items() if not each.of_harmonics}
        own_per_entry = None if self.known.streams else 1.0
        return Choices(
            degrees, self._has_palettes(), bits, self.by_psnr, self._entries(), own_per_entry
        )

    def _has_palettes(self) -> bool:
        """Whether the size of a palette is to be chosen.

        If the format can also be written without one, the writer of a palette has to hold the whole
        result, so there must be memory for it.
        """
        if PALETTE not in self.known.options or PALETTE in self.given:
            return False
        return not self.known.streams or self.most is None or self.size <= self.most * LEAST_BYTES

    def _entries(self) -> int:
        option = self.known.options.get(PALETTE)
        return option.values[-1] if option else 0

    def sharing(self, packing: Packing) -> Sharing | None:
        """Return how splats share entries of the palette; None without one."""
        if PALETTE in self.given and packing.sh_degree:
            return self.known.sharing_with(self.given)
        return packing.sharing

    def smallest(self, degree: int) -> Packing:
        """Return the packing of the smallest files, for a model of an SH degree."""
        choices = self.choices(degree)
        per_entry = SMALLER_PALETTES[-1] if choices.first.per_entry else None
        bits = tuple((name, each.values[0]) for name, each in choices.bits.items())
        return Packing(choices.degrees[0], per_entry, bits, choices.entries)

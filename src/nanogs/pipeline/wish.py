"""A wish for a file of a given size, and the interface that writes results and measures them."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol, TypeVar

from nanogs.io.format import Format
from nanogs.pipeline.packing import PALETTE, SMALLER, Bits, Choices, Packing
from nanogs.pipeline.settings import Sharing
from nanogs.report import PackingReport
from nanogs.splats import Splats

R_contra = TypeVar("R_contra", contravariant=True)
SH_BITS = "sh_bits"
LEAST_BYTES = 8  # of a splat in a packed file
Options = Mapping[str, Any]


class Files(Protocol[R_contra]):
    """Writes results to see how large their files are, and what these show."""

    def count(self, result: R_contra) -> int:
        """Splats of a result."""

    def sample_bytes(self, some: Splats, options: Options) -> int:
        """Bytes of a file of some splats, with options of the format."""

    def bytes_of(self, result: R_contra, options: Options) -> int:
        """Bytes of a result's file."""

    def shows(self) -> bool:
        """Whether views by which is chosen show the original, so that files can be looked at."""

    def seen(self, result: R_contra, sh_degree: int, options: Options) -> PackingReport:
        """Write a result to a file; measure its bytes, and its quality on the views for choosing.

        Args:
            result: The result.
            sh_degree: Of the harmonics that are written, as far as it has them.
            options: Of the format; the report has those that follow from the result too.
        """


class Wish(NamedTuple):
    """A wish for a file of a given size, without what can be chosen.

    Attributes:
        size: Bytes that it may have.
        known: Its format.
        given: Options of it.
        sh_degree: Of the harmonics that are to be written, or None to choose it.
        by_psnr: Whether the PSNR alone says what is best.
        looks: Whether views tell what is best, as presets that render have them.
        most: Splats that a writer may hold whole; None for any number.
    """

    size: int
    known: Format
    given: Options
    sh_degree: int | None = None
    by_psnr: bool = False
    looks: bool = True
    most: int | None = None

    def choices(self, degree: int) -> Choices:
        """Choices that it leaves open, of a model with harmonics of a degree."""
        highest = min(degree, self.known.max_degree)
        wanted = highest if self.sh_degree is None else min(self.sh_degree, highest)
        degrees: Sequence[int] = [wanted]
        if not self.known.readable:
            return Choices(degrees, palettes=False)
        if self.looks and self.sh_degree is None:
            degrees = range(highest + 1)
        bits = {
            name: Bits(option.begin, option.values, option.unseen or option.begin)
            for name, option in self.known.options.items()
            if option.begin is not None and name not in self.given
        }
        if not highest:
            bits.pop(SH_BITS, None)
        return Choices(degrees, self._has_palettes(), bits, self.by_psnr, self._entries())

    def _has_palettes(self) -> bool:
        """Whether a palette is to be chosen.

        Where the format can do without, one has to see the whole result, for which there must be
        room.
        """
        if PALETTE not in self.known.options or PALETTE in self.given:
            return False
        return not self.known.streams or self.most is None or self.size <= self.most * LEAST_BYTES

    def _entries(self) -> int:
        option = self.known.options.get(PALETTE)
        return max(option.values) if option else 0

    def sharing(self, packing: Packing) -> Sharing | None:
        """How splats share entries of the palette; None without one."""
        if PALETTE in self.given and packing.sh_degree:
            return Sharing(1.0, int(self.given[PALETTE]))
        return packing.sharing

    def smallest(self, degree: int) -> Packing:
        """The packing of the smallest files, of a model with harmonics of a degree."""
        choices = self.choices(degree)
        share = SMALLER[-1] if choices.first.share else None
        bits = tuple((name, each.values[0]) for name, each in choices.bits.items())
        return Packing(choices.degrees[0], share, bits, choices.entries)

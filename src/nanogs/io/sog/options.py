"""How the values of a SOG file are quantised, and the defaults."""

from dataclasses import dataclass

from nanogs.io.format import Sharing
from nanogs.io.precision import Precision
from nanogs.io.sog.meta import PALETTE_MAX

USUAL_BITS = 7  # default; files then look no worse than those of PlayCanvas' own tool
# Bits of a code of the harmonics: of an exact palette, and of merged values, which need fewer.
EXACT_BITS, MERGED_BITS = 6, 5
# By default a palette has two entries for three splats, and one each in small models. Files then
# look better than those of PlayCanvas' own tool. With a smaller palette, a file of the same size
# can hold more splats, which often looks better still.
USUAL_PALETTE = Sharing(1.5, PALETTE_MAX, 1024)
_USUAL_PRECISION = Precision(USUAL_BITS)


@dataclass(frozen=True, slots=True)
class SogOptions:
    """How the values of a file are quantised; see `write.write`.

    Attributes:
        palette_size: Largest number of entries of the palette of the higher coefficients, 1 to
            65,536; by default `USUAL_PALETTE`.
        precision: Precision of all other values.
        sh_bits: Bits of the codes of these coefficients, 2 to 8; by default 5, or 6 if the palette
            holds the very coefficients of the splats and not means of several.
    """

    palette_size: int | None = None
    precision: Precision = _USUAL_PRECISION
    sh_bits: int | None = None


USUAL_OPTIONS = SogOptions()

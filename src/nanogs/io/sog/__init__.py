"""PlayCanvas' SOG: splats in lossless WebP textures; streamed SOG has levels of detail."""

from nanogs.io.format import Format, FormatOptions, WriteOption
from nanogs.io.precision import FEWEST_BITS, MOST_BITS, MOST_SPARE_BITS
from nanogs.io.rate_distortion import Quantisation
from nanogs.io.registry import ARCHIVE, LEVELS, META
from nanogs.io.sog import rounding, write
from nanogs.io.sog.levels import open_level
from nanogs.io.sog.meta import MAX_DEGREE, PALETTE_MAX
from nanogs.io.sog.options import MERGED_BITS, USUAL_BITS, USUAL_PALETTE
from nanogs.io.sog.read import SogSource
from nanogs.io.sog.unstorable import losses
from nanogs.source import Source
from nanogs.splats import Splats

_FIRST_BITS = 6  # start of a search for the best `bits`: mostly at most one off
_OPTIONS = {
    "palette": WriteOption("palette_size", range(1, PALETTE_MAX + 1), of_harmonics=True),
    # A search goes on to fewer where files are small, for more splats or a larger palette.
    "sh_bits": WriteOption("sh_bits", range(2, 9), MERGED_BITS, of_harmonics=True),
    "bits": WriteOption(
        "bits",
        range(FEWEST_BITS, MOST_BITS + 1),
        _FIRST_BITS,
        # 6 would gain 1 dB in most scenes, but lose 4 dB in smooth ones.
        without_rendering=USUAL_BITS,
    ),
    "spare_bits": WriteOption("spare", range(MOST_SPARE_BITS + 1)),
}


def _derived_options(source: Source, options: FormatOptions) -> FormatOptions:
    bits = options.get("bits") or USUAL_BITS
    return {"spare_bits": rounding.spare_bits(source.load(), bits)}


def _quantisation(splats: Splats, options: FormatOptions) -> Quantisation:
    bits, spare = options.get("bits") or USUAL_BITS, options.get("spare_bits")
    return rounding.quantisation(splats, bits, spare)


FORMATS = (
    Format(
        ".sog",
        SogSource,
        write.write,
        reports_progress=True,
        losses=losses,
        options=_OPTIONS,
        derived_options=_derived_options,
        quantisation=_quantisation,
        max_degree=MAX_DEGREE,
        rounds=True,
        zip_member=META,
        sharing=USUAL_PALETTE,
    ),
    Format(
        META,
        SogSource,
        reports_progress=True,
        losses=losses,
        options=_OPTIONS,
        derived_options=_derived_options,
        quantisation=_quantisation,
        max_degree=MAX_DEGREE,
        rounds=True,
        write_folder=write.write_folder,
        named_files=lambda path: SogSource(path).files[1:],
        ours=write.ours,
        sharing=USUAL_PALETTE,
    ),
    Format(LEVELS, open_level, open_level=open_level, rounds=True),
    Format(ARCHIVE, open_level, open_level=open_level, rounds=True, zip_member=LEVELS),
)

"""Niantic's `.spz`: columns of bytes, packed by gzip or zstd."""

from collections.abc import Sequence

from nanogs.io.format import Format, FormatOptions, WriteOption
from nanogs.io.precision import FEWEST_BITS, MOST_BITS, MOST_SPARE_BITS
from nanogs.io.rate_distortion import Quantisation
from nanogs.io.spz import rounding, write
from nanogs.io.spz.centres import spare_bits
from nanogs.io.spz.header import GZIP, MAGIC, RECORDED_FRAMES, VERSION_WITH_FRAME
from nanogs.io.spz.read import open_spz
from nanogs.io.spz.records import is_record_name
from nanogs.io.spz.unstorable import losses
from nanogs.source import Source
from nanogs.splats import Splats

_FRAME = (
    "not stated in the file; y up (rub) by the specification, though many files have y down (rdf)"
)

# Where a search for the best values starts: usually at most one away from them.
_FIRST_BITS, _FIRST_SH_BITS = 6, 6


def _version(options: FormatOptions) -> int:
    """Return the file version that these options lead to, for a model without extension records."""
    bits = options.get("bits") or MOST_BITS
    usual = write.usual_version(bits, stating=bool(options.get("frame")))
    return options.get("spz_version") or usual


def _derived_options(source: Source, options: FormatOptions) -> FormatOptions:
    return {"spare_bits": spare_bits(source, options.get("bits") or MOST_BITS)}


def _quantisation(splats: Splats, options: FormatOptions) -> Quantisation:
    bits, spare = options.get("bits") or MOST_BITS, options.get("spare_bits")
    return rounding.quantisation(splats, bits, _version(options), spare)


def _check_options(options: FormatOptions) -> None:
    if options.get("frame"):
        write.check_holds_records(_version(options), "states its frame")


def _check_elements(names: Sequence[str], options: FormatOptions) -> None:
    version = options.get("spz_version")
    if version is not None and any(map(is_record_name, names)):
        write.check_holds_records(version, write.HOLDS_RECORDS)


FORMATS = (
    Format(
        ".spz",
        open_spz,
        write.write,
        losses=losses,
        frame=_FRAME,
        axes=None,
        options={
            "spz_version": WriteOption("version", (2, 3, 4)),
            "palette": WriteOption(
                "palette_size", range(1, write.MOST_ENTRIES + 1), whole=True, of_harmonics=True
            ),
            "bits": WriteOption("bits", range(FEWEST_BITS, MOST_BITS + 1), _FIRST_BITS),
            "sh_bits": WriteOption("sh_bits", range(2, 9), _FIRST_SH_BITS, of_harmonics=True),
            "spare_bits": WriteOption("spare", range(MOST_SPARE_BITS + 1)),
            "frame": WriteOption("frame", RECORDED_FRAMES),
        },
        states_frame=lambda options: _version(options) == VERSION_WITH_FRAME,
        check_options=_check_options,
        check_elements=_check_elements,
        derived_options=_derived_options,
        quantisation=_quantisation,
        reports_progress=True,
        streams=True,
        rounds=True,
        magic=(MAGIC, GZIP),
    ),
)

"""Writing `.spz` (Niantic), version 2 to 4; `header` and `read` describe the layout.

SH coefficients of degree 1 keep 5 bits and higher ones 4, as in the reference writer: the fewer
values a byte takes, the better it compresses. Unlike there, the number of fraction bits depends on
the scene, so that a small one keeps its detail and a large one does not wrap around; and centres
and rotations are quantised no finer than is worthwhile beside scales, which have steps of a
sixteenth.

With fewer bits than 8, the axes of each splat are reordered so that its rotation is as small as
possible, and fewer codes are in use. The three bytes of version 2 then hold as much of a rotation
as four, so files are of that version; and rows are sorted so that they compress well.

The higher SH coefficients are most of a file. The format has no palette, but repetitions within
32 kB cost gzip next to nothing: with a palette, splats that share an entry are written in a row, so
that each entry is packed once.
"""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import BinaryIO

import numpy as np

from nanogs._types import F32, F64, I64, U8
from nanogs.activations import BYTE_LOGITS, rounded_bytes
from nanogs.errors import OptionError, OutputError, UnstorableError
from nanogs.findings import Finding
from nanogs.io import limits
from nanogs.io.by_column import Encoder, encoded_columns
from nanogs.io.palette import palette
from nanogs.io.precision import FINEST, MOST_BITS, Precision, visibility
from nanogs.io.rate_distortion import Quantisation
from nanogs.io.rotations import Rounding, minimise_rotation, place_left_out, split_quats
from nanogs.io.spz.body import frame_record
from nanogs.io.spz.header import (
    ANTIALIASED,
    EXTENSIONS,
    HEADER,
    LAST_GZIP,
    LEGACY_HEADER,
    MAGIC,
    TOC_ENTRY,
    column_widths,
)
from nanogs.io.spz.packing import BEST, is_small, sorted_columns, write_gzip
from nanogs.io.spz.read import (
    COLOUR_SCALE,
    COLOURS,
    LOG_SCALES,
    MAGNITUDE,
    SCALE_LOW,
    SCALE_STEPS,
    SH_STEPS,
)
from nanogs.io.spz.records import has_per_splat_record, packed, without_records
from nanogs.progress import PartProgress, ignore_progress
from nanogs.source import InMemory, Source, source_of
from nanogs.splats import RenderMode, Splats

SUFFIX = ".spz"
SH_BITS = 5  # bits kept of an SH coefficient of degree 1; of a higher degree, one less
# File versions: the default, the one with 3-byte rotations, and the one that can state a frame.
DEFAULT_VERSION, VERSION_SHORT_ROTATIONS, VERSION_WITH_FRAME = 3, 2, 4
MOST_ENTRIES = 1 << 20  # of a palette
HOLDS_RECORDS = "holds the extension records of the model"  # for `check_holds_records`
USUAL_FRACTION_BITS = 12
_FIXED_MAX = (1 << 23) - 1
_SIGNIFICANT_BITS = 16
_BYTE, _ZERO = 255, 128  # the codes of 1 (opaque) and of 0 in a component of a rotation
_END = 1e-3  # distance, in codes, of values from an end that were read from its code
_BLACK = 60  # the code of a base colour that is almost black
_ZSTD_LEVEL = 12  # the reference writer's


@dataclass(frozen=True, slots=True)
class Steps:
    """Quantisation steps, in units of the stored codes, for each kind of value.

    They are balanced so that each kind of value costs about the same error in rendered views.

    Attributes:
        scales: Step of log-scales.
        rotations: Step of the rotations of version 2.
        magnitudes: Step of the 9-bit magnitudes in the rotations of later versions.
        colours: Step of base colours, counted from black, which many splats have.
        alphas: Step of alphas, counted from opaque.
    """

    scales: int
    rotations: int
    magnitudes: int
    colours: int
    alphas: int


STEPS = {
    8: Steps(1, 1, 4, 1, 1),
    7: Steps(1, 1, 8, 2, 2),
    6: Steps(2, 2, 16, 4, 4),
    5: Steps(2, 3, 16, 5, 5),
    4: Steps(4, 5, 32, 8, 8),
}
"""Quantisation steps by the value of the option `bits`."""


def write(
    model: Splats | Source,
    file: BinaryIO,
    on_progress: PartProgress = ignore_progress,
    *,
    version: int | None = None,
    palette_size: int | None = None,
    bits: int = MOST_BITS,
    sh_bits: int = SH_BITS,
    spare: int | None = None,
    frame: str | None = None,
    gzip_level: int = BEST,
) -> None:
    """Write a model, with its axes unchanged; `losses` names what the file cannot hold.

    Args:
        model: The model. Of a source, at most one column is held in memory, in its encoded form,
            unless there is a palette, or all columns are so small that they are packed as a whole.
        file: Open for binary writing.
        on_progress: Progress callback for the merges that build a palette.
        version: 3 (gzip), which Spark reads; 4 (zstd), as today's reference writer writes; or 2
            (gzip), which older readers know, with less precise rotations. The default is 3, or 2
            with fewer bits than 8; but 4 for a frame or for a model with extension records, which
            come from a file of that version.
        palette_size: Most distinct sets of higher SH coefficients; by default each splat has its
            own. Splats that share a set are then written in a row.
        bits: Precision of values, 4 to 8, see `STEPS`. With fewer than 8, the rows of small files
            are reordered, see `packing`.
        sh_bits: Bits of an SH coefficient of degree 1, 2 to 8; higher degrees have one less.
        spare: Fraction bits dropped from centres, 0 to 6; by default depending on how small the
            splats are, see `Precision.spare_bits`.
        frame: The coordinate frame of the axes, which the file then states; for version 4 only,
            because readers of older ones expect nothing after the columns.
        gzip_level: Compression level of versions 2 and 3, see `packing.write_gzip`.

    Raises:
        OptionError: A frame or extension records are given with another version than 4, or `spare`
            exceeds the fraction bits that centres have.
        OutputError: A value is NaN or infinite, or a centre is too far out; nothing has been
            written then.
        OSError: The system refuses to write.
    """
    source = source_of(model)
    elements = source.read_elements()
    records = packed(elements) + (frame_record(frame) if frame else b"")
    version = version or usual_version(bits, stating=bool(records))
    if records:
        check_holds_records(version, "states its frame" if frame else HOLDS_RECORDS)
    degree, count = source.columns.sh_degree, source.count
    fraction = fraction_bits(source, Precision(bits, spare))
    movable, groups = not has_per_splat_record(elements, count), None
    buckets = _buckets(degree, sh_bits)[:, None]
    if palette_size is not None and degree and count:
        source, groups = _with_palette(
            source.load(), palette_size, on_progress, buckets if movable else None
        )
    flags = ANTIALIASED if source.columns.render_mode == RenderMode.MIP else 0
    flags |= EXTENSIONS if records else 0
    start = (MAGIC, version, count, degree, fraction, flags)
    columns: Iterator[Iterable[bytes]] = encoded_columns(
        source, _encoders(fraction, version, bits, buckets)
    )
    widths = list(column_widths(version, degree).values())
    size = count * sum(widths)
    if movable and (bits < MOST_BITS or groups is not None) and is_small(size):
        columns = sorted_columns(columns, widths, count, groups)
    if VERSION_SHORT_ROTATIONS <= version <= LAST_GZIP:
        write_gzip(file, LEGACY_HEADER.pack(*start, 0), columns, size, gzip_level)
    elif version == VERSION_WITH_FRAME:
        streams = [_compressed(column) for column in columns]
        file.write(HEADER.pack(*start, len(streams), HEADER.size + len(records)) + records)
        sizes = zip(streams, widths, strict=True)
        file.writelines(TOC_ENTRY.pack(len(column), w * count) for column, w in sizes)
        file.writelines(streams)
    else:
        raise OutputError(f"nanogs does not write .spz version {version}; choose 2, 3 or 4.")


def check_holds_records(version: int, what: str) -> None:
    """Refuse a file version that cannot hold extension records.

    Args:
        version: The version that is to be written.
        what: The feature that only version `VERSION_WITH_FRAME` has, for the message.

    Raises:
        OptionError: It is not version `VERSION_WITH_FRAME`.
    """
    if version != VERSION_WITH_FRAME:
        raise OptionError(
            f"Only .spz of version {VERSION_WITH_FRAME} {what}; leave"
            f" `spz_version={version}` out, or give {VERSION_WITH_FRAME}."
        )


def usual_version(bits: int, *, stating: bool) -> int:
    """Return the default file version.

    Args:
        bits: Precision of values.
        stating: Whether there are extension records, that of a frame included.
    """
    if stating:
        return VERSION_WITH_FRAME
    return DEFAULT_VERSION if bits == MOST_BITS else VERSION_SHORT_ROTATIONS


def losses(
    splats: Splats, *, records: bool = True, suffix: str = SUFFIX, range_of: str = SUFFIX
) -> tuple[str, ...]:
    """Name what the file leaves out or clamps, or why it is refused, one sentence each.

    Args:
        splats: The model.
        records: Whether its extension records go into the file.
        suffix: Name of the format in the sentences, if it contains this one.
        range_of: What has the range to which values are clamped, in the sentences.
    """
    step = 0.5 / SCALE_STEPS
    low, high = SCALE_LOW, SCALE_LOW + 255 / SCALE_STEPS
    scales = splats.log_scales
    with np.errstate(invalid="ignore"):  # signalling NaNs would warn
        far = (np.abs(splats.means) > _FIXED_MAX) & np.isfinite(splats.means)
    beyond = f"coordinates beyond ±{_FIXED_MAX:,}"
    out = list(limits.refusal(int(far.any(axis=1).sum()), suffix, beyond))
    out += limits.left_out(without_records(splats) if records else splats, suffix)
    out += limits.lost_mode(splats, suffix, RenderMode.MIP)
    out += limits.clamped(
        (scales < low - step) | (scales > high + step),
        f"log-scales outside {low:g} to {high:.2f}, the range of {range_of}",
    )
    out += clamped_colours(splats, range_of)
    fraction = _most_fraction_bits(_reach([splats]))
    if 0 <= fraction < USUAL_FRACTION_BITS:
        text = "Centres are rounded to 1/{}, because the scene is so large."
        out.append(Finding(text, 1 << fraction, min))
    return tuple(out)


def clamped_colours(splats: Splats, range_of: str) -> list[str]:
    """Return a sentence each if base colours, or higher SH coefficients, are clamped to a range."""
    colours, rest = splats.sh[:, 0], splats.sh[:, 1:]
    widest = 0.5 / COLOUR_SCALE
    half = (_buckets(splats.sh_degree, SH_BITS) / 2 / SH_STEPS)[:, None]
    out = limits.clamped(
        np.abs(colours) > widest * (1 + 1 / 255),
        f"base colours outside ±{widest:.2f}, the range of {range_of}",
    )
    return out + limits.clamped(
        (rest < -1 - half) | (rest > 1 - 1 / SH_STEPS + half),
        f"higher SH coefficients outside ±1, the range of {range_of}",
    )


def fraction_bits(model: Splats | Source, precision: Precision = FINEST) -> int:
    """Return the number of fraction bits for centres: 12 or more, less those that are spared.

    They are spared where splats are so large that they do not need them. Very large scenes have
    fewer than 12, and then none is spared by default.

    Args:
        model: The model.
        precision: Precision of the values, and how many bits are spared if it states that.

    Raises:
        OptionError: The `spare` of `precision` exceeds the number of fraction bits that there are.
        OutputError: A value is NaN or infinite, or a centre is too far out for 24-bit integers.
    """
    most, spare = _fraction_and_spare(source_of(model), precision)
    if spare > most:
        raise OptionError(
            f"`spare_bits={spare}` leaves none of the {most} fraction bits of the centres; give"
            " fewer."
        )
    return most - spare


def spare_bits(source: Source, bits: int = MOST_BITS) -> int:
    """Return the number of fraction bits that `write` drops from centres by default.

    Args:
        source: The model.
        bits: As for `write`.

    Raises:
        OutputError: As for `fraction_bits`.
    """
    return _fraction_and_spare(source, Precision(bits))[1]


def _fraction_and_spare(source: Source, precision: Precision) -> tuple[int, int]:
    """Return the most fraction bits that the scene's extent allows, and how many are dropped.

    Raises:
        OutputError: As for `fraction_bits`.
    """
    reach = _reach(limits.storable(source, SUFFIX))
    if (most := _most_fraction_bits(reach)) < 0:
        raise UnstorableError(
            f"A centre is {reach:g} from the origin along an axis, but {SUFFIX} ends at"
            f" {_FIXED_MAX:,}; move the model to the origin or scale it down."
        )
    spare = _spare(source, precision, most)
    # Rounding down to a power of two makes room for one more bit. Without it, a file that is read
    # and written again would change.
    decoded = math.ldexp(round(math.ldexp(reach, most - spare)), spare - most)
    if (more := _most_fraction_bits(decoded)) > most:
        return more, _spare(source, precision, more)
    return most, spare


def _spare(source: Source, precision: Precision, fraction: int) -> int:
    """Return how many of a number of fraction bits to drop from centres."""
    if precision.spare is None and fraction < USUAL_FRACTION_BITS:
        return 0
    step = np.full((1, 1), math.ldexp(1.0, -fraction))
    decoded = (_sizes_as_decoded(block, STEPS[precision.bits]) for block in source.blocks())
    return precision.spare_bits(decoded, lambda _block: step)


def _sizes_as_decoded(block: Splats, steps: Steps) -> Splats:
    """Return a block with the scales and opacities that reading it again gives.

    Fraction bits are spared by these, so that a model that was read is written with as many as
    before.
    """
    return replace(
        block,
        log_scales=LOG_SCALES[_scales(block.log_scales, steps.scales)],
        opacity_logits=BYTE_LOGITS[_alphas(block, steps.alphas)],
    )


def _reach(blocks: Iterable[Splats]) -> float:
    """Return the largest absolute coordinate of all centres; NaN if one of them is NaN."""
    return float(np.max([np.abs(block.means).max(initial=0) for block in blocks], initial=0))


def _most_fraction_bits(reach: float) -> int:
    """Return the fraction bits for an extent; negative if it is too large or not finite."""
    if not reach <= _FIXED_MAX:
        return -1
    mantissa, exponent = math.frexp(reach or math.ulp(0))  # as near as possible to zero
    exponent -= mantissa == 0.5  # reach <= 2^exponent: centres may be rounded up to it
    most = min(max(USUAL_FRACTION_BITS, _SIGNIFICANT_BITS - exponent), 23 - exponent, 20)
    return most - (round(math.ldexp(reach, most)) > _FIXED_MAX)


def _with_palette(
    splats: Splats, size: int, on_progress: PartProgress, buckets: F64 | None
) -> tuple[InMemory, I64 | None]:
    """Replace the higher SH coefficients by at most `size` palette entries.

    Args:
        splats: N splats.
        size: Largest number of entries.
        on_progress: Progress callback.
        buckets: (K - 1, 1) steps of the coefficients; None if splats may not be moved.

    Returns:
        The splats, sorted by palette entry, and (N,) int64, the entry of each, ascending; entries
        that the steps make equal count as one. If splats may not be moved: the splats in their own
        order, and None.
    """
    points = splats.sh[:, 1:].reshape(len(splats), -1)
    found = palette(points, size, visibility(splats), on_progress)
    sh = splats.sh.copy()
    sh[:, 1:] = found.entries[found.labels].reshape(len(splats), -1, 3)
    sharing = replace(splats, sh=sh)
    if buckets is None:
        return InMemory(sharing), None
    codes = _coefficients(found.entries.reshape(len(found.entries), -1, 3), buckets)
    distinct = palette(codes.astype(np.float32), len(codes))
    labels = distinct.labels[found.labels]
    rows = np.argsort(labels, kind="stable")
    return InMemory(sharing.take(rows)), labels[rows].astype(np.int64)


def _encoders(fraction: int, version: int, bits: int, buckets: F64) -> list[Encoder]:
    """Return the functions that encode a block of rows, one for each column of the file."""
    steps = STEPS[bits]
    pack: Callable[[F32], U8]
    turned: Callable[[Splats], tuple[F32, F32]] = _as_they_are
    if version == VERSION_SHORT_ROTATIONS:
        rounding = _xyz_rounding(steps.rotations)
        pack = partial(_xyz_rotations, step=steps.rotations)
        turned = partial(_unit_or_read, rounding=rounding)
    else:
        rounding = _rounding(steps.magnitudes)
        pack = partial(_rotations, rounding=rounding, step=steps.magnitudes)
    if bits < MOST_BITS:
        turned = partial(_smallest_rotations, rounding=rounding)
    encoders: list[Encoder] = [
        lambda block: _positions(block.means, fraction),
        lambda block: _alphas(block, steps.alphas),
        lambda block: _stepped(_colours(block), steps.colours, _BLACK),
        lambda block: _scales(turned(block)[1], steps.scales),
        lambda block: pack(turned(block)[0]),
    ]
    if len(buckets):
        encoders.append(lambda block: _coefficients(block.sh[:, 1:], buckets))
    return encoders


def quantisation(splats: Splats, bits: int, version: int, spare: int | None) -> Quantisation:
    """Return the values that `write` can give a model, in a version of the format.

    Args:
        splats: The model.
        bits: As for `write`.
        version: As for `write`.
        spare: As for `write`.

    Raises:
        OptionError: As for `write`.
        OutputError: As for `write`.
    """
    steps, fraction = STEPS[bits], fraction_bits(splats, Precision(bits, spare))
    rotations: F64 | None = None
    if bits < MOST_BITS and version == VERSION_SHORT_ROTATIONS:
        rotations = _codes(steps.rotations, _ZERO) / 127.5 - 1
    elif bits < MOST_BITS:
        codes = np.arange(-(MAGNITUDE // steps.magnitudes), MAGNITUDE // steps.magnitudes + 1)
        rotations = codes * np.float64(steps.magnitudes * math.sqrt(0.5) / MAGNITUDE)
    return Quantisation(
        centres=(_on_grid(splats.means, fraction), _on_grid(splats.means, fraction - 1)),
        log_scales=LOG_SCALES[_codes(steps.scales)],
        logits=BYTE_LOGITS[_codes(steps.alphas, _BYTE)],
        colours=COLOURS[_codes(steps.colours, _BLACK)],
        rotations=rotations,
    )


def _on_grid(means: F32, fraction: int) -> F32:
    """Return centres, (N, 3), with this number of fraction bits."""
    return np.ldexp(_fixed_point(means, fraction), -fraction).astype(np.float32)


def _codes(step: int, start: int = 0) -> I64:
    """Return the codes that `_stepped` gives, ascending."""
    return np.unique(_stepped(np.arange(256.0), step, start)).astype(np.int64)


def _alphas(block: Splats, step: int) -> U8:
    """Encode (R,) opacities as codes; invisible splats stay invisible, whatever the step."""
    values = block.opacities() * _BYTE
    codes = _stepped(values, step, _BYTE)
    codes[values < 0.5] = 0  # the code that a step of 1 gives
    return codes


def _scales(log_scales: F32, step: int) -> U8:
    """Encode (R, 3) log-scales as codes."""
    return _stepped((log_scales - np.float64(SCALE_LOW)) * SCALE_STEPS, step)


def _colours(block: Splats) -> F64:
    """Return (R, 3) base colours in units of codes, before rounding."""
    codes: F64 = (block.sh[:, 0] * np.float64(COLOUR_SCALE) + 0.5) * _BYTE
    return codes


def _as_they_are(block: Splats) -> tuple[F32, F32]:
    """Return the rotations, (R, 4) unit wxyz, and the (R, 3) log-scales, with axes unchanged."""
    return block.unit_quats(), block.log_scales


def _unit_or_read(block: Splats, rounding: Rounding) -> tuple[F32, F32]:
    """Do as `_as_they_are`, but do not normalise rotations that were read with w = 0.

    Their three bytes may stand for a length a little above 1, and are written again like this.
    """
    quats = block.unit_quats()
    rows = np.flatnonzero(block.quats[:, 0] == 0)
    stored = block.quats[rows]
    near = np.abs(np.linalg.norm(stored.astype(np.float64), axis=1) - 1) < 2 * rounding.error
    read = near & rounding.keeps(stored[:, 1:].astype(np.float64))
    quats[rows[read]] = stored[read]
    return quats, block.log_scales


def _smallest_rotations(block: Splats, rounding: Rounding) -> tuple[F32, F32]:
    """Return rotations and log-scales with the axes reordered so that rotations are small."""
    quats, log_scales = minimise_rotation(block, rounding)
    return quats.astype(np.float32), log_scales


def _stepped(values: F32 | F64, step: int, start: int = 0) -> U8:
    """Round values to the nearest code of the grid that contains `start` and has this step."""
    if step == 1:
        return rounded_bytes(values)
    nearest = start + step * np.rint((values - start) / step)
    # Both ends are codes of every grid: values beyond them are clamped to them, and stay there when
    # a file is read and written again.
    nearest = np.where(values < _END, 0, np.where(values > _BYTE - _END, _BYTE, nearest))
    return rounded_bytes(nearest)


def _compressed(column: Iterable[bytes]) -> bytes:
    """Compress one column to a zstd frame that states its size and has a checksum."""
    import zstandard

    plain = b"".join(column)
    return zstandard.ZstdCompressor(level=_ZSTD_LEVEL, write_checksum=True).compress(plain)


def _fixed_point(means: F32 | F64, fraction: int) -> F64:
    """Return centres as whole numbers, with this number of fraction bits."""
    fixed: F64 = np.rint(np.ldexp(means.astype(np.float64), fraction))
    return fixed


def _positions(means: F32 | F64, fraction: int) -> U8:
    """Encode (R, 3) centres as (R, 3, 3) bytes: a little-endian 24-bit integer for each value.

    `fraction` is the number of their fraction bits.
    """
    fixed = _fixed_point(means, fraction).astype("<i4")
    wide: U8 = fixed[:, :, None].view(np.uint8)
    return wide[:, :, :3]


def _xyz_rotations(quats: F32, step: int) -> U8:
    """Encode (R, 4) unit wxyz as (R, 3) codes of xyz, with the sign for which w is positive."""
    return _xyz_codes(np.where(quats[:, :1] < 0, -quats[:, 1:], quats[:, 1:]), step)


def _xyz_codes(xyz: F32 | F64, step: int) -> U8:
    return _stepped((xyz.astype(np.float64) + 1) * 127.5, step, _ZERO)


def _xyz_rounding(step: int) -> Rounding:
    """Return how the rotations of version 2 are rounded."""
    return Rounding(lambda xyz: _xyz_codes(xyz, step) / 127.5 - 1, step / 255)


def _rotations(quats: F32, rounding: Rounding, step: int) -> U8:
    """Encode (R, 4) unit wxyz as (R, 4) bytes, the layout of versions 3 and 4.

    It is the index of the largest component, then sign and magnitude of each other one; magnitudes
    are multiples of the step.
    """
    xyzw = quats[:, [1, 2, 3, 0]].astype(np.float64)
    largest, small = split_quats(xyzw, place_left_out(xyzw, rounding))
    # A magnitude of 0 has a sign too, which is read as that of a zero.
    parts = _magnitudes(small, step).astype(np.uint32) | np.signbit(small).astype(np.uint32) << 9
    packed = largest.astype(np.uint32) << 30 | parts[:, 0] << 20 | parts[:, 1] << 10 | parts[:, 2]
    result: U8 = packed.astype("<u4")[:, None].view(np.uint8)
    return result


def _magnitudes(small: F64, step: int) -> F64:
    exact = np.minimum(np.abs(small) / np.sqrt(0.5), 1) * (MAGNITUDE / step)
    whole: F64 = np.minimum(np.rint(exact), MAGNITUDE // step) * step
    return whole


def _rounding(step: int) -> Rounding:
    """Return how the rotations of versions 3 and 4 are rounded."""
    one = np.sqrt(0.5) / MAGNITUDE
    return Rounding(lambda v: np.copysign(_magnitudes(v, step) * one, v), step / 2 * one)


def _buckets(degree: int, sh_bits: int) -> F64:
    """Return (K - 1,) quantisation steps of the higher SH coefficients, in units of codes."""
    per_band = [2.0 ** (8 - sh_bits + (band > 1)) for band in range(1, degree + 1)]
    return np.repeat(per_band, [2 * band + 1 for band in range(1, degree + 1)])


def _coefficients(sh: F32, buckets: F64) -> U8:
    """Encode higher SH coefficients as (R, 3 (K - 1)) codes, rounded to the bucket's multiples.

    The grid contains 128, the code of zero.
    """
    nearest = np.rint(sh.astype(np.float64) * SH_STEPS / buckets) * buckets + 128
    return rounded_bytes(nearest).reshape(len(sh), -1)

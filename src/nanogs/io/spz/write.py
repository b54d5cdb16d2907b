"""Writing `.spz` (Niantic), version 2 to 4; `header` and `read` have the layout.

Coefficients of degree 1 keep 5 bits and higher ones 4, as the reference writer has it: the fewer
values a byte takes, the better it compresses. Unlike there, the fraction bits follow the scene,
so that a small one keeps its detail and a large one does not wrap around; and centres and
rotations are no finer than they are worth beside scales, which have steps of a sixteenth.

With fewer bits than 8, splats are turned as little as their axes allow, so that fewer codes are in
use. Three bytes, as version 2 has them, then hold as much of a rotation as four, and files are of
that version; and rows go in an order that packs well.

The higher coefficients are most of a file. Nothing in the format lets splats share them, but what
repeats within 32 kB costs gzip next to nothing: with a palette, splats that share an entry follow
each other, and so each entry is packed once.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import BinaryIO

import numpy as np

from nanogs._types import F32, F64, I64, U8
from nanogs.errors import OptionError, OutputError, UnstorableError
from nanogs.findings import Finding
from nanogs.io import limits
from nanogs.io.by_column import Encoder, encoded_columns
from nanogs.io.palette import palette
from nanogs.io.precision import FINEST, MOST_BITS, Precision, visibility
from nanogs.io.rotations import least_turned, split_quats
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
from nanogs.io.spz.read import COLOUR_SCALE, MAGNITUDE, SCALE_LOW, SCALE_STEPS, SH_STEPS
from nanogs.io.spz.records import of_splats, packed, without_records
from nanogs.progress import Parts, untold
from nanogs.source import InMemory, Source, source_of
from nanogs.splats import RenderMode, Splats
from nanogs.stored import rounded_bytes

SUFFIX = ".spz"
SH_BITS = 5  # kept of a coefficient of degree 1; of a higher one, one less
# Versions: the usual one, that of rounded rotations, and the one that can state a frame.
USUAL, ROUNDED, STATING = 3, 2, 4
MOST_ENTRIES = 1 << 20  # of a palette
USUAL_FRACTION_BITS = 12
_FIXED_MAX = (1 << 23) - 1
_SIGNIFICANT_BITS = 16
_BYTE, _ZERO = 255, 128  # codes of 1, which is opaque, and of no rotation
_BLACK = 60  # of the base colour, nearly
_ZSTD_LEVEL = 12  # the reference writer's


@dataclass(frozen=True, slots=True)
class Steps:
    """Codes from one that is used to the next, so that each kind of value costs views as much.

    Attributes:
        scales: Of log-scales.
        rotations: Of version 2.
        magnitudes: Of the rotations of later versions.
        colours: Of base colours, counted from black, which many splats are.
        alphas: Counted from opaque.
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
"""By the bits that are asked for."""


def write(
    model: Splats | Source,
    file: BinaryIO,
    tell: Parts = untold,
    *,
    version: int | None = None,
    palette_size: int | None = None,
    bits: int = MOST_BITS,
    sh_bits: int = SH_BITS,
    spare: int | None = None,
    frame: str | None = None,
    gzip_level: int = BEST,
) -> None:
    """Write a model, axes as they are; `losses` says what does not go in.

    Args:
        model: The model; of a source, no more than a column is held, and that as it is written,
            unless there is a palette, or all columns are so small that they are packed as a whole.
        file: Open for binary writing.
        tell: Told of the merges that a palette comes of.
        version: 3 (gzip), which Spark reads; 4 (zstd), as today's reference writer has it; or 2
            (gzip), which older readers know, with rotations of less precision. By default 3, with
            fewer bits than 8 2, but 4 for a model with extension records, which were read of such a
            file, or with a frame.
        palette_size: Most sets of higher coefficients that splats may have; by default each splat
            has its own. Splats of one set then follow each other.
        bits: How fine values are, 4 to 8, see `STEPS`. With fewer than 8, rows of small files go in
            another order, see `packing`.
        sh_bits: Of a coefficient of degree 1, 2 to 8; higher ones have one less.
        spare: Bits that centres do without, 0 to 6; by default they are as fine as splats are
            small, see `Precision.spare_bits`.
        frame: The frame of the axes, which the file then states; of version 4 alone, since readers
            of older ones expect nothing after the columns.
        gzip_level: Of versions 2 and 3, see `packing.write_gzip`.

    Raises:
        OptionError: A frame or a record is to be in a file of another version, or centres are to do
            without more bits than they have.
        OutputError: A value is NaN or infinite, or a centre is too far out; nothing has been
            written then.
        OSError: The system refuses to write.
    """
    source = source_of(model)
    elements = source.read_elements()
    records = packed(elements) + (frame_record(frame) if frame else b"")
    version = version or usual_version(bits, stating=bool(records))
    if records:
        what = "states its frame" if frame else "holds the extension records of the model"
        check_states(version, what)
    degree, count = source.columns.sh_degree, source.count
    fraction = fraction_bits(source, Precision(bits, spare))
    movable, groups = not of_splats(elements, count), None
    if palette_size is not None and degree and count:
        source, groups = _sharing(source.load(), palette_size, tell, movable=movable)
    flags = ANTIALIASED if source.columns.render_mode == RenderMode.MIP else 0
    flags |= EXTENSIONS if records else 0
    start = (MAGIC, version, count, degree, fraction, flags)
    buckets = _buckets(degree, sh_bits)[:, None]
    columns: Iterator[Iterable[bytes]] = encoded_columns(
        source, _encoders(fraction, version, bits, buckets)
    )
    widths = list(column_widths(version, degree).values())
    size = count * sum(widths)
    if movable and (bits < MOST_BITS or groups is not None) and is_small(size):
        columns = sorted_columns(columns, widths, count, groups)
    if ROUNDED <= version <= LAST_GZIP:
        write_gzip(file, LEGACY_HEADER.pack(*start, 0), columns, size, gzip_level)
    elif version == STATING:
        streams = [_compressed(column) for column in columns]
        file.write(HEADER.pack(*start, len(streams), HEADER.size + len(records)) + records)
        sizes = zip(streams, widths, strict=True)
        file.writelines(TOC_ENTRY.pack(len(column), w * count) for column, w in sizes)
        file.writelines(streams)
    else:
        raise OutputError(f".spz version {version} is not written; choose 2, 3 or 4.")


def check_states(version: int, what: str) -> None:
    """Refuse a version after whose columns readers expect nothing.

    Args:
        version: That is to be written.
        what: What files of `STATING` do beside.

    Raises:
        OptionError: It is another one.
    """
    if version != STATING:
        raise OptionError(
            f"Only .spz of version {STATING} {what}; leave `spz_version={version}` out, or give"
            f" {STATING}."
        )


def usual_version(bits: int = MOST_BITS, *, stating: bool = False) -> int:
    """The version that is written unless told otherwise.

    Args:
        bits: How fine values are.
        stating: Whether there are records, a frame perhaps.
    """
    if stating:
        return STATING
    return USUAL if bits == MOST_BITS else ROUNDED


def losses(splats: Splats, *, records: bool = True) -> tuple[str, ...]:
    """Name what the file leaves out or clamps, one sentence each.

    Args:
        splats: The model.
        records: Whether its extension records go into the file.
    """
    step = 0.5 / SCALE_STEPS
    low, high = SCALE_LOW, SCALE_LOW + 255 / SCALE_STEPS
    scales, colours, rest = splats.log_scales, splats.sh[:, 0], splats.sh[:, 1:]
    widest = 0.5 / COLOUR_SCALE
    half = (_buckets(splats.sh_degree, SH_BITS) / 2 / SH_STEPS)[:, None]
    out = limits.left_out(without_records(splats) if records else splats, SUFFIX)
    out += limits.lost_mode(splats, SUFFIX, RenderMode.MIP)
    out += limits.clamped(
        (scales < low - step) | (scales > high + step),
        f"log-scales outside {low:g} to {high:.2f}, the range of {SUFFIX}",
    )
    out += limits.clamped(
        np.abs(colours) > widest * (1 + 1 / 255),
        f"base colours outside ±{widest:.2f}, the range of {SUFFIX}",
    )
    out += limits.clamped(
        (rest < -1 - half) | (rest > 1 - 1 / SH_STEPS + half),
        f"higher SH coefficients outside ±1, the range of {SUFFIX}",
    )
    bits = _bits(_reach([splats]))
    if 0 <= bits < USUAL_FRACTION_BITS:
        text = "Centres are rounded to 1/{}, since the scene is so large."
        out.append(Finding(text, 1 << bits, min))
    return tuple(out)


def fraction_bits(model: Splats | Source, precision: Precision = FINEST) -> int:
    """Bits behind the binary point: 12 or more, less those that large splats have no use for.

    Very large scenes have fewer, and then all of them unless told otherwise.

    Raises:
        OptionError: Centres are to do without more bits than there are.
        OutputError: A value is NaN or infinite, or a centre is too far out for whole numbers of 24
            bits.
    """
    source = source_of(model)
    bits = _possible_bits(source)
    spare = _spare(source, precision, bits)
    if spare > bits:
        raise OptionError(
            f"Of {bits} bits behind the point, `spare_bits={spare}` leaves none; give fewer."
        )
    return bits - spare


def spare_bits(source: Source, bits: int = MOST_BITS) -> int:
    """Bits that centres do without unless told otherwise, as `write` has it for so many bits.

    Raises:
        OutputError: As for `fraction_bits`.
    """
    return _spare(source, Precision(bits), _possible_bits(source))


def _possible_bits(source: Source) -> int:
    """Bits behind the binary point that there may be; it raises what `fraction_bits` does."""
    reach = _reach(limits.storable(source, SUFFIX))
    if (bits := _bits(reach)) < 0:
        raise UnstorableError(
            f"A centre is {reach:g} from the origin along an axis, but {SUFFIX} ends at"
            f" {_FIXED_MAX:,}; move the model to the origin or scale it down."
        )
    return bits


def _spare(source: Source, precision: Precision, bits: int) -> int:
    """Bits that centres do without, of so many behind the point."""
    if precision.spare is None and bits < USUAL_FRACTION_BITS:
        return 0
    step = np.full((1, 1), math.ldexp(1.0, -bits))
    return precision.spare_bits(source.blocks(), lambda _block: step)


def _reach(blocks: Iterable[Splats]) -> float:
    """The largest coordinate of all centres, without its sign; NaN if one of them is."""
    return float(np.max([np.abs(block.means).max(initial=0) for block in blocks], initial=0))


def _bits(reach: float) -> int:
    """Fraction bits, see `fraction_bits`; negative where a centre is too far out or not finite."""
    if not reach <= _FIXED_MAX:
        return -1
    exponent = math.frexp(reach)[1]  # reach < 2^exponent
    bits = min(max(USUAL_FRACTION_BITS, _SIGNIFICANT_BITS - exponent), 23 - exponent, 20)
    return bits - (round(math.ldexp(reach, bits)) > _FIXED_MAX)


def _sharing(
    splats: Splats, size: int, tell: Parts, *, movable: bool
) -> tuple[InMemory, I64 | None]:
    """The splats with so many sets of higher coefficients at most, those of one set in a row.

    Returns:
        The splats, and (N,) which set they are of, ascending; None where they may not be moved.
    """
    points = splats.sh[:, 1:].reshape(len(splats), -1)
    found = palette(points, size, visibility(splats), tell)
    sh = splats.sh.copy()
    sh[:, 1:] = found.entries[found.labels].reshape(len(splats), -1, 3)
    sharing = replace(splats, sh=sh)
    if not movable:
        return InMemory(sharing), None
    rows = np.argsort(found.labels, kind="stable")
    return InMemory(sharing.take(rows)), found.labels[rows].astype(np.int64)


def _encoders(fraction: int, version: int, bits: int, buckets: F64) -> list[Encoder]:
    """Functions that encode a block of rows, one for each column of the file."""
    steps = STEPS[bits]
    if version == ROUNDED:
        pack = partial(_xyz_rotations, step=steps.rotations)
    else:
        pack = partial(_rotations, step=steps.magnitudes)
    turned = _least_turned if bits < MOST_BITS else _as_they_are
    encoders: list[Encoder] = [
        lambda block: _positions(block.means, fraction),
        lambda block: _alphas(block, steps.alphas),
        lambda block: _stepped(_colours(block), steps.colours, _BLACK),
        lambda block: _stepped(
            (turned(block)[1] - np.float64(SCALE_LOW)) * SCALE_STEPS, steps.scales
        ),
        lambda block: pack(turned(block)[0]),
    ]
    if len(buckets):
        encoders.append(lambda block: _coefficients(block.sh[:, 1:], buckets))
    return encoders


def _alphas(block: Splats, step: int) -> U8:
    """(R,) opacities as codes; what nobody sees stays so, whatever the step."""
    values = block.opacities() * _BYTE
    codes = _stepped(values, step, _BYTE)
    codes[values < 0.5] = 0  # as with steps of 1
    return codes


def _colours(block: Splats) -> F64:
    """(R, 3) base colours as codes, before rounding."""
    codes: F64 = (block.sh[:, 0] * np.float64(COLOUR_SCALE) + 0.5) * _BYTE
    return codes


def _as_they_are(block: Splats) -> tuple[F32, F32]:
    """(R, 4) unit wxyz, and (R, 3) log-scales."""
    return block.unit_quats(), block.log_scales


def _least_turned(block: Splats) -> tuple[F32, F32]:
    """The same with other axes first, so that rotations are small."""
    quats, log_scales = least_turned(block)
    return quats.astype(np.float32), log_scales


def _stepped(values: F32 | F64, step: int, start: int = 0) -> U8:
    """The nearest of the codes that are so far apart, one of which is `start`."""
    if step == 1:
        return rounded_bytes(values)
    return rounded_bytes(start + step * np.rint((values - start) / step))


def _compressed(column: Iterable[bytes]) -> bytes:
    """One column as a zstd frame that states its size and has a checksum."""
    import zstandard

    plain = b"".join(column)
    return zstandard.ZstdCompressor(level=_ZSTD_LEVEL, write_checksum=True).compress(plain)


def _positions(means: F32 | F64, bits: int) -> U8:
    """(R, 9): three little-endian 24-bit integers."""
    fixed = np.rint(np.ldexp(means.astype(np.float64), bits)).astype("<i4")
    wide: U8 = fixed[:, :, None].view(np.uint8)
    return wide[:, :, :3]


def _xyz_rotations(quats: F32, step: int) -> U8:
    """(R, 3) from unit wxyz: x, y and z of the two that turn alike with w positive."""
    xyz = np.where(quats[:, :1] < 0, -quats[:, 1:], quats[:, 1:]).astype(np.float64)
    return _stepped((xyz + 1) * 127.5, step, _ZERO)


def _rotations(quats: F32, step: int) -> U8:
    """(R, 4) from unit wxyz: the largest part's place, then sign and magnitude of the others.

    Magnitudes are multiples of the step.
    """
    largest, small = split_quats(quats[:, [1, 2, 3, 0]].astype(np.float64))
    exact = np.minimum(np.abs(small) / np.sqrt(0.5), 1) * (MAGNITUDE / step)
    magnitude = (np.minimum(np.rint(exact), MAGNITUDE // step) * step).astype(np.uint32)
    parts = magnitude | (small < 0).astype(np.uint32) << 9
    packed = largest.astype(np.uint32) << 30 | parts[:, 0] << 20 | parts[:, 1] << 10 | parts[:, 2]
    result: U8 = packed.astype("<u4")[:, None].view(np.uint8)
    return result


def _buckets(degree: int, sh_bits: int) -> F64:
    """(K - 1,): the distance of the bytes that each higher coefficient may take."""
    per_band = [2.0 ** (8 - sh_bits + (band > 1)) for band in range(1, degree + 1)]
    return np.repeat(per_band, [2 * band + 1 for band in range(1, degree + 1)])


def _coefficients(sh: F32, buckets: F64) -> U8:
    """(R, 3 (K - 1)): the nearest multiple of the bucket, which includes 128 for zero."""
    nearest = np.rint(sh.astype(np.float64) * SH_STEPS / buckets) * buckets + 128
    return rounded_bytes(nearest).reshape(len(sh), -1)

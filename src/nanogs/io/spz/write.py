"""Writing `.spz` (Niantic), version 2 to 4; `header` and `read` have the layout.

Coefficients of degree 1 keep 5 bits and higher ones 4, as the reference writer has it: the fewer
values a byte takes, the better it compresses. Unlike there, the fraction bits follow the scene,
so that a small one keeps its detail and a large one does not wrap around; and centres and
rotations are no finer than they are worth beside scales, which have steps of a sixteenth.

The higher coefficients are most of a file. Nothing in the format lets splats share them, but what
repeats within 32 kB costs gzip next to nothing: with a palette, splats that share an entry follow
each other, and so each entry is packed once. Where rotations are rounded, splats are turned as
little as their axes allow, so that fewer codes are in use.
"""

import gzip
import math
from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from typing import BinaryIO

import numpy as np

from nanogs._types import F32, F64, U8
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
    LEGACY_HEADER,
    MAGIC,
    TOC_ENTRY,
    column_widths,
)
from nanogs.io.spz.read import COLOUR_SCALE, MAGNITUDE, SCALE_LOW, SCALE_STEPS, SH_STEPS
from nanogs.io.spz.records import packed, without_records
from nanogs.progress import Parts, untold
from nanogs.source import InMemory, Source, source_of
from nanogs.splats import RenderMode, Splats
from nanogs.stored import rounded_bytes

SUFFIX = ".spz"
SH_BITS = 5  # kept of a coefficient of degree 1; of a higher one, one less
USUAL, STATING = 3, 4  # the version by default, and the one that can state a frame
MOST_ENTRIES = 1 << 20  # of a palette
USUAL_FRACTION_BITS = 12
_FIXED_MAX = (1 << 23) - 1
_SIGNIFICANT_BITS = 16
_BYTE = 255
_ROTATION_STEP = 4  # of the magnitudes, for 8 bits with the sign
GZIP_LEVEL, _ZSTD_LEVEL = 6, 12  # the reference writer's


def write(
    model: Splats | Source,
    file: BinaryIO,
    tell: Parts = untold,
    *,
    version: int | None = None,
    palette_size: int | None = None,
    bits: int = MOST_BITS,
    sh_bits: int = SH_BITS,
    frame: str | None = None,
    gzip_level: int = GZIP_LEVEL,
) -> None:
    """Write a model, axes as they are; `losses` says what does not go in.

    Args:
        model: The model; of a source, no more than a column is held, and that as it is written,
            unless there is a palette.
        file: Open for binary writing.
        tell: Told of the rounds in which a palette is looked for.
        version: 3 (gzip), which Spark reads; 4 (zstd), as today's reference writer has it; or 2
            (gzip), which older readers know, with rotations of less precision. By default 3, but 4
            for a model with extension records, which were read of such a file, or with a frame.
        palette_size: Most sets of higher coefficients that splats may have; by default each splat
            has its own. Splats of one set then follow each other.
        bits: Of a part of a rotation, a colour and an alpha, 4 to 8; centres follow, see
            `Precision.spare_bits`.
        sh_bits: Of a coefficient of degree 1, 2 to 8; higher ones have one less.
        frame: The frame of the axes, which the file then states; of version 4 alone, since readers
            of older ones expect nothing after the columns.
        gzip_level: 0, which packs nothing, to 9; of versions 2 and 3.

    Raises:
        OptionError: A frame or a record is to be in a file of another version.
        OutputError: A value is NaN or infinite, or a centre is too far out; nothing has been
            written then.
        OSError: The system refuses to write.
    """
    source = source_of(model)
    records = packed(source.read_elements()) + (frame_record(frame) if frame else b"")
    version = version or (STATING if records else USUAL)
    if records and version != STATING:
        what = "states its frame" if frame else "holds the extension records of the model"
        raise OptionError(
            f"Only .spz of version {STATING} {what}; leave spz_version={version} out, or give"
            f" {STATING}."
        )
    precision, (degree, count) = Precision(bits), (source.columns.sh_degree, source.count)
    fraction = fraction_bits(source, precision)
    if palette_size is not None and degree and count:
        source = InMemory(_sharing(source.load(), palette_size, tell))
    flags = ANTIALIASED if source.columns.render_mode == RenderMode.MIP else 0
    flags |= EXTENSIONS if records else 0
    start = (MAGIC, version, count, degree, fraction, flags)
    buckets = _buckets(degree, sh_bits)[:, None]
    columns = encoded_columns(source, _encoders(fraction, version, precision, buckets))
    if version in (2, 3):
        with gzip.GzipFile("", "wb", gzip_level, file, mtime=0) as stream:
            stream.write(LEGACY_HEADER.pack(*start, 0))
            for column in columns:
                for block in column:
                    stream.write(block)
    elif version == STATING:
        widths = list(column_widths(version, degree).values())
        streams = [_compressed(column) for column in columns]
        file.write(HEADER.pack(*start, len(streams), HEADER.size + len(records)) + records)
        sizes = zip(streams, widths, strict=True)
        file.writelines(TOC_ENTRY.pack(len(column), w * count) for column, w in sizes)
        file.writelines(streams)
    else:
        raise OutputError(f".spz version {version} is not written; choose 2, 3 or 4.")


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

    Very large scenes have fewer, and then all of them.

    Raises:
        OutputError: A value is NaN or infinite, or a centre is too far out for whole numbers of 24
            bits.
    """
    source = source_of(model)
    reach = _reach(limits.storable(source, SUFFIX))
    if (bits := _bits(reach)) < 0:
        raise UnstorableError(
            f"A centre is {reach:g} from the origin along an axis, but {SUFFIX} ends at"
            f" {_FIXED_MAX:,}; move the model to the origin or scale it down."
        )
    if bits < USUAL_FRACTION_BITS:
        return bits
    step = np.full((1, 1), math.ldexp(1.0, -bits))
    return bits - precision.spare_bits(source.blocks(), lambda _block: step)


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


def _sharing(splats: Splats, size: int, tell: Parts) -> Splats:
    """The splats with so many sets of higher coefficients at most, those of one set in a row."""
    points = splats.sh[:, 1:].reshape(len(splats), -1)
    found = palette(points, size, visibility(splats), tell)
    sh = splats.sh.copy()
    sh[:, 1:] = found.entries[found.labels].reshape(len(splats), -1, 3)
    return replace(splats, sh=sh).take(np.argsort(found.labels, kind="stable"))


def _encoders(fraction: int, version: int, precision: Precision, buckets: F64) -> list[Encoder]:
    """Functions that encode a block of rows, one for each column of the file."""
    step, levels = _ROTATION_STEP * precision.rotation_step, (1 << precision.bits) - 1
    pack = _xyz_rotations if version == 2 else partial(_rotations, step=step)
    turned = _least_turned if precision.bits < MOST_BITS else _as_they_are
    encoders: list[Encoder] = [
        lambda block: _positions(block.means, fraction),
        lambda block: _levels(block.opacities(), precision.alphas),
        lambda block: _levels(block.sh[:, 0] * np.float64(COLOUR_SCALE) + 0.5, levels),
        lambda block: rounded_bytes((turned(block)[1] - np.float64(SCALE_LOW)) * SCALE_STEPS),
        lambda block: pack(turned(block)[0]),
    ]
    if len(buckets):
        encoders.append(lambda block: _coefficients(block.sh[:, 1:], buckets))
    return encoders


def _as_they_are(block: Splats) -> tuple[F32, F32]:
    """(R, 4) unit wxyz, and (R, 3) log-scales."""
    return block.unit_quats(), block.log_scales


def _least_turned(block: Splats) -> tuple[F32, F32]:
    """The same with other axes first, so that rotations are small."""
    quats, log_scales = least_turned(block)
    return quats.astype(np.float32), log_scales


def _levels(values: F32 | F64, levels: int) -> U8:
    """The nearest of so many steps from 0 to 1, as bytes from 0 to 255."""
    nearest = values if levels == _BYTE else np.rint(values * levels) / levels
    return rounded_bytes(nearest * _BYTE)


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


def _xyz_rotations(quats: F32) -> U8:
    """(R, 3) from unit wxyz: x, y and z of the two that turn alike with w positive."""
    xyz = np.where(quats[:, :1] < 0, -quats[:, 1:], quats[:, 1:]).astype(np.float64)
    return rounded_bytes((xyz + 1) * 127.5)


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

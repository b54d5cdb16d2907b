"""Writing `.spz` (Niantic), version 2 to 4; `header` and `read` describe the layout.

Unlike in the reference writer, centres and rotations are quantised no finer than is worthwhile
beside scales, which have steps of a sixteenth (`centres`, `codes`).

With fewer bits than 8, the axes of each splat are reordered so that its rotation is as small as
possible, and fewer codes are in use. The three bytes of version 2 then hold as much of a rotation
as four, so files are of that version; and rows are sorted so that they compress well.
"""

from collections.abc import Iterable, Iterator
from typing import BinaryIO

from nanogs.errors import OptionError, OutputError
from nanogs.io.by_column import encoded_columns
from nanogs.io.precision import MOST_BITS, Precision
from nanogs.io.spz.body import frame_record
from nanogs.io.spz.centres import fraction_bits
from nanogs.io.spz.codes import SH_BITS, buckets_of
from nanogs.io.spz.encode import encoders, with_palette
from nanogs.io.spz.header import (
    ANTIALIASED,
    EXTENSIONS,
    HEADER,
    LAST_GZIP,
    LEGACY_HEADER,
    MAGIC,
    TOC_ENTRY,
    VERSION_SHORT_ROTATIONS,
    VERSION_WITH_FRAME,
    column_widths,
)
from nanogs.io.spz.packing import BEST, is_small, sorted_columns, write_gzip
from nanogs.io.spz.records import has_per_splat_record, packed
from nanogs.progress import PartProgress, ignore_progress
from nanogs.source import Source, source_of
from nanogs.splats import RenderMode, Splats

DEFAULT_VERSION = 3  # as most readers know
MOST_ENTRIES = 1 << 20  # of a palette
HOLDS_RECORDS = "holds the extension records of the model"  # for `check_holds_records`
_ZSTD_LEVEL = 12  # the reference writer's


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
    """Write a model, with its axes unchanged; `unstorable.losses` names what the file cannot hold.

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
        bits: Precision of values, 4 to 8, see `codes.STEPS`. With fewer than 8, the rows of small
            files are reordered, see `packing`.
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
    buckets = buckets_of(degree, sh_bits)[:, None]
    if palette_size is not None and degree and count:
        source, groups = with_palette(
            source.load(), palette_size, on_progress, buckets if movable else None
        )
    flags = ANTIALIASED if source.columns.render_mode == RenderMode.MIP else 0
    flags |= EXTENSIONS if records else 0
    start = (MAGIC, version, count, degree, fraction, flags)
    columns: Iterator[Iterable[bytes]] = encoded_columns(
        source, encoders(fraction, version, bits, buckets)
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


def _compressed(column: Iterable[bytes]) -> bytes:
    """Compress one column to a zstd frame that states its size and has a checksum."""
    import zstandard

    plain = b"".join(column)
    return zstandard.ZstdCompressor(level=_ZSTD_LEVEL, write_checksum=True).compress(plain)

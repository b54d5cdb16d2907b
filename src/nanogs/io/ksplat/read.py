"""Reading `.ksplat` (GaussianSplats3D): sections of rows, centres relative to buckets in space.

Layout: https://github.com/mkkellogg/GaussianSplats3D (MIT), `src/loaders/SplatBuffer.js`, version
0.1. A header of 4096 bytes, one of 1024 for each section, then the sections: lengths of the buckets
that are not full, centres of all buckets, rows. Mode 0 holds float32; modes 1 and 2 hold float16
and centres as 16-bit steps from their bucket's centre, mode 2 also a byte for each SH coefficient.
Scales and alpha are linear, rotations wxyz; each SH band has all coefficients of red first. The
frame is that of `.ply`.
"""

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from nanogs._types import F64, I64, Array
from nanogs.activations import base_colour, logit
from nanogs.errors import FormatError
from nanogs.findings import negative_scales
from nanogs.formatting import counted
from nanogs.io.info import FileInfo
from nanogs.io.ksplat.header import AGAIN, TYPE_NAMES, Headers, SplatSection, columns, read_headers
from nanogs.io.parts import FileSource, row_blocks
from nanogs.splats import Splats, empty_arrays

_CENTRE = np.dtype([("centre", "<f4", 3)])
_SCALE_RANGE = 32767  # steps to either side of a bucket's centre, if the header gives none


class KsplatFile(FileSource):
    """The source of a `.ksplat` file.

    A scale of zero becomes a log-scale of -inf; alphas of 0 and 255 become logits of -inf and +inf.

    Raises:
        FormatError: It cannot be read, is cut short, or its counts contradict each other.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._headers = file = read_headers(path)
        stored = columns(file.mode, file.degree)
        self.info = FileInfo(
            path=path,
            format="ksplat",
            encoding="binary_little_endian",
            file_bytes=file.file_bytes,
            splats=file.splats,
            sh_degree=file.degree,
            properties=tuple((name, TYPE_NAMES[kind]) for name, kind in stored),
        )

    def _span(self, start: int, stop: int) -> Splats:
        """Read rows `start` to `stop`; see `Source`."""
        file, n = self._headers, stop - start
        out = empty_arrays(n, file.degree)
        at = negative = first = 0
        with np.errstate(all="ignore"):  # the file may hold NaN, infinity, zero scales
            for section in file.sections:
                low, high = max(start - first, 0), min(stop - first, section.splats)
                first += section.splats
                if low >= high:
                    continue
                for block, means in _blocks(file, section, low, high):
                    negative += _decode(file, block, means, out, slice(at, at + len(block)))
                    at += len(block)
        notes = negative_scales(negative)
        if file.trailing:
            notes.append(f"Left out: {counted(file.trailing, 'byte')} after the last section.")
        return Splats(**out, notes=notes)


def _blocks(
    file: Headers, section: SplatSection, start: int, stop: int
) -> Iterator[tuple[Array, F64 | None]]:
    """Yield blocks of rows of a section, with their centres decoded.

    In mode 0 the rows hold the centres themselves, and None is yielded in their place.
    """
    buckets = _buckets(file, section, start, stop) if file.mode else None
    at = section.rows_at + start * file.row.itemsize
    for span, block in row_blocks(file.path, file.row, at, stop - start):
        if buckets is None:
            yield block, None
            continue
        places = np.arange(start + span.start, start + span.stop)
        steps = block["mean"].astype(np.float64) - (section.fields["range"] or _SCALE_RANGE)
        step = section.fields["width"] / 2 / (section.fields["range"] or _SCALE_RANGE)
        centres, ends = buckets
        yield block, centres[np.searchsorted(ends, places, side="right")] + steps * step


def _buckets(file: Headers, section: SplatSection, start: int, stop: int) -> tuple[F64, I64]:
    """Return the buckets of rows `start` to `stop`: (B, 3) centres, (B,) the row after each's last.

    Full buckets come first; the others have various lengths, so that all lengths are summed up,
    some at a time. Only buckets that hold some of the rows are kept, so memory is bounded by them.

    Raises:
        FormatError: The buckets do not hold as many splats as the section.
    """
    fields = section.fields
    full, capacity = fields["full"], fields["capacity"]
    low, high = (min(row // capacity, full) if capacity else 0 for row in (start, stop + capacity))
    held = min(full * capacity, 1 << 40)  # the limit exceeds any number of rows
    found = [_centres(file, section, np.arange(low, high))]
    ends = [capacity * np.arange(low + 1, high + 1)]
    for span, lengths in row_blocks(
        file.path, np.dtype("<u4"), section.lengths_at, fields["partial"]
    ):
        last = held + np.cumsum(lengths, dtype=np.int64)
        met = np.flatnonzero((last > start) & (last - lengths < stop) & (lengths > 0))
        found.append(_centres(file, section, full + span.start + met))
        ends.append(last[met])
        held = int(last[-1])
    if held < section.splats:
        raise FormatError(
            f"{file.path}: the buckets of a section hold {held:,} of its"
            f" {counted(section.splats, 'splat')}; {AGAIN}"
        )
    return np.concatenate(found), np.concatenate(ends)


def _centres(file: Headers, section: SplatSection, buckets: I64) -> F64:
    """Read the (B, 3) centres of buckets, given in ascending order."""
    if not len(buckets):
        return np.empty((0, 3))
    first, count = int(buckets[0]), int(buckets[-1] - buckets[0]) + 1
    at = section.centres_at + first * _CENTRE.itemsize
    found = np.empty((count, 3))
    for span, values in row_blocks(file.path, _CENTRE, at, count):
        found[span] = values["centre"]
    return found[buckets - first]


def _decode(file: Headers, rows: Array, means: F64 | None, out: dict[str, Any], span: slice) -> int:
    """Decode one block into `out` and return its number of rows with a negative scale."""
    out["means"][span] = rows["mean"] if means is None else means
    out["log_scales"][span] = np.log(rows["scale"].astype(np.float64))
    out["quats"][span] = rows["quat"]
    rgba = rows["rgba"] / 255.0
    out["sh"][span, 0] = base_colour(rgba[:, :3])
    out["opacity_logits"][span] = logit(rgba[:, 3])
    if file.degree:
        _decode_bands(file, rows["sh"], out["sh"][span])
    return int((rows["scale"] < 0).any(axis=1).sum())


def _decode_bands(file: Headers, stored: Array, sh: Array) -> None:
    """Decode the SH bands, each stored as all of red, then green, then blue, into `sh`."""
    if file.mode == 2:
        low, high = file.sh_range
        stored = stored / 255.0 * (high - low) + low
    for first, last in pairwise((degree + 1) ** 2 for degree in range(file.degree + 1)):
        band = stored[:, 3 * (first - 1) : 3 * (last - 1)]
        sh[:, first:last] = band.reshape(len(band), 3, -1).transpose(0, 2, 1)

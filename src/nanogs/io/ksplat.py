"""Reading `.ksplat` (GaussianSplats3D): sections of rows, centres relative to buckets in space.

Layout: https://github.com/mkkellogg/GaussianSplats3D (MIT), `src/loaders/SplatBuffer.js`, version
0.1. A header of 4096 bytes, 1024 for each section, then the sections: lengths of the buckets that
are not full, centres of all buckets, rows. Mode 0 holds float32; modes 1 and 2 hold float16 and
centres as 16-bit steps from their bucket's centre, mode 2 also a byte for each SH coefficient.
Scales and alpha are linear, rotations wxyz; in each SH band all of red comes first. The frame is
that of `.ply`.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from nanogs._types import F64, I64, Array
from nanogs.errors import FormatError
from nanogs.io.compressed_ply import base_colour, logit
from nanogs.io.files import BLOCK_ROWS, input_size, unreadable
from nanogs.io.info import FileInfo
from nanogs.splats import RenderMode, Splats

_HEADER_BYTES = 4096
_SECTION_BYTES = 1024
_BUCKET_BYTES = 12
_MAX_DEGREE = 3
_SCALE_RANGE = 32767  # steps of a centre on either side of the bucket's, where none are given
_SH_LIMIT = 1.5  # of the bytes of mode 2, where no range is given
_AGAIN = "convert or download it again."

_HEADER = np.dtype(
    {
        "names": ["major", "minor", "sections", "splats", "mode", "sh_low", "sh_high"],
        "formats": ["u1", "u1", "<u4", "<u4", "<u2", "<f4", "<f4"],
        "offsets": [0, 1, 4, 16, 20, 36, 40],
        "itemsize": _HEADER_BYTES,
    }
)
_SECTION = np.dtype(
    {
        "names": ["splats", "rows", "capacity", "buckets", "width", "bucket_bytes", "range",
                  "full", "partial", "degree"],
        "formats": ["<u4", "<u4", "<u4", "<u4", "<f4", "<u2", "<u4", "<u4", "<u4", "<u2"],
        "offsets": [0, 4, 8, 12, 16, 20, 24, 32, 36, 40],
        "itemsize": _SECTION_BYTES,
    }
)  # fmt: skip
_NUMBERS = ("<f4", "<f2", "<f2")  # of scales and rotations, by mode
_CENTRES = ("<f4", "<u2", "<u2")
_COEFFICIENTS = ("<f4", "<f2", "u1")
_TYPE_NAMES = {"<f4": "float", "<f2": "ushort", "<u2": "ushort", "u1": "uchar"}


@dataclass(frozen=True, slots=True)
class _Section:
    """One section: its header as plain numbers, and where its parts lie in the file."""

    splats: int
    fields: dict[str, Any]
    lengths_at: int
    centres_at: int
    rows_at: int


@dataclass(frozen=True, slots=True)
class _File:
    path: Path
    file_bytes: int
    mode: int
    degree: int
    sh_range: tuple[float, float]
    row: np.dtype[np.void]
    sections: tuple[_Section, ...]
    trailing: int

    @property
    def splats(self) -> int:
        return sum(section.splats for section in self.sections)


def read(path: Path) -> Splats:
    """Read a `.ksplat` file; a scale of zero becomes -inf, alpha 0 and 255 become ∓inf.

    Raises:
        FormatError: The file cannot be read, is cut short, or its counts contradict each other.
    """
    file = _parsed(path)
    n = file.splats
    out: dict[str, Any] = {
        "means": np.empty((n, 3), np.float32),
        "log_scales": np.empty((n, 3), np.float32),
        "quats": np.empty((n, 4), np.float32),
        "opacity_logits": np.empty(n, np.float32),
        "sh": np.empty((n, (file.degree + 1) ** 2, 3), np.float32),
    }
    start = negative = 0
    try:
        with np.errstate(all="ignore"):  # whatever bits there are: NaN, infinity, zero scales
            for section in file.sections:
                for rows, means in _blocks(file, section):
                    negative += _decode(file, rows, means, out, slice(start, start + len(rows)))
                    start += len(rows)
    except OSError as error:
        raise unreadable(path, error) from error
    notes = [f"{negative} splats have a negative scale, which became NaN."] if negative else []
    if file.trailing:
        notes.append(f"{file.trailing} bytes after the last section were left out.")
    return Splats(**out, notes=notes)


def inspect(path: Path) -> FileInfo:
    """Describe a `.ksplat` file from its headers.

    Raises:
        FormatError: As for `read`, except for the lengths of the buckets.
    """
    file = _parsed(path)
    return FileInfo(
        path=path,
        format="ksplat",
        encoding="binary_little_endian",
        file_bytes=file.file_bytes,
        splats=file.splats,
        sh_degree=file.degree,
        double_means=False,
        properties=tuple(
            (name, _TYPE_NAMES[kind]) for name, kind in _columns(file.mode, file.degree)
        ),
        extras=(),
        elements=(),
        render_mode=RenderMode.DEFAULT,
        comments=(),
    )


def _columns(mode: int, degree: int) -> list[tuple[str, str]]:
    """(name, numpy type) of each part of a row, without the number of its components."""
    columns = [("mean", _CENTRES[mode]), ("scale", _NUMBERS[mode])]
    columns += [("quat", _NUMBERS[mode]), ("rgba", "u1")]
    return [*columns, ("sh", _COEFFICIENTS[mode])] if degree else columns


def _row(mode: int, degree: int) -> np.dtype[np.void]:
    sizes = {"mean": 3, "scale": 3, "quat": 4, "rgba": 4, "sh": 3 * ((degree + 1) ** 2 - 1)}
    return np.dtype([(name, kind, sizes[name]) for name, kind in _columns(mode, degree)])


def _parsed(path: Path) -> _File:
    """The headers, every count and offset in them checked against the file's size."""
    size = input_size(path)
    if size < _HEADER_BYTES:
        raise FormatError(
            f"{path} has {size} bytes, less than the {_HEADER_BYTES} of a .ksplat header; {_AGAIN}"
        )
    try:
        header = np.fromfile(path, _HEADER, 1)[0]
        _check_header(path, header, size)
        tables = np.fromfile(path, _SECTION, int(header["sections"]), offset=_HEADER_BYTES)
    except OSError as error:
        raise unreadable(path, error) from error
    mode = int(header["mode"])
    sections = [{name: table[name].item() for name in _SECTION.names or ()} for table in tables]
    degree = _degree(path, sections)
    row = _row(mode, degree)
    placed, end = _placed(path, sections, mode, row.itemsize, size)
    total = sum(section.splats for section in placed)
    if total != header["splats"] or total == 0:
        raise FormatError(
            f"{path}: the header counts {header['splats']} splats and the sections hold {total},"
            f" so it is damaged or empty; {_AGAIN}"
        )
    low, high = float(header["sh_low"]), float(header["sh_high"])
    sh_range = (low or -_SH_LIMIT, high or _SH_LIMIT)
    return _File(path, size, mode, degree, sh_range, row, placed, size - end)


def _check_header(path: Path, header: Any, size: int) -> None:  # noqa: ANN401 - a numpy record
    version = f"{header['major']}.{header['minor']}"
    if header["major"] != 0 or header["minor"] < 1:
        raise FormatError(
            f"{path}: nanogs reads .ksplat of version 0.1, not {version}; convert it with the"
            " program that made it."
        )
    if header["mode"] > 2:
        raise FormatError(f"{path}: compression mode {header['mode']} is none of 0 to 2; {_AGAIN}")
    if _HEADER_BYTES + _SECTION_BYTES * int(header["sections"]) > size:
        raise FormatError(
            f"{path} is cut short: {header['sections']} section headers do not fit into its"
            f" {size} bytes; {_AGAIN}"
        )


def _degree(path: Path, sections: list[dict[str, Any]]) -> int:
    degrees = {section["degree"] for section in sections if section["splats"]}
    if len(degrees) > 1 or (degrees and max(degrees) > _MAX_DEGREE):
        raise FormatError(
            f"{path}: its sections have the SH degrees {sorted(degrees)}, and not all the same one"
            f" from 0 to {_MAX_DEGREE}; {_AGAIN}"
        )
    return degrees.pop() if degrees else 0


def _placed(
    path: Path, sections: list[dict[str, Any]], mode: int, row_bytes: int, size: int
) -> tuple[tuple[_Section, ...], int]:
    """The sections that hold splats, and where the last one ends."""
    placed = []
    offset = _HEADER_BYTES + _SECTION_BYTES * len(sections)
    for number, fields in enumerate(sections):
        centres_at = offset + 4 * fields["partial"]
        rows_at = centres_at + fields["bucket_bytes"] * fields["buckets"]
        end = rows_at + row_bytes * fields["rows"]
        if end > size:
            raise FormatError(
                f"{path} is cut short: section {number} should end at byte {end} of {size};"
                f" {_AGAIN}"
            )
        if fields["splats"] > fields["rows"]:
            raise FormatError(
                f"{path}: section {number} has {fields['splats']} splats in {fields['rows']} rows;"
                f" {_AGAIN}"
            )
        if mode and fields["splats"]:
            _check_buckets(path, number, fields)
        if fields["splats"]:
            placed.append(_Section(fields["splats"], fields, offset, centres_at, rows_at))
        offset = end
    return tuple(placed), offset


def _check_buckets(path: Path, number: int, fields: dict[str, Any]) -> None:
    if (
        fields["bucket_bytes"] != _BUCKET_BYTES
        or fields["full"] + fields["partial"] > fields["buckets"]
        or not np.isfinite(fields["width"])
    ):
        raise FormatError(
            f"{path}: section {number} has {fields['buckets']} buckets of"
            f" {fields['bucket_bytes']} bytes and {fields['width']} wide, {fields['full']} full"
            f" and {fields['partial']} not, which cannot be; {_AGAIN}"
        )


def _blocks(file: _File, section: _Section) -> Iterator[tuple[Array, F64 | None]]:
    """Blocks of rows, with their centres where the rows hold them in steps from a bucket's."""
    rows = np.memmap(file.path, file.row, "r", section.rows_at, (section.splats,))
    centres, ends = _buckets(file, section) if file.mode else (None, None)
    for start in range(0, section.splats, BLOCK_ROWS):
        block = rows[start : start + BLOCK_ROWS]
        if centres is None or ends is None:
            yield block, None
            continue
        places = np.arange(start, start + len(block))
        steps = block["mean"].astype(np.float64) - (section.fields["range"] or _SCALE_RANGE)
        step = section.fields["width"] / 2 / (section.fields["range"] or _SCALE_RANGE)
        yield block, centres[np.searchsorted(ends, places, side="right")] + steps * step


def _buckets(file: _File, section: _Section) -> tuple[F64, I64]:
    """(B, 3) centres of the buckets, and the row after the last one of each.

    Raises:
        FormatError: The buckets do not hold as many splats as the section.
    """
    fields = section.fields
    full, partial = fields["full"], fields["partial"]
    lengths = np.fromfile(file.path, "<u4", partial, offset=section.lengths_at)
    ends = np.cumsum(np.concatenate([np.full(full, fields["capacity"], np.int64), lengths]))
    held = int(ends[-1]) if len(ends) else 0
    if held < section.splats:
        raise FormatError(
            f"{file.path}: the buckets of a section hold {held} of its {section.splats} splats;"
            f" {_AGAIN}"
        )
    values = np.fromfile(file.path, "<f4", 3 * (full + partial), offset=section.centres_at)
    return values.reshape(-1, 3).astype(np.float64), ends


def _decode(file: _File, rows: Array, means: F64 | None, out: dict[str, Any], span: slice) -> int:
    """Decode one block; how many of its rows have a negative scale."""
    out["means"][span] = rows["mean"] if means is None else means
    out["log_scales"][span] = np.log(rows["scale"].astype(np.float64))
    out["quats"][span] = rows["quat"]
    rgba = rows["rgba"] / 255.0
    out["sh"][span, 0] = base_colour(rgba[:, :3])
    out["opacity_logits"][span] = logit(rgba[:, 3])
    if file.degree:
        _decode_bands(file, rows["sh"], out["sh"][span])
    return int((rows["scale"] < 0).any(axis=1).sum())


def _decode_bands(file: _File, stored: Array, sh: Array) -> None:
    """Bands one after the other, each with all of red, then green, then blue."""
    if file.mode == 2:
        low, high = file.sh_range
        stored = stored / 255.0 * (high - low) + low
    for first, last in pairwise((degree + 1) ** 2 for degree in range(file.degree + 1)):
        band = stored[:, 3 * (first - 1) : 3 * (last - 1)]
        sh[:, first:last] = band.reshape(len(band), 3, -1).transpose(0, 2, 1)

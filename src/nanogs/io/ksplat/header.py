"""The headers of `.ksplat`: its sections and the offsets of their parts; `read` has the layout."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nanogs.errors import FormatError
from nanogs.formatting import counted
from nanogs.io.files import input_size, reading

_HEADER_BYTES = 4096
_SECTION_BYTES = 1024
_BUCKET_BYTES = 12
_MAX_DEGREE = 3
_SH_LIMIT = 1.5  # the bytes of mode 2 cover -1.5 to 1.5 if no range is given
AGAIN = "convert or download it again."

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
_NUMBERS = ("<f4", "<f2", "<f2")  # types of scales and rotations, by mode
_CENTRES = ("<f4", "<u2", "<u2")
_COEFFICIENTS = ("<f4", "<f2", "u1")
TYPE_NAMES = {"<f4": "float", "<f2": "float16", "<u2": "ushort", "u1": "uchar"}


@dataclass(frozen=True, slots=True)
class SplatSection:
    """A section that holds splats.

    Attributes:
        splats: Number of splats.
        fields: The fields of its header.
        lengths_at: Byte offset of the lengths of the partially filled buckets.
        centres_at: Byte offset of the centres of the buckets.
        rows_at: Byte offset of the rows.
    """

    splats: int
    fields: dict[str, Any]
    lengths_at: int
    centres_at: int
    rows_at: int


@dataclass(frozen=True, slots=True)
class Headers:
    """All headers of a file, with counts and offsets checked against its size.

    Attributes:
        path: The file.
        file_bytes: Its size.
        mode: Compression mode, 0 to 2.
        degree: SH degree, 0 to 3.
        sh_range: The values of the lowest and the highest byte of an SH coefficient in mode 2.
        row: The dtype of a row.
        sections: The sections that hold splats.
        trailing: Bytes after the last section.
    """

    path: Path
    file_bytes: int
    mode: int
    degree: int
    sh_range: tuple[float, float]
    row: np.dtype[np.void]
    sections: tuple[SplatSection, ...]
    trailing: int

    @property
    def splats(self) -> int:
        """Number of splats of all sections."""
        return sum(section.splats for section in self.sections)


def columns(mode: int, degree: int) -> list[tuple[str, str]]:
    """Return name and numpy type of each column, without its number of components."""
    columns = [("mean", _CENTRES[mode]), ("scale", _NUMBERS[mode])]
    columns += [("quat", _NUMBERS[mode]), ("rgba", "u1")]
    return [*columns, ("sh", _COEFFICIENTS[mode])] if degree else columns


def _row(mode: int, degree: int) -> np.dtype[np.void]:
    sizes = {"mean": 3, "scale": 3, "quat": 4, "rgba": 4, "sh": 3 * ((degree + 1) ** 2 - 1)}
    return np.dtype([(name, kind, sizes[name]) for name, kind in columns(mode, degree)])


def read_headers(path: Path) -> Headers:
    """Read and check the headers of a file.

    Raises:
        FormatError: It cannot be read, is cut short, or its counts contradict each other.
    """
    size = input_size(path)
    if size < _HEADER_BYTES:
        raise FormatError(
            f"{path} has {size} bytes, less than the {_HEADER_BYTES} of a .ksplat header; {AGAIN}"
        )
    with reading(path) as file:
        header = np.frombuffer(file.read(_HEADER_BYTES), _HEADER)[0]
        _check_header(path, header, size)
        tables = np.frombuffer(file.read(_SECTION_BYTES * int(header["sections"])), _SECTION)
    mode = int(header["mode"])
    sections = [{name: table[name].item() for name in _SECTION.names or ()} for table in tables]
    degree = _degree(path, sections)
    row = _row(mode, degree)
    placed, end = _placed(path, sections, mode, row.itemsize, size)
    total = sum(section.splats for section in placed)
    if total != header["splats"] or total == 0:
        raise FormatError(
            f"{path}: the header counts {counted(int(header['splats']), 'splat')} and the sections"
            f" hold {total:,},"
            f" so it is damaged or empty; {AGAIN}"
        )
    low, high = float(header["sh_low"]), float(header["sh_high"])
    sh_range = (low or -_SH_LIMIT, high or _SH_LIMIT)
    return Headers(path, size, mode, degree, sh_range, row, placed, size - end)


def _check_header(path: Path, header: Any, size: int) -> None:  # noqa: ANN401 - a numpy record
    version = f"{header['major']}.{header['minor']}"
    if header["major"] != 0 or header["minor"] < 1:
        raise FormatError(
            f"{path}: nanogs reads .ksplat of version 0.1, not {version}; convert it with the"
            " program that made it."
        )
    if header["mode"] > 2:
        raise FormatError(f"{path}: compression mode {header['mode']} is none of 0 to 2; {AGAIN}")
    if _HEADER_BYTES + _SECTION_BYTES * int(header["sections"]) > size:
        raise FormatError(
            f"{path} is cut short: {header['sections']} section headers do not fit into its"
            f" {size} bytes; {AGAIN}"
        )


def _degree(path: Path, sections: list[dict[str, Any]]) -> int:
    degrees = {section["degree"] for section in sections if section["splats"]}
    if len(degrees) > 1 or (degrees and max(degrees) > _MAX_DEGREE):
        raise FormatError(
            f"{path}: its sections have the SH degrees {sorted(degrees)}, but must all have the"
            f" same one from 0 to {_MAX_DEGREE}; {AGAIN}"
        )
    return degrees.pop() if degrees else 0


def _placed(
    path: Path, sections: list[dict[str, Any]], mode: int, row_bytes: int, size: int
) -> tuple[tuple[SplatSection, ...], int]:
    """Return the sections that hold splats, and the byte offset of the end of all sections."""
    placed = []
    offset = _HEADER_BYTES + _SECTION_BYTES * len(sections)
    for number, fields in enumerate(sections):
        centres_at = offset + 4 * fields["partial"]
        rows_at = centres_at + fields["bucket_bytes"] * fields["buckets"]
        end = rows_at + row_bytes * fields["rows"]
        if end > size:
            raise FormatError(
                f"{path} is cut short: section {number} should end at byte {end} of {size}; {AGAIN}"
            )
        if fields["splats"] > fields["rows"]:
            raise FormatError(
                f"{path}: section {number} has {fields['splats']} splats in {fields['rows']} rows;"
                f" {AGAIN}"
            )
        if mode and fields["splats"]:
            _check_buckets(path, number, fields)
        if fields["splats"]:
            placed.append(SplatSection(fields["splats"], fields, offset, centres_at, rows_at))
        offset = end
    return tuple(placed), offset


def _check_buckets(path: Path, number: int, fields: dict[str, Any]) -> None:
    if (
        fields["bucket_bytes"] != _BUCKET_BYTES
        or fields["full"] + fields["partial"] > fields["buckets"]
        or not np.isfinite(fields["width"])
    ):
        raise FormatError(
            f"{path}: section {number} states an impossible layout: {fields['buckets']} buckets of"
            f" {fields['bucket_bytes']} bytes and width {fields['width']}, {fields['full']} of them"
            f" full and {fields['partial']} partly filled; {AGAIN}"
        )

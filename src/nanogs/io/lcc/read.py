"""Reading a level of `.lcc` (XGRIDS), by random access to its rows; `header` has the layout.

A splat's centre is three floats, in metres, z up; its scales are linear and its alpha is a byte. Of
its rotation, three components have 10 bits each, and the two top bits are the index in xyzw of the
largest one, which is not stored. An SH coefficient has 11, 10 and 11 bits for red, green and blue.
The environment, which viewers draw with every level, is read as the last rows of each level.
Normals are left out.
"""

from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from nanogs._types import F64, Array
from nanogs.activations import base_colour, logit
from nanogs.errors import FormatError
from nanogs.findings import Finding
from nanogs.frames import TRAINED, change_frame
from nanogs.io.files import input_size
from nanogs.io.info import FileInfo
from nanogs.io.lcc.header import DATA, ENVIRONMENT, FRAME, HARMONICS, ROW, SH_ROW, Header, Ranges
from nanogs.io.parts import FileSource, check_level, row_blocks
from nanogs.io.rotations import whole_quats
from nanogs.slices import overlapping
from nanogs.splats import Splats, empty_arrays

_TYPES = {"mean": "float", "rgba": "uchar", "scale": "ushort", "quat": "uint", "normal": "ushort"}
_NORMALS = "The normals of {:splat|splats} were left out, because their encoding is not known."


def open_level(path: Path, level: int = 0) -> "LccLevel":
    """Open a level of an `.lcc` model; 0 is the finest.

    Raises:
        OptionError: There is no such level.
        FormatError: A file is missing or damaged, they contradict each other, or the level is
            empty.
    """
    header = Header(path)
    check_level(path, level, len(header.levels))
    return LccLevel(header, level)


class LccLevel(FileSource):
    """The source of a level: its splats, cell by cell, followed by those of the environment."""

    def __init__(self, header: Header, level: int) -> None:
        super().__init__(header.path)
        self._header, self._runs = header, header.levels[level]
        if not self._runs.count:
            raise FormatError(f"{self.path} holds no splats of level {level}; export it again.")
        kinds = [*_TYPES.items(), *([("sh", "uint")] if header.harmonics else [])]
        self.info = FileInfo(
            path=self.path,
            format="lcc",
            encoding="binary_little_endian",
            file_bytes=sum(map(input_size, header.files())),
            splats=self._runs.count + header.environment,
            sh_degree=header.degree,
            properties=tuple(kinds),
        )

    @property
    def files(self) -> Sequence[Path]:
        """The JSON file and all files beside it that are read; see `FileSource`."""
        return self._header.files()

    @property
    def levels(self) -> tuple[int, ...]:
        """Number of splats of each level, the environment included; see `FileSource`."""
        return tuple(level.count + self.environment for level in self._header.levels)

    @cached_property
    def environment(self) -> int:
        """Number of splats of the environment, which are in every level; see `FileSource`."""
        return self._header.environment

    def _span(self, start: int, stop: int) -> Splats:
        """Read rows `start` to `stop`; see `Source`."""
        header = self._header
        out = empty_arrays(stop - start, header.degree)
        at = normals = 0
        with np.errstate(all="ignore"):  # the file may hold NaN, infinity, scales of 0
            for ranges, block, sh in self._blocks(start, stop):
                part = {name: array[at : at + len(block)] for name, array in out.items()}
                _decode(block, sh, ranges, part)
                turned = change_frame(Splats(**part), FRAME, TRAINED)
                for name, rows in part.items():
                    rows[:] = getattr(turned, name)
                normals += int(block["normal"].any(axis=1).sum())
                at += len(block)
        return Splats(**out, notes=[Finding(_NORMALS, normals)] if normals else [])

    def _blocks(self, start: int, stop: int) -> Iterator[tuple[Ranges, Array, Array | None]]:
        """Yield blocks of stored rows: the ranges of their codes, the rows, and their harmonics."""
        header, runs = self._header, self._runs
        for cell, low, high in overlapping(runs.ends, start, min(stop, runs.count)):
            offset = int(runs.offsets[cell]) + low * ROW.itemsize
            plain = row_blocks(header.beside(DATA), ROW, offset, high - low)
            if not header.harmonics:
                yield from ((header.ranges, block, None) for _, block in plain)
                continue
            more = row_blocks(header.beside(HARMONICS), SH_ROW, 2 * offset, high - low)
            for (_, block), (_, coefficients) in zip(plain, more, strict=True):
                yield header.ranges, block, coefficients["sh"]
        low, high = max(start, runs.count) - runs.count, stop - runs.count
        if low < high:
            row = header.environment_row
            path = header.beside(ENVIRONMENT)
            for _, block in row_blocks(path, row, low * row.itemsize, high - low):
                yield header.environment_ranges, block, block["sh"] if header.harmonics else None


def _decode(block: Array, sh: Array | None, ranges: Ranges, out: dict[str, Any]) -> None:
    out["means"][:] = block["mean"]
    rgba = block["rgba"] / 255.0
    out["sh"][:, 0] = base_colour(rgba[:, :3])
    out["opacity_logits"][:] = logit(rgba[:, 3])
    out["log_scales"][:] = np.log(_between(ranges.scale, block["scale"] / 65535.0))
    out["quats"][:] = _quats(block["quat"])
    if sh is not None and ranges.sh is not None:
        parts = [(sh & 2047) / 2047.0, (sh >> 11 & 1023) / 1023.0, (sh >> 21) / 2047.0]
        out["sh"][:, 1:] = _between(ranges.sh, np.stack(parts, axis=-1))


def _between(edges: F64, share: F64) -> F64:
    """Interpolate linearly from the low to the high edge by a share in [0, 1]."""
    low, high = edges
    values: F64 = (1 - share) * low + share * high
    return values


def _quats(packed: Array) -> F64:
    """Decode rotations to (R, 4) wxyz."""
    parts = np.stack([packed >> shift & 1023 for shift in (0, 10, 20)], axis=1)
    small = (parts / 1023.0 * 2 - 1) * np.sqrt(0.5)
    return whole_quats(small, packed >> 30)[:, [3, 0, 1, 2]]

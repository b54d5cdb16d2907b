"""Division into blocks: Morton ranges of about equal counts, from digests of sorted segments.

Source: Shi and Schaeffer, "Parallel sorting by regular sampling", 1992: splitters from every d-th
key of sorted runs divide all keys evenly, to d keys a run, for any distribution. No histogram has
to be refined where splats are dense.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from nanogs._types import I64, U64
from nanogs.errors import NONE_USABLE, CrowdedError, ModelError
from nanogs.pipeline.options.settings import Settings
from nanogs.pipeline.tasks.sorted_segments import DIGEST
from nanogs.store.columns import CODES
from nanogs.store.scratch import Scratch
from nanogs.store.tables import Record, read_column


@dataclass(frozen=True, slots=True)
class Partition:
    """The rows of each segment that make each block.

    Attributes:
        bounds: For each segment, the first row of each block, and then its number of rows.
    """

    bounds: tuple[tuple[int, ...], ...]

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return len(self.bounds[0]) - 1

    def pieces(self, block: int) -> list[slice]:
        """Return the rows of a block in each segment."""
        return [slice(each[block], each[block + 1]) for each in self.bounds]

    def count(self, block: int) -> int:
        """Return the number of splats of a block."""
        return sum(piece.stop - piece.start for piece in self.pieces(block))

    @property
    def largest(self) -> int:
        """Largest number of splats of a block."""
        return max(map(self.count, range(self.blocks)))

    @property
    def splats(self) -> int:
        """Number of splats of all blocks."""
        return sum(each[-1] for each in self.bounds)

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        return {"bounds": self.bounds}


def partition_of(data: Any) -> Partition:  # noqa: ANN401 - a record's facts
    """Rebuild a partition from the data of `to_dict` after a round trip through JSON."""
    return Partition(tuple(tuple(each) for each in data["bounds"]))


def partition(scratch: Scratch, settings: Settings, segments: Sequence[Record]) -> Partition:
    """Divide all splats into as few blocks as the largest size allows, of about equal counts.

    Args:
        scratch: Where the segments are.
        settings: The job.
        segments: Their records.

    Raises:
        ModelError: No splat is usable.
        CrowdedError: More splats than a block may have are at one position; the caller, who knows
            what limits the block size, adds the remedy.
    """
    splats = sum(int(record.facts["splats"]) for record in segments)
    if splats == 0:
        raise ModelError(NONE_USABLE)
    # A range may be off by half of it at either end. Digests of every code divide exactly, but for
    # the last block, which may have a row more.
    coarse = settings.rows_per_code > 1
    slack = 2 * settings.rows_per_code * len(segments) if coarse else 1
    most_rows = max(settings.block - slack, 1)
    codes, before = _merged(scratch, segments, settings.rows_per_code)
    found = _divided(scratch, segments, _even(codes, before, -(-splats // most_rows)))
    if found.largest > settings.block + slack:
        # Splats in one place, which stay together, shift the bounds of even ranges by their number.
        found = _divided(scratch, segments, _full(codes, before, splats, most_rows))
    if found.largest > settings.block + slack:
        raise CrowdedError(
            f"{found.largest:,} splats lie in one place and cannot be divided into blocks of"
            f" {settings.block:,}"
        )
    return found


def len_of(record: Record) -> int:
    """Return the number of rows of a segment."""
    return record.columns[CODES].shape[0]


def _merged(scratch: Scratch, segments: Sequence[Record], rows_per_code: int) -> tuple[U64, I64]:
    """Return the codes of all digests, ascending, and the number of rows before each."""
    codes, weights = [], []
    for record in segments:
        codes.append(read_column(scratch, record, DIGEST))
        full, rest = divmod(len_of(record), rows_per_code)
        weights.append(np.array([rows_per_code] * full + [rest] * (rest > 0), np.int64))
    merged, heavy = np.concatenate(codes), np.concatenate(weights)
    order = np.argsort(merged, kind="stable")
    return merged[order], np.cumsum(heavy[order]) - heavy[order]


def _even(codes: U64, before: I64, blocks: int) -> U64:
    """Return (blocks - 1,) splitters, the lowest code of each block after the first."""
    wanted = before[-1] * np.arange(1, blocks) // blocks
    chosen: U64 = codes[np.minimum(np.searchsorted(before, wanted), len(codes) - 1)]
    return chosen


def _full(codes: U64, before: I64, rows: int, most_rows: int) -> U64:
    """Return splitters for blocks of whole places, each of up to `most_rows` of all rows."""
    places, firsts = np.unique(codes, return_index=True)
    ends = np.append(before[firsts[1:]], rows)
    splitters: list[int] = []
    place = start = 0
    while True:
        fitting = int(np.searchsorted(ends, start + most_rows, side="right"))
        place = max(fitting, place + 1)  # one place alone may have more rows
        if place >= len(places):
            break
        splitters.append(places[place])
        start = int(ends[place - 1])
    return np.array(splitters, np.uint64)


def _divided(scratch: Scratch, segments: Sequence[Record], splitters: U64) -> Partition:
    bounds = []
    for record in segments:
        inner = np.searchsorted(read_column(scratch, record, CODES), splitters)
        bounds.append((0, *map(int, inner), len_of(record)))
    return _without_empty(np.array(bounds, np.int64))


def _without_empty(bounds: I64) -> Partition:
    """Remove empty ranges, which arise where many splats are at one position."""
    full = [i for i, (a, b) in enumerate(pairwise(bounds.T)) if (b > a).any()]
    kept = np.concatenate([bounds[:, :1], bounds[:, [i + 1 for i in full]]], axis=1)
    return Partition(tuple(tuple(map(int, each)) for each in kept))

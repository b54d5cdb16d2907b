"""The splats that are left of each block, by level: the parts that results are assembled from."""

from dataclasses import asdict, fields
from itertools import accumulate
from typing import TYPE_CHECKING

import numpy as np

from nanogs._types import F32, I64, U64, Array, F
from nanogs.frames import change_between, turned
from nanogs.io.rate_distortion import Curvatures
from nanogs.pipeline.api import simplify
from nanogs.pipeline.options.settings import Settings, plain
from nanogs.pipeline.scene import Task
from nanogs.slices import overlapping
from nanogs.sorting import stable_order
from nanogs.source import Layout, Source
from nanogs.splats import Splats, concatenate
from nanogs.store.columns import (
    CODES,
    count_of,
    empty_columns,
    read_rows,
    sorted_columns,
    splats_of,
)
from nanogs.store.scratch import Scratch
from nanogs.store.tables import Record, Table, read_column, write_table

if TYPE_CHECKING:
    from nanogs.pipeline.work import Work

BOUNDS = "bounds"
_CURVATURE = "curvature:"


def read_part(scratch: Scratch, layout: Layout, record: Record) -> Splats:
    """Read all splats of a table."""
    return _rows(scratch, layout, record, slice(0, count_of(record)))


class LevelSource(Source):
    """A source of the splats of a level, block after block; one table is open at a time.

    Args:
        work: The job, all its tasks done.
        level: Of the result.
        block: Number of the only block to read; by default all are read.
    """

    def __init__(self, work: "Work", level: int, block: int | None = None) -> None:
        self._work = work
        records = work.delivered(level)
        self._records = records if block is None else records[block : block + 1]
        self._ends = [0, *accumulate(map(count_of, self._records))]
        self.count, self.columns = self._ends[-1], work.settings.result_layout
        self._table: Table | None = None

    def _span(self, start: int, stop: int) -> Splats:
        """Read rows `start` to `stop`; see `Source.read`."""
        columns, at = empty_columns(self.columns, stop - start), 0
        for number, low, high in overlapping(self._ends, start, stop):
            read_rows(self._opened(self._records[number]), columns, at, slice(low, high))
            at += high - low
        return splats_of(columns, self.columns)

    def _opened(self, record: Record) -> Table:
        if self._table is None or self._table.record is not record:
            self.close()
            self._table = Table(self._work.scratch, record)
        return self._table

    def close(self) -> None:
        """Close the table that is open."""
        if self._table is not None:
            self._table.close()
            self._table = None


def columns_of_curvatures(curvatures: Curvatures) -> dict[str, Array]:
    """Return the columns by which the curvatures of a part are kept beside its splats."""
    return {_CURVATURE + each.name: getattr(curvatures, each.name) for each in fields(curvatures)}


def read_curvatures(work: "Work", level: int) -> Curvatures | None:
    """Read the curvatures of a level's splats, in the order of `LevelSource`.

    Splats of blocks that were not fitted get the median of all others.

    Returns:
        None if no block was fitted, or if splats were merged afterwards.
    """
    records = work.delivered(level)
    names = [each.name for each in fields(Curvatures)]
    fitted = [record for record in records if _CURVATURE + names[0] in record.columns]
    if not fitted or work.delivered_count(level) > work.target(level):
        return None

    def read(name: str) -> F32:
        parts: dict[str, Array] = {
            record.name: read_column(work.scratch, record, _CURVATURE + name) for record in fitted
        }
        median = np.median(np.concatenate([*parts.values()]), axis=0)
        for record in records:
            if record.name not in parts:
                parts[record.name] = np.broadcast_to(median, (count_of(record), *median.shape))
        return np.concatenate([parts[record.name] for record in records]).astype(np.float32)

    return Curvatures(**{name: read(name) for name in names})


def simplify_further(small: Splats, target: int, settings: Settings, threads: int) -> Splats:
    """Simplify a model in memory to a count below what blocks can be cut to."""
    given = asdict(plain(settings).parameters)
    return simplify(small, count=target, preset="fast", threads=threads, **given)[0]


def write_rest(work: "Work", task: Task) -> Record:
    """Simplify a level in memory if blocks could not be cut far enough, and divide the result.

    Each splat belongs to the block it lies in; if a finer level left that one empty, to the one
    before. The table has no columns if nothing was left to do.
    """
    records, target = work.delivered(task.level), work.target(task.level)
    if work.delivered_count(task.level) <= target:
        return write_table(work.scratch, task.name, {}, {BOUNDS: None})
    parts = [read_part(work.scratch, work.settings.result_layout, record) for record in records]
    small = simplify_further(concatenate(parts), target, work.settings, work.threads)
    codes = work.units.codes(small)
    order = stable_order(codes)
    blocks = _filled(work, task.level)
    found = np.searchsorted(_first_codes(work)[blocks], codes[order], side="right") - 1
    places = blocks[np.maximum(found, 0)]
    bounds = np.searchsorted(places, np.arange(len(records) + 1))
    facts = {BOUNDS: bounds.tolist()}
    return write_table(work.scratch, task.name, sorted_columns(small, order), facts)


def part_of_block(work: "Work", block: int, level: int) -> Splats:
    """Read the splats of a level that belong to a block, in the frame of the results.

    Each splat of the level belongs to exactly one block.
    """
    splats = _rows(work.scratch, work.settings.result_layout, *_place(work, block, level))
    return turned(splats, work.settings.frame)


def count_of_block(work: "Work", block: int, level: int) -> int:
    """Return the number of splats of a level that belong to a block."""
    rows = _place(work, block, level)[1]
    return int(rows.stop - rows.start)


def means_of_block(work: "Work", block: int) -> F:
    """Read (N, 3) the centres of a block's finest level, scene units, in the results' frame."""
    record, rows = _place(work, block, 0)
    if rows.start == rows.stop:
        return np.empty((0, 3), np.float32)
    with Table(work.scratch, record) as table:
        means: F = table.read("means", rows.start, rows.stop)
    frame = work.settings.frame
    return change_between(*frame).of_means(means) if frame else means


def _place(work: "Work", block: int, level: int) -> tuple[Record, slice]:
    """Return the table that holds a block's splats of a level, and their rows in it."""
    rest = work.of_job("rest", level)
    bounds = rest.facts[BOUNDS]
    if bounds is None:
        record = work.delivered(level)[block]
        return record, slice(0, count_of(record))
    return rest, slice(*bounds[block : block + 2])


def _filled(work: "Work", level: int) -> I64:
    """Return the blocks that splats may go to: those not empty in the finest level."""
    bounds = work.of_job("rest", 0).facts[BOUNDS] if level else None
    if bounds is None:
        return np.arange(work.partition.blocks)
    return np.flatnonzero(np.diff(bounds))


def _first_codes(work: "Work") -> U64:
    """Return (B,) the lowest Morton code of each block."""
    partition = work.partition
    lowest = np.full(partition.blocks, np.iinfo(np.uint64).max)
    for record, bounds in zip(work.segments(), partition.bounds, strict=True):
        with Table(work.scratch, record) as table:
            for block in np.flatnonzero(np.diff(bounds)):
                start = bounds[block]
                lowest[block] = min(lowest[block], table.read(CODES, start, start + 1)[0])
    return lowest


def _rows(scratch: Scratch, layout: Layout, record: Record, rows: slice) -> Splats:
    columns: dict[str, Array] = empty_columns(layout, rows.stop - rows.start)
    if rows.stop > rows.start:
        with Table(scratch, record) as table:
            read_rows(table, columns, 0, rows)
    return splats_of(columns, layout)

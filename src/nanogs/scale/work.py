"""The tasks of a job: each reads what those before it wrote, and writes one table of its own.

A task's bytes depend on nothing but the job's settings, so that it can be done anywhere, at any
time, and again.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from nanogs._types import I32, I64, Array
from nanogs.errors import OutputError
from nanogs.method.nodes import Nodes
from nanogs.method.store import store_groups
from nanogs.pipeline.target import target_count
from nanogs.scale.blocks import leaves_of, morton_rows, read_block, with_codes
from nanogs.scale.budget import budget
from nanogs.scale.chunked import write_cells, write_chunks
from nanogs.scale.columns import CODES, empty_columns, read_rows, sorted_columns, splats_of
from nanogs.scale.cuts import LABELS, cut_block, write_cut
from nanogs.scale.forests import grow
from nanogs.scale.frame import Frame, frame_of, survey
from nanogs.scale.halo import find_halo
from nanogs.scale.partition import Partition, partition, partition_of
from nanogs.scale.parts import write_rest
from nanogs.scale.scratch import Scratch
from nanogs.scale.settings import Settings
from nanogs.scale.settle import GONE, GROUP, settled, view_of, write_settled
from nanogs.scale.spill import spill
from nanogs.scale.tables import Record, Table, read_record, write_table
from nanogs.scale.unpack import Unpacked, unpack
from nanogs.source import Layout
from nanogs.splats import Splats
from nanogs.threads import use_threads

UNPACK = "unpack"
FEWEST = 64  # splats of a block's part, on average


@dataclass(frozen=True, slots=True)
class Task:
    """One of the tasks of a job.

    Attributes:
        stage: What is done.
        number: Of the segment or block.
        level: Of the result.
    """

    stage: str
    number: int = 0
    level: int = 0

    @property
    def name(self) -> str:
        """Name of the table that it writes."""
        return f"{self.stage}-{self.level}-{self.number:05d}"


MARK = Task("job")  # done by the caller: who does not see its record sees other files


@dataclass(slots=True, eq=False)
class Work:
    """A job as a task sees it.

    Attributes:
        scratch: Its files.
        settings: What it is about.
        threads: Threads in use.
        known: Records that have been read.
    """

    scratch: Scratch
    settings: Settings
    threads: int
    known: dict[str, Record] = field(default_factory=dict)

    def record(self, task: Task) -> Record:
        """The record of what a task wrote.

        Raises:
            OutputError: It is not there.
        """
        name = task.name
        if name not in self.known:
            found = read_record(self.scratch, name)
            if found is None:
                raise OutputError(
                    f"{name} of the job is not in {self.scratch.place}; workers and caller must"
                    " see the same files there, name such a place with `scratch`."
                )
            self.known[name] = found
        return self.known[name]

    @property
    def frame(self) -> Frame:
        """The frame that all blocks share."""
        return frame_of(self.record(Task("frame")).facts)

    @property
    def partition(self) -> Partition:
        """The rows of each block."""
        return partition_of(self.record(Task("partition")).facts)

    def unpacked(self) -> Unpacked:
        """The input files that have been unpacked."""
        files = enumerate(self.settings.unpacked)
        return Unpacked(self.scratch, {file: self.record(Task(UNPACK, i)) for i, file in files})

    def segments(self) -> list[Record]:
        """The sorted segments."""
        return [self.record(Task("segment", i)) for i in range(len(self.settings.segments))]

    def of_job(self, stage: str, level: int = 0) -> Record:
        """The record of what a stage of one task wrote."""
        return self.record(Task(stage, 0, level))

    def of_block(self, stage: str, block: int, level: int = 0) -> Record:
        """The record of what a stage wrote for a block."""
        return self.record(Task(stage, block, level))

    def of_blocks(self, stage: str, level: int = 0) -> list[Record]:
        """The records of what a stage wrote, one a block."""
        return [self.record(Task(stage, b, level)) for b in range(self.partition.blocks)]

    def read(
        self, block: int, columns: dict[str, Array], at: int = 0, rows: I64 | None = None
    ) -> int:
        """Fill columns with splats of a block, as `read_block` does."""
        return read_block(self.scratch, self.segments(), self.partition, block, columns, at, rows)


def do(work: Work, task: Task) -> Record:
    """Do a task.

    Raises:
        NanogsError: The input cannot be read, or the scratch not be written.
    """
    with use_threads(work.threads):
        record = _STAGES[task.stage](work, task)
    work.known[task.name] = record
    return record


def _unpack(work: Work, task: Task) -> Record:
    settings = work.settings
    return unpack(work.scratch, task.name, settings.inputs[settings.unpacked[task.number]])


def _frame(work: Work, task: Task) -> Record:
    facts = survey(work.settings, work.unpacked()).to_dict()
    return write_table(work.scratch, task.name, {}, facts)


def _segment(work: Work, task: Task) -> Record:
    return spill(work.scratch, task.name, work.settings, work.frame, task.number, work.unpacked())


def _partition(work: Work, task: Task) -> Record:
    found = partition(work.scratch, work.settings, work.segments())
    return write_table(work.scratch, task.name, {}, found.to_dict())


def _forest(work: Work, task: Task) -> Record:
    splats, rows = _block(work, task.number)
    frame = work.frame
    return grow(
        work.scratch, task.name, lambda: leaves_of(splats, rows, frame, bare=True),
        work.settings.parameters, work.threads,
    )  # fmt: skip


def _budget(work: Work, task: Task) -> Record:
    counts = work.settings.counts
    if counts:
        target = target_count(work.partition.splats, None, counts[task.level])
    else:
        target = target_count(work.partition.splats, work.settings.ratios[task.level], None)
    # Blocks cannot be cut to less than a splat each, nor well to a few: the rest is done in memory.
    cut_to = max(target, min(FEWEST * work.partition.blocks, work.partition.splats))
    groups = budget(work.scratch, work.of_blocks("forest"), cut_to)
    return write_table(work.scratch, task.name, {}, {"target": target, "groups": groups})


def _cut(work: Work, task: Task) -> Record:
    bare = replace(work.settings.layout, sh_degree=0, extras=())  # colours have no part in it
    splats, rows = _block(work, task.number, bare)
    leaves, groups = leaves_of(splats, rows, work.frame), _groups(work, task)
    labels = cut_block(work.scratch, _forest_of(work, task), groups)
    return write_cut(work.scratch, task.name, leaves, labels, groups, work.threads)


def _settle(work: Work, task: Task) -> Record:
    cuts = work.of_blocks("cut", task.level)
    own = work.partition.count(task.number)
    halo = find_halo(work.scratch, cuts, task.number, own, work.threads)
    count = own + sum(len(each.rows) for each in halo)
    columns = with_codes(empty_columns(work.settings.layout, count), count)
    work.read(task.number, columns)
    at = own
    for each in halo:
        at = work.read(each.block, columns, at, each.rows)
    with Table(work.scratch, cuts[task.number]) as table:
        labels = table.read(LABELS)
    splats = splats_of(columns, work.settings.layout)
    leaves = leaves_of(splats, morton_rows(columns[CODES]), work.frame)
    view = view_of(leaves, labels, own, _groups(work, task), halo)
    after = settled(view, work.settings.parameters.rounds, work.threads)
    return write_settled(work.scratch, task.name, after, view, columns)


def _part(work: Work, task: Task) -> Record:
    splats, leaves, labels = _members(work, task)
    frame, growth = work.frame, work.settings.parameters.growth
    groups = store_groups(leaves, labels, splats, frame.centre(), frame.dilation(), sheets=True)
    small = groups.grown(growth)
    order = morton_rows(frame.codes(small))
    return write_table(work.scratch, task.name, sorted_columns(small, order), {})


def _rest(work: Work, task: Task) -> Record:
    target = int(work.of_job("budget", task.level).facts["target"])
    return write_rest(work, task.name, task.level, target)


def _cells(work: Work, task: Task) -> Record:
    return write_cells(work, task.name, task.number)


def _chunk(work: Work, task: Task) -> Record:
    return write_chunks(work, task.name, task.number, task.level)


def _members(work: Work, task: Task) -> tuple[Splats, Nodes, I32]:
    """The splats of a block's groups, a leaf for each of them, and the group of each leaf."""
    if not work.settings.parameters.rounds:
        splats, rows = _block(work, task.number)
        labels = cut_block(work.scratch, _forest_of(work, task), _groups(work, task))
        return splats, leaves_of(splats, rows, work.frame), labels
    given = _handed_to(work, task)
    own = work.partition.count(task.number)
    count = own + sum(stop - start for _, start, stop in given)
    columns = with_codes(empty_columns(work.settings.layout, count), count)
    by_row = np.empty(count, np.int32)
    work.read(task.number, columns)
    with Table(work.scratch, work.of_block("settle", task.number, task.level)) as table:
        table.read_into(LABELS, 0, by_row[:own])
    at = own
    for record, start, stop in given:
        with Table(work.scratch, record) as table:
            read_rows(table, columns, at, slice(start, stop))
            by_row[at : at + stop - start] = table.read(GROUP, start, stop)
        at += stop - start
    rows = morton_rows(columns[CODES])
    rows = rows[by_row[rows] != GONE]
    splats = splats_of(columns, work.settings.layout)
    return splats, leaves_of(splats, rows, work.frame), by_row[rows]


def _handed_to(work: Work, task: Task) -> list[tuple[Record, int, int]]:
    """Rows that other blocks hand over to one, block by block."""
    settled = work.of_blocks("settle", task.level)
    places = [(record, record.facts["handed"].get(str(task.number))) for record in settled]
    return [(record, *place) for record, place in places if place]


def _block(work: Work, block: int, layout: Layout | None = None) -> tuple[Splats, I64]:
    """The splats of a block, and their rows in Morton order."""
    layout = layout or work.settings.layout
    count = work.partition.count(block)
    columns = with_codes(empty_columns(layout, count), count)
    wanted = dict(columns)
    if layout is not work.settings.layout:
        columns["sh"][:] = 0
        del wanted["sh"]
    work.read(block, wanted)
    return splats_of(columns, layout), morton_rows(columns[CODES])


def _forest_of(work: Work, task: Task) -> Record:
    return work.of_block("forest", task.number)


def _groups(work: Work, task: Task) -> int:
    return int(work.of_job("budget", task.level).facts["groups"][task.number])


_STAGES: dict[str, Callable[[Work, Task], Record]] = {
    UNPACK: _unpack,
    "frame": _frame,
    "segment": _segment,
    "partition": _partition,
    "forest": _forest,
    "budget": _budget,
    "cut": _cut,
    "settle": _settle,
    "part": _part,
    "rest": _rest,
    "cells": _cells,
    "chunk": _chunk,
}

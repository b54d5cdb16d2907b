"""The tasks of a job: each reads what those before it wrote, and writes one table of its own.

A task's bytes depend on nothing but the job's settings, so that it can be done anywhere, at any
time, and again.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from nanogs._types import F64, I32, I64, Array
from nanogs.errors import OutputError
from nanogs.method.store import Groups, store_groups
from nanogs.pipeline.blocks import Seen, leaves_of, morton_rows, read_block, with_codes
from nanogs.pipeline.cuts import LABELS, cut_block
from nanogs.pipeline.frame import Frame, frame_of
from nanogs.pipeline.halo import Halo
from nanogs.pipeline.look import VISIBLE, read_visible, typical_weight
from nanogs.pipeline.partition import Partition, partition_of
from nanogs.pipeline.settings import Settings
from nanogs.pipeline.settle import GONE, GROUP
from nanogs.pipeline.unpack import Unpacked
from nanogs.pipeline.views import Views, views_of
from nanogs.source import Layout
from nanogs.splats import Splats
from nanogs.store.columns import CODES, empty_columns, read_rows, splats_of
from nanogs.store.scratch import Scratch
from nanogs.store.tables import Record, Table, read_record

UNPACK = "unpack"


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

    def table(self, stage: str, block: int, level: int = 0) -> Table:
        """The table that a stage wrote for a block, open for reading."""
        return Table(self.scratch, self.of_block(stage, block, level))

    @property
    def views(self) -> Views:
        """The views of the whole scene."""
        return views_of(self.of_job("views").facts)

    @property
    def looks(self) -> bool:
        """Whether anything is looked at: not in a scene that shows nothing."""
        return self.settings.looks and bool(self.of_job("views").facts["kept"])

    @property
    def measures(self) -> bool:
        """Whether results are chosen by how they look."""
        return self.settings.measures and self.looks

    @property
    def balances(self) -> tuple[float, ...]:
        """The balances of the cuts that are tried; the usual one where none can be measured."""
        given = self.settings.parameters
        return given.balances if self.measures else (given.balance,)

    def delivered(self, level: int) -> list[Record]:
        """The records of a level's splats, one a block, as they are delivered."""
        return self.of_blocks("fit" if self.settings.fits else "part", level)

    def read(
        self, block: int, columns: dict[str, Array], at: int = 0, rows: I64 | None = None
    ) -> int:
        """Fill columns with splats of a block, as `read_block` does."""
        return read_block(self.scratch, self.segments(), self.partition, block, columns, at, rows)

    def block(self, block: int, layout: Layout | None = None) -> tuple[Splats, I64]:
        """The splats of a block, and their rows in Morton order.

        Args:
            block: Its number.
            layout: The columns that are needed; those left out are zeros.
        """
        layout = layout or self.settings.layout
        count = self.partition.count(block)
        columns = with_codes(empty_columns(layout, count), count)
        wanted = dict(columns)
        if layout is not self.settings.layout:
            columns["sh"][:] = 0
            del wanted["sh"]
        self.read(block, wanted)
        return splats_of(columns, layout), morton_rows(columns[CODES])

    def seen(self, visible: F64 | None) -> Seen | None:
        """How nodes of splats are weighed that are so visible; None where nothing is measured."""
        if visible is None or not self.measures:
            return None
        return Seen(visible, self.settings.parameters.hidden, typical_weight(self))

    def visible(self, block: int) -> F64 | None:
        """(N,) how visible a block's splats are; None where nothing is looked at."""
        return read_visible(self, block) if self.looks else None

    def groups(self, block: int, level: int) -> int:
        """How many groups of a block are left."""
        return int(self.of_job("budget", level).facts["groups"][self.balance(level)][block])

    def balance(self, level: int) -> int:
        """Number of the balance that was chosen."""
        return int(self.of_job("pick", level).facts["balance"]) if self.measures else 0

    def labels(self, block: int, level: int) -> I32:
        """(N,) the group of each leaf of a block's forest, before reassignment."""
        forest, balance = self.of_block("forest", block), self.balance(level)
        return cut_block(self.scratch, forest, self.groups(block, level), balance)

    def members(self, block: int, level: int, *, reassigned: bool) -> "Members":
        """The splats of a block's groups, of which some may come from other blocks.

        Args:
            block: Its number.
            level: Of the result.
            reassigned: Whether as they are after reassignment.
        """
        if not reassigned:
            splats, rows = self.block(block)
            visible = self.visible(block)
            return Members(splats, rows, self.labels(block, level), visible)
        given = self._handed_to(block, level)
        own = self.partition.count(block)
        count = own + sum(stop - start for _, start, stop in given)
        columns = with_codes(empty_columns(self.settings.layout, count), count)
        by_row = np.empty(count, np.int32)
        self.read(block, columns)
        if self.looks:
            columns[VISIBLE] = np.empty(count)
            columns[VISIBLE][:own] = self.visible(block)
        with self.table("settle", block, level) as table:
            table.read_into(LABELS, 0, by_row[:own])
        at = own
        for record, start, stop in given:
            with Table(self.scratch, record) as table:
                read_rows(table, columns, at, slice(start, stop))
                by_row[at : at + stop - start] = table.read(GROUP, start, stop)
            at += stop - start
        if (gone := by_row == GONE).any():
            for name in columns:  # one after the other, so that no two copies of all are held
                columns[name] = columns[name][~gone]
            by_row = by_row[~gone]
        rows = morton_rows(columns[CODES])
        splats = splats_of(columns, self.settings.layout)
        return Members(splats, rows, by_row[rows], columns.get(VISIBLE))

    def stored(self, members: "Members") -> Groups:
        """The groups of a block as splats."""
        leaves = leaves_of(members.splats, members.rows, self.frame, self.seen(members.visible))
        frame, sheets = self.frame, not self.measures
        return store_groups(
            leaves, members.labels, members.splats, frame.centre(), frame.dilation(), sheets=sheets
        )

    def visible_with(self, block: int, halo: Sequence[Halo]) -> F64:
        """(V,) how visible a block's splats are, and after them those of its halo."""
        parts = [read_visible(self, block)]
        parts += [read_visible(self, each.block)[each.rows] for each in halo]
        return np.concatenate(parts)

    def chosen(self, level: int) -> "Chosen":
        """How the groups of a level become splats."""
        parameters = self.settings.parameters
        if not self.measures:
            return Chosen(parameters.rounds > 0, parameters.growth)
        facts = self.of_job("choose", level).facts
        return Chosen(bool(facts["reassigned"]), float(facts["growth"]))

    def _handed_to(self, block: int, level: int) -> list[tuple[Record, int, int]]:
        """Rows that other blocks hand over to one, block by block."""
        settled = self.of_blocks("settle", level)
        places = [(record, record.facts["handed"].get(str(block))) for record in settled]
        return [(record, *place) for record, place in places if place]


@dataclass(frozen=True, slots=True)
class Chosen:
    """The choice for a level: whether splats stay reassigned, and how much they may grow."""

    reassigned: bool
    growth: float


@dataclass(frozen=True, slots=True, eq=False)
class Members:
    """The splats of a block's groups.

    Attributes:
        splats: N of them.
        rows: (N,) int64, their rows in Morton order.
        labels: (N,) int32, the group of each, in that order.
        visible: (N,) float64, how visible each splat is, or None where nothing is looked at.
    """

    splats: Splats
    rows: I64
    labels: I32
    visible: F64 | None

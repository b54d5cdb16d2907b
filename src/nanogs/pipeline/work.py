"""A scene in blocks as it passes through the stages: each reads the tables of those before it.

A task's bytes depend only on the job's settings, so that it can be done anywhere, at any time, and
again.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from nanogs._types import F64, I32, I64, Array
from nanogs.errors import OutputError
from nanogs.fit.report import RefitReport
from nanogs.fit.targets import Target, make_target
from nanogs.io.rate_distortion import Curvatures
from nanogs.kernels.blocks import ALL_BLOCKS, FIELDS
from nanogs.method.correct import Correction, Ordering
from nanogs.method.growth import Cover
from nanogs.method.store import Groups, store_groups
from nanogs.pipeline.job.rows import sample
from nanogs.pipeline.options.settings import FINE, ROUGH, Settings
from nanogs.pipeline.scene import Block, FitViews, Look, Members, Scene, Task
from nanogs.pipeline.tasks.block_visibility import (
    VISIBLE,
    closer_views,
    hidden_weight,
    looks_at,
    read_visible,
    shown_share,
    typical_weight,
    write_look,
)
from nanogs.pipeline.tasks.blocks import Visibility, leaves_of, read_block, with_codes
from nanogs.pipeline.tasks.coarse import surroundings
from nanogs.pipeline.tasks.cuts import LABELS, cut_block, read_merges
from nanogs.pipeline.tasks.fitting import (
    FITTED,
    facts_of_fit,
    fit_report,
    fit_views,
    notes_on_fits,
)
from nanogs.pipeline.tasks.forests import grow, number_of, passes_of, write_correction
from nanogs.pipeline.tasks.halo import Halo, find_halo, near_groups
from nanogs.pipeline.tasks.partition import Partition, partition_of
from nanogs.pipeline.tasks.parts import columns_of_curvatures, read_part
from nanogs.pipeline.tasks.reassigning import (
    GONE,
    GROUP,
    block_with_halo,
    read_cover,
    reassigned,
    reassigned_cover,
    write_reassigned,
)
from nanogs.pipeline.tasks.trials import nth
from nanogs.pipeline.tasks.units import Units, find_units, units_of
from nanogs.pipeline.tasks.unpack import Unpacked
from nanogs.pipeline.tasks.views import Views, parts_of, views_of
from nanogs.progress import PartProgress, ignore_progress
from nanogs.raster.camera import Camera
from nanogs.raster.light import SplatLight, light_in_view
from nanogs.raster.rendering import PreparedSplats, concatenated, prepare
from nanogs.report import PassReport
from nanogs.sorting import stable_order
from nanogs.source import Layout
from nanogs.splats import Splats
from nanogs.store.columns import (
    CODES,
    columns_of,
    count_of,
    read_rows,
    sorted_columns,
    splats_of,
)
from nanogs.store.scratch import Scratch
from nanogs.store.tables import Record, Table, read_record, write_table
from nanogs.views.light import SHOWN

BEGUN = Task("job")  # written by the caller: a worker that cannot read it sees another folder
VIEW_SAMPLE, SHORT_RUN = 1 << 18, 32  # rows of the original that cameras are placed by, in runs


@dataclass(eq=False)
class Work(Scene):
    """A job as a task sees it; see `Scene`.

    Attributes:
        scratch: Its files.
        settings: Of the job.
        threads: Number of threads in use.
        known: Cache of the records that have been read.
        on_progress: Progress callback for the parts of the current task.
    """

    scratch: Scratch
    settings: Settings
    threads: int
    known: dict[str, Record] = field(default_factory=dict)
    on_progress: PartProgress = ignore_progress

    def record(self, task: Task) -> Record:
        """Return the record that a task wrote.

        Raises:
            OutputError: It is not there.
        """
        name = task.name
        if name not in self.known:
            found = read_record(self.scratch, name)
            if found is None:
                raise OutputError(
                    f"{name} of the job was not found in {self.scratch.label}; name a place with"
                    " `scratch` where the caller and all workers see the same files."
                )
            self.known[name] = found
        return self.known[name]

    @cached_property
    def units(self) -> Units:
        """The units that all blocks share."""
        return units_of(self.record(Task("units")).facts)

    @cached_property
    def partition(self) -> Partition:
        """The rows of each block."""
        return partition_of(self.record(Task("partition")).facts)

    def unpacked(self) -> Unpacked:
        """Return the input files that have been unpacked."""
        files = enumerate(self.settings.unpacked)
        return Unpacked(self.scratch, {file: self.record(Task("unpack", i)) for i, file in files})

    def segments(self) -> list[Record]:
        """Return the records of the sorted segments."""
        return [self.record(Task("segment", i)) for i in range(len(self.settings.segments))]

    def table(self, stage: str, block: int, level: int = 0) -> Table:
        """Open the table that a stage wrote for a block, for reading."""
        return Table(self.scratch, self.of_block(stage, block, level))

    @cached_property
    def views(self) -> Views:
        """The views of the whole scene."""
        return views_of(self.of_job("views").facts)

    def delivered(self, level: int) -> list[Record]:
        """Return the records of a level's splats in their final form, one for each block."""
        return self.of_blocks("fit" if self.fits(level) else "store", level)

    def delivered_count(self, level: int) -> int:
        """Return the number of these: more than `target` if blocks cannot be cut as far."""
        return sum(map(count_of, self.delivered(level)))

    def read(
        self, block: int, columns: dict[str, Array], at: int = 0, rows: I64 | None = None
    ) -> int:
        """Fill columns with splats of a block; see `read_block`."""
        return read_block(self.scratch, self.segments(), self.partition, block, columns, at, rows)

    def block(self, block: int, layout: Layout | None = None) -> tuple[Splats, I64]:
        """Read the splats of a block, all usable, and their rows in Morton order.

        Args:
            block: Its number.
            layout: The columns that are needed; harmonics that it leaves out are zeros.
        """
        layout = layout or self.settings.layout
        count = self.partition.count(block)
        columns = with_codes(layout, count)
        wanted = dict(columns)
        if layout is not self.settings.layout:
            columns["sh"][:] = 0
            del wanted["sh"]
        self.read(block, wanted)
        return splats_of(columns, layout), stable_order(columns[CODES])

    def open(self, block: int) -> Block:
        """Read the splats of a block, and their visibility if it is known."""
        return Block(*self.block(block), self.visible(block))

    def bare(self, block: int) -> Block:
        """Read the splats of a block without colours, which occlusion does not need."""
        return Block(*self.block(block, self.settings.layout.bare()), None)

    def weighing(self, visible: F64 | None) -> Visibility | None:
        """Return how nodes are weighed by visibility; None if the method is not guided."""
        if visible is None or not self.guided:
            return None
        hidden = hidden_weight(self)
        return Visibility(visible, hidden, typical_weight(self, hidden))

    def visible(self, block: int) -> F64 | None:
        """Read (N,) the visibility of a block's splats; None if nothing was rendered."""
        return read_visible(self, block) if self.looks else None

    def target(self, level: int) -> int:
        """Return the number of splats that a result is to have."""
        return int(self.of_job("budget", level).facts["target"])

    def merges(self, level: int) -> bool:
        """Whether a result has fewer splats than the scene."""
        return self.target(level) < self.partition.splats

    def cut_to(self, level: int) -> int:
        """Return the number of splats that the blocks of a result are cut to, all together."""
        return int(self.of_job("budget", level).facts["cut_to"])

    def group_count(self, block: int, level: int, cut: int | None = None) -> int:
        """Return the number of groups of a block in a cut, by default in the chosen one."""
        number = self.picked(level) if cut is None else cut
        step = self._correction_of(number)
        budget, place = ("budget", number) if step is None else (nth("budget", step), 0)
        return int(self.of_job(budget, level).facts["groups"][place][block])

    def _correction_of(self, cut: int) -> int | None:
        """Return the number of the correction that guides a cut; None for one of `balances`."""
        step = cut - len(self.balances)
        return step if step >= 0 else None

    def cut(self, block: int, level: int, number: int) -> I32:
        """Return the group of each leaf of a block in a cut; see `Scene.cut`."""
        groups = self.group_count(block, level, number)
        forest, scores = self.of_block("grow", block), self._scores(block, level, number)
        return cut_block(self.scratch, forest, groups, *scores)

    def ordering(self, own: Block, block: int, level: int, number: int) -> Ordering:
        """Read the merges of a block's forest and their errors; see `Scene.ordering`."""
        weighing = self.weighing(own.visible)
        weights = leaves_of(own.splats, own.rows, self.units, weighing).weights
        record, place = self._scores(block, level, number)
        children, scores = read_merges(self.scratch, self.of_block("grow", block), record, place)
        return Ordering(children, scores, weights)

    def keep_correction(self, task: Task, number: int, correction: Correction) -> Record:
        """Write the corrected errors for a further cut; see `Scene.keep_correction`."""
        return write_correction(
            self.scratch, task.name, self.partition.count(task.number), correction
        )

    def correction_targets(
        self, block: int, own: Block, others: PreparedSplats | None
    ) -> Iterator[Target]:
        """Render the part of each view that shows a block, except for the deciding views.

        As in memory, views that only the fit uses have half of their pixels if it uses half.
        """
        views, deciding, parameters = self.views, self.deciding, self.settings.parameters
        cameras = [camera for camera in views.kept if camera not in deciding]  # by identity
        cameras += [camera for camera, _ in looks_at(self, block)[len(views.kept) :]]
        whole = len(cameras)
        cameras += views.further if parameters.pictured else ()
        drawn, parts = self._crops(own, others, cameras)
        for number, part in enumerate(parts, -whole):
            if part:
                half = parameters.halves and number >= 0
                yield make_target(
                    drawn, part, depth=False, wanted=FIELDS[number % 2] if half else ALL_BLOCKS
                )

    def _scores(self, block: int, level: int, number: int) -> tuple[Record, int]:
        """Return the table that holds the scores of a cut of a block, and their number in it."""
        step = self._correction_of(number)
        if step is None:
            forest = self.of_block("grow", block)
            return forest, number_of(forest, self.balances[number])
        return self.of_block(nth("correct", step), block, level), 0

    def members(self, block: int, level: int, *, reassigned: bool) -> Members:
        """Read the splats and groups of a block; some splats may come from other blocks.

        Args:
            block: Its number.
            level: Of the result.
            reassigned: Whether to return the groups after reassignment.
        """
        if not reassigned:
            whole = self.open(block)
            return Members(
                whole.splats, whole.rows, whole.visible, self.picked_labels(block, level)
            )
        given = self._handed_to(block, level)
        own = self.partition.count(block)
        count = own + sum(stop - start for _, start, stop in given)
        columns = with_codes(self.settings.layout, count)
        by_row = np.empty(count, np.int32)
        self.read(block, columns)
        if self.looks:
            columns[VISIBLE] = np.empty(count)
            columns[VISIBLE][:own] = self.visible(block)
        with self.table("reassign", block, level) as table:
            table.read_into(LABELS, 0, by_row[:own])
        at = own
        for record, start, stop in given:
            with Table(self.scratch, record) as table:
                read_rows(table, columns, at, slice(start, stop))
                by_row[at : at + stop - start] = table.read(GROUP, start, stop)
            at += stop - start
        if (gone := by_row == GONE).any():
            for name in columns:  # one by one, so that no two copies of all are held
                columns[name] = columns[name][~gone]
            by_row = by_row[~gone]
        rows = stable_order(columns[CODES])
        splats = splats_of(columns, self.settings.layout)
        others = [] if self.guided else self._near_cover(block, level)
        return Members(splats, rows, columns.get(VISIBLE), by_row[rows], others)

    def stored(self, members: Members) -> Groups:
        """Merge each group of a block into one splat."""
        leaves = leaves_of(members.splats, members.rows, self.units, self.weighing(members.visible))
        units, growth = self.units, self.settings.parameters.growth
        return store_groups(
            leaves, members.labels, members.splats, units.centre(), units.dilation(),
            growth=None if self.guided else growth, others=members.others,
        )  # fmt: skip

    def visible_with(self, block: int, halo: Sequence[Halo]) -> F64:
        """Read (V,) the visibility of a block's splats, and then of those of its halo."""
        parts = [read_visible(self, block)]
        parts += [read_visible(self, each.block)[each.rows] for each in halo]
        return np.concatenate(parts)

    def write(self, name: str, columns: Mapping[str, Array], facts: Mapping[str, Any]) -> Record:
        """Write the columns and facts of a task as a table."""
        return write_table(self.scratch, name, columns, facts)

    def find_units(self, name: str) -> Record:
        """Compute the units that all blocks share, and write them."""
        return self.write(name, {}, find_units(self.settings, self.unpacked()).to_dict())

    def sample(self) -> Splats:
        """Read evenly spread splats of the inputs, for placing cameras."""
        return sample(self.settings, self.unpacked(), rows=VIEW_SAMPLE, span=SHORT_RUN)

    def keep_views(self, name: str, views: Views) -> Record:
        """Write the views that were chosen."""
        return self.write(name, {}, views.to_dict())

    def occluders(self, block: int) -> PreparedSplats | None:
        """Return the coarse level `FINE` of all other blocks; None if there are none."""
        return surroundings(self, block, FINE)

    def surroundings(self, block: int) -> PreparedSplats | None:
        """Return the coarse level `ROUGH` of all other blocks; None if there are none."""
        return surroundings(self, block, ROUGH)

    def closer_views(self, own: Block) -> Sequence[Camera]:
        """Return additional views of a block that is small in every view of the scene."""
        return closer_views(self, own.splats)

    def draw(self, drawn: PreparedSplats, camera: Camera) -> SplatLight:
        """Compute the light in a view; images to compare results with are rendered later."""
        return light_in_view(drawn, camera)

    def keep_look(self, name: str, look: Look) -> Record:
        """Write a block's visibility, how much of it each view shows, and what the views miss."""
        return write_look(self, name, look)

    def grow(self, name: str, block: int) -> Record:
        """Grow the merge forest of a block, and write it."""
        parameters, balances = self.settings.parameters, self.balances
        if self.settings.search is not None:  # it begins with plain cuts, which have one balance
            balances = tuple(dict.fromkeys((*balances, parameters.balance)))
        own = self.open(block)
        units, weighing = self.units, self.weighing(own.visible)
        return grow(
            self.scratch, name,
            lambda: leaves_of(own.splats, own.rows, units, weighing, growing=True),
            parameters, balances,
        )  # fmt: skip

    def reassign(self, name: str, block: int, level: int) -> Record:
        """Reassign the splats of a block and its halo, and write the outcome for the block."""
        cuts, settings = self.of_blocks("cut", level), self.settings
        own = self.partition.count(block)
        halo = find_halo(self.scratch, cuts, block, own)
        count = own + sum(len(each.rows) for each in halo)
        columns = with_codes(settings.layout, count)
        self.read(block, columns)
        at = own
        for each in halo:
            at = self.read(each.block, columns, at, each.rows)
        if self.looks:
            columns[VISIBLE] = self.visible_with(block, halo)
        with self.table("cut", block, level) as table:
            labels = table.read(LABELS)
        splats = splats_of(columns, settings.layout)
        weighing = self.weighing(columns.get(VISIBLE))
        leaves = leaves_of(splats, stable_order(columns[CODES]), self.units, weighing)
        area = block_with_halo(leaves, labels, own, self.group_count(block, level), halo)
        found = reassigned(area, settings.parameters.rounds, self.units.dilation())
        # If the method is guided, growth does not depend on covers.
        cover = None if self.guided else reassigned_cover(area, found.labels, self.units.dilation())
        return write_reassigned(self.scratch, name, found, area, columns, cover)

    @property
    def deciding(self) -> Sequence[Camera]:
        """The cameras by which results are chosen."""
        return self.views.deciding

    def deciding_targets(
        self, own: Block, others: PreparedSplats | None
    ) -> Sequence[Target | None]:
        """Render the part of each deciding view that shows a block, or None if none does."""
        drawn, parts = self._crops(own, others, self.deciding)
        return [make_target(drawn, part, depth=False) if part else None for part in parts]

    def _crops(
        self, own: Block, others: PreparedSplats | None, cameras: Sequence[Camera]
    ) -> tuple[PreparedSplats, list[Camera | None]]:
        """Return a block with its surroundings, and the part of each view that shows the block."""
        assert own.visible is not None  # noqa: S101 - this job renders
        drawn = prepare(own.splats)
        parts = parts_of(drawn, own.visible >= SHOWN, cameras)
        return concatenated(drawn, others).with_buffers(), parts

    def fit_views(self, block: int, level: int) -> FitViews | None:
        """Return the views to fit a block to; None if too few show it."""
        return fit_views(self, block, level)

    @property
    def passes(self) -> tuple[PassReport, ...]:
        """Reports of the merge passes, summed over the blocks."""
        return passes_of(self.of_blocks("grow"))

    @property
    def shown(self) -> float:
        """Share of the prominence of all splats, in [0, 1], that the views show."""
        return shown_share(self)

    def fit_report(self, level: int) -> RefitReport | None:
        """Return the report of a result's fit, in which each block is a group."""
        return fit_report(self, level)

    def notes_on_fits(self, level: int) -> Sequence[str]:
        """Return a sentence on blocks that could not be fitted; empty if all were."""
        return notes_on_fits(self, level)

    def part(self, block: int, level: int) -> Splats:
        """Read the splats of a block in a result, before the fit."""
        record = self.of_block("store", block, level)
        return read_part(self.scratch, self.settings.result_layout, record)

    def keep_part(self, name: str, small: Splats) -> Record:
        """Write the splats of a block in a result, before the fit, in Morton order."""
        order = stable_order(self.units.codes(small))
        return write_table(self.scratch, name, sorted_columns(small, order), {})

    def keep_fit(
        self, name: str, fitted: Splats, curvatures: Curvatures | None, report: RefitReport | None
    ) -> Record:
        """Write the splats of a block in a result after the fit, and what of it is reported."""
        facts = {FITTED: facts_of_fit(report) if report else None}
        columns = columns_of(fitted)
        if curvatures is not None and self.settings.keeps_curvatures:
            columns |= columns_of_curvatures(curvatures)
        return self.write(name, columns, facts)

    def _near_cover(self, block: int, level: int) -> list[Cover]:
        """Read the groups of other blocks that may cover those of a block, block by block."""
        near = near_groups(self.scratch, self.of_blocks("cut", level), block)
        found = []
        for each in near:
            with self.table("reassign", each.block, level) as table:
                found.append(read_cover(table, each.groups))
        return found

    def _handed_to(self, block: int, level: int) -> list[tuple[Record, int, int]]:
        """Return the rows that other blocks hand over to a block, as (record, start, stop)."""
        records = self.of_blocks("reassign", level)
        places = [(record, record.facts["handed"].get(str(block))) for record in records]
        return [(record, *place) for record, place in places if place]

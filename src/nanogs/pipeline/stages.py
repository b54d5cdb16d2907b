"""The stages of a job, in their order: each reads what those before it wrote.

A task of a stage writes one table, whose bytes depend on nothing but the job's settings, so that it
can be done anywhere, at any time, and again.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

from nanogs.pipeline.blocks import leaves_of, morton_rows, with_codes
from nanogs.pipeline.budget import budget
from nanogs.pipeline.chunked import write_cells, write_chunks
from nanogs.pipeline.coarse import outline_counts, write_coarse
from nanogs.pipeline.cuts import LABELS, write_cut
from nanogs.pipeline.fitting import fit_part
from nanogs.pipeline.forests import grow
from nanogs.pipeline.frame import survey
from nanogs.pipeline.halo import find_halo
from nanogs.pipeline.look import VISIBLE, look_at_block
from nanogs.pipeline.memory_blocks import COARSE_SHARES
from nanogs.pipeline.partition import partition
from nanogs.pipeline.parts import write_rest
from nanogs.pipeline.settings import SOG, Settings
from nanogs.pipeline.settle import settled, view_of, write_settled
from nanogs.pipeline.spill import spill
from nanogs.pipeline.target import target_count
from nanogs.pipeline.trials import choose, pick_balance, try_balances, try_growths
from nanogs.pipeline.unpack import unpack
from nanogs.pipeline.views import choose_views
from nanogs.pipeline.work import Task, Work
from nanogs.progress import Stage
from nanogs.store.columns import CODES, empty_columns, sorted_columns, splats_of
from nanogs.store.tables import Record, write_table
from nanogs.threads import use_threads

FEWEST = 64  # splats of a block's part, on average
Per = Literal["job", "file", "segment", "block"]


@dataclass(frozen=True, slots=True)
class JobStage:
    """A stage of a job.

    Attributes:
        name: For progress, clock and tables.
        per: What it is done for: once, or for each packed file, segment or block.
        do: Does one task of it.
        seconds: For a million splats, of one machine.
        wanted: Whether a job has it.
        levels: How many it has; None for one of each result.
        needed: Whether there is anything to do, those before it being done.
    """

    name: str
    per: Per
    do: Callable[[Work, Task], Record]
    seconds: float
    wanted: Callable[[Settings], bool] = lambda _: True
    levels: int | None = 1
    needed: Callable[[Work], bool] = lambda _: True

    def count(self, work: Work) -> int:
        """How many tasks it has, those before it being done."""
        if not self.needed(work):
            return 0
        if self.per == "job":
            return 1
        if self.per == "file":
            return len(work.settings.unpacked)
        if self.per == "segment":
            return len(work.settings.segments)
        return work.partition.blocks


def do(work: Work, task: Task) -> Record:
    """Do a task.

    Raises:
        NanogsError: The input cannot be read, or the scratch not be written.
    """
    with use_threads(work.threads):
        record = STAGES[task.stage].do(work, task)
    work.known[task.name] = record
    return record


def stages_of(settings: Settings) -> Iterator[tuple[JobStage, int]]:
    """The stages of a job in their order, and the level of each."""
    wanted = [stage for stage in STAGES.values() if stage.wanted(settings)]
    per_level = [stage for stage in wanted if stage.levels is None]
    before = wanted[: wanted.index(per_level[0])]
    yield from ((stage, level) for stage in before for level in range(stage.levels or 0))
    for level in range(settings.levels):
        yield from ((stage, level) for stage in per_level if stage not in _CHUNKED)
    for stage in wanted:
        if stage in _CHUNKED:
            levels = settings.levels if stage.levels is None else stage.levels
            yield from ((stage, level) for level in range(levels))


def job_stages(settings: Settings) -> list[Stage]:
    """The stages of a job, and how long each takes beside the others."""
    ratios = settings.ratios or tuple(count / settings.splats for count in settings.counts)
    packing = PACKING if settings.chunks is not None and settings.chunks.layout == SOG else 1.0
    stages = [
        Stage(stage.name, packing * ratios[level] if stage.name == "chunk" else stage.seconds)
        for stage, level in stages_of(settings)
    ]
    return [*stages, Stage("write", 0.1)]


PACKING = 25.0  # seconds for a million splats of streamed SOG


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


def _rough(work: Work, task: Task) -> Record:
    splats, rows = work.block(task.number)
    frame, parameters = work.frame, work.settings.parameters
    return grow(
        work.scratch, task.name, lambda: leaves_of(splats, rows, frame, bare=True), parameters,
        [parameters.balance], work.threads,
    )  # fmt: skip


def _outline(work: Work, task: Task) -> Record:
    wanted, groups = outline_counts(work.settings, work.partition.blocks), []
    if work.partition.blocks > 1:
        rough = work.of_blocks("rough")
        groups = [budget(work.scratch, rough, count) for count in wanted]
    return write_table(work.scratch, task.name, {}, {"groups": groups})


def _coarse(work: Work, task: Task) -> Record:
    return write_coarse(work, task.name, task.number, task.level)


def _views(work: Work, task: Task) -> Record:
    return write_table(work.scratch, task.name, {}, choose_views(work).to_dict())


def _look(work: Work, task: Task) -> Record:
    return look_at_block(work, task.name, task.number)


def _forest(work: Work, task: Task) -> Record:
    splats, rows = work.block(task.number)
    frame, settings = work.frame, work.settings
    seen = work.seen(work.visible(task.number))
    return grow(
        work.scratch, task.name, lambda: leaves_of(splats, rows, frame, seen, bare=True),
        settings.parameters, work.balances, work.threads,
    )  # fmt: skip


def _budget(work: Work, task: Task) -> Record:
    counts = work.settings.counts
    if counts:
        target = target_count(work.partition.splats, None, counts[task.level])
    else:
        target = target_count(work.partition.splats, work.settings.ratios[task.level], None)
    # Blocks cannot be cut to less than a splat each, nor well to a few: the rest is done in memory.
    cut_to = max(target, min(FEWEST * work.partition.blocks, work.partition.splats))
    forests = work.of_blocks("forest")
    groups = [budget(work.scratch, forests, cut_to, number) for number in range(len(work.balances))]
    return write_table(work.scratch, task.name, {}, {"target": target, "groups": groups})


def _trial(work: Work, task: Task) -> Record:
    return try_balances(work, task.name, task.number, task.level)


def _pick(work: Work, task: Task) -> Record:
    return pick_balance(work, task.name, task.level)


def _cut(work: Work, task: Task) -> Record:
    # Colours have no part in it.
    splats, rows = work.block(task.number, work.settings.layout.bare())
    leaves = leaves_of(splats, rows, work.frame, work.seen(work.visible(task.number)))
    labels, groups = work.labels(task.number, task.level), work.groups(task.number, task.level)
    return write_cut(work.scratch, task.name, leaves, labels, groups, work.threads)


def _settle(work: Work, task: Task) -> Record:
    cuts, settings = work.of_blocks("cut", task.level), work.settings
    own = work.partition.count(task.number)
    halo = find_halo(work.scratch, cuts, task.number, own, work.threads)
    count = own + sum(len(each.rows) for each in halo)
    columns = with_codes(empty_columns(settings.layout, count), count)
    work.read(task.number, columns)
    at = own
    for each in halo:
        at = work.read(each.block, columns, at, each.rows)
    if work.looks:
        columns[VISIBLE] = work.visible_with(task.number, halo)
    with work.table("cut", task.number, task.level) as table:
        labels = table.read(LABELS)
    splats = splats_of(columns, settings.layout)
    seen = work.seen(columns.get(VISIBLE))
    leaves = leaves_of(splats, morton_rows(columns[CODES]), work.frame, seen)
    view = view_of(leaves, labels, own, work.groups(task.number, task.level), halo)
    after = settled(view, settings.parameters.rounds, work.threads)
    return write_settled(work.scratch, task.name, after, view, columns)


def _judge(work: Work, task: Task) -> Record:
    return try_growths(work, task.name, task.number, task.level)


def _choose(work: Work, task: Task) -> Record:
    return choose(work, task.name, task.level)


def _part(work: Work, task: Task) -> Record:
    chosen = work.chosen(task.level)
    found = work.members(task.number, task.level, reassigned=chosen.reassigned)
    small = work.stored(found).grown(chosen.growth)
    frame = work.frame
    order = morton_rows(frame.codes(small))
    return write_table(work.scratch, task.name, sorted_columns(small, order), {})


def _fit(work: Work, task: Task) -> Record:
    return fit_part(work, task.name, task.number, task.level)


def _rest(work: Work, task: Task) -> Record:
    target = int(work.of_job("budget", task.level).facts["target"])
    return write_rest(work, task.name, task.level, target)


def _cells(work: Work, task: Task) -> Record:
    return write_cells(work, task.name, task.number)


def _chunk(work: Work, task: Task) -> Record:
    return write_chunks(work, task.name, task.number, task.level)


def _looks(settings: Settings) -> bool:
    return settings.looks


def _measures(settings: Settings) -> bool:
    return settings.measures


def _settles(settings: Settings) -> bool:
    return settings.parameters.rounds > 0


def _fits(settings: Settings) -> bool:
    return settings.fits


def _in_chunks(settings: Settings) -> bool:
    return settings.chunks is not None


def _divided(work: Work) -> bool:
    return work.partition.blocks > 1


def _shown(work: Work) -> bool:
    return work.measures


STAGES = {
    stage.name: stage
    for stage in (
        JobStage("unpack", "file", _unpack, 1.0, lambda settings: bool(settings.unpacked)),
        JobStage("frame", "job", _frame, 1.0),
        JobStage("segment", "segment", _segment, 0.5),
        JobStage("partition", "job", _partition, 0.05),
        JobStage("rough", "block", _rough, 5.0, _looks, needed=_divided),
        JobStage("outline", "job", _outline, 0.02, _looks),
        JobStage("coarse", "block", _coarse, 0.5, _looks, len(COARSE_SHARES), _divided),
        JobStage("views", "job", _views, 0.5, _looks),
        JobStage("look", "block", _look, 3.0, _looks),
        JobStage("forest", "block", _forest, 5.0),
        JobStage("budget", "job", _budget, 0.02, levels=None),
        JobStage("trial", "block", _trial, 2.0, _measures, None, _shown),
        JobStage("pick", "job", _pick, 0.01, _measures, None, _shown),
        JobStage("cut", "block", _cut, 0.4, _settles, levels=None),
        JobStage("settle", "block", _settle, 2.0, _settles, levels=None),
        JobStage("judge", "block", _judge, 2.0, _measures, None, _shown),
        JobStage("choose", "job", _choose, 0.01, _measures, None, _shown),
        JobStage("part", "block", _part, 0.5, levels=None),
        JobStage("fit", "block", _fit, 5.0, _fits, levels=None),
        JobStage("rest", "job", _rest, 0.2, _in_chunks, levels=None),
        JobStage("cells", "block", _cells, 0.5, _in_chunks),
        JobStage("chunk", "block", _chunk, 1.0, _in_chunks, levels=None),
    )
}
_CHUNKED = tuple(STAGES[name] for name in ("rest", "cells", "chunk"))

"""The stages of a simplification, in order: each uses the results of those before it.

A task of a stage in blocks writes one table, whose bytes depend only on the job's settings, so that
it can be done anywhere, at any time, and again.
"""

from collections.abc import Callable, Iterator
from dataclasses import KW_ONLY, dataclass
from functools import partial
from itertools import chain
from typing import Any, Literal

import numpy as np

from nanogs.block_layouts import Chunked, Linked
from nanogs.method.choose import GROWTHS
from nanogs.method.correct import unseen_changes
from nanogs.method.parameters import MOST_CORRECTIONS
from nanogs.pipeline.estimates.stage_weights import (
    Load,
    chunking_seconds,
    correcting_seconds,
    fitting_seconds,
    judging_seconds,
    looking_seconds,
    reassigning_seconds,
    trying_seconds,
)
from nanogs.pipeline.options.presets import renders
from nanogs.pipeline.options.settings import COARSE_SHARES, Settings, most_coarse
from nanogs.pipeline.options.target import target_count
from nanogs.pipeline.scene import SUMS, Scene, Task
from nanogs.pipeline.tasks.blocks import leaves_of
from nanogs.pipeline.tasks.budget import budget
from nanogs.pipeline.tasks.chunked import write_cells, write_chunks
from nanogs.pipeline.tasks.coarse import write_coarse
from nanogs.pipeline.tasks.corrections import correct
from nanogs.pipeline.tasks.cuts import write_cut
from nanogs.pipeline.tasks.fitting import fit_part
from nanogs.pipeline.tasks.forests import grow, number_of
from nanogs.pipeline.tasks.linked import linked_levels, write_tree
from nanogs.pipeline.tasks.look import look_at_block
from nanogs.pipeline.tasks.partition import partition
from nanogs.pipeline.tasks.parts import write_rest
from nanogs.pipeline.tasks.sorted_segments import write_segment
from nanogs.pipeline.tasks.trials import (
    choose,
    correction_is_promising,
    growth_is_promising,
    has_corrected,
    nth,
    pick_cut,
    try_balances,
    try_corrected,
    try_growth,
    try_reassigned,
)
from nanogs.pipeline.tasks.unpack import unpack
from nanogs.pipeline.tasks.views import choose_views
from nanogs.pipeline.work import Work
from nanogs.store.tables import Record
from nanogs.threads import use_threads

FEWEST = 64  # fewest splats of a block's part, on average
Per = Literal["job", "file", "segment", "block"]
Seconds = float | Callable[[Load], float]


def _always(*_: object) -> bool:
    return True


@dataclass(frozen=True, slots=True)
class JobStage:
    """A stage of a simplification, in blocks or of a model in memory.

    Attributes:
        name: In progress, clock and tables.
        per: Whether there is one task in all, or one for each packed file, segment or block.
        do: Does one task.
        seconds: Seconds on one machine: for a million splats of the scene, or computed from the
            load.
        wanted: Whether a job with these settings has the stage; for estimates, takes its load.
        levels: Number of levels that it is done for; None for each result.
        needed: Whether there is anything to do for a level, once the stages before it are done.
        held: Whether a model in memory has the stage, too.
        last: Whether it comes after all results are made.
        here: Whether the calling process does it, while workers of this machine start.
    """

    name: str
    per: Per
    do: Callable[[Any, Task], Record]
    seconds: Seconds
    _: KW_ONLY
    wanted: Callable[[Any], bool] = _always
    levels: int | None = 1
    needed: Callable[[Any, int], bool] = _always
    held: bool = False
    last: bool = False
    here: bool = False

    def count(self, scene: Scene, level: int) -> int:
        """Return the number of tasks for a level; the stages before it must be done."""
        if not self.needed(scene, level):
            return 0
        if self.per == "job":
            return 1
        if self.per == "file":
            return len(scene.settings.unpacked)
        if self.per == "segment":
            return len(scene.settings.segments)
        return scene.partition.blocks

    def weight(self, load: Load) -> float:
        """Estimate the seconds it takes on one machine."""
        return self.seconds(load) if callable(self.seconds) else self.seconds * load.splats


def do(scene: Scene, task: Task) -> Record:
    """Do a task.

    Raises:
        NanogsError: The input cannot be read, or the scratch cannot be written.
    """
    with use_threads(scene.threads):
        return STAGES[task.stage].do(scene, task)


def stages_of(settings: Settings) -> Iterator[tuple[JobStage, int]]:
    """Yield the stages of a job in blocks in order, each with its level."""
    wanted = [stage for stage in STAGES.values() if stage.wanted(settings)]
    for stage in wanted:
        if stage.levels is not None and not stage.last:
            yield from ((stage, level) for level in range(stage.levels))
    for level in range(settings.levels):
        yield from level_stages(settings, level)
    for stage in wanted:
        if stage.last:
            levels = settings.levels if stage.levels is None else stage.levels
            yield from ((stage, level) for level in range(levels))


def level_stages(settings: Settings, level: int) -> Iterator[tuple[JobStage, int]]:
    """Yield the stages of one result of a job in blocks; those after all results are left out."""
    for stage in STAGES.values():
        if stage.levels is None and not stage.last and stage.wanted(settings):
            yield stage, level


def held_stages(job: Settings | Load, *, results: bool) -> list[JobStage]:
    """Return the stages of a model in memory: those of each result, or those done once before."""
    stages = (stage for stage in STAGES.values() if stage.held and stage.wanted(job))
    return [stage for stage in stages if (stage.levels is None) == results]


def _unpack(work: Work, task: Task) -> Record:
    settings = work.settings
    return unpack(work.scratch, task.name, settings.inputs[settings.unpacked[task.number]])


def _units(scene: Scene, task: Task) -> Record:
    return scene.find_units(task.name)


def _partition(work: Work, task: Task) -> Record:
    settings = work.settings
    found = partition(work.scratch, settings, work.segments())
    for count in () if settings.at_most else settings.counts:
        target_count(found.splats, None, count)  # refuses a count above the usable splats
    return work.write(task.name, {}, found.to_dict())


def _rough(work: Work, task: Task) -> Record:
    splats, rows = work.block(task.number)
    units, parameters = work.units, work.settings.parameters
    return grow(
        work.scratch, task.name, lambda: leaves_of(splats, rows, units, growing=True), parameters,
        [parameters.balance],
    )  # fmt: skip


def _outline(work: Work, task: Task) -> Record:
    settings, blocks, groups = work.settings, work.partition.blocks, []
    if blocks > 1:
        rough = work.of_blocks("rough")
        for level in range(len(COARSE_SHARES)):
            count = max(most_coarse(level, settings.block, settings.splats), blocks)
            groups.append(budget(work.scratch, rough, count))
    return work.write(task.name, {}, {"groups": groups})


def _views(scene: Scene, task: Task) -> Record:
    return scene.keep_views(task.name, choose_views(scene))


def _grow(scene: Scene, task: Task) -> Record:
    return scene.grow(task.name, task.number)


def _budget(work: Work, task: Task) -> Record:
    counts, usable = work.settings.counts, work.partition.splats
    if counts:
        target = min(counts[task.level], usable)
    else:
        target = target_count(usable, work.settings.ratios[task.level], None)
    # Blocks cannot be cut to less than a splat each, nor well to a few: the rest is done in memory.
    cut_to = max(target, min(FEWEST * work.partition.blocks, usable))
    forests = work.of_blocks("grow")
    numbers = [number_of(forests[0], balance) for balance in work.balances]
    groups = [budget(work.scratch, forests, cut_to, number) for number in numbers]
    facts = {"target": target, "cut_to": cut_to, "groups": groups}
    return work.write(task.name, {}, facts)


def _budget_corrected(step: int, work: Work, task: Task) -> Record:
    scored = [work.of_blocks(nth("correct", past), task.level) for past in range(step + 1)]
    sums = [np.array([record.facts[SUMS] for record in records]) for records in scored]
    shifts, cut_to = unseen_changes(sums), work.cut_to(task.level)
    groups = budget(work.scratch, scored[step], cut_to, shifts=shifts)
    return work.write(task.name, {}, {"groups": [groups]})


def _cut(work: Work, task: Task) -> Record:
    # The centres and reaches of groups need no colours.
    splats, rows = work.block(task.number, work.settings.layout.bare())
    leaves = leaves_of(splats, rows, work.units, work.weighing(work.visible(task.number)))
    block, level = task.number, task.level
    labels, groups = work.picked_labels(block, level), work.group_count(block, level)
    return write_cut(work.scratch, task.name, leaves, labels, groups)


def _reassign(scene: Scene, task: Task) -> Record:
    return scene.reassign(task.name, task.number, task.level)


def _store(scene: Scene, task: Task) -> Record:
    if scene.merges(task.level):
        chosen = scene.chosen(task.level)
        found = scene.members(task.number, task.level, reassigned=chosen.reassigned)
        small = scene.stored(found).grown(chosen.growth)
        del found
    else:
        own = scene.open(task.number)
        small = own.splats.take(np.sort(own.rows).astype(np.int64))
    if (degree := scene.settings.sh_degree) is not None:
        small = small.with_sh_degree(degree)
    return scene.keep_part(task.name, small)


# Whether a job has a stage: `JobStage.wanted`.


def _looks(job: Settings | Load) -> bool:
    return renders(job.parameters)


def _guided(job: Settings | Load) -> bool:
    return job.parameters.guided


def _reassigns(job: Settings | Load) -> bool:
    return job.parameters.rounds > 0


def _judges(job: Settings | Load) -> bool:
    return _guided(job) and _reassigns(job)


def _fits(job: Settings | Load) -> bool:
    return job.parameters.steps > 0


def _corrects(step: int, job: Settings | Load) -> bool:
    return _guided(job) and step < job.parameters.corrections


def _in_chunks(settings: Settings) -> bool:
    return isinstance(settings.block_layout, Chunked)


def _in_a_tree(settings: Settings) -> bool:
    return isinstance(settings.block_layout, Linked)


def _unpacks(settings: Settings) -> bool:
    return bool(settings.unpacked)


# Whether there is anything to do for a level: `JobStage.needed`.


def _divided(scene: Scene, _level: int) -> bool:
    return scene.partition.blocks > 1


def _links(work: Work, _level: int) -> bool:
    return linked_levels(work) > 0


def _merges(scene: Scene, level: int) -> bool:
    return scene.merges(level)


def _shows(scene: Scene, _level: int) -> bool:
    return scene.looks


def _may_grow(step: int, scene: Scene, level: int) -> bool:
    return scene.tries(level) and growth_is_promising(scene, level, step)


def _may_correct(step: int, scene: Scene, level: int) -> bool:
    return scene.tries(level) and correction_is_promising(scene, level, step)


def _has_corrected(step: int, scene: Scene, level: int) -> bool:
    return _may_correct(step, scene, level) and has_corrected(scene, level, step)


_for_each_result = partial(JobStage, levels=None)


def _correction_stages(step: int) -> tuple[JobStage, ...]:
    """Return the stages that correct errors once more, and measure the cut that follows."""
    wanted, corrected = partial(_corrects, step), partial(_has_corrected, step)
    return (
        _for_each_result(
            nth("correct", step), "block", partial(correct, step), correcting_seconds,
            wanted=wanted, needed=partial(_may_correct, step), held=True,
        ),
        _for_each_result(
            nth("budget", step), "job", partial(_budget_corrected, step), 0.02,
            wanted=wanted, needed=corrected,
        ),
        _for_each_result(
            nth("trial", step), "block", partial(try_corrected, step), judging_seconds,
            wanted=wanted, needed=corrected, held=True,
        ),
    )  # fmt: skip


def _growth_stage(step: int) -> JobStage:
    """Return the stage that tries a growth; those after the first are seldom needed."""
    return _for_each_result(
        nth("growth", step), "block", partial(try_growth, step),
        judging_seconds if step == 0 else lambda load: 0.1 * judging_seconds(load),
        wanted=_guided, needed=partial(_may_grow, step), held=True,
    )  # fmt: skip


STAGES = {
    stage.name: stage
    for stage in (
        JobStage("unpack", "file", _unpack, 1.0, wanted=_unpacks),
        JobStage("units", "job", _units, 0.3, held=True, here=True),
        JobStage("segment", "segment", write_segment, 0.5),
        JobStage("partition", "job", _partition, 0.05),
        JobStage("rough", "block", _rough, 3.0, wanted=_looks, needed=_divided),
        JobStage("outline", "job", _outline, 0.02, wanted=_looks),
        JobStage(
            "coarse", "block", write_coarse, 0.5,
            wanted=_looks, levels=len(COARSE_SHARES), needed=_divided,
        ),
        JobStage("views", "job", _views, 0.2, wanted=_looks, held=True),
        JobStage(
            "look", "block", look_at_block, looking_seconds,
            wanted=_looks, needed=_shows, held=True,
        ),
        JobStage("grow", "block", _grow, 3.3, held=True),
        _for_each_result("budget", "job", _budget, 0.02),
        _for_each_result(
            "trial", "block", try_balances, trying_seconds,
            wanted=_guided, needed=Scene.tries, held=True,
        ),
        *chain.from_iterable(map(_correction_stages, range(MOST_CORRECTIONS))),
        _for_each_result(
            "pick", "job", pick_cut, 0.0, wanted=_guided, needed=Scene.tries, held=True
        ),
        _for_each_result("cut", "block", _cut, 0.2, wanted=_reassigns, needed=_merges),
        _for_each_result(
            "reassign", "block", _reassign, reassigning_seconds,
            wanted=_reassigns, needed=_merges, held=True,
        ),
        _for_each_result(
            "judge", "block", try_reassigned, judging_seconds,
            wanted=_judges, needed=Scene.tries, held=True,
        ),
        *map(_growth_stage, range(len(GROWTHS))),
        _for_each_result(
            "choose", "job", choose, 0.0, wanted=_guided, needed=Scene.tries, held=True
        ),
        _for_each_result("store", "block", _store, 0.2, held=True),
        _for_each_result(
            "fit", "block", fit_part, fitting_seconds,
            wanted=_fits, needed=Scene.fits, held=True,
        ),
        _for_each_result("rest", "job", write_rest, 0.2, wanted=_in_chunks, last=True),
        JobStage("cells", "block", write_cells, 0.5, wanted=_in_chunks, last=True),
        _for_each_result(
            "chunk", "block", write_chunks, chunking_seconds, wanted=_in_chunks, last=True
        ),
        JobStage("tree", "block", write_tree, 9.0, wanted=_in_a_tree, needed=_links, last=True),
    )
}  # fmt: skip

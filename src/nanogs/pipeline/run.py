"""Running the stages of a scene in order: of a model in memory, or as tasks of a job."""

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from nanogs.clock import StageClock
from nanogs.pipeline.one_block import OneBlock
from nanogs.pipeline.outcome import Outcome, outcome_of
from nanogs.pipeline.scene import Scene, Task
from nanogs.pipeline.stages import JobStage, do, held_stages, stages_of
from nanogs.pipeline.work import BEGUN, Work
from nanogs.progress import Tracker, ignore_progress
from nanogs.source import Source
from nanogs.store.tables import verified, write_table


class Runner(Protocol):
    """Does tasks that do not depend on each other."""

    def run(self, work: Work, tasks: Sequence[Task]) -> Iterator[Task]:
        """Do tasks, in any order, and yield each when it is done."""

    def finish(self) -> None:
        """Wait for tasks that had begun when another failed: they still write to the scratch."""


class InProcess:
    """Does tasks in this process, one at a time, each on all threads."""

    def run(self, work: Scene, tasks: Sequence[Task]) -> Iterator[Task]:
        """Do tasks in their order, and yield each when it is done."""
        for task in tasks:
            do(work, task)
            yield task

    def finish(self) -> None:
        """Wait for nothing: a task that failed was the only one; see `Runner`."""


@dataclass(frozen=True, slots=True, eq=False)
class Done:
    """A job whose tasks are done.

    Attributes:
        work: The job, with all records cached.
        kept: Number of tasks that an earlier run had done.
        levels: Levels of the results that are delivered.
        fields: Report fields that a search has found, by name.
        notes: Other notes, one sentence each.
        prepared: Returns what is written of the result of a search: itself, or with values that
            pack well.
    """

    work: Work
    kept: int
    levels: Sequence[int]
    fields: Mapping[str, Any] = field(default_factory=dict)
    notes: Sequence[str] = ()
    prepared: Callable[[Source], Source] = lambda source: source


@dataclass(slots=True, eq=False)
class Run:
    """Does the tasks of a job that are not done yet.

    Attributes:
        runner: Does the tasks.
        clock: Gets the seconds of each stage.
        resumed: Whether to look for tasks that an earlier run has done; their files are then
            checked.
        kept: Number of these tasks.
    """

    runner: Runner
    clock: StageClock
    resumed: bool
    kept: int = 0

    def do(self, work: Work, stages: Iterable[tuple[JobStage, int]], progress: Tracker) -> None:
        """Do the tasks of some stages, stage by stage.

        Args:
            work: The job.
            stages: Each with its level.
            progress: Notified of each stage.

        Raises:
            NanogsError: A task could not be done.
        """
        for stage, level in stages:
            tasks = tasks_of(work, stage, level)
            with self.clock.time(stage.name):
                left = [task for task in tasks if not (self.resumed and is_done(work, task))]
                self.kept += len(tasks) - len(left)
                progress.begin(stage.name)
                progress.part(len(tasks) - len(left), len(tasks))
                doing = InProcess() if stage.here else self.runner
                for done, task in enumerate(doing.run(work, left), len(tasks) - len(left) + 1):
                    work.record(task)  # cached: the report is made after the scratch is gone
                    progress.part(done, len(tasks))


FindResult = Callable[[Work, Run, Tracker], Done]
"""Makes results of a job, from stages that are run only once, until one meets the target."""


def run_tasks(work: Work, run: Run, progress: Tracker, search: FindResult | None = None) -> Done:
    """Do every task of a job that is not done yet.

    Args:
        work: The job, whose scratch is prepared.
        run: Does the tasks.
        progress: Notified of each stage.
        search: Finds the result, if its count is not known beforehand.

    Raises:
        NanogsError: A task could not be done.
    """
    write_table(work.scratch, BEGUN.name, {}, {})
    run.do(work, stages_of(work.settings), progress)
    if search is not None:
        return search(work, run, progress)
    return Done(work, run.kept, range(work.settings.levels))


def tasks_of(scene: Scene, stage: JobStage, level: int) -> list[Task]:
    """Return the tasks of a stage; the stages before it must be done."""
    return [Task(stage.name, number, level) for number in range(stage.count(scene, level))]


def is_done(work: Work, task: Task) -> bool:
    """Whether an earlier run has done a task; if so, its record is cached."""
    record = verified(work.scratch, task.name)
    if record is not None:
        work.known[task.name] = record
    return record is not None


def build(scene: OneBlock, clock: StageClock, progress: Tracker) -> None:
    """Do the stages that all counts share, once: render the model, and grow its forest.

    Args:
        scene: The model.
        clock: Gets the seconds of each stage.
        progress: Notified of each stage.
    """
    _do_here(scene, held_stages(scene.settings, results=False), clock, progress)


def deliver(scene: OneBlock, count: int, clock: StageClock, progress: Tracker) -> Outcome:
    """Make the model of a count, or of the fewest splats that the forest has.

    Args:
        scene: The model, after `build`; unchanged, also if `progress` raises.
        count: Splats to deliver.
        clock: Gets the seconds of each stage.
        progress: Notified of each stage.
    """
    own = scene.asking(count)
    _do_here(own, held_stages(scene.settings, results=True), clock, progress)
    return outcome_of(own)


def _do_here(
    scene: OneBlock, stages: Iterable[JobStage], clock: StageClock, progress: Tracker
) -> None:
    """Do stages of a model in memory, and add up their seconds.

    A stage that times its steps itself has the seconds in its record.
    """
    for stage in stages:
        for task in tasks_of(scene, stage, 0):
            progress.begin(stage.name)
            start = time.perf_counter()
            scene.on_progress = progress.part
            own = do(scene, task).facts.get("seconds")
            scene.on_progress = ignore_progress
            for seconds in own or [{stage.name: time.perf_counter() - start}]:
                clock.add(seconds)

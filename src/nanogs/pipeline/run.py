"""The stages of a scene in turn: of a model in memory, or as tasks of a job."""

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

from nanogs.clock import StageClock
from nanogs.pipeline.one_block import OneBlock
from nanogs.pipeline.outcome import Outcome, outcome_of
from nanogs.pipeline.scene import Scene, Task
from nanogs.pipeline.settings import Settings
from nanogs.pipeline.stages import JobStage, do, held_stages, stages_of
from nanogs.pipeline.work import BEGUN, Work
from nanogs.progress import Tracker, untold
from nanogs.store.scratch import Scratch
from nanogs.store.tables import verified, write_table

BRIEF = 28  # steps at most of the fit of results that are only held against each other


class Executor(Protocol):
    """Does tasks that need nothing of each other."""

    def run(self, work: Work, tasks: Sequence[Task]) -> Iterator[Task]:
        """Do tasks, in any order, and yield each when it is done."""


class Here:
    """One task after the other, in this process, each on all threads."""

    def run(self, work: Scene, tasks: Sequence[Task]) -> Iterator[Task]:
        """Do tasks in their order, and yield each when it is done."""
        for task in tasks:
            do(work, task)
            yield task


@dataclass(frozen=True, slots=True, eq=False)
class Done:
    """A job whose tasks are done.

    Attributes:
        work: The job, all records in it.
        kept: Tasks that a run before had done.
        levels: Of the results that are delivered.
        entries: Of the reports, by name: what a search has found.
        notes: What else it has to say, one sentence each.
    """

    work: Work
    kept: int
    levels: Sequence[int]
    entries: Mapping[str, Any] = field(default_factory=dict)
    notes: Sequence[str] = ()


@dataclass(slots=True, eq=False)
class Run:
    """Does the tasks of a job that are not done yet.

    Attributes:
        executor: Where they are done.
        clock: Gets the seconds of each stage.
        resumed: Whether to look for what a run before has done; its files are then checked.
        kept: Tasks that it had done.
    """

    executor: Executor
    clock: StageClock
    resumed: bool
    kept: int = 0

    def do(self, work: Work, stages: Iterable[tuple[JobStage, int]], progress: Tracker) -> None:
        """Do the tasks of some stages, one stage after the other.

        Args:
            work: The job.
            stages: Each with its level.
            progress: Told of each stage.

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
                # The units are found here, while workers of this machine start.
                doing = Here() if stage.name == "frame" else self.executor
                for done, task in enumerate(doing.run(work, left), len(tasks) - len(left) + 1):
                    work.record(task)  # kept: the report is made when the scratch is gone
                    progress.part(done, len(tasks))


Search = Callable[[Work, Run, Tracker], Done]
"""Makes results of a job, what is done once being done, until one meets what is sought."""


def run_tasks(
    scratch: Scratch,
    settings: Settings,
    executor: Executor,
    threads: int,
    clock: StageClock,
    progress: Tracker,
    *,
    resumed: bool,
    search: Search | None = None,
) -> Done:
    """Do every task of a job that is not done yet.

    Args:
        scratch: Its files; prepared.
        settings: What it is about.
        executor: Where tasks are done.
        threads: Threads of this process.
        clock: Gets the seconds of each stage.
        progress: Told of each stage.
        resumed: As `Run` has it.
        search: Finds the result, where its count is not known beforehand.

    Raises:
        NanogsError: A task could not be done.
    """
    write_table(scratch, BEGUN.name, {}, {})
    work, run = Work(scratch, settings, threads), Run(executor, clock, resumed)
    run.do(work, stages_of(settings), progress)
    if search is not None:
        return search(work, run, progress)
    return Done(work, run.kept, range(settings.levels))


def tasks_of(scene: Scene, stage: JobStage, level: int) -> list[Task]:
    """The tasks of a stage, those before it being done."""
    return [Task(stage.name, number, level) for number in range(stage.count(scene, level))]


def is_done(work: Work, task: Task) -> bool:
    """Whether a run before has done a task, of which the record is then known."""
    record = verified(work.scratch, task.name)
    if record is not None:
        work.known[task.name] = record
    return record is not None


def build(scene: OneBlock, clock: StageClock, progress: Tracker) -> None:
    """Do once what every count needs: look at the model, and grow its forest.

    Args:
        scene: The model.
        clock: Gets the seconds of each stage.
        progress: Told of each stage.
    """
    _do_here(scene, held_stages(scene.settings, results=False), 0, clock, progress)


def deliver(scene: OneBlock, count: int, clock: StageClock, progress: Tracker) -> Outcome:
    """Make the model of a count, or of the fewest splats that the forest has.

    Args:
        scene: The model, which `build` has seen.
        count: Splats to deliver.
        clock: Gets the seconds of each stage.
        progress: Told of each stage.
    """
    level = len(scene.targets)
    scene.targets.append(count)
    _do_here(scene, held_stages(scene.settings, results=True), level, clock, progress)
    return outcome_of(scene, level)


def plain(settings: Settings, rounds: int | None = None) -> Settings:
    """Settings by which results are cut without looking.

    Args:
        settings: Others.
        rounds: Of reassignment; by default as before.
    """
    given = settings.parameters
    parameters = replace(
        given, measure=False, steps=0, rounds=given.rounds if rounds is None else rounds
    )
    return replace(settings, parameters=parameters)


def brief(settings: Settings) -> Settings:
    """Settings by which results are fitted in a third of the steps or fewer, to be compared.

    Args:
        settings: Others.
    """
    given = settings.parameters
    return replace(settings, parameters=replace(given, steps=min(-(-given.steps // 3), BRIEF)))


def _do_here(
    scene: OneBlock,
    stages: Iterable[JobStage],
    level: int,
    clock: StageClock,
    progress: Tracker,
) -> None:
    """Do stages of a model in memory; those that time their steps themselves say so."""
    for stage in stages:
        for task in tasks_of(scene, stage, level):
            progress.begin(stage.name)
            start = time.perf_counter()
            scene.tell = progress.part
            own = do(scene, task).facts.get("seconds")
            scene.tell = untold
            for seconds in own or [{stage.name: time.perf_counter() - start}]:
                clock.add(seconds)

"""A job from its first task to its last, wherever the tasks are done."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

from nanogs.clock import StageClock
from nanogs.pipeline.settings import Settings
from nanogs.pipeline.stages import do, stages_of
from nanogs.pipeline.work import MARK, Task, Work
from nanogs.progress import Tracker
from nanogs.store.scratch import Scratch
from nanogs.store.tables import verified, write_table


class Executor(Protocol):
    """Does tasks that need nothing of each other."""

    def run(self, work: Work, tasks: Sequence[Task]) -> Iterator[Task]:
        """Do tasks, in any order, and yield each when it is done."""


class Here:
    """One task after the other, in this process, each on all threads."""

    def run(self, work: Work, tasks: Sequence[Task]) -> Iterator[Task]:
        """Do tasks in their order, and yield each when it is done."""
        for task in tasks:
            do(work, task)
            yield task


@dataclass(frozen=True, slots=True)
class Done:
    """A job whose tasks are done.

    Attributes:
        work: The job, all records in it.
        kept: Tasks that a run before had done.
    """

    work: Work
    kept: int


def run_tasks(
    scratch: Scratch,
    settings: Settings,
    executor: Executor,
    threads: int,
    clock: StageClock,
    progress: Tracker,
    *,
    resumed: bool,
) -> Done:
    """Do every task of a job that is not done yet.

    Args:
        scratch: Its files; prepared.
        settings: What it is about.
        executor: Where tasks are done.
        threads: Threads of this process.
        clock: Gets the seconds of each stage.
        progress: Told of each stage.
        resumed: Whether to look for what a run before has done; its files are then checked.

    Raises:
        NanogsError: A task could not be done.
    """
    work, kept = Work(scratch, settings, threads), 0
    write_table(scratch, MARK.name, {}, {})
    for each, level in stages_of(settings):
        stage = each.name
        tasks = [Task(stage, number, level) for number in range(each.count(work))]
        with clock.time(stage):
            left = [task for task in tasks if not (resumed and _is_done(work, task))]
            kept += len(tasks) - len(left)
            progress.begin(stage)
            progress.part(len(tasks) - len(left), len(tasks))
            # The frame is made here, while workers of this machine start.
            doing = Here() if stage == "frame" else executor
            for done, task in enumerate(doing.run(work, left), len(tasks) - len(left) + 1):
                work.record(task)  # kept: the report is made when the scratch is gone
                progress.part(done, len(tasks))
    return Done(work, kept)


def _is_done(work: Work, task: Task) -> bool:
    record = verified(work.scratch, task.name)
    if record is not None:
        work.known[task.name] = record
    return record is not None

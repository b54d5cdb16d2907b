"""A job from its first task to its last, wherever the tasks are done."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

from nanogs.clock import StageClock
from nanogs.progress import Stage, Tracker
from nanogs.scale.scratch import Scratch
from nanogs.scale.settings import SOG, Settings
from nanogs.scale.tables import verified, write_table
from nanogs.scale.work import MARK, UNPACK, Task, Work, do

# Seconds for a million splats, of one machine; chunks take them for each of their own.
_WEIGHTS = {
    UNPACK: 1.0, "frame": 1.0, "segment": 0.5, "partition": 0.05, "forest": 5.0, "budget": 0.02,
    "cut": 0.4, "settle": 2.0, "part": 0.5, "rest": 0.2, "cells": 0.5,
}  # fmt: skip
_PACKING = 25.0  # seconds for a million splats of streamed SOG


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
    for stage, level in _stages(settings):
        tasks = [Task(stage, number, level) for number in range(_count(work, stage))]
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


def job_stages(settings: Settings) -> list[Stage]:
    """The stages of a job, and how long each takes beside the others."""
    weights = _WEIGHTS | {"chunk": _PACKING if _is_sog(settings) else 1.0}
    ratios = settings.ratios or tuple(count / settings.splats for count in settings.counts)
    stages = [
        Stage(stage, weights[stage] * (ratios[level] if stage == "chunk" else 1.0))
        for stage, level in _stages(settings)
    ]
    return [*stages, Stage("write", 0.1)]


def _is_sog(settings: Settings) -> bool:
    return settings.chunks is not None and settings.chunks.layout == SOG


def _stages(settings: Settings) -> Iterator[tuple[str, int]]:
    if settings.unpacked:
        yield UNPACK, 0
    for stage in ("frame", "segment", "partition", "forest"):
        yield stage, 0
    for level in range(settings.levels):
        yield "budget", level
        if settings.parameters.rounds:
            yield "cut", level
            yield "settle", level
        yield "part", level
    if settings.chunks:
        yield from (("rest", level) for level in range(settings.levels))
        yield "cells", 0
        yield from (("chunk", level) for level in range(settings.levels))


def _count(work: Work, stage: str) -> int:
    if stage in ("frame", "partition", "budget", "rest"):
        return 1
    if stage == UNPACK:
        return len(work.settings.unpacked)
    return len(work.settings.segments) if stage == "segment" else work.partition.blocks


def _is_done(work: Work, task: Task) -> bool:
    record = verified(work.scratch, task.name)
    if record is not None:
        work.known[task.name] = record
    return record is not None

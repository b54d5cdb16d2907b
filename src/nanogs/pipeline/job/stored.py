"""A job on disk: begun or resumed under its lock, brought to an end, and removed."""

import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from nanogs.clock import StageClock
from nanogs.defaults import PATIENCE
from nanogs.errors import (
    CrowdedError,
    ManyChildrenError,
    ModelError,
    NanogsError,
    OutputError,
    SmallViewError,
    TooManyError,
    TooSmallError,
    UnstorableError,
)
from nanogs.io.urls import is_url
from nanogs.pipeline.estimates.durations import job_stages
from nanogs.pipeline.estimates.stage_weights import measure_stage
from nanogs.pipeline.job.folder import (
    MANIFEST,
    SCRATCH,
    forget,
    locked,
    read_manifest,
    write_manifest,
)
from nanogs.pipeline.job.result_writer import ResultWriter
from nanogs.pipeline.job.workers import workers_of
from nanogs.pipeline.options.settings import Settings, differences, in_words
from nanogs.pipeline.run import Done, FindResult, InProcess, Run, Runner, run_tasks
from nanogs.pipeline.work import Work
from nanogs.progress import WAITING, Progress, Tracker
from nanogs.sink import Written
from nanogs.store.scratch import Scratch, open_scratch
from nanogs.threads import use_threads

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from distributed import Client

UNRECOVERABLE = (
    CrowdedError, ManyChildrenError, ModelError, SmallViewError, TooManyError, TooSmallError,
    UnstorableError,
)  # fmt: skip
"""Errors after which a job cannot be resumed, so that its files are removed."""


@dataclass(frozen=True, slots=True, eq=False)
class Execution:
    """The workers that do the tasks of a job.

    Attributes:
        threads: In this process, or in each worker; None takes all.
        executor: A Dask client or a `concurrent.futures.Executor`; None for this process.
        patience: Seconds to wait for workers if a cluster has none.
    """

    threads: int | None = None
    executor: "Client | Executor | None" = None
    patience: float = PATIENCE

    def runner(self, progress: Tracker) -> Runner:
        """Return what does the tasks.

        Args:
            progress: Notified while there is no worker.

        Raises:
            OptionError: `executor` is neither a client nor an executor.
        """
        if self.executor is None:
            return InProcess()
        waiting = partial(progress.aside, WAITING)
        return workers_of(self.executor, self.threads, self.patience, waiting)


@dataclass(frozen=True, slots=True, eq=False)
class BlockJob:
    """A job to be done, and where its files are until then.

    Attributes:
        settings: Everything that decides the results.
        folder: Of the job.
        scratch: Folder or URL of the intermediate files, or None for one in the job folder.
        writer: Makes the results from the tasks' files.
        search: Finds the result, if its count is not known beforehand.
    """

    settings: Settings
    folder: Path
    scratch: str | None
    writer: ResultWriter
    search: FindResult | None = None

    def run(
        self, execution: Execution, clock: StageClock, on_step: Progress | None, *, resume: bool
    ) -> tuple[Done, list[Written]]:
        """Do what is left of the job.

        Args:
            execution: The workers that do its tasks.
            clock: Gets the seconds of each stage.
            on_step: Called with each step; its stage is "wait" while a cluster has no worker.
            resume: Whether a job that was begun is continued.

        Returns:
            What was done, and each result as it was written.

        Raises:
            NanogsError: The job is another one, cannot be done, or is in use.
        """
        stages = job_stages(self.settings)
        if self.writer.measured:
            stages.append(measure_stage(self.settings.splats))
        progress = Tracker(on_step, stages)
        with locked(self.folder), _resume_hint(self.folder):
            place = self._found(resume=resume)
            resumed = place is not None
            runner = execution.runner(progress)
            with use_threads(execution.threads) as threads:
                scratch = open_scratch(place or self._new_place())
                scratch.prepare()
                if resumed:
                    scratch.tidy()
                else:
                    self._begin(scratch)
                work, run = Work(scratch, self.settings, threads), Run(runner, clock, resumed)
                try:
                    done = run_tasks(work, run, progress, self.search)
                    progress.begin("write")
                    with clock.time("write"):
                        written = self.writer.finish(done, self.folder, progress)
                except UNRECOVERABLE:
                    runner.finish()
                    self._remove(scratch)
                    raise
            self._remove(scratch)
        progress.finish()
        return done, written

    def _found(self, *, resume: bool) -> str | None:
        """Return the scratch of a job that an earlier run has begun, or None for a new job.

        Raises:
            NanogsError: The job that was begun is not to be continued, or a new one could not be
                written.
        """
        found = read_manifest(self.folder)
        if found is None:
            self.writer.check(self.folder, resume=resume)
            return None
        if not resume:
            raise OutputError(
                f"{self.folder} holds a job that was not finished; `resume=True` continues it, or"
                " remove the folder to begin anew."
            )
        before, place = found
        other = differences(before, self.settings)
        if other or _parent_of(place) != self._scratch_parent():
            what = in_words(other or ["scratch"])
            raise OutputError(
                f"{self.folder} holds another job (what differs: {what}); resume it with the same"
                " inputs and options, or remove the folder."
            )
        self.writer.check_begun(self.folder)
        return place

    def _scratch_parent(self) -> str:
        """Return the folder or URL that holds the job's own folder of intermediate files."""
        if self.scratch is None:
            return str(self.folder.resolve())
        if is_url(self.scratch):
            return self.scratch.rstrip("/")
        return str(Path(self.scratch).absolute())

    def _new_place(self) -> str:
        """Return a folder or URL for the scratch that no other job uses.

        So files that others keep beside it are never taken for the job's own.
        """
        name = SCRATCH if self.scratch is None else f"nanogs-{secrets.token_hex(8)}"
        return f"{self._scratch_parent()}/{name}"

    def _begin(self, scratch: Scratch) -> None:
        """Write the manifest, or remove the scratch if that fails, so that nothing is left."""
        try:
            write_manifest(self.folder, self.settings, scratch.place)
        except BaseException:
            scratch.remove()
            raise

    def _remove(self, scratch: Scratch) -> None:
        """Delete all files of the job.

        The notes on finished results and then the manifest are last, because a resumed run
        recognises the results by them.
        """
        scratch.remove()
        for left in self.folder.glob(".nanogs-*"):
            left.unlink(missing_ok=True)
        forget(self.folder)


@contextmanager
def _resume_hint(folder: Path) -> Iterator[None]:
    """Add to errors of the system, such as too little memory, a note that the job is kept."""
    try:
        yield
    except NanogsError:
        raise
    except Exception as error:
        if (folder / MANIFEST).exists():
            error.add_note(
                f"The finished part is kept in {folder}: `resume=True` continues from there;"
                " remove the folder to begin anew, for example with another `max_memory`."
            )
        raise


def _parent_of(place: str) -> str:
    """Return the folder or URL that contains a folder or URL."""
    return place.rpartition("/")[0] if is_url(place) else str(Path(place).parent)

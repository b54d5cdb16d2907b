"""A job on disk: begun or continued under its lock, brought to an end, and taken away."""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from nanogs.errors import OutputError
from nanogs.report import StageClock
from nanogs.scale.cluster import Workers, connected, threads_each
from nanogs.scale.ending import Ending
from nanogs.scale.folder import SCRATCH, forget, locked, read_manifest, write_manifest
from nanogs.scale.run import Done, Executor, Here, Progress, run_tasks
from nanogs.scale.scratch import Scratch, open_scratch
from nanogs.scale.settings import Settings, differences
from nanogs.threads import use_threads

if TYPE_CHECKING:
    from distributed import Client


@dataclass(frozen=True, slots=True, eq=False)
class Where:
    """Where the tasks of a job are done.

    Attributes:
        threads: In this process, or in each worker; None takes all.
        client: A Dask client, or None.
        scheduler: Address of a Dask scheduler, or None.
        workers: Processes to start on this machine, or None.
    """

    threads: int | None = None
    client: "Client | None" = None
    scheduler: str | None = None
    workers: int | None = None

    @contextmanager
    def executor(self) -> Iterator[Executor]:
        """What does the tasks.

        Raises:
            OptionError: The workers cannot be had.
        """
        if self.client is None and self.scheduler is None and self.workers is None:
            yield Here()
            return
        threads = self.threads
        if self.workers is not None and threads is None:
            threads = threads_each(self.workers)
        given = nullcontext(self.client) if self.client else connected(self.scheduler, self.workers)
        with given as client:
            assert client is not None  # noqa: S101 - one of three was given
            yield Workers(client, threads)


@dataclass(frozen=True, slots=True, eq=False)
class BlockJob:
    """What is to be made, and where it is kept until then.

    Attributes:
        settings: What decides the results.
        folder: Of the job.
        scratch: Folder or URL of the intermediate files, or None for one in the job folder.
        ending: What is made of the tasks' files.
    """

    settings: Settings
    folder: Path
    scratch: str | None
    ending: Ending

    def run(
        self, where: Where, clock: StageClock, progress: Progress, *, resume: bool
    ) -> tuple[Done, list[int]]:
        """Do what is left of the job.

        Args:
            where: To do its tasks.
            clock: Gets the seconds of each stage.
            progress: Told of each stage.
            resume: Whether a job that was begun is continued.

        Returns:
            What was done, and the splats of each result.

        Raises:
            NanogsError: The job is another one, cannot be done, or is in use.
        """
        with locked(self.folder):
            resumed = self._begin(resume=resume)
            with where.executor() as executor, use_threads(where.threads) as threads:
                scratch = self._open()
                if resumed:
                    scratch.tidy()
                done = run_tasks(
                    scratch, self.settings, executor, threads, clock, progress, resumed=resumed
                )
                with clock.time("write"):
                    counts = self.ending.finish(done, self.folder, progress)
            self._remove(scratch)
        return done, counts

    def _begin(self, *, resume: bool) -> bool:
        """Whether a run before has begun the job; writes the manifest of a new one."""
        found = read_manifest(self.folder)
        if found is None:
            self.ending.check()
            write_manifest(self.folder, self.settings, self._place())
            return False
        if not resume:
            raise OutputError(
                f"{self.folder} holds a job that was not finished; --resume continues it, or"
                " remove the folder to begin anew."
            )
        before, place = found
        other = differences(before, self.settings)
        if other or place != self._place():
            what = ", ".join(other) or "scratch"
            raise OutputError(
                f"{self.folder} holds another job (its {what} differ); resume it with the same"
                " inputs and options, or remove the folder."
            )
        return True

    def _place(self) -> str:
        return self.scratch or str((self.folder / SCRATCH).resolve())

    def _open(self) -> Scratch:
        return open_scratch(self._place())

    def _remove(self, scratch: Scratch) -> None:
        """Take away everything; the notes of results go last, with which they are known again."""
        scratch.remove()
        for left in self.folder.glob(".nanogs-*.tmp"):
            left.unlink(missing_ok=True)
        forget(self.folder)

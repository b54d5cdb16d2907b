"""Tasks on a Dask client or any `concurrent.futures.Executor`; the bytes are those of one process.

Workers read the inputs and read and write the scratch, which all of them must see under the same
name. The results of tasks are in the scratch: nothing that was done is lost with a worker.
"""

import asyncio
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent import futures
from dataclasses import dataclass, field
from functools import partial
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any

from nanogs._version import __version__
from nanogs.errors import NanogsError, OptionError, OutputError
from nanogs.formatting import counted
from nanogs.pipeline.options.settings import Settings
from nanogs.pipeline.scene import Task
from nanogs.pipeline.stages import do
from nanogs.pipeline.work import BEGUN, Work
from nanogs.store.scratch import open_scratch
from nanogs.threads import use_threads

if TYPE_CHECKING:
    from distributed import Client

KEPT = "the job is kept, and `resume=True` continues it"
_SCHEDULER, _EXECUTOR = "The Dask scheduler was lost", "The executor was shut down"
_LOOK = 1.0  # seconds between checks of the cluster
_POLL = 0.1  # seconds between checks of a worker
_ANSWER = 10  # seconds that a scheduler may take to list its workers
_SILENT = 30.0  # seconds after which a scheduler that does not answer is lost
_ONE = threading.Lock()  # a process has memory and Numba threads for one task at a time


@dataclass(frozen=True, slots=True, eq=False)
class Workers:
    """Does tasks on an executor.

    Attributes:
        submit: `submit` of an executor, whose workers do the tasks.
        threads: For a task; None takes all of the worker's machine.
        watch: Called each second without a result, with the time of the last; it raises if no
            more can be expected.
        settle: Called by `finish`, to wait for tasks whose futures cannot tell when they end.
        lost: What has happened if no task is taken any more, as the beginning of the sentence.
        begun: Futures of tasks that had begun when another failed.
    """

    submit: "Callable[..., futures.Future[None]]"
    threads: int | None
    watch: Callable[[float], None] = lambda _: None
    settle: Callable[[], None] = lambda: None
    lost: str = _SCHEDULER
    begun: "list[futures.Future[None]]" = field(default_factory=list)

    def run(self, work: Work, tasks: Sequence[Task]) -> Iterator[Task]:
        """Do tasks on any workers, and yield each when it is done.

        Raises:
            NanogsError: A task failed, or the workers or the scheduler are lost.
        """
        done: SimpleQueue[futures.Future[None]] = SimpleQueue()
        left: dict[futures.Future[None], Task] = {}
        since = time.monotonic()
        try:
            for task in tasks:
                future = self._begin(
                    do_task, work.scratch.place, work.settings, task, self.threads, __version__
                )  # fmt: skip
                left[future] = task
                future.add_done_callback(done.put)
            while left:
                try:
                    future = done.get(timeout=_LOOK)
                except Empty:
                    self.watch(since)
                    continue
                task, since = left.pop(future), time.monotonic()
                check(future, task, self.lost)
                yield task
        finally:
            # Tasks that no worker has begun are not begun any more.
            self.begun[:] = [future for future in left if not future.cancel()]

    def finish(self) -> None:
        """Wait for tasks that had begun when another failed; see `run.Runner`."""
        futures.wait(self.begun)
        self.settle()

    def _begin(self, *given: Any) -> "futures.Future[None]":  # noqa: ANN401
        try:
            return self.submit(*given)
        except futures.BrokenExecutor:
            raise _ended(1) from None
        except Exception as error:
            self.watch(time.monotonic())  # raises a better error if the cluster is gone
            if isinstance(error, RuntimeError):  # as executors do after `shutdown`
                raise _lost(self.lost) from error
            raise


def _submit_to(client: "Client", keys: set[str], *given: Any) -> "futures.Future[None]":  # noqa: ANN401
    """Submit a task to a Dask client, as an executor does, but fetch no result.

    The futures of `Client.get_executor` are never done if the result cannot be fetched.

    Args:
        client: The client.
        keys: Gets Dask's name of the task.
        given: The function and its arguments.
    """
    theirs, ours = client.submit(*given, pure=False), futures.Future[None]()
    keys.add(theirs.key)

    def end(theirs: Any) -> None:  # noqa: ANN401 - Dask's future
        if not ours.set_running_or_notify_cancel():
            return
        if theirs.status == "finished":
            ours.set_result(None)
        else:
            error = theirs.exception() if theirs.status == "error" else None
            ours.set_exception(error or futures.CancelledError())

    theirs.add_done_callback(end)
    ours.add_done_callback(lambda _: theirs.release())
    return ours


def _settle(client: "Client", keys: set[str]) -> None:
    """Wait until no Dask worker does one of these tasks, even if it was cancelled meanwhile."""

    async def settled(dask_worker: Any) -> None:  # noqa: ANN401 - Dask's worker
        while any(task.key in keys for task in dask_worker.state.executing):
            await asyncio.sleep(_POLL)

    client.run(settled, on_error="ignore")


@dataclass(slots=True, eq=False)
class _Watch:
    """Raises if a Dask cluster can be expected to do nothing more.

    Attributes:
        client: Of the cluster.
        patience: Seconds to wait for a worker if there is none.
        waiting: Called repeatedly while there is none.
        heard: Time of the scheduler's last answer.
        staffed: Time when there last was a worker.
    """

    client: "Client"
    patience: float
    waiting: Callable[[], None]
    heard: float = 0.0
    staffed: float = 0.0

    def __call__(self, since: float) -> None:
        """Ask the scheduler for its workers.

        Raises:
            OutputError: It does not answer, or has had no worker for too long.
        """
        self.heard, self.staffed = max(self.heard, since), max(self.staffed, since)
        found = None if self.client.status == "closed" else _count(self.client)
        now = time.monotonic()
        if found is not None:
            self.heard = now
        if self.client.status == "closed" or now - self.heard > _SILENT:
            raise _lost()
        if found:
            self.staffed = now
        elif found == 0:
            self.waiting()
            if now - self.staffed > self.patience:
                raise OutputError(
                    f"The Dask cluster has had no worker for {self.patience:g} seconds; start some"
                    f" with `dask worker`; {KEPT}."
                )


def workers_of(
    given: "Client | futures.Executor",
    threads: int | None,
    patience: float,
    waiting: Callable[[], None],
) -> Workers:
    """Return the workers of a Dask client, or of an executor.

    Args:
        given: The client or executor.
        threads: For a task; None takes all of the worker's machine.
        patience: Seconds to wait for a worker if a cluster has none.
        waiting: Called repeatedly while it has none.

    Raises:
        OptionError: It is neither, or takes no tasks.
        OutputError: A worker of the executor ended before, and it takes no tasks any more.
    """
    if isinstance(given, futures.Executor):
        _try_out(given)
        return Workers(given.submit, threads, lost=_EXECUTOR)
    if not hasattr(given, "scheduler_info"):
        raise OptionError(
            "`executor` is a Dask client or a concurrent.futures.Executor, not"
            f" {type(given).__name__}."
        )
    if given.status == "closed":
        raise OptionError("The Dask client is closed; give one that is connected.")
    if given.asynchronous:
        raise OptionError(
            "The Dask client is asynchronous; give one that was made without `asynchronous=True`."
        )
    keys = set[str]()
    submit, settle = partial(_submit_to, given, keys), partial(_settle, given, keys)
    return Workers(submit, threads, _Watch(given, patience, waiting), settle)


def _try_out(executor: futures.Executor) -> None:
    """Refuse an executor that takes no tasks, before a job is begun that it could not do."""
    try:
        executor.submit(int)
    except futures.BrokenExecutor:
        raise OutputError(
            "1 worker ended in the middle of an earlier task, perhaps because memory ran out; give"
            " a new executor."
        ) from None
    except RuntimeError as error:
        raise OptionError(f"The executor takes no tasks ({error}); give one that runs.") from None


def _count(client: "Client") -> int | None:
    """Return the number of workers; None if the scheduler does not answer."""
    try:
        asked = client.scheduler.ncores
        return len(client.sync(asked, callback_timeout=_ANSWER))
    except Exception:  # of any kind that Dask raises: the scheduler does not answer
        return None


def check(future: "futures.Future[None]", task: Task, lost: str = _SCHEDULER) -> None:
    """Raise the error of a task, if it failed.

    Args:
        future: Of the task; done.
        task: For the message.
        lost: What has happened if the task was cancelled, as the beginning of the sentence.

    Raises:
        NanogsError: It failed for a known reason.
    """
    error = None if future.cancelled() else future.exception()
    if future.cancelled() or isinstance(error, futures.CancelledError):
        raise _lost(lost)
    if error is None:
        return
    if isinstance(error, NanogsError):
        raise error from None
    if isinstance(error, futures.BrokenExecutor) or type(error).__name__ == "KilledWorker":
        raise _ended(getattr(error, "allowed_failures", 0) + 1) from None
    reason = str(error).splitlines()[0] if str(error) else type(error).__name__
    if isinstance(error, ImportError) or "deserializ" in str(error):
        raise OptionError(
            f"The Dask scheduler or a worker cannot load nanogs ({reason}); install the same"
            f" versions there as here; {KEPT}."
        ) from None
    if isinstance(error, OSError | MemoryError):
        raise OutputError(f"{task.name} failed on a worker ({reason}); {KEPT}.") from error
    raise error


def _ended(workers: int) -> OutputError:
    found = counted(workers, "worker")
    return OutputError(
        f"{found} ended in the middle of a task, perhaps because memory ran out; {KEPT}."
    )


def _lost(who: str = _SCHEDULER) -> OutputError:
    return OutputError(f"{who}, or has cancelled the work; {KEPT}.")


def do_task(
    place: str,
    settings: Settings,
    task: Task,
    threads: int | None,
    version: str,
) -> None:
    """Do a task in a worker.

    Args:
        place: Folder or URL of the scratch.
        settings: Of the job.
        task: To be done.
        threads: To use; None takes all.
        version: Of the caller's nanogs.

    Raises:
        NanogsError: The task cannot be done here.
    """
    host = socket.gethostname()
    if version != __version__:
        raise OptionError(
            f"The worker on {host} has nanogs {__version__} and the caller {version}; install the"
            " same version there."
        )
    try:
        with _ONE, use_threads(threads) as used:
            work = Work(open_scratch(place), settings, used)
            work.record(BEGUN)
            do(work, task)
    except NanogsError as error:
        raise _plain_kind(error)(f"On the worker {host}: {error}") from None


def _plain_kind(error: NanogsError) -> type[NanogsError]:
    """Return the nearest class of an error that holds a message alone, such as `OptionError`."""
    kinds = [kind for kind in type(error).__mro__ if issubclass(kind, NanogsError)]
    return next(kind for kind in kinds if kind.__init__ is NanogsError.__init__)

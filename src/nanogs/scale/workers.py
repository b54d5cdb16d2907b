"""Tasks as Dask futures; the bytes are those of one process.

Workers read the inputs and read and write the scratch, which all of them must see under the same
name. A task that a worker took with it is done by another. What a task makes is in the scratch, so
no result is fetched from a worker, and a worker that goes takes nothing with it that was done.
"""

import json
import secrets
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any

from nanogs._version import __version__
from nanogs.errors import NanogsError, OptionError, OutputError
from nanogs.scale.scratch import open_scratch
from nanogs.scale.settings import settings_of
from nanogs.scale.work import MARK, Task, Work, do
from nanogs.threads import use_threads

if TYPE_CHECKING:
    from distributed import Client, Future

KEPT = "the job is kept, `resume=True` continues it"
_LOOK = 1.0  # seconds between looks at the cluster
_ANSWER = 10  # seconds for a scheduler to say who its workers are
_SILENT = 30.0  # seconds after which one that says nothing is lost
_ONE = threading.Lock()  # a process has memory for one task, and Numba threads for one at a time


@dataclass(frozen=True, slots=True, eq=False)
class Workers:
    """Tasks as Dask futures.

    Attributes:
        connect: Waits for the cluster, and returns a client of it.
        threads: For a task; None takes all of the worker's machine.
        patience: Seconds to wait for a worker where there is none.
        waiting: Called again and again while there is none.
    """

    connect: Callable[[], "Client"]
    threads: int | None
    patience: float
    waiting: Callable[[], None]

    def run(self, work: Work, tasks: Sequence[Task]) -> Iterator[Task]:
        """Do tasks on any workers, and yield each when it is done.

        Raises:
            NanogsError: A task failed, or the workers or the scheduler are lost.
        """
        client = self.connect()
        text, run = json.dumps(work.settings.to_dict()), secrets.token_hex(4)
        done: SimpleQueue[Future[Any]] = SimpleQueue()
        left: dict[str, tuple[Task, Future[Any]]] = {}
        try:
            for task in tasks:
                key = f"nanogs-{run}-{task.name}"
                future = _submit(
                    client, do_task, work.scratch.place, text, task.stage, task.number, task.level,
                    self.threads, __version__, key=key, pure=False,
                )  # fmt: skip
                left[key] = task, future
                future.add_done_callback(done.put)
            while left:
                future = self._next(client, done)
                task = left[str(future.key)][0]
                _check(future, task)
                del left[str(future.key)]
                future.release()
                yield task
        finally:
            for _, future in left.values():
                future.release()  # what no worker has begun is not begun any more

    def _next(self, client: "Client", done: "SimpleQueue[Future[Any]]") -> "Future[Any]":
        """The next future that is done.

        Raises:
            OutputError: There will be none, as far as one can tell.
        """
        heard = staffed = time.monotonic()
        while True:
            try:
                return done.get(timeout=_LOOK)
            except Empty:
                pass
            if client.status == "closed":
                raise _lost()
            found, now = _count(client), time.monotonic()
            if found is not None:
                heard = now
            if now - heard > _SILENT:
                raise _lost()
            if found == 0:
                self._wait(now - staffed)
            elif found:
                staffed = now

    def _wait(self, seconds: float) -> None:
        """Say that there is no worker; raise if there has been none for too long."""
        self.waiting()
        if seconds > self.patience:
            raise OutputError(
                f"The Dask cluster has had no worker for {self.patience:g} seconds; start some with"
                f" `dask worker`; {KEPT}."
            )


def _submit(client: "Client", *given: object, **options: Any) -> "Future[Any]":  # noqa: ANN401
    try:
        return client.submit(*given, **options)
    except Exception:
        if client.status in ("running", "connecting"):
            raise
        raise _lost() from None


def _count(client: "Client") -> int | None:
    """How many workers there are; None where the scheduler does not say."""
    try:
        asked = client.scheduler.ncores
        return len(client.sync(asked, callback_timeout=_ANSWER))
    except Exception:  # whatever Dask raises here: the scheduler does not say
        return None


def _check(future: "Future[Any]", task: Task) -> None:
    """Raise what a task ended with, if it failed."""
    from distributed import KilledWorker

    if future.status == "cancelled":
        raise _lost()
    if future.status != "error":
        return
    error = future.exception()
    if isinstance(error, KilledWorker):
        raise OutputError(
            f"{task.name} ended {error.allowed_failures + 1} workers, as when memory runs out;"
            f" {KEPT}."
        ) from None
    if isinstance(error, NanogsError):
        raise error from None
    reason = str(error).splitlines()[0] if str(error) else type(error).__name__
    if isinstance(error, ImportError) or "deserializ" in str(error):
        raise OptionError(
            f"The Dask scheduler or a worker cannot load nanogs ({reason}); install the same"
            f" versions there as here; {KEPT}."
        ) from None
    if isinstance(error, OSError | MemoryError):
        raise OutputError(f"{task.name} failed on a worker ({reason}); {KEPT}.") from error
    assert error is not None  # noqa: S101 - the future's status says so
    raise error


def _lost() -> OutputError:
    return OutputError(f"The Dask scheduler was lost, or has cancelled the work; {KEPT}.")


def do_task(
    place: str,
    settings: str,
    stage: str,
    number: int,
    level: int,
    threads: int | None,
    version: str,
) -> None:
    """Do a task in a worker.

    Args:
        place: Folder or URL of the scratch.
        settings: Of the job, as JSON.
        stage: Of the task.
        number: Of the task.
        level: Of the task.
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
            work = Work(open_scratch(place), settings_of(json.loads(settings)), used)
            work.record(MARK)
            do(work, Task(stage, number, level))
    except NanogsError as error:
        raise type(error)(f"On the worker {host}: {error}") from None

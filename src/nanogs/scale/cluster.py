"""Tasks on Dask workers, of a cluster or of this machine; the bytes are those of one process.

Workers read the inputs and read and write the scratch, which all of them must see under the same
name. A task that a worker took with it is done by another.
"""

import json
import os
import secrets
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from nanogs.errors import NanogsError, OptionError, OutputError
from nanogs.scale.settings import settings_of
from nanogs.scale.work import Task, Work, do_elsewhere

if TYPE_CHECKING:
    from distributed import Client

_PATIENCE = 5  # seconds for a scheduler to answer
_ONE = threading.Lock()  # a process has memory for one task, and Numba threads for one at a time


class Workers:
    """Tasks as Dask futures."""

    def __init__(self, client: "Client", threads: int | None) -> None:
        self.client, self.threads = client, threads

    def run(self, work: Work, tasks: Sequence[Task]) -> Iterator[Task]:
        """Do tasks on any workers, and yield each when it is done.

        Raises:
            NanogsError: A task failed, or the workers or the scheduler are lost.
        """
        from distributed import CancelledError, KilledWorker, as_completed

        text, run = json.dumps(work.settings.to_dict()), secrets.token_hex(4)
        try:
            futures = {
                self.client.submit(
                    do_task, work.scratch.place, text, task.stage, task.number, task.level,
                    self.threads, key=f"nanogs-{run}-{task.name}", pure=False,
                ): task
                for task in tasks
            }  # fmt: skip
            for future in as_completed(futures, loop=self.client.loop):
                future.result()
                yield futures[future]
        except NanogsError:
            raise
        except (OSError, TimeoutError, CancelledError, KilledWorker, RuntimeError) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise OutputError(
                f"The Dask cluster was lost ({reason}); the job is kept, --resume continues it."
            ) from error


def do_task(
    place: str, settings: str, stage: str, number: int, level: int, threads: int | None
) -> str:
    """What a worker runs.

    Args:
        place: Folder or URL of the scratch.
        settings: Of the job, as JSON.
        stage: Of the task.
        number: Of the task.
        level: Of the task.
        threads: To use; None takes all.

    Returns:
        The name of what it wrote.
    """
    with _ONE:
        return do_elsewhere(
            place, settings_of(json.loads(settings)), Task(stage, number, level), threads
        )


@contextmanager
def connected(scheduler: str | None, workers: int | None) -> Iterator["Client"]:
    """A client of the scheduler at an address, or of a cluster on this machine.

    Args:
        scheduler: Such as tcp://host:8786, or None.
        workers: Processes on this machine where there is no scheduler.

    Raises:
        OptionError: Dask is not installed, or no scheduler answers.
    """
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        raise OptionError("Workers need Dask; install nanogs[cluster].") from None
    if scheduler is not None:
        with _answering(Client, scheduler) as client:
            yield client
        return
    with (
        LocalCluster(
            n_workers=workers, threads_per_worker=1, processes=True, memory_limit=None,
            dashboard_address=None, silence_logs=50,
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):  # fmt: skip
        yield client


@contextmanager
def _answering(kind: Any, scheduler: str) -> Iterator["Client"]:  # noqa: ANN401 - Dask's own class
    try:
        client = kind(scheduler, timeout=_PATIENCE, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise OptionError(
            f"No Dask scheduler answers at {scheduler} ({type(error).__name__}); start one with"
            " `dask scheduler`, or leave --scheduler out."
        ) from None
    with client:
        yield client


def threads_each(workers: int) -> int:
    """Threads for each of several processes on this machine."""
    return max((os.cpu_count() or 1) // workers, 1)

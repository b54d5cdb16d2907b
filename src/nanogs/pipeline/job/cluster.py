"""Executors for the command's tasks: local processes, or the workers of a Dask scheduler."""

import gc
import logging
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from multiprocessing import active_children, get_context, parent_process, util
from typing import TYPE_CHECKING

from nanogs.cleanup import cleaned_up, starting_processes
from nanogs.errors import OptionError

if TYPE_CHECKING:
    from distributed import Client

_PATIENCE = 10  # seconds for a scheduler to answer


def executor_of(
    workers: int | None, scheduler: str | None
) -> "AbstractContextManager[Client | Executor | None]":
    """Return a context manager that yields a process pool, a Dask client, or None for neither.

    Args:
        workers: Number of local processes, or None.
        scheduler: Address such as tcp://host:8786, or None.
    """
    if workers is not None:
        return processes(workers)
    return nullcontext() if scheduler is None else connected(scheduler)


@contextmanager
def processes(workers: int) -> Iterator[Executor]:
    """Yield a pool of local processes, which start at once and end with the context.

    They also end if this process does.

    Args:
        workers: Number of processes.
    """
    pool = ProcessPoolExecutor(workers, get_context("spawn"), _attend)
    with cleaned_up(_end_children):
        with starting_processes():
            for _ in range(workers):  # each submitted task starts one process
                pool.submit(_load)
        yield pool
        pool.shutdown()


def _attend() -> None:
    """Initialise a worker: ignore SIGINT, which the parent handles, and exit with the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()

    def follow() -> None:
        if parent:
            parent.join()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


def _load() -> None:
    """Import the modules that tasks need, as the first task of a worker."""
    import nanogs.pipeline.job.workers  # noqa: F401


def _end_children() -> None:
    """Kill the child processes of this process, and remove their semaphores."""
    util._run_finalizers(0)  # type: ignore[attr-defined]  # noqa: SLF001 - what Python calls when it ends
    for child in active_children():
        child.kill()


@contextmanager
def connected(scheduler: str) -> Iterator["Client"]:
    """Yield a client of the Dask scheduler at an address, such as tcp://host:8786.

    Raises:
        OptionError: Dask is not installed, or no scheduler answers.
    """
    try:
        from distributed import Client
    except ImportError:
        raise OptionError('A Dask scheduler needs Dask: pip install "nanogs[cluster]".') from None

    def connect() -> "Client":
        return Client(scheduler, timeout=_PATIENCE / 2, set_as_default=False)

    with _silent():
        try:
            client = _in_time(connect)
        except Exception as error:  # the type depends on what Dask finds at the address
            raise OptionError(
                f"No Dask scheduler answers at {scheduler!r} ({type(error).__name__}); start one"
                " with `dask scheduler`, or leave the scheduler out."
            ) from None
        with closing(client):
            yield client


def _in_time(connect: Callable[[], "Client"]) -> "Client":
    """Connect with a time limit of `_PATIENCE` seconds: with some servers Dask never gives up.

    A client that connects only after that is closed.

    Raises:
        TimeoutError: There is no answer.
    """
    answer: Future[Client] = Future()

    def fill() -> None:
        try:
            client = connect()
        except BaseException as error:
            if answer.set_running_or_notify_cancel():
                # Without the traceback, whose frames hold the client.
                answer.set_exception(error.with_traceback(None))
        else:
            if answer.set_running_or_notify_cancel():
                answer.set_result(client)
            else:
                client.close()
            return
        # Dask's finaliser of a client takes a lock that starting another one holds. Run by the
        # garbage collector in that moment, it would wait for ever; here nothing is held.
        gc.collect()

    threading.Thread(target=fill, daemon=True).start()
    try:
        return answer.result(_PATIENCE)
    except TimeoutError:
        if answer.cancel():
            raise
        return answer.result()  # which came at this very moment


@contextmanager
def _silent() -> Iterator[None]:
    """Silence Dask's loggers, which write tracebacks: the caller raises one sentence instead."""
    names = [name for name in logging.root.manager.loggerDict if name.startswith("distributed")]
    loggers = [logging.getLogger(name) for name in names]
    before = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)

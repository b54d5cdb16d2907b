"""Who does tasks for the command: processes of this machine, or workers of a Dask scheduler."""

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
    """Who does the tasks: so many processes, the workers of a scheduler, or nobody else.

    Args:
        workers: Processes of this machine, or None.
        scheduler: Address such as tcp://host:8786, or None.
    """
    if workers is not None:
        return processes(workers)
    return nullcontext() if scheduler is None else connected(scheduler)


@contextmanager
def processes(workers: int) -> Iterator[Executor]:
    """Processes of this machine, which start at once and end with the block or with this process.

    Args:
        workers: Their number.
    """
    pool = ProcessPoolExecutor(workers, get_context("spawn"), _attend)
    with cleaned_up(_end_children):
        with starting_processes():
            for _ in range(workers):  # each starts one
                pool.submit(_load)
        yield pool
        pool.shutdown()


def _attend() -> None:
    """Leave interrupts from the terminal to the process that started this one, and end with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()

    def follow() -> None:
        if parent:
            parent.join()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


def _load() -> None:
    """Import what tasks need."""
    import nanogs.pipeline.workers  # noqa: F401


def _end_children() -> None:
    """Kill the processes that this one has started, and take away their semaphores."""
    util._run_finalizers(0)  # type: ignore[attr-defined]  # noqa: SLF001 - what Python calls when it ends
    for child in active_children():
        child.kill()


@contextmanager
def connected(scheduler: str) -> Iterator["Client"]:
    """A client of the scheduler at an address, such as tcp://host:8786.

    Raises:
        OptionError: Dask is not installed, or no scheduler answers.
    """
    try:
        from distributed import Client
    except ImportError:
        raise OptionError("A Dask scheduler needs Dask; install nanogs[cluster].") from None

    def connect() -> "Client":
        return Client(scheduler, timeout=_PATIENCE / 2, set_as_default=False)

    with _silent():
        try:
            client = _in_time(connect)
        except Exception as error:  # Dask raises most kinds here, by what it finds at the address
            raise OptionError(
                f"No Dask scheduler answers at {scheduler!r} ({type(error).__name__}); start one"
                " with `dask scheduler`, or do without one."
            ) from None
        with closing(client):
            yield client


def _in_time(connect: Callable[[], "Client"]) -> "Client":
    """Connect, and give up after some seconds: to some servers Dask would try for ever.

    Raises:
        TimeoutError: There is no answer.
    """
    answer: Future[Client] = Future()

    def fill() -> None:
        try:
            answer.set_result(connect())
        except BaseException as error:
            answer.set_exception(error)

    threading.Thread(target=fill, daemon=True).start()
    return answer.result(_PATIENCE)


@contextmanager
def _silent() -> Iterator[None]:
    """Dask logs what it lost, with tracebacks; here a sentence says it."""
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

"""Dask clusters: one whose scheduler has an address, or processes of this machine."""

import asyncio
import logging
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager, suppress
from typing import TYPE_CHECKING

from nanogs.cleanup import clean_at_end
from nanogs.errors import OptionError

if TYPE_CHECKING:
    from distributed import Client

_PATIENCE = 5  # seconds for a scheduler to answer


@contextmanager
def connected(scheduler: str | None = None, workers: int | None = None) -> Iterator["Client"]:
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
    with _silent():
        if scheduler is not None:
            with closing(_answering(scheduler)) as client:
                yield client
            return
        with (
            LocalCluster(
                n_workers=workers, threads_per_worker=1, processes=True, memory_limit=None,
                dashboard_address=None, silence_logs=logging.CRITICAL,
            ) as cluster,
            closing(Client(cluster, set_as_default=False)) as client,
        ):  # fmt: skip
            yield client


@contextmanager
def starting(workers: int) -> Iterator[Callable[[], "Client"]]:
    """Processes on this machine that start while the caller does something else.

    Args:
        workers: Their number.

    Yields:
        What waits for them, and returns their client.
    """
    with ExitStack() as stack, ThreadPoolExecutor(1) as pool:
        clean_at_end(_end_children)
        begun = pool.submit(_shielded, stack, workers)
        yield begun.result


def _shielded(stack: ExitStack, workers: int) -> "Client":
    """Start workers that an interrupt from the terminal does not reach: it is this process's.

    Threads and processes inherit what is blocked in the thread that starts them.
    """
    if hasattr(signal, "pthread_sigmask"):  # not on Windows
        from multiprocessing import resource_tracker

        resource_tracker.ensure_running()  # or it would be started later, and unblock them
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    return stack.enter_context(connected(None, workers))


def _end_children() -> None:
    """Kill all processes that this one has started, and take away their semaphores."""
    from multiprocessing import util

    import psutil  # Dask brings it

    util._run_finalizers(0)  # type: ignore[attr-defined]  # noqa: SLF001 - what Python calls when it ends
    for child in psutil.Process().children(recursive=True):
        with suppress(psutil.Error):
            if not any("resource_tracker" in word for word in child.cmdline()):
                child.kill()


def _answering(scheduler: str) -> "Client":
    """A client of a scheduler that is one."""
    from distributed import Client

    try:
        # A client would wait for ever for some servers that speak something else.
        found = _in_time(lambda: asyncio.run(_kind(scheduler)))
        if found == "Scheduler":
            return Client(scheduler, timeout=_PATIENCE, set_as_default=False)
        reason = f"a {found.lower()} does"
    except Exception as error:  # Dask raises most kinds here, by what it finds at the address
        reason = type(error).__name__
    raise OptionError(
        f"No Dask scheduler answers at {scheduler!r} ({reason}); start one with `dask scheduler`,"
        " or leave `scheduler` out."
    )


async def _kind(address: str) -> str:
    """The kind of process at an address of Dask's: "Scheduler", "Worker" or "Nanny"."""
    from distributed import rpc

    async with rpc(address, timeout=_PATIENCE) as server:
        return str((await server.identity())["type"])


def _in_time(ask: Callable[[], str]) -> str:
    """Ask, and give up after some seconds; an answer that comes later is dropped.

    Raises:
        TimeoutError: There is no answer.
    """
    answer: Future[str] = Future()

    def fill() -> None:
        try:
            answer.set_result(ask())
        except BaseException as error:
            answer.set_exception(error)

    threading.Thread(target=fill, daemon=True).start()
    return answer.result(2 * _PATIENCE)


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


def threads_each(workers: int) -> int:
    """Threads for each of several processes on this machine."""
    return max((os.cpu_count() or 1) // workers, 1)

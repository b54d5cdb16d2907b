"""Run the ranges of a kernel, or other parts of some work, on all threads.

Numba's own parallel loops compile to the same speed, but in two to three times the time: the body
of each is optimised as a function of its own and again with all that surrounds it.
"""

import inspect
import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from threading import Lock
from typing import Any, Concatenate, Generic, ParamSpec, TypeVar

import numba
from numba.core import config

P = ParamSpec("P")
T = TypeVar("T")


class Spread(Generic[P]):
    """A compiled kernel `f(start, stop, *args)` that is called as `f(*args)`.

    The range is split, and its parts are run on the thread pool.
    """

    def __init__(
        self,
        function: Callable[Concatenate[int, int, P], None],
        compiled: Callable[..., None],
        over: str,
        least: int,
        each: int,
    ) -> None:
        """See `policy.parallel_kernel` for the arguments."""
        self._compiled = compiled
        self._place = list(inspect.signature(function).parameters).index(over) - 2
        self._least, self._each = least, each
        self.__doc__ = function.__doc__

    @property
    def signatures(self) -> list[Any]:
        """The signatures that it was compiled for."""
        return getattr(self._compiled, "signatures", [])

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> None:
        """Run the whole range; the arguments of the kernel but for the first two, by position."""
        assert not kwargs  # noqa: S101 - a kernel is called by position
        count = len(args[self._place])  # type: ignore[arg-type]
        threads = int(numba.get_num_threads())
        parts = max(1, min(threads * self._each, count // self._least))
        threads = min(threads, parts)
        ranges = iter([(count * p // parts, count * (p + 1) // parts) for p in range(parts)])

        def work() -> None:
            for start, stop in ranges:
                self._compiled(start, stop, *args)

        _on(threads, work)

    def here(self, *args: P.args, **kwargs: P.kwargs) -> None:
        """Run the whole range on this thread alone: for a part of what is spread already."""
        assert not kwargs  # noqa: S101 - as above
        self._compiled(0, len(args[self._place]), *args)  # type: ignore[arg-type]


def each(parts: Iterable[T], work: Callable[[T], None]) -> None:
    """Do some work for each part, in any order, on all threads; for NumPy, which lets others run.

    Args:
        parts: What the work takes; what it does for one must not touch what it does for another.
        work: Called once for each.
    """
    every = list(parts)
    waiting, lock = iter(every), Lock()

    def work_on() -> None:
        while True:
            with lock:
                part = next(waiting, None)
            if part is None:
                return
            work(part)

    _on(min(int(numba.get_num_threads()), len(every)), work_on)


def _on(threads: int, work: Callable[[], None]) -> None:
    """Call it on so many threads, this one among them."""
    others = [_pool().submit(work) for _ in range(threads - 1)]
    try:
        work()
    finally:
        for other in others:
            other.result()


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(int(config.NUMBA_NUM_THREADS))  # type: ignore[attr-defined]


# A forked process has the pool but none of its threads, for which it would wait for ever.
if hasattr(os, "register_at_fork"):  # not on Windows, where nothing forks
    os.register_at_fork(after_in_child=_pool.cache_clear)

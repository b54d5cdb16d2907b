"""Run the ranges of a kernel, or other parts of some work, on all threads.

Numba's own parallel loops compile to the same speed, but in two to three times the time: the body
of each is optimised as a function of its own and again with all that surrounds it.
"""

import inspect
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from threading import Lock, local
from typing import TYPE_CHECKING, Any, Concatenate, Generic, ParamSpec, TypeVar

from nanogs.threads import most_threads

if TYPE_CHECKING:
    from concurrent.futures import Executor, Future, ThreadPoolExecutor

P = ParamSpec("P")
T = TypeVar("T")
R = TypeVar("R")


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
        threads = _threads()
        parts = max(1, min(threads * self._each, count // self._least))
        ranges = [(count * p // parts, count * (p + 1) // parts) for p in range(parts)]
        _on(threads, ranges, lambda part: self._compiled(*part, *args))

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
    _on(_threads(), list(parts), work)


def results(parts: Iterable[T], work: Callable[[T], R]) -> list[R]:
    """Do some work on each part, and return its results in the order of the parts; see `each`."""
    every = list(parts)
    found: dict[int, R] = {}

    def keep(number: int) -> None:
        found[number] = work(every[number])

    each(range(len(every)), keep)
    return [found[number] for number in range(len(every))]


def asked(pool: "Executor", work: Callable[..., R], *args: object) -> "Future[R] | None":
    """Have a pool do some work; None where it takes no more, which is then to be done here.

    Python shuts all pools when the main thread ends, and other threads may have work to do yet.
    """
    try:
        return pool.submit(work, *args)
    except RuntimeError as error:
        if "cannot schedule new futures" not in str(error):
            raise
        return None


class _Parts(Generic[T]):
    """Parts of some work, of which each is taken once, by one of several threads."""

    def __init__(self, parts: Sequence[T], work: Callable[[T], None]) -> None:
        self._waiting, self._lock = list(reversed(parts)), Lock()
        self._work: Callable[[T], None] | None = work

    def work_on(self) -> None:
        """Take one part after the other, until none is left or one has failed anywhere."""
        while True:
            with self._lock:
                if not self._waiting or self._work is None:
                    return
                part, work = self._waiting.pop(), self._work
            try:
                work(part)
            except BaseException:
                self.drop()
                raise

    def drop(self) -> None:
        """Leave what nobody has begun, and hold none of its arrays: the pool may hold this long."""
        with self._lock:
            self._waiting.clear()
            self._work = None

    @contextmanager
    def closed(self) -> Iterator[None]:
        """Let nobody begin before the end of the block; or at all, if it fails."""
        with self._lock:
            try:
                yield
            except BaseException:
                self._waiting.clear()
                raise


def _on(threads: int, parts: Sequence[T], work: Callable[[T], None]) -> None:
    """Work on parts with at most so many threads, this one among them; none works on afterwards.

    On this one alone, if it is of the pool: all that are would wait for each other.
    """
    shared, more = _Parts(parts, work), 0 if _own.of_pool else min(threads, len(parts)) - 1
    others: list[Future[None]] = []
    try:
        with shared.closed():  # who begins before all are known is not waited for if it fails
            called = (asked(_pool(), shared.work_on) for _ in range(more))
            others = [other for other in called if other is not None]
        shared.work_on()
        failures = _ended(others)
        shared.drop()
    except BaseException:  # an interrupt may come while others are waited for
        shared.drop()
        _ended(others)
        raise
    if failures:
        raise failures[0]


def _ended(others: "Sequence[Future[None]]") -> list[BaseException]:
    """Wait for those that have begun, let the others be, and say what failed."""
    failures = [other.exception() for other in others if not other.cancel()]
    return [failure for failure in failures if failure is not None]


class _Own(local):
    """Of each thread: whether it is one of the pool's."""

    of_pool = False

    def join(self) -> None:
        """Be one of them."""
        self.of_pool = True


_own = _Own()


@cache
def _pool() -> "ThreadPoolExecutor":
    from concurrent.futures import ThreadPoolExecutor

    return ThreadPoolExecutor(most_threads(), initializer=_own.join)


def _threads() -> int:
    """How many threads to use: as many as Numba, which files are read and written without."""
    found = getattr(sys.modules.get("numba"), "get_num_threads", most_threads)()
    return int(found)


# A forked process has the pool but none of its threads, for which it would wait for ever.
if hasattr(os, "register_at_fork"):  # not on Windows, where nothing forks
    os.register_at_fork(after_in_child=_pool.cache_clear)

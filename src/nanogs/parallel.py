"""Parallel execution: run a kernel over ranges, or other work in parts, on a thread pool.

Numba's own parallel loops run at the same speed, but take two to three times as long to compile:
the body of each loop is optimised as a function of its own and again inlined into its caller.
"""

import inspect
import math
import os
import sys
import time
from array import array
from collections.abc import Callable, Iterable, Iterator, Sequence

# Imported at once: Python refuses the first import after the main thread has ended.
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from threading import Lock, local
from typing import TYPE_CHECKING, Any, Concatenate, Generic, ParamSpec, TypeVar

from nanogs.threads import most_threads, usual_threads

if TYPE_CHECKING:
    from concurrent.futures import Executor, Future

_STARTING = 2e-5  # seconds that a call takes longer for each further thread that it starts
_TURN = 0.1  # seconds after which a thread returns from compiled code: interrupts wait for that

P = ParamSpec("P")
T = TypeVar("T")
R = TypeVar("R")


class ParallelKernel(Generic[P]):
    """A kernel `f(start, stop, *args)` that is called as `f(*args)`.

    The range is split into parts, which the threads of the pool take one after another.
    """

    def __init__(
        self,
        function: Callable[Concatenate[int, int, P], None],
        compiled: Callable[..., None],
        over: str,
        least: int,
        for_each: int,
    ) -> None:
        """Wrap a function and its compiled version: itself, or as `kernels/taking.py` compiles it.

        See `policy.parallel_kernel` for the other arguments.
        """
        self._compiled, self._takes = compiled, compiled is not function
        self._place = list(inspect.signature(function).parameters).index(over) - 2
        self._least, self._each = least, for_each
        self._timed, self._pace = 0, 0.0  # iterations of the latest call, and seconds of each
        self.__doc__ = function.__doc__

    @property
    def signatures(self) -> list[Any]:
        """The signatures that the kernel was compiled for."""
        return getattr(self._compiled, "signatures", [])

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> None:
        """Run the kernel over the whole range; takes its arguments after `stop`, by position."""
        assert not kwargs  # noqa: S101 - a kernel is called by position
        count = len(args[self._place])  # type: ignore[arg-type]
        most = self._most_threads(count, _threads())
        parts = max(1, min(most * self._each, count // self._least))
        left, turn = _Range(count, parts), self._turn(count, parts)
        seconds: list[float] = []

        def run(_: int) -> None:
            start = time.thread_time()  # without the time that the thread waits for the lock
            self._take(left, turn, args)
            seconds.append(time.thread_time() - start)

        threads = min(most, parts)
        _on(threads, range(threads), run)
        # Half of the pace before, at least: after an easy call the next may be as hard as ever.
        self._timed, self._pace = count, max(sum(seconds) / max(count, 1), self._pace / 2)

    def _take(self, left: "_Range", turn: int, args: tuple[Any, ...]) -> None:
        """Run parts until none is left; compiled code takes `turn` of them at a time."""
        try:
            if self._takes:
                while left:
                    self._compiled(left.address, turn, *args)
            else:
                for start, stop in left.taken():
                    self._compiled(start, stop, *args)
        except BaseException:
            left.drop()
            raise

    def _known(self, count: int) -> bool:
        """Return whether the latest call tells what each of `count` iterations will take.

        If it had many more, each of them may have been shorter.
        """
        return self._pace > 0 and count > 0 and count >= self._timed // 2

    def _most_threads(self, count: int, threads: int) -> int:
        """Return the number of threads for a call with `count` iterations.

        A call that takes W seconds on one thread takes W / t + t c on t threads, if starting one
        takes c. This is least for t = sqrt(W / c).
        """
        if not self._known(count):
            return threads
        return max(1, min(threads, math.isqrt(int(count * self._pace / _STARTING))))

    def _turn(self, count: int, parts: int) -> int:
        """Return the number of parts that a thread takes at a time; 1 if their time is unknown."""
        if not self._known(count):
            return 1
        # A coarse clock may make the pace so small that the quotient has no int64, or is infinite.
        return max(1, int(min(_TURN * parts / (count * self._pace), parts)))

    def here(self, *args: P.args, **kwargs: P.kwargs) -> None:
        """Run the whole range on this thread only, for use within work that is parallel already."""
        assert not kwargs  # noqa: S101 - as above
        self._take(_Range(len(args[self._place]), 1), 1, args)  # type: ignore[arg-type]


class _Range:
    """A range of iterations in parts of similar length, each of which is taken once.

    Threads may take parts at the same time, in Python or in compiled code; see `kernels/taking.py`.
    """

    def __init__(self, count: int, parts: int) -> None:
        self.parts = parts
        self._numbers, self._lock = array("q", (0, parts, count)), Lock()
        self.address, _ = self._numbers.buffer_info()

    def __bool__(self) -> bool:
        return self._numbers[0] < self.parts

    def taken(self) -> Iterator[tuple[int, int]]:
        """Take parts until none is left; each is its first iteration and the one after its last."""
        _, parts, count = self._numbers
        while True:
            with self._lock:
                part = self._numbers[0]
                self._numbers[0] += 1
            if part >= parts:
                return
            yield count * part // parts, count * (part + 1) // parts

    def drop(self) -> None:
        """Leave the parts that were not taken."""
        self._numbers[0] = self.parts


def for_each(parts: Iterable[T], work: Callable[[T], None]) -> None:
    """Call a function for each part, in any order, on all threads.

    This is for NumPy, which releases the GIL.

    Args:
        parts: Arguments of the calls, which must write to disjoint memory.
        work: Function that is called once for each part.
    """
    _on(_threads(), list(parts), work)


def map_ordered(parts: Iterable[T], work: Callable[[T], R]) -> list[R]:
    """Call a function for each part as `for_each` does, and return the results in order."""
    every = list(parts)
    found: dict[int, R] = {}

    def keep(number: int) -> None:
        found[number] = work(every[number])

    for_each(range(len(every)), keep)
    return [found[number] for number in range(len(every))]


def try_submit(pool: "Executor", work: Callable[..., R], *args: object) -> "Future[R] | None":
    """Submit work to a pool; None if the pool is shut down, and the caller must do the work itself.

    Python shuts down all pools when the main thread ends, while other threads may still work.
    """
    try:
        return pool.submit(work, *args)
    except RuntimeError as error:
        if "cannot schedule new futures" not in str(error):
            raise
        return None


class _Parts(Generic[T]):
    """A shared queue of parts of work, each of which is taken once by one of several threads."""

    def __init__(self, parts: Sequence[T], work: Callable[[T], None]) -> None:
        self._waiting, self._lock = list(reversed(parts)), Lock()
        self._work: Callable[[T], None] | None = work

    def work_on(self) -> None:
        """Process parts until none is left or one has failed in any thread."""
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
        """Discard parts not yet begun, and release their arrays: the pool may keep this object."""
        with self._lock:
            self._waiting.clear()
            self._work = None

    @contextmanager
    def closed(self) -> Iterator[None]:
        """Keep threads from starting before the end of the block, or at all if it raises."""
        with self._lock:
            try:
                yield
            except BaseException:
                self._waiting.clear()
                raise


def _on(threads: int, parts: Sequence[T], work: Callable[[T], None]) -> None:
    """Process parts with up to `threads` threads, including this one; all have finished on return.

    If this thread belongs to the pool, it works alone: otherwise all pool threads could wait for
    each other.
    """
    shared, more = _Parts(parts, work), 0 if _own.of_pool else min(threads, len(parts)) - 1
    others: list[Future[None]] = []
    try:
        # If submitting fails, threads that had started already would not be waited for.
        with shared.closed():
            called = (try_submit(_pool(), shared.work_on) for _ in range(more))
            others = [other for other in called if other is not None]
        shared.work_on()
        failures = _ended(others)
        shared.drop()
    except BaseException:  # such as an interrupt while waiting for other threads
        shared.drop()
        _ended(others)
        raise
    if failures:
        raise failures[0]


def _ended(others: "Sequence[Future[None]]") -> list[BaseException]:
    """Wait for the threads that have started, cancel the others, and return the exceptions."""
    failures = [other.exception() for other in others if not other.cancel()]
    return [failure for failure in failures if failure is not None]


class _Own(local):
    """Thread-local flag: whether the thread belongs to the pool."""

    of_pool = False

    def join(self) -> None:
        """Mark this thread as one of the pool."""
        self.of_pool = True


_own = _Own()


@cache
def _pool() -> "ThreadPoolExecutor":
    return ThreadPoolExecutor(most_threads(), initializer=_own.join)


def _threads() -> int:
    """Return the number of threads that Numba uses, or `usual_threads()` if it is not imported.

    Files are read and written without Numba.
    """
    found = getattr(sys.modules.get("numba"), "get_num_threads", usual_threads)()
    return int(found)


# A forked process inherits the pool without its threads, and would wait for them for ever.
if hasattr(os, "register_at_fork"):  # not on Windows, where nothing forks
    os.register_at_fork(after_in_child=_pool.cache_clear)

"""The number of processors and threads, and the number that kernels use."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

from nanogs.control_groups import processor_quota
from nanogs.errors import RangeError
from nanogs.ranges import is_number


def processors() -> int:
    """Return the number of processors whose time this process may use.

    More threads than the quota of the control group allows are only throttled.
    """
    return min(_assigned(), _quota() or _assigned())


def most_threads() -> int:
    """Return the number of threads of Numba's pool without the slow import of Numba."""
    return _asked() or _assigned()


def usual_threads() -> int:
    """Return the number of threads that are used if the caller asks for none."""
    return _asked() or processors()


def _assigned() -> int:
    """Return the number of processors that this process may run on."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS and Windows
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _asked() -> int:
    asked = os.environ.get("NUMBA_NUM_THREADS", "")
    return int(asked) if asked.isdecimal() else 0


@cache
def _quota() -> int | None:
    return processor_quota()


@contextmanager
def use_threads(threads: int | None) -> Iterator[int]:
    """Run the kernels in the block on a number of threads; None for the usual number.

    Yields:
        The number in use.

    Raises:
        RangeError: Fewer than one, or more than the machine offers.
    """
    import numba
    from numba.core import config

    most = int(config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
    chosen = min(most, usual_threads()) if threads is None else threads
    if not is_number(chosen, whole=True):
        raise RangeError("threads", "threads", f"must be a whole number, not {chosen!r}")
    if not 1 <= chosen <= most:
        raise RangeError(
            "threads", "threads", f"must be from 1 to {most} on this machine, not {chosen}"
        )
    before, chosen = numba.get_num_threads(), int(chosen)  # converts a NumPy integer
    numba.set_num_threads(chosen)
    try:
        yield chosen
    finally:
        numba.set_num_threads(before)

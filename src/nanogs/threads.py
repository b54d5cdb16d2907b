"""How many threads there are, and how many of them the kernels use."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

from nanogs.errors import OptionError
from nanogs.ranges import is_number


def processors() -> int:
    """How many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS and Windows
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def most_threads() -> int:
    """How many threads Numba has, told without its import, which takes a while."""
    asked = os.environ.get("NUMBA_NUM_THREADS", "")
    return int(asked) if asked.isdecimal() and int(asked) else processors()


@contextmanager
def use_threads(threads: int | None) -> Iterator[int]:
    """Run the block's kernels on so many threads; None takes all that Numba has.

    Yields:
        The number in use.

    Raises:
        OptionError: Fewer than one, or more than the machine offers.
    """
    import numba
    from numba.core import config

    most = int(config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
    chosen = most if threads is None else threads
    if not is_number(chosen, whole=True):
        raise OptionError(f"threads must be a whole number, not {chosen!r}.")
    if not 1 <= chosen <= most:
        raise OptionError(f"threads must be from 1 to {most} on this machine, not {chosen}.")
    before, chosen = numba.get_num_threads(), int(chosen)  # which may be a number of NumPy
    numba.set_num_threads(chosen)
    try:
        yield chosen
    finally:
        numba.set_num_threads(before)

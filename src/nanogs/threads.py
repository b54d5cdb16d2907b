"""How many threads the kernels use."""

from collections.abc import Iterator
from contextlib import contextmanager

from nanogs.errors import OptionError


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
    if not 1 <= chosen <= most:
        raise OptionError(f"threads must be from 1 to {most} on this machine, not {chosen}.")
    before = numba.get_num_threads()
    numba.set_num_threads(chosen)
    try:
        yield chosen
    finally:
        numba.set_num_threads(before)

"""Imports without the search for garbage."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def uncollected() -> Iterator[None]:
    """Import in the block, and never search what it made for garbage.

    Modules make many objects and drop next to none. Python searches them all the same, again and
    again as they become more: a sixth of the time that importing Numba takes.
    """
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()

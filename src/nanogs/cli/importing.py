"""Imports without garbage collection."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def without_gc() -> Iterator[None]:
    """Disable garbage collection within the context, and exclude its objects from later ones.

    Imports create many objects and free hardly any, so that the repeated collections find nothing:
    they are a sixth of the time of importing Numba.
    """
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()

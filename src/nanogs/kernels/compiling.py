"""Whom to tell when a kernel is compiled rather than taken from the cache; imports no Numba."""

from collections.abc import Callable

_waiting: list[Callable[[], None]] = []


def when_compiling(callback: Callable[[], None]) -> None:
    """Have a function called once, should a kernel not be in the cache and so take seconds."""
    _waiting.append(callback)


def tell() -> None:
    """Call all that wait, and forget them."""
    while _waiting:
        _waiting.pop()()

"""The value of the latest call, kept for the next one with the same arguments."""

from collections.abc import Callable
from typing import Any, Generic, TypeVar

V = TypeVar("V")


class Latest(Generic[V]):
    """Keeps one value: a search asks several times about one result, and never again later."""

    def __init__(self) -> None:
        self._kept: tuple[tuple[Any, ...], V] | None = None

    def of(self, arguments: tuple[Any, ...], compute: Callable[[], V]) -> V:
        """Return the kept value if its arguments were equal, else compute and keep a new one."""
        if self._kept is None or self._kept[0] != arguments:
            self._kept = arguments, compute()
        return self._kept[1]

"""Kernels on disk, loaded without what only a compiler needs.

Numba gathers all that it can compile before it so much as looks for a kernel on disk, and that
takes it longer than to load all of ours; it gathers it again before it compiles.
"""

from collections.abc import Callable
from functools import cached_property
from typing import Any, TypeVar, cast

import numba
from numba.core.caching import FunctionCache
from numba.core.runtime.nrt import rtsys

Kernel = TypeVar("Kernel", bound=Callable[..., Any])


def cached(function: Kernel, **options: Any) -> Kernel:  # noqa: ANN401 - Numba's own
    """Have Numba compile a function when it is called, unless it is on disk, where it is kept."""
    compiled = numba.njit(function, **options)
    if compiled is not function:  # as it is with NUMBA_DISABLE_JIT=1
        compiled._cache = _Cache(function)  # noqa: SLF001 - what `cache=True` sets
    return cast("Kernel", compiled)


class _Cache:
    """A kernel's place on disk, found when the kernel is first called: many never are."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    @cached_property
    def _disk(self) -> Any:  # noqa: ANN401
        return FunctionCache(self._function)  # type: ignore[no-untyped-call]

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401
        return getattr(self._disk, name)

    def load_overload(self, sig: Any, target_context: Any) -> Any:  # noqa: ANN401
        """What is kept for a signature, or None; under Numba's lock, as all that compiles."""
        rtsys.initialize(target_context)  # for the arrays that it makes
        target_context.refresh = lambda: None
        try:
            return self._disk.load_overload(sig, target_context)
        finally:
            vars(target_context).pop("refresh", None)

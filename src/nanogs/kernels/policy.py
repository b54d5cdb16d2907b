"""The one place for compile options of every kernel.

No flag assumes that NaN or infinity are absent (`nnan`, `ninf` stay out): infinite opacities are
data. `error_model="numpy"` divides as IEEE does; kernels guard their divisions all the same, so
that they also run with `NUMBA_DISABLE_JIT=1`.
"""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
from numba.core import event

Kernel = TypeVar("Kernel", bound=Callable[..., Any])

FASTMATH = {"nsz", "arcp", "contract", "reassoc"}


def kernel(function: Kernel) -> Kernel:
    """Compile a serial kernel, cached on disk."""
    options: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy"}
    return cast("Kernel", numba.njit(function, fastmath=FASTMATH, **options))


def parallel_kernel(function: Kernel) -> Kernel:
    """Compile a kernel whose `numba.prange` loops run on all threads, cached on disk.

    Each iteration must write to places of its own: results then do not depend on the thread count.
    """
    options: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy"}
    return cast("Kernel", numba.njit(function, parallel=True, fastmath=FASTMATH, **options))


def inline(function: Kernel) -> Kernel:
    """Compile a small function that LLVM is to inline into the kernels that call it."""
    options: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy"}
    return cast("Kernel", numba.njit(function, fastmath=FASTMATH, forceinline=True, **options))


def exact_parallel_kernel(function: Kernel) -> Kernel:
    """Compile a parallel kernel whose floating-point operations are those written, as in IEEE."""
    options: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy"}
    return cast("Kernel", numba.njit(function, parallel=True, **options))


def exact_inline(function: Kernel) -> Kernel:
    """Compile a small function to be inlined, without any liberty: for `exact_parallel_kernel`."""
    options: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy"}
    return cast("Kernel", numba.njit(function, forceinline=True, **options))


class _First(event.Listener):
    """Calls back when the first function is compiled rather than taken from the cache."""

    def __init__(self, callback: Callable[[], None]) -> None:
        self.callback: Callable[[], None] | None = callback

    def on_start(self, event: event.Event) -> None:
        del event
        if self.callback is not None:
            callback, self.callback = self.callback, None
            callback()

    def on_end(self, event: event.Event) -> None:
        del event


def when_compiling(callback: Callable[[], None]) -> None:
    """Have a function called once, should a kernel not be in the cache and so take seconds."""
    event.register("numba:compile", _First(callback))  # type: ignore[no-untyped-call]

"""The one place for compile options of every kernel.

No flag assumes that NaN or infinity are absent (`nnan`, `ninf` stay out): infinite opacities are
data. `error_model="numpy"` divides as IEEE does; kernels guard their divisions all the same, so
that they also run with `NUMBA_DISABLE_JIT=1`.
"""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
from numba.core import event

from nanogs.kernels.compiling import tell

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


class _Listener(event.Listener):
    """Passes on that something is compiled; what the cache holds makes no such event."""

    def on_start(self, event: event.Event) -> None:
        del event
        tell()

    def on_end(self, event: event.Event) -> None:
        del event


event.register("numba:compile", _Listener())  # type: ignore[no-untyped-call]

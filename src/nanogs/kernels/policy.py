"""The one place for compile options of every kernel.

No flag assumes that NaN or infinity are absent (`nnan`, `ninf` stay out): infinite opacities are
data. `error_model="numpy"` divides as IEEE does; kernels guard their divisions all the same, so
that they also run with `NUMBA_DISABLE_JIT=1`.
"""

from collections.abc import Callable
from functools import wraps
from importlib import import_module
from typing import Any, Concatenate, ParamSpec, TypeVar, cast

import numpy as np
from numba.core import event
from numba.extending import overload

from nanogs import spread
from nanogs.kernels import compiling
from nanogs.kernels.cached import TWO_WAYS, cached
from nanogs.kernels.inlined import OPTIONS, inlined
from nanogs.kernels.simd.choice import Way, chosen

Kernel = TypeVar("Kernel", bound=Callable[..., Any])
P = ParamSpec("P")
Ranged = Callable[Concatenate[int, int, P], None]

FASTMATH = {"nsz", "arcp", "contract", "reassoc"}
# Numba wraps a function for callers in C: there are none, and it is quicker to compile without.
CALLED: dict[str, Any] = {
    "nogil": True,
    "error_model": "numpy",
    "no_cfunc_wrapper": True,
}


def kernel(function: Kernel) -> Kernel:
    """Compile a serial kernel, cached on disk."""
    return cached(function, fastmath=FASTMATH, **CALLED)


def exact_kernel(function: Kernel) -> Kernel:
    """Compile a serial kernel whose floating-point operations are those written, as in IEEE."""
    return cached(function, **CALLED)


def parallel_kernel(
    over: str, least: int = 1024, each: int = 8
) -> Callable[[Ranged[P]], spread.Spread[P]]:
    """Compile a kernel whose ranges run on all threads, cached on disk.

    It takes the range [start, stop) first, which its callers leave to `nanogs.spread`. What it
    does for one number of the range must not touch what it does for another: results then do not
    depend on the thread count.

    Args:
        over: The argument that the range numbers the rows of.
        least: Numbers that are worth a range of their own.
        each: Ranges for each thread, so that none waits long for the others.
    """

    def compiled(function: Ranged[P]) -> spread.Spread[P]:
        return spread.Spread(function, kernel(function), over, least, each)

    return compiled


def exact_parallel_kernel(
    over: str, least: int = 1024, each: int = 8
) -> Callable[[Ranged[P]], spread.Spread[P]]:
    """As `parallel_kernel`; its floating-point operations are those written, as in IEEE."""

    def compiled(function: Ranged[P]) -> spread.Spread[P]:
        return spread.Spread(function, exact_kernel(function), over, least, each)

    return compiled


def inline(function: Kernel) -> Kernel:
    """Compile a small function that LLVM is to inline into the kernels that call it."""
    return inlined(function, fastmath=FASTMATH, **CALLED)


def exact_inline(function: Kernel) -> Kernel:
    """Compile a small function to be inlined, without any liberty: for the exact kernels."""
    return inlined(function, **CALLED)


def two_ways(function: Kernel) -> Kernel:
    """Compile a small function as vectors of `nanogs.kernels.simd`, or as it is written here.

    The former is the function of the same name in the module of the same name there. Which it is,
    `simd/choice.py` says for all.
    """
    return _two_ways(function, fastmath=FASTMATH, **CALLED)


def exact_two_ways(function: Kernel) -> Kernel:
    """As `two_ways`; its floating-point operations are those written, as in IEEE."""
    return _two_ways(function, **CALLED)


def _two_ways(function: Kernel, **options: Any) -> Kernel:  # noqa: ANN401 - Numba's own
    given: Any = options | OPTIONS  # of the type that Numba keeps for itself

    @wraps(function)
    def python(*args: Any) -> Any:  # noqa: ANN401 - of any kernel
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # as compiled
            return function(*args)

    def implementation(*args: Any) -> Callable[..., Any]:  # noqa: ANN401 - types of Numba's
        del args
        if chosen() is Way.PLAIN:
            return function
        name = function.__module__.rpartition(".")[2]
        operation = getattr(import_module(f"nanogs.kernels.simd.{name}"), function.__name__)

        def body(*args: Any) -> Any:  # noqa: ANN401
            return operation(*args)

        return body

    setattr(python, TWO_WAYS, True)
    overload(python, jit_options=given, strict=False)(implementation)
    return cast("Kernel", python)


class _Listener(event.Listener):
    """Passes on when something is compiled; what the cache holds makes no such event."""

    def on_start(self, event: event.Event) -> None:
        del event
        compiling.begin()

    def on_end(self, event: event.Event) -> None:
        del event
        compiling.end()


event.register("numba:compile", _Listener())  # type: ignore[no-untyped-call]

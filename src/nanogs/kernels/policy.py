"""Decorators for kernels, and the compile options of all of them.

No flag assumes that NaN or infinity are absent (`nnan` and `ninf` are not set), because infinite
opacities are valid data. `error_model="numpy"` divides as IEEE does; kernels guard their divisions
nevertheless, so that they also run with `NUMBA_DISABLE_JIT=1`.
"""

from collections.abc import Callable
from functools import wraps
from importlib import import_module
from typing import Any, Concatenate, ParamSpec, TypeVar, cast

import numpy as np
from numba.core import event
from numba.extending import overload

from nanogs import parallel
from nanogs.kernels import compiling
from nanogs.kernels.cached import SIMD_OR_PLAIN, cached, savable
from nanogs.kernels.inlined import OPTIONS, inlined
from nanogs.kernels.simd.choice import Way, chosen
from nanogs.kernels.taking import taking

Kernel = TypeVar("Kernel", bound=Callable[..., Any])
P = ParamSpec("P")
Ranged = Callable[Concatenate[int, int, P], None]

FASTMATH = {"nsz", "arcp", "contract", "reassoc"}
# No wrapper for callers in C, because there are none, and compiling is faster without it.
CALLED: dict[str, Any] = {
    "nogil": True,
    "error_model": "numpy",
    "no_cfunc_wrapper": True,
}


def kernel(function: Kernel) -> Kernel:
    """Compile a serial kernel, cached on disk."""
    return cached(function, fastmath=FASTMATH, **CALLED)


def exact_kernel(function: Kernel) -> Kernel:
    """Compile a serial kernel with strict IEEE floating point: nothing is reordered or fused."""
    return cached(function, **CALLED)


def parallel_kernel(
    over: str, least: int = 1024, each: int = 16
) -> Callable[[Ranged[P]], parallel.ParallelKernel[P]]:
    """Compile a kernel whose ranges run on all threads, cached on disk.

    Its first two arguments are the range [start, stop), which `nanogs.parallel` adds to those of
    the caller. Iterations must not write to the same places, so that results do not depend on the
    number of threads.

    Args:
        over: The argument whose rows are iterated over.
        least: Least number of iterations in a range.
        each: Ranges for each thread, so that none waits long for the others.
    """
    return _parallel(over, least, each, fastmath=FASTMATH)


def exact_parallel_kernel(
    over: str, least: int = 1024, each: int = 16
) -> Callable[[Ranged[P]], parallel.ParallelKernel[P]]:
    """Compile as `parallel_kernel` does, with strict IEEE floating point."""
    return _parallel(over, least, each)


def _parallel(
    over: str,
    least: int,
    each: int,
    **options: Any,  # noqa: ANN401 - Numba's own
) -> Callable[[Ranged[P]], parallel.ParallelKernel[P]]:
    def wrapped(function: Ranged[P]) -> parallel.ParallelKernel[P]:
        compiled = taking(function, **CALLED, **options)
        return parallel.ParallelKernel(function, compiled, over, least, each)

    return wrapped


def inline(function: Kernel) -> Kernel:
    """Mark a small function to be inlined into the kernels that call it."""
    return inlined(function, fastmath=FASTMATH, **CALLED)


def exact_inline(function: Kernel) -> Kernel:
    """Mark a small function to be inlined, with strict IEEE floating point, for exact kernels."""
    return inlined(function, **CALLED)


def allocating_inline(function: Kernel) -> Kernel:
    """Mark a small function to be inlined that only makes arrays, which the others must not."""
    return inlined(function, allocates=True, **CALLED)


def simd_or_plain(function: Kernel) -> Kernel:
    """Compile a small function as vectors of `nanogs.kernels.simd`, or as it is written.

    The vector version is the function of the same name in the module of the same name there.
    `simd/choice.py` makes the choice for all functions.
    """
    return _simd_or_plain(function, fastmath=FASTMATH, **CALLED)


def exact_simd_or_plain(function: Kernel) -> Kernel:
    """Compile as `simd_or_plain` does, with strict IEEE floating point."""
    return _simd_or_plain(function, **CALLED)


def _simd_or_plain(function: Kernel, **options: Any) -> Kernel:  # noqa: ANN401 - Numba's own
    given: Any = options | OPTIONS  # `Any`, because Numba does not export the type

    @wraps(function)
    def python(*args: Any) -> Any:  # noqa: ANN401 - of any kernel
        # Compiled kernels give no such warnings.
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
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

    setattr(python, SIMD_OR_PLAIN, True)
    overload(python, jit_options=given, strict=False)(implementation)
    return cast("Kernel", python)


class _Listener(event.Listener):
    """Forwards Numba's compile events to `compiling`; loading from the cache makes none."""

    def on_start(self, event: event.Event) -> None:
        dispatcher = (event.data or {}).get("dispatcher")
        compiling.begin(savable=savable(getattr(dispatcher, "_cache", None)))

    def on_end(self, event: event.Event) -> None:
        del event
        compiling.end()


event.register("numba:compile", _Listener())  # type: ignore[no-untyped-call]

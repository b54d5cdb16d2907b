"""Small functions without machine code of their own: they are only inlined into kernels.

Numba optimises each function that it compiles, turns it into machine code and wraps it for Python.
For a function that is inlined into all its callers this is done again with each caller, and its own
machine code is never used: that took a fifth of the time of compiling.

If floating-point operations may be reordered and fused, results depend on whether a function was
optimised before it was inlined. So such functions are still optimised by themselves, and the last
bits of results stay the same.
"""

from collections.abc import Callable
from functools import cached_property
from typing import Any, TypeVar, cast

from numba.core import config, registry
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler

from nanogs.kernels.cached import cached

Kernel = TypeVar("Kernel", bound=Callable[..., Any])


class _Source(JITCodeLibrary):
    """The LLVM code of a function that is only inlined; it cannot be run."""

    liberal = False  # whether floating-point operations may be reordered

    def _optimize_functions(self, ll_module: Any) -> None:  # noqa: ANN401 - Numba's own
        """Run Numba's function passes, but not on the many functions that are only declared."""
        codegen = self._codegen
        ll_module.data_layout = codegen._data_layout  # noqa: SLF001
        for function in ll_module.functions:
            if not function.is_declaration:
                passes, builder = codegen._function_pass_manager()  # type: ignore[no-untyped-call] # noqa: SLF001
                passes.run(function, builder)

    def _optimize_final_module(self) -> None:
        """Optimise only if `liberal`; otherwise optimising the caller gives the same result."""
        if self.liberal:
            super()._optimize_final_module()  # type: ignore[no-untyped-call]

    def _finalize_final_module(self) -> None:
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """Return 0, because there is no machine code."""
        del name
        self._ensure_finalized()  # type: ignore[no-untyped-call]
        return 0

    @property
    def codegen(self) -> "_Source":
        """This object, whose `set_env` drops the environment, which only machine code needs."""
        return self

    def set_env(self, name: str, environment: object) -> None:
        """Ignore the environment, because nothing reads it."""


class SourceCompiler(Compiler):
    """Numba's compiler, stopped before machine code is made."""

    def compile_extra(self, func: Callable[..., Any]) -> Any:  # noqa: ANN401
        """Compile one function."""
        codegen = self.state.targetctx.codegen()
        self.state.library = _Source(codegen, func.__qualname__)  # type: ignore[no-untyped-call]
        self.state.library.liberal = bool(self.state.flags.fastmath)
        return super().compile_extra(func)  # type: ignore[no-untyped-call]


# Options of Numba's decorators for functions that are inlined.
OPTIONS: dict[str, Any] = {
    "forceinline": True,
    "no_cpython_wrapper": True,
    "pipeline_class": SourceCompiler,
}


class _Inlined(registry.CPUDispatcher):
    """A function that kernels inline; if Python calls it, as tests do, it is compiled by itself.

    Then it may also take arrays in place of numbers, and make new ones.
    """

    @cached_property
    def _alone(self) -> Callable[..., Any]:
        options = self.targetoptions | {"no_cpython_wrapper": False, "_nrt": True}
        del options["nopython"]
        return cached(self.py_func, **options)

    def __call__(self, *args: Any) -> Any:  # noqa: ANN401
        return self._alone(*args)


def inlined(function: Kernel, *, allocates: bool = False, **options: Any) -> Kernel:  # noqa: ANN401
    """Mark a function to be inlined into the kernels that call it, and compiled nowhere else.

    Args:
        function: The function.
        allocates: Whether it makes arrays. If not, it counts no references to arrays, because its
            caller holds them all. Threads would wait for each other's counting at every call.
        options: Options of Numba's decorators.
    """
    if config.DISABLE_JIT:  # type: ignore[attr-defined]
        return function
    given = options | OPTIONS | {"nopython": True, "boundscheck": None, "_nrt": allocates}
    compiler = given.pop("pipeline_class")
    return cast("Kernel", _Inlined(function, targetoptions=given, pipeline_class=compiler))

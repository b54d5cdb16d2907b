"""Small functions of which Numba makes no machine code: they exist in the kernels that call them.

What Numba compiles it optimises whole, turns into machine code and wraps for Python. For a function
that is inlined wherever it is called all this is done again with its caller, and alone it is done
for nobody: a fifth of what compiling took.

Where floating-point operations may be reordered and fused, what comes of them depends on what was
optimised before it was inlined. So such functions are optimised alone all the same: last bits stay
as they were.
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
    """A function's code for LLVM to inline; nothing can run it."""

    liberal = False  # whether floating-point operations may be reordered

    def _optimize_functions(self, ll_module: Any) -> None:  # noqa: ANN401 - Numba's own
        """Tidy up as Numba does, but not the many functions that are only named."""
        codegen = self._codegen
        ll_module.data_layout = codegen._data_layout  # noqa: SLF001
        for function in ll_module.functions:
            if not function.is_declaration:
                passes, builder = codegen._function_pass_manager()  # type: ignore[no-untyped-call] # noqa: SLF001
                passes.run(function, builder)

    def _optimize_final_module(self) -> None:
        """Leave it to who inlines it, where that comes to the same."""
        if self.liberal:
            super()._optimize_final_module()  # type: ignore[no-untyped-call]

    def _finalize_final_module(self) -> None:
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """None: there is no machine code."""
        del name
        self._ensure_finalized()  # type: ignore[no-untyped-call]
        return 0

    @property
    def codegen(self) -> "_Source":
        """Who is told of the function's environment, which only machine code has."""
        return self

    def set_env(self, name: str, environment: object) -> None:
        """Nobody looks for it."""


class SourceCompiler(Compiler):
    """Numba's compiler, up to the code for LLVM."""

    def compile_extra(self, func: Callable[..., Any]) -> Any:  # noqa: ANN401
        """Compile one function."""
        codegen = self.state.targetctx.codegen()
        self.state.library = _Source(codegen, func.__qualname__)  # type: ignore[no-untyped-call]
        self.state.library.liberal = bool(self.state.flags.fastmath)
        return super().compile_extra(func)  # type: ignore[no-untyped-call]


# For Numba's decorators, of what is inlined.
OPTIONS: dict[str, Any] = {
    "forceinline": True,
    "no_cpython_wrapper": True,
    "pipeline_class": SourceCompiler,
}


class _Inlined(registry.CPUDispatcher):
    """A function that kernels inline; called from Python, as by tests, it is compiled alone."""

    @cached_property
    def _alone(self) -> Callable[..., Any]:
        options = self.targetoptions | {"no_cpython_wrapper": False}
        del options["nopython"]
        return cached(self.py_func, **options)

    def __call__(self, *args: Any) -> Any:  # noqa: ANN401
        return self._alone(*args)


def inlined(function: Kernel, **options: Any) -> Kernel:  # noqa: ANN401
    """Have a function inlined into the kernels that call it, and compiled nowhere else."""
    if config.DISABLE_JIT:  # type: ignore[attr-defined]
        return function
    given = options | OPTIONS | {"nopython": True, "boundscheck": None}
    compiler = given.pop("pipeline_class")
    return cast("Kernel", _Inlined(function, targetoptions=given, pipeline_class=compiler))

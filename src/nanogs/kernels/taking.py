"""Kernels that take parts of a range from a counter, which several threads share.

Python's lock (GIL) is needed to call a kernel. If threads call it once for each part of a range,
they wait for each other's calls; the more threads, the longer. So a compiled kernel takes its parts
itself: its entry point from Python repeats it, with one atomic addition for each part.
"""

from collections.abc import Callable
from typing import Any, TypeVar, cast

from llvmlite import ir
from numba.core.callwrapper import PyCallWrapper
from numba.core.compiler import Compiler

from nanogs.kernels.cached import cached

Kernel = TypeVar("Kernel", bound=Callable[..., Any])

_INT = ir.IntType(64)
_START, _STOP = 2, 3  # places of these two among the arguments of compiled code


def taking(function: Kernel, **options: Any) -> Kernel:  # noqa: ANN401 - Numba's own
    """Compile a kernel `f(start, stop, *args)` to be called as `f(address, most, *args)`.

    At the address there are three int64: the number of the next part, the number of parts, and the
    number of iterations. A call takes at most `most` parts, and returns if none is left.
    """
    return cached(function, pipeline_class=_TakingCompiler, **options)


class _TakingCompiler(Compiler):
    """Numba's compiler with `_add_entry` in place of its own wrapper for Python."""

    def compile_extra(self, func: Callable[..., Any]) -> Any:  # noqa: ANN401 - Numba's own
        """Compile one function."""
        context: Any = self.state.targetctx

        def create(*args: Any, **kwargs: Any) -> None:  # noqa: ANN401
            _add_entry(context, *args, **kwargs)

        self.state.targetctx = context.subtarget(create_cpython_wrapper=create)
        return super().compile_extra(func)  # type: ignore[no-untyped-call]


def _add_entry(
    context: Any,  # noqa: ANN401
    library: Any,  # noqa: ANN401
    description: Any,  # noqa: ANN401
    env: Any,  # noqa: ANN401
    call_helper: Any,  # noqa: ANN401
    release_gil: bool = False,
) -> None:
    """Add the kernel's entry point from Python to its library; it calls `_repeated`."""
    module = context.create_module("wrapper")
    types = context.call_conv.get_function_type(description.restype, description.argtypes)
    kernel = ir.Function(module, types, description.llvm_func_name)
    repeated = _repeated(module, kernel)
    wrapper = PyCallWrapper(context, module, repeated, description, env, call_helper, release_gil)  # type: ignore[no-untyped-call]
    wrapper.build()  # type: ignore[no-untyped-call]
    library.add_ir_module(module)


def _repeated(module: ir.Module, kernel: ir.Function) -> ir.Function:
    """Return a function that calls the kernel for each part that it takes from the counter.

    A status other than 0, of an exception, is returned at once.
    """
    function = ir.Function(module, kernel.function_type, f"{kernel.name}.repeated")
    function.linkage = "internal"
    entry, take, run, done = (
        function.append_basic_block(name) for name in ("entry", "take", "run", "done")
    )
    status = kernel.function_type.return_type

    builder = ir.IRBuilder(entry)
    counter = builder.inttoptr(function.args[_START], _INT.as_pointer())
    parts, count = (
        builder.load(builder.gep(counter, [ir.Constant(_INT, place)])) for place in (1, 2)
    )
    builder.branch(take)

    builder.position_at_end(take)
    left = builder.phi(_INT)
    left.add_incoming(function.args[_STOP], entry)
    some = builder.icmp_signed(">", left, ir.Constant(_INT, 0))
    builder.cbranch(some, run, done)

    builder.position_at_end(run)
    part = builder.atomic_rmw("add", counter, ir.Constant(_INT, 1), "monotonic")
    with builder.if_then(builder.icmp_signed(">=", part, parts), likely=False):
        builder.ret(ir.Constant(status, 0))
    start, stop = (
        builder.sdiv(builder.mul(count, number), parts)
        for number in (part, builder.add(part, ir.Constant(_INT, 1)))
    )
    args = list(function.args)
    args[_START], args[_STOP] = start, stop
    returned = builder.call(kernel, args, attrs=("noinline",))
    with builder.if_then(builder.icmp_signed("!=", returned, ir.Constant(status, 0)), likely=False):
        builder.ret(returned)
    left.add_incoming(builder.sub(left, ir.Constant(_INT, 1)), builder.block)
    builder.branch(take)

    builder.position_at_end(done)
    builder.ret(ir.Constant(status, 0))
    return cast("ir.Function", function)

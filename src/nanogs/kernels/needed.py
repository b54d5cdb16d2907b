"""Which kernels runs need, and for which types: `signatures.txt`, in the order of their need.

So that they can be compiled without a model, in any order and in several processes.
"""

from dataclasses import dataclass
from importlib import import_module
from importlib.resources import files
from typing import Any

from numba.core import sigutils

PRESETS = {"f": "fast", "d": "default", "p": "paper"}  # as the table marks them


@dataclass(frozen=True, slots=True)
class Needed:
    """A kernel for some types of its arguments.

    Attributes:
        name: Of the module in this package and of the function, such as `radix.radix_sort`.
        types: Of the arguments, such as `(uint64[::1], uint64[::1])`.
        presets: Those that need it.
    """

    name: str
    types: str
    presets: frozenset[str]

    @property
    def _kernel(self) -> Any:  # noqa: ANN401 - Numba's own
        module, _, function = self.name.rpartition(".")
        value = getattr(import_module(f"nanogs.kernels.{module}"), function)
        return getattr(value, "_compiled", value)

    @property
    def _signature(self) -> Any:  # noqa: ANN401 - as above
        types, _ = sigutils.normalize_signature(self.types)  # type: ignore[no-untyped-call]
        return types

    @property
    def processor(self) -> str:
        """Which it is compiled for, as LLVM names it: kernels for others are kept apart."""
        _system, name, _features = self._kernel.targetctx.codegen().magic_tuple()
        return str(name)

    @property
    def folder(self) -> str:
        """Where it is kept, or would be."""
        return str(self._kernel._cache.cache_path)  # noqa: SLF001

    def held(self) -> bool:
        """Whether it is on the disk."""
        kernel = self._kernel
        return bool(kernel._cache.holds(self._signature, kernel.targetctx.codegen()))  # noqa: SLF001

    def compile(self, *, wait: bool = True) -> bool:
        """Compile it and keep it, unless it is on the disk.

        Args:
            wait: For another process that compiles it; otherwise it is left to that one.

        Returns:
            Whether it was compiled here.
        """
        kernel = self._kernel
        if self.held() or not (wait or kernel._cache.free()):  # noqa: SLF001
            return False
        kernel.compile(self._signature)
        return not kernel.stats.cache_hits


def needed(preset: str | None = None) -> list[Needed]:
    """The kernels that a preset needs, those that it needs first first; by default all."""
    text = files("nanogs.kernels").joinpath("signatures.txt").read_text(encoding="utf-8")
    found = []
    for line in text.splitlines():
        if line and not line.startswith("#"):
            marks, _, rest = line.partition(" ")
            name, opened, types = rest.partition("(")
            presets = frozenset(PRESETS[mark] for mark in marks if mark in PRESETS)
            found.append(Needed(name, opened + types, presets))
    return [one for one in found if preset is None or preset in one.presets]

"""The kernels that runs need, with their argument types, from `signatures.txt` in order of use.

Thus kernels can be compiled without a model, in any order and in several processes.
"""

from dataclasses import dataclass
from importlib import import_module
from importlib.resources import files
from typing import Any

from numba.core import sigutils

PRESETS = {"f": "fast", "d": "default", "p": "paper"}  # by their mark in the table


@dataclass(frozen=True, slots=True)
class Needed:
    """A kernel to be compiled for given argument types.

    Attributes:
        name: Module in this package and function, such as `radix.radix_sort`.
        types: Types of the arguments, such as `(uint64[::1], uint64[::1])`.
        presets: The presets that need it.
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
        """LLVM's name of the processor it is compiled for; each has its own cache entry."""
        _system, name, _features = self._kernel.targetctx.codegen().magic_tuple()
        return str(name)

    @property
    def folder(self) -> str:
        """The folder of the disk cache that it is in, or would be."""
        return str(self._kernel._cache.cache_path)  # noqa: SLF001

    def held(self) -> bool:
        """Return whether it is in the cache on disk."""
        kernel = self._kernel
        return bool(kernel._cache.holds(self._signature, kernel.targetctx.codegen()))  # noqa: SLF001

    def compile(self, *, wait: bool = True) -> bool:
        """Compile it into the cache on disk, unless it is there.

        Args:
            wait: Whether to wait if another process is compiling it; otherwise return at once.

        Returns:
            Whether it was compiled here.
        """
        kernel = self._kernel
        if self.held() or not (wait or kernel._cache.free()):  # noqa: SLF001
            return False
        kernel.compile(self._signature)
        return not kernel.stats.cache_hits


def needed(preset: str | None = None) -> list[Needed]:
    """Return the kernels that a preset needs, in order of use; by default all kernels."""
    text = files("nanogs.kernels").joinpath("signatures.txt").read_text(encoding="utf-8")
    found = []
    for line in text.splitlines():
        if line and not line.startswith("#"):
            marks, _, rest = line.partition(" ")
            name, opened, types = rest.partition("(")
            presets = frozenset(PRESETS[mark] for mark in marks if mark in PRESETS)
            found.append(Needed(name, opened + types, presets))
    return [one for one in found if preset is None or preset in one.presets]

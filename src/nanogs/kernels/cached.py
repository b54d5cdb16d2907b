"""Kernels on disk: kept while no kernel's source changes, and loaded without a compiler's tools.

Numba keys what it keeps by the file of the function that is called. Kernels inline helpers of other
files, so here the key covers the sources of them all. Processes that start at once compile nothing
twice: who needs what another compiles waits for it.
"""

import hashlib
import os
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, cached_property, wraps
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar, cast

import numba
from numba.core import caching, config
from numba.core.runtime.nrt import rtsys

from nanogs.kernels import compiling
from nanogs.kernels.simd.choice import chosen

try:
    import fcntl
except ImportError:  # Windows: each process compiles for itself
    fcntl = None  # type: ignore[assignment]

Kernel = TypeVar("Kernel", bound=Callable[..., Any])
TWO_WAYS = "two_ways"  # set on functions of which `policy` makes vectors or plain code


def cached(function: Kernel, **options: Any) -> Kernel:  # noqa: ANN401 - Numba's own
    """Have Numba compile a function when it is called, unless it is on disk, where it is kept."""
    compiled = numba.njit(function, **options)
    if compiled is not function:  # as it is with NUMBA_DISABLE_JIT=1
        compiled._cache = kept = _Cache(function)  # noqa: SLF001 - what `cache=True` sets
        compiled.compile = _once(compiled, kept)
    return cast("Kernel", compiled)


def _once(compiled: Any, kept: "_Cache") -> Callable[[Any], Any]:  # noqa: ANN401
    """Compile for a signature, unless another process does: then load what it has compiled."""
    compile_now = compiled.compile

    @wraps(compile_now)
    def compile_once(signature: Any) -> Any:  # noqa: ANN401
        if signature in compiled.overloads or kept.holds(signature, compiled.targetctx.codegen()):
            return compile_now(signature)
        with kept.alone():
            return compile_now(signature)

    return compile_once


@cache
def sources_digest(folder: Path = Path(__file__).parent) -> str:
    """SHA-256 of all Python files in a folder, with their names; here of all kernels."""
    digest = hashlib.sha256()
    for source in sorted(folder.rglob("*.py")):
        content = source.read_bytes()
        digest.update(f"{source.relative_to(folder).as_posix()} {len(content)}\n".encode())
        digest.update(content)
    return digest.hexdigest()


@cache
def _has_two_ways(function: Callable[..., Any]) -> bool:
    """Whether a kernel, or what it calls, is compiled in one of two ways; see `simd/choice.py`.

    The others can be compiled before it is known which.
    """
    names, known = function.__code__.co_names, function.__globals__
    called = [known[name] for name in names if name in known]
    modules = [one for one in called if isinstance(one, ModuleType)]
    for module in [one for one in modules if one.__name__.startswith("nanogs.")]:
        called += [getattr(module, name) for name in names if hasattr(module, name)]
    return any(
        getattr(one, TWO_WAYS, False) or (hasattr(one, "py_func") and _has_two_ways(one.py_func))
        for one in called
    )


class _AsItIs:
    """Makes a locator find its folder where it cannot be written to: to load from it."""

    def ensure_cache_path(self) -> None:
        """Ask for nothing."""


class _OwnFolder(_AsItIs, caching.UserProvidedCacheLocator):
    """The folder NUMBA_CACHE_DIR, as it is."""


class _InTree(_AsItIs, caching.InTreeCacheLocator):
    """The folder `__pycache__` beside the sources, as it is."""


class _Place(caching.CompileResultCacheImpl):
    """Where a kernel is kept: where Numba would, or, if it can write nowhere, where it may read."""

    _locator_classes = [*caching.CacheImpl._locator_classes, _OwnFolder, _InTree]  # noqa: RUF012, SLF001


class _Disk(caching.FunctionCache):
    """Numba's cache of one function, stale once any kernel's source has changed."""

    _impl_class = _Place

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        self._cache_file._source_stamp = sources_digest()  # noqa: SLF001

    def _index_key(self, sig: Any, codegen: Any) -> Any:  # noqa: ANN401
        """As Numba's; with checks of bounds or without, and each way of `simd`, are kept apart."""
        key = super()._index_key(sig, codegen)  # type: ignore[no-untyped-call]
        way = chosen().value if _has_two_ways(self._py_func) else ""
        return (*key, bool(config.BOUNDSCHECK), way)  # type: ignore[attr-defined]

    def save_overload(self, sig: Any, data: Any) -> None:  # noqa: ANN401
        """Keep a kernel; where that is impossible, the next process compiles it again."""
        with suppress(OSError):
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]


class _Cache:
    """A kernel's place on disk, found when the kernel is first called: many never are."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    @cached_property
    def _disk(self) -> Any:  # noqa: ANN401
        return _Disk(self._function)

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401
        return getattr(self._disk, name)

    def load_overload(self, sig: Any, target_context: Any) -> Any:  # noqa: ANN401
        """The code kept for a signature, or None; under Numba's lock, as all that compiles."""
        rtsys.initialize(target_context)  # for the arrays that it makes
        target_context.refresh = lambda: None
        try:
            return self._disk.load_overload(sig, target_context)
        finally:
            vars(target_context).pop("refresh", None)

    def holds(self, sig: Any, codegen: Any) -> bool:  # noqa: ANN401
        """Whether there is code for a signature."""
        key = self._disk._index_key(sig, codegen)  # noqa: SLF001
        return key in self._disk._cache_file._load_index()  # noqa: SLF001

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Be the only process that compiles this kernel; where that cannot be, one of several."""
        lock = None
        with suppress(OSError):
            self._disk._impl.locator.ensure_cache_path()  # noqa: SLF001
            lock = _lock(Path(self._disk.cache_path), self._place)
        try:
            yield
        finally:
            if lock is not None:
                fcntl.lockf(lock, fcntl.LOCK_UN, 1, self._place)

    def free(self) -> bool:
        """Whether no other process compiles this kernel just now, as far as can be told."""
        if not fcntl:
            return True
        try:
            self._disk._impl.locator.ensure_cache_path()  # noqa: SLF001
            file = _lock_file(Path(self._disk.cache_path))
        except OSError:
            return True
        try:
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, self._place)
        except OSError:
            return False
        fcntl.lockf(file, fcntl.LOCK_UN, 1, self._place)
        return True

    @property
    def _place(self) -> int:
        """The kernel's byte in the file of locks."""
        return zlib.crc32(f"{self._function.__module__}.{self._function.__qualname__}".encode())


@cache
def _lock_file(folder: Path) -> int:
    """A file in which each kernel has a byte to lock; open until the process ends."""
    return os.open(folder / "nanogs.lock", os.O_RDWR | os.O_CREAT, 0o666)


def _lock(folder: Path, place: int) -> int | None:
    """Lock a byte as soon as no other process has; a wait is one for a compiler too."""
    if not fcntl:
        return None
    file = _lock_file(folder)
    try:
        fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, place)
    except OSError:
        compiling.begin()
        try:
            fcntl.lockf(file, fcntl.LOCK_EX, 1, place)
        finally:
            compiling.end()
    return file

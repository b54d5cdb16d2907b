"""The cache of compiled kernels on disk: valid until any kernel's source changes.

Numba's own cache depends on the file of the function that is called only. Kernels inline helpers of
other files, so here it depends on the sources of all kernels. Kernels are loaded without
initialising the compiler. Processes that start at the same time compile nothing twice: one that
needs a kernel that another one compiles waits for it.
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
# Attribute of functions that `policy` compiles as vectors or as plain code.
SIMD_OR_PLAIN = "simd_or_plain"


def cached(function: Kernel, **options: Any) -> Kernel:  # noqa: ANN401 - Numba's own
    """Compile a function with Numba when it is called, or load it from the cache on disk."""
    compiled = numba.njit(function, **options)
    if compiled is not function:  # they are the same with NUMBA_DISABLE_JIT=1
        compiled._cache = kept = _Cache(function)  # noqa: SLF001 - the attribute that `cache=True` sets
        compiled.compile = _once(compiled, kept)
    return cast("Kernel", compiled)


def _once(compiled: Any, kept: "_Cache") -> Callable[[Any], Any]:  # noqa: ANN401
    """Wrap `compile`: if another process compiles the kernel, wait and load the result."""
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
    """SHA-256 of all Python files in a folder, with their names; by default of all kernels."""
    digest = hashlib.sha256()
    for source in sorted(folder.rglob("*.py")):
        content = source.read_bytes()
        digest.update(f"{source.relative_to(folder).as_posix()} {len(content)}\n".encode())
        digest.update(content)
    return digest.hexdigest()


@cache
def _has_both(function: Callable[..., Any]) -> bool:
    """Return whether a kernel, or a function that it calls, has a vector and a plain version.

    Kernels that have not can be compiled before `simd/choice.py` chooses between the two.
    """
    names, known = function.__code__.co_names, function.__globals__
    called = [known[name] for name in names if name in known]
    modules = [one for one in called if isinstance(one, ModuleType)]
    for module in [one for one in modules if one.__name__.startswith("nanogs.")]:
        called += [getattr(module, name) for name in names if hasattr(module, name)]
    return any(
        getattr(one, SIMD_OR_PLAIN, False) or (hasattr(one, "py_func") and _has_both(one.py_func))
        for one in called
    )


class _AsItIs:
    """Makes a cache locator accept a folder that is read-only, to load from it."""

    def ensure_cache_path(self) -> None:
        """Skip Numba's test that the folder can be written to."""


class _OwnFolder(_AsItIs, caching.UserProvidedCacheLocator):
    """The folder NUMBA_CACHE_DIR, even if it is read-only."""


class _InTree(_AsItIs, caching.InTreeCacheLocator):
    """The folder `__pycache__` beside the sources, even if it is read-only."""


def savable(cache: object) -> bool:
    """Return whether a kernel's cache can be written to; True for what is not cached by itself."""
    return not (isinstance(cache, _Cache) and cache.read_only)


class _Place(caching.CompileResultCacheImpl):
    """The folder of a kernel's cache: Numba's choice, or a read-only one if none is writable."""

    _locator_classes = [*caching.CacheImpl._locator_classes, _OwnFolder, _InTree]  # noqa: RUF012, SLF001


class _Disk(caching.FunctionCache):
    """Numba's cache of one function, stale once any kernel's source has changed."""

    _impl_class = _Place

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        self._cache_file._source_stamp = sources_digest()  # noqa: SLF001

    def _index_key(self, sig: Any, codegen: Any) -> Any:  # noqa: ANN401
        """Numba's key, with entries of their own for bounds checks and for each way of `simd`."""
        key = super()._index_key(sig, codegen)  # type: ignore[no-untyped-call]
        way = chosen().value if _has_both(self._py_func) else ""
        return (*key, bool(config.BOUNDSCHECK), way)  # type: ignore[attr-defined]

    def save_overload(self, sig: Any, data: Any) -> None:  # noqa: ANN401
        """Save a kernel; if that is impossible, the next process compiles it again."""
        try:
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]
        except OSError as error:
            compiling.note_unsaved(self.cache_path, error)


class _Cache:
    """The cache of one kernel, opened when it is first called: many kernels never are."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    @cached_property
    def _disk(self) -> Any:  # noqa: ANN401
        return _Disk(self._function)

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401
        return getattr(self._disk, name)

    def load_overload(self, sig: Any, target_context: Any) -> Any:  # noqa: ANN401
        """Load the code for a signature, or None; called under Numba's compiler lock."""
        rtsys.initialize(target_context)  # the runtime that allocates a kernel's arrays
        target_context.refresh = lambda: None
        try:
            return self._disk.load_overload(sig, target_context)
        finally:
            vars(target_context).pop("refresh", None)

    @property
    def read_only(self) -> bool:
        """Whether Numba found no folder for the cache that it could write to."""
        return isinstance(self._disk._impl.locator, _AsItIs)  # noqa: SLF001

    def holds(self, sig: Any, codegen: Any) -> bool:  # noqa: ANN401
        """Return whether there is code for a signature."""
        key = self._disk._index_key(sig, codegen)  # noqa: SLF001
        return key in self._disk._cache_file._load_index()  # noqa: SLF001

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Keep other processes from compiling this kernel; without effect if locking fails."""
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
        """Return whether no other process is compiling this kernel, as far as locks can show."""
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
        """The kernel's byte offset in the lock file."""
        return zlib.crc32(f"{self._function.__module__}.{self._function.__qualname__}".encode())


@cache
def _lock_file(folder: Path) -> int:
    """Open the lock file, in which each kernel has one byte; it is closed when the process ends."""
    return os.open(folder / "nanogs.lock", os.O_RDWR | os.O_CREAT, 0o666)


def _lock(folder: Path, place: int) -> int | None:
    """Lock a byte, and wait while another process has it; waiting is reported as compiling."""
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

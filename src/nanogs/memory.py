"""How much memory this process may still take: what the machine has free, and what limits it.

Three things count, and the least decides:

- what the machine can give without swapping (psutil's `available`; on Linux, MemAvailable);
- what the control group of a container or job leaves (Linux, versions 1 and 2);
- `ulimit -v` and `ulimit -d`, which count what is mapped, not what is used: libraries, stacks and
  the reserves of each thread map far more than they ever touch.

No NumPy here: a process that has too little for NumPy can still be told so.
"""

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path, PurePosixPath

from nanogs.errors import NotEnoughMemoryError
from nanogs.formatting import bytes_text
from nanogs.threads import most_threads

LIBRARIES = 210_000_000  # bytes, measured, that Python and its libraries take at the most
_PLAIN = 70_000_000  # the same without Numba
SHARE = 0.9  # of what is free is planned with: plans are off by up to a tenth, and others want some

# Address space in bytes, measured (Linux, glibc, wheels of NumPy and Numba): of one thread, and for
# each further one: a stack, the allocator's reserve of 64 MiB, and 40 MB for NumPy's OpenBLAS.
_MAPPED, _MAPPED_THREAD = 500_000_000, 120_000_000
_DATA, _DATA_THREAD = 190_000_000, 95_000_000  # the part of it that `ulimit -d` counts
_PLAIN_MAPPED, _PLAIN_THREAD = 200_000_000, 45_000_000  # `ulimit -v`, without Numba
_NUMPY, _NUMPY_THREAD = 130_000_000, 45_000_000  # what NumPy alone maps
_BLAS_THREADS = 64  # at the most, as the wheels are built
_UNFRAGMENTED = 0.8  # of address space: what is given back leaves gaps that are mapped all the same
_UNLIMITED = 1 << 60  # control groups of version 1 say a little less than 2^63 where there is none


@dataclass(frozen=True, slots=True)
class Memory:
    """Memory that work may take, beside what Python and its libraries do.

    Attributes:
        bytes: How much; below 0 where not even the libraries fit.
        limit: What sets it, to end a sentence that says how much there is.
    """

    bytes: int
    limit: str

    def __str__(self) -> str:
        """`1.9 GB are free on this machine`, to be a part of a sentence."""
        return f"{bytes_text(self.bytes)} are {self.limit}"


def allowed_memory(max_memory: int | None, *, compiled: bool = True) -> Memory:
    """Bytes that work may take: of those allowed to a process, or of those that are free.

    Args:
        max_memory: Bytes that a process may take in all; None for what is free, less a tenth.
        compiled: Whether the work needs Numba.

    Raises:
        NotEnoughMemoryError: There is none beside what Python and its libraries take.
    """
    if max_memory is not None:
        limit = "left of the memory allowed, beside Python and its libraries"
        return Memory(max(max_memory - (LIBRARIES if compiled else _PLAIN), 0), limit)
    free = free_memory(compiled=compiled)
    if free.bytes <= 0:
        raise NotEnoughMemoryError(
            f"No memory is left beside Python and its libraries: {bytes_text(-free.bytes)} more are"
            f" needed for these than are {free.limit}; free some, or raise the limit."
        )
    return Memory(int(SHARE * free.bytes), free.limit)


def process_memory(memory: Memory, processes: int = 1) -> int:
    """Bytes that each of some processes may take in all, in three digits so that they can be named.

    Args:
        memory: What is free for all of them, the libraries of one allowed for.
        processes: How many share it.
    """
    each = (memory.bytes - (processes - 1) * LIBRARIES) // processes + LIBRARIES
    step: int = 10 ** (len(str(max(each, 100))) - 3)
    return max(each // step * step, 0)


def refuse_too_large(what: str, needed: int, memory: Memory, remedy: str) -> None:
    """Refuse work before it begins that there is too little memory for.

    Args:
        what: The work, to begin the sentence, such as `Rendering this model`.
        needed: Bytes that it takes beside the libraries.
        memory: What it may take.
        remedy: What to do instead, to end the sentence.

    Raises:
        NotEnoughMemoryError: It takes more.
    """
    if needed > memory.bytes:
        raise NotEnoughMemoryError(
            f"{what} takes about {bytes_text(needed)} of memory, and {memory}; {remedy}."
        )


def free_memory(
    proc: Path = Path("/proc"), groups: Path = Path("/sys/fs/cgroup"), *, compiled: bool = True
) -> Memory:
    """The least of what the machine, the control group and `ulimit` leave beside the libraries.

    Args:
        proc: Where the system describes processes (Linux).
        groups: Where it describes control groups (Linux).
        compiled: Whether the work needs Numba.
    """
    import psutil

    held = psutil.Process().memory_info()
    libraries = LIBRARIES if compiled else _PLAIN
    coming = max(libraries - held.rss, 0)  # most of them load later
    found = [Memory(psutil.virtual_memory().available - coming, "free on this machine")]
    if sys.platform == "linux":
        left = [limit - used for limit, used in _group_limits(proc, groups)]
        found += [Memory(least - coming, "free in this control group") for least in left]
    for limit, option, mapped in _ulimits(held.vms, getattr(held, "data", 0), compiled):
        rest = limit - mapped
        usable = int(_UNFRAGMENTED * rest) if rest > 0 else rest
        found.append(Memory(usable, f"left by `ulimit {option}`"))
    return min(found, key=lambda each: each.bytes)


def refuse_without_numpy() -> None:
    """Refuse to begin where NumPy could not even be loaded: its libraries would end the process.

    Raises:
        NotEnoughMemoryError: `ulimit -v` is too low.
    """
    for limit, option in set_ulimits():
        least = _NUMPY + _NUMPY_THREAD * (min(most_threads(), _BLAS_THREADS) - 1)
        if option == "-v" and limit < least:
            raise NotEnoughMemoryError(
                f"`ulimit -v` allows {limit / 1e6:,.0f} MB of address space, and loading NumPy"
                f" alone takes {least / 1e6:,.0f} MB of it; raise the limit."
            )


def _ulimits(mapped: int, data: int, compiled: bool) -> Iterator[tuple[int, str, int]]:
    """Each limit in force, its option, and the bytes that it counts once all libraries are loaded.

    Args:
        mapped: Bytes of address space that this process has.
        data: Bytes of it that are writable and its own.
        compiled: Whether the work needs Numba.
    """
    more = min(most_threads(), _BLAS_THREADS) - 1
    libraries = {"-v": _MAPPED + more * _MAPPED_THREAD, "-d": _DATA + more * _DATA_THREAD}
    if not compiled:
        libraries = {"-v": _PLAIN_MAPPED + more * _PLAIN_THREAD, "-d": _PLAIN}
    now = {"-v": mapped, "-d": data}
    for limit, option in set_ulimits():
        yield limit, option, max(now[option], libraries[option])


def set_ulimits() -> Iterator[tuple[int, str]]:
    """The limits on address space and data that are in force, where the system keeps to them."""
    if sys.platform != "win32" and sys.platform != "darwin":
        import resource

        for kind, option in ((resource.RLIMIT_AS, "-v"), (resource.RLIMIT_DATA, "-d")):
            limit = resource.getrlimit(kind)[0]
            if limit != resource.RLIM_INFINITY:
                yield limit, option


def _group_limits(proc: Path, groups: Path) -> Iterator[tuple[int, int]]:
    """Limit and use in bytes of this process's control group and of those above it."""
    for line in _text(proc / "self" / "cgroup").splitlines():
        _number, _, rest = line.partition(":")
        controllers, _, path = rest.partition(":")
        names = controllers.split(",")
        if "memory" in names:
            above = _and_above(groups / "memory", path)
            yield from chain.from_iterable(map(_first_version, above))
        elif names == [""]:
            yield from chain.from_iterable(map(_second_version, _and_above(groups, path)))


def _and_above(root: Path, path: str) -> Iterator[Path]:
    """A group's folder and those above it; in a container, which sees its own as the root, that."""
    inner = PurePosixPath(path.lstrip("/"))
    for each in (inner, *inner.parents):
        yield root / each


def _second_version(group: Path) -> Iterator[tuple[int, int]]:
    used = _number(group / "memory.current")
    for name in ("memory.max", "memory.high"):  # above the second, the system slows it to a crawl
        limit = _number(group / name)
        if limit is not None and used is not None:
            yield limit, used - _cache(group, "inactive_file", "active_file")


def _first_version(group: Path) -> Iterator[tuple[int, int]]:
    limit, used = _number(group / "memory.limit_in_bytes"), _number(group / "memory.usage_in_bytes")
    if limit is not None and used is not None and limit < _UNLIMITED:
        yield limit, used - _cache(group, "total_inactive_file", "total_active_file")


def _cache(group: Path, *names: str) -> int:
    """Bytes of files in memory, which the system gives back before anything runs out."""
    facts = dict(line.split()[:2] for line in _text(group / "memory.stat").splitlines() if line)
    return sum(int(facts.get(name, "0")) for name in names)


def _number(path: Path) -> int | None:
    """The number in a file; None where there is none, or `max`."""
    text = _text(path).strip()
    return int(text) if text.isdigit() else None


def _text(path: Path) -> str:
    """The contents of a small file of the system's; nothing where there is none."""
    try:
        return path.read_text(encoding="ascii")
    except (OSError, UnicodeDecodeError):
        return ""

"""The memory that this process may still use: free memory of the machine, and limits.

The least of three counts:

- memory that the machine can give without swapping (psutil's `available`; on Linux, MemAvailable);
- memory left in the control group of a container or job (Linux, versions 1 and 2);
- `ulimit -v` and `ulimit -d`, which count mapped address space, not used memory: libraries, stacks
  and the reserves of each thread map far more than they ever touch.

Does not import NumPy, so that a process with too little memory for NumPy can still say so.
"""

import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from nanogs.control_groups import GROUPS, PROC, group_folders, read_number, read_text
from nanogs.errors import NotEnoughMemoryError
from nanogs.formatting import bytes_text
from nanogs.threads import most_threads

LIBRARIES = 210_000_000  # most bytes, measured, that Python and its libraries take
_PLAIN = 70_000_000  # the same without Numba
SHARE = 0.9  # share of free memory to plan with: plans err by up to a tenth, and others need some

# Address space in bytes, measured (Linux, glibc, wheels of NumPy and Numba): of one thread, and for
# each further one: a stack, the allocator's reserve of 64 MiB, and 40 MB for NumPy's OpenBLAS.
_MAPPED, _MAPPED_THREAD = 500_000_000, 120_000_000
_DATA, _DATA_THREAD = 190_000_000, 95_000_000  # the part of it that `ulimit -d` counts
_PLAIN_MAPPED, _PLAIN_THREAD = 200_000_000, 45_000_000  # `ulimit -v`, without Numba
_NUMPY, _NUMPY_THREAD = 130_000_000, 45_000_000  # NumPy alone
_BLAS_THREADS = 64  # most threads of OpenBLAS in NumPy's wheels
_UNFRAGMENTED = 0.8  # usable share of address space: freed memory leaves gaps that stay mapped
_UNLIMITED = 1 << 60  # control groups of version 1 report a little less than 2^63 for no limit


@dataclass(frozen=True, slots=True)
class Memory:
    """Memory that work may use in addition to Python and its libraries.

    Attributes:
        bytes: Number of bytes; below 0 if not even the libraries fit.
        limit: Source of this limit, as the end of a sentence that states the number.
        remedy: How to get more.
    """

    bytes: int
    limit: str
    remedy: str = "free some"

    def __str__(self) -> str:
        """Return a part of a sentence, such as `1.9 GB are free on this machine`."""
        return f"{bytes_text(self.bytes)} are {self.limit}"


def allowed_memory(max_memory: int | None, *, compiled: bool = True) -> Memory:
    """Return the memory that work may use, out of that allowed to the process or that is free.

    Args:
        max_memory: Bytes that the process may use in all; None for the free memory, less a tenth.
        compiled: Whether the work needs Numba.

    Raises:
        NotEnoughMemoryError: The free memory is not enough for Python and its libraries.
    """
    if max_memory is not None:
        limit = "left of the memory allowed, after Python and its libraries"
        left = max(max_memory - (LIBRARIES if compiled else _PLAIN), 0)
        return Memory(left, limit, "raise `max_memory`")
    free = free_memory(compiled=compiled)
    if free.bytes <= 0:
        raise NotEnoughMemoryError(
            "There is not enough memory for Python and its libraries, which need"
            f" {bytes_text(-free.bytes)} more than is {free.limit}; {free.remedy}."
        )
    return replace(free, bytes=int(SHARE * free.bytes))


def process_memory(memory: Memory, processes: int = 1) -> int:
    """Divide memory between processes, and round it down to three digits for use in messages.

    Args:
        memory: Memory for all processes, without the libraries of one of them.
        processes: Number of processes.

    Returns:
        Bytes that each process may use in all, with its libraries.
    """
    each = (memory.bytes - (processes - 1) * LIBRARIES) // processes + LIBRARIES
    step: int = 10 ** (len(str(max(each, 100))) - 3)
    return max(each // step * step, 0)


def refuse_too_large(what: str, needed: int, memory: Memory, otherwise: str = "") -> None:
    """Refuse work before it begins if there is not enough memory for it.

    Args:
        what: The work, as the beginning of the message, such as `Rendering this model`.
        needed: Bytes that it needs in addition to the libraries.
        memory: Memory that it may use.
        otherwise: What helps besides more memory, as the end of the message.

    Raises:
        NotEnoughMemoryError: The work needs more.
    """
    if needed > memory.bytes:
        remedies = ", or ".join(filter(None, (memory.remedy, otherwise)))
        raise NotEnoughMemoryError(
            f"{what} takes about {bytes_text(needed)} of memory, and {memory}; {remedies}."
        )


def free_memory(proc: Path = PROC, groups: Path = GROUPS, *, compiled: bool = True) -> Memory:
    """Return the least memory that the machine, the control group and `ulimit` leave for work.

    Args:
        proc: Root of the system's process information (Linux).
        groups: Root of the control groups (Linux).
        compiled: Whether the work needs Numba.
    """
    import psutil

    held = psutil.Process().memory_info()
    libraries = LIBRARIES if compiled else _PLAIN
    coming = max(libraries - held.rss, 0)  # the part of them that is not loaded yet
    found = [Memory(psutil.virtual_memory().available - coming, "free on this machine")]
    if sys.platform == "linux":
        left = [limit - used for limit, used in _group_limits(proc, groups)]
        where, remedy = "free in this control group", "free some or raise the limit"
        found += [Memory(least - coming, where, remedy) for least in left]
    for limit, option, mapped in _ulimits(held.vms, getattr(held, "data", 0), compiled):
        rest = limit - mapped
        usable = int(_UNFRAGMENTED * rest) if rest > 0 else rest
        found.append(Memory(usable, f"left by `ulimit {option}`", "raise the limit"))
    return min(found, key=lambda each: each.bytes)


def refuse_without_numpy() -> None:
    """Refuse to start if not even NumPy can be loaded, whose libraries would abort the process.

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
    """Iterate over the active limits.

    Args:
        mapped: Bytes of address space of this process.
        data: Bytes of it that are writable and private.
        compiled: Whether the work needs Numba.

    Yields:
        The limit, its `ulimit` option, and the bytes that count once all libraries are loaded.
    """
    more = min(most_threads(), _BLAS_THREADS) - 1
    libraries = {"-v": _MAPPED + more * _MAPPED_THREAD, "-d": _DATA + more * _DATA_THREAD}
    if not compiled:
        libraries = {"-v": _PLAIN_MAPPED + more * _PLAIN_THREAD, "-d": _PLAIN}
    now = {"-v": mapped, "-d": data}
    for limit, option in set_ulimits():
        yield limit, option, max(now[option], libraries[option])


def set_ulimits() -> Iterator[tuple[int, str]]:
    """Iterate over the active limits on address space and data, on systems that enforce them."""
    if sys.platform != "win32" and sys.platform != "darwin":
        import resource

        for kind, option in ((resource.RLIMIT_AS, "-v"), (resource.RLIMIT_DATA, "-d")):
            limit = resource.getrlimit(kind)[0]
            if limit != resource.RLIM_INFINITY:
                yield limit, option


def _group_limits(proc: Path, groups: Path) -> Iterator[tuple[int, int]]:
    """Iterate over limit and use, in bytes, of this process's control group and its ancestors."""
    for version, folder in group_folders("memory", proc, groups):
        yield from _first_version(folder) if version == 1 else _second_version(folder)


def _second_version(group: Path) -> Iterator[tuple[int, int]]:
    used = read_number(group / "memory.current")
    for name in ("memory.max", "memory.high"):  # above `high` the group is throttled
        limit = read_number(group / name)
        if limit is not None and used is not None:
            yield limit, used - _cache(group, "inactive_file", "active_file")


def _first_version(group: Path) -> Iterator[tuple[int, int]]:
    limit, used = (
        read_number(group / "memory.limit_in_bytes"),
        read_number(group / "memory.usage_in_bytes"),
    )
    if limit is not None and used is not None and limit < _UNLIMITED:
        yield limit, used - _cache(group, "total_inactive_file", "total_active_file")


def _cache(group: Path, *names: str) -> int:
    """Return the bytes of cached files, which the system frees before memory runs out."""
    facts = dict(line.split()[:2] for line in read_text(group / "memory.stat").splitlines() if line)
    return sum(int(facts.get(name, "0")) for name in names)

"""Compile all kernels in advance, for container images and CI."""

import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING

from nanogs.errors import NanogsError, OptionError
from nanogs.kernels.compiling import unsaved_text
from nanogs.progress import Progress, Stage, Tracker
from nanogs.ranges import is_number
from nanogs.threads import processors

if TYPE_CHECKING:
    from nanogs.kernels.needed import Needed


@dataclass(frozen=True, slots=True)
class CompileReport:
    """Report of compiling the kernels in advance.

    Attributes:
        kernels: Number of kernels in the cache.
        compiled: Number of these that were missing and were compiled.
        seconds: Duration.
        processor: Processor they were compiled for, by LLVM's name; others cannot use them.
        folders: Folders of the cache.
    """

    kernels: int
    compiled: int
    seconds: float
    processor: str
    folders: tuple[str, ...]


def warm(workers: int | None = None, progress: Progress | None = None) -> CompileReport:
    """Compile all kernels that commands need and that are not cached, in several processes.

    Args:
        workers: Number of processes, 1 or more; by default the number of processors.
        progress: Progress callback.

    Raises:
        OptionError: Compilation by Numba is disabled, or `workers` is no whole number or is below
            1.
        NanogsError: The cache cannot be written.
    """
    from concurrent.futures import as_completed

    from numba.core import config

    from nanogs.kernels.needed import needed
    from nanogs.pipeline.job.cluster import processes

    if config.DISABLE_JIT:  # type: ignore[attr-defined]
        raise OptionError("NUMBA_DISABLE_JIT is set, so that nothing is compiled; unset it.")
    count = processors() if workers is None else workers
    if not (is_number(count, whole=True) and count >= 1):
        raise OptionError(f"workers must be a whole number, 1 or more, not {count!r}.")
    start, every = time.perf_counter(), needed()
    folders = tuple(sorted({one.folder for one in every}))
    tracker = Tracker(progress, [Stage("compile", 1.0)])
    tracker.begin("compile")
    # Kernels that are needed last take longest to compile, so they are compiled first.
    missing = [one for one in reversed(every) if not one.held()]
    if missing:
        for folder in folders:
            _check_writable(Path(folder))
        with processes(min(count, len(missing))) as pool:
            done = as_completed([pool.submit(_compile, one) for one in missing])
            for number, future in enumerate(done, start=1):
                future.result()
                tracker.part(number, len(missing))
    tracker.finish()
    return CompileReport(
        kernels=len(every),
        compiled=len(missing),
        seconds=time.perf_counter() - start,
        processor=every[0].processor,
        folders=folders,
    )


def _check_writable(folder: Path) -> None:
    """Create a folder if it is missing, and check that it can be written to."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise NanogsError(unsaved_text(str(folder), error)) from None


def _compile(one: "Needed") -> None:
    """Compile one kernel, in a worker process."""
    from nanogs.kernels.compiling import watching

    with watching(lambda _begun: None):  # otherwise each process would log that it compiles
        one.compile()

"""Compile every kernel now, so that no run has to: for images, and for CI."""

import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING

from nanogs.errors import NanogsError, OptionError
from nanogs.progress import Progress, Stage, Tracker
from nanogs.threads import processors

if TYPE_CHECKING:
    from nanogs.kernels.needed import Needed


@dataclass(frozen=True, slots=True)
class Warmth:
    """Kernels on the disk, and how many of them were compiled now.

    Attributes:
        kernels: How many there are.
        compiled: How many of these were missing, and were compiled.
        seconds: That it took.
        processor: Whom they are for, as LLVM names it; others do not take them.
        folders: Where they are kept.
    """

    kernels: int
    compiled: int
    seconds: float
    processor: str
    folders: tuple[str, ...]


def warm(workers: int | None = None, progress: Progress | None = None) -> Warmth:
    """Compile all kernels that commands need and that are not on the disk, in several processes.

    Args:
        workers: Processes, 1 or more; by default as many as there are processors.
        progress: Called with each step.

    Raises:
        OptionError: Numba was told to compile nothing, or there is no worker.
        NanogsError: What was compiled cannot be kept.
    """
    from concurrent.futures import as_completed

    from numba.core import config

    from nanogs.kernels.needed import needed
    from nanogs.pipeline.cluster import processes

    if config.DISABLE_JIT:  # type: ignore[attr-defined]
        raise OptionError("NUMBA_DISABLE_JIT is set, so that nothing is compiled; unset it.")
    count = processors() if workers is None else workers
    if count < 1:
        raise OptionError(f"workers must be 1 or more, not {count}.")
    start, every = time.perf_counter(), needed()
    folders = tuple(sorted({one.folder for one in every}))
    tracker = Tracker(progress, [Stage("compile", 1.0)])
    tracker.begin("compile")
    # What is needed last takes longest.
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
    return Warmth(
        kernels=len(every),
        compiled=len(missing),
        seconds=time.perf_counter() - start,
        processor=every[0].processor,
        folders=folders,
    )


def _check_writable(folder: Path) -> None:
    """See to it that a folder is there and can be written to."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise NanogsError(
            f"Kernels cannot be kept in {folder} ({error.strerror}); name a folder that can be"
            " written to in NUMBA_CACHE_DIR."
        ) from None


def _compile(one: "Needed") -> None:
    """Compile one kernel of the table, in a process of its own."""
    from nanogs.kernels.compiling import watching

    with watching(lambda _begun: None):  # or each process would say that it compiles
        one.compile()

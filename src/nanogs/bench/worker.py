"""Running one method in a separate process, so that its time and peak memory are not shared."""

import multiprocessing
import signal
import sys
import time
from contextlib import closing, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from nanogs.bench.baselines import Method, MethodContext
from nanogs.bench.methods import find_method, preset_arguments
from nanogs.cleanup import cleaned_up, starting_processes
from nanogs.errors import NanogsError
from nanogs.io import encoded_bytes, load, write_model
from nanogs.kernels.compiling import watching
from nanogs.pipeline.options.target import target_count
from nanogs.raster.camera import Camera
from nanogs.splats import Splats

_WARM_UP = 1000  # splats of the run that compiles the kernels or loads them from the cache


@dataclass(frozen=True, slots=True)
class Job:
    """The task of a worker process.

    Attributes:
        model: The model's file.
        method: Name of the method.
        ratio: Compaction ratio in (0, 1]; not used with a size.
        output: File for the result: .ply, or of any format with a size.
        cameras: Views the method may learn from.
        trained: Whether `cameras` are those of the training photographs.
        seed: Seed of the random numbers.
        threads: Threads to use; None for all.
        size: Maximum size of the file, bytes; the method must be a preset then.
        render_mode: "default" or "mip", which overrides the render mode of the model's file.
    """

    model: Path
    method: str
    ratio: float
    output: Path
    cameras: tuple[Camera, ...] = ()
    trained: bool = False
    seed: int = 0
    threads: int | None = None
    size: int | None = None
    render_mode: str | None = None


@dataclass(frozen=True, slots=True)
class Outcome:
    """The result of a worker process.

    Attributes:
        error: Why there is no result; empty if there is one.
        splats: Splats delivered.
        asked: Splats requested; with a size, the splats delivered.
        seconds: The method alone, on warm kernels; with a size, also writing files.
        read_seconds: Reading the model.
        peak_memory: Peak resident memory, bytes, before the result was written (with a size, after
            it), or None if the system does not report it.
        notes: Notes of the report; only with a size.
    """

    error: str = ""
    splats: int = 0
    asked: int = 0
    seconds: float = 0.0
    read_seconds: float = 0.0
    peak_memory: int | None = None
    notes: tuple[str, ...] = ()


def run_job(job: Job) -> Outcome:
    """Run a job in a new process and wait for it; failures are returned as an `Outcome` too."""
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_serve, args=(job, sender), daemon=True)

    def end() -> None:  # nothing is lost: the result is written before it is announced
        if process.pid is not None:
            process.kill()
            process.join()

    with cleaned_up(end), closing(receiver):
        with starting_processes():
            process.start()
        sender.close()
        try:
            outcome = receiver.recv()
        except EOFError:
            process.join()
            reason = _ending(process.exitcode)
            outcome = Outcome(error=f"Its process ended without a result ({reason}).")
    assert isinstance(outcome, Outcome)  # noqa: S101 - what `_serve` sends
    return outcome


def _serve(job: Job, sender: Connection) -> None:
    # The parent handles interrupts, and ends this process.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with watching(lambda _begun: None):  # no message that the warm-up compiles kernels
            outcome = do_job(job)
    except NanogsError as error:
        outcome = Outcome(error=str(error))
    except Exception as error:  # noqa: BLE001,RUF100 - a method that raises is a result
        outcome = Outcome(error=f"{type(error).__name__}: {error}")
    sender.send(outcome)


def do_job(job: Job) -> Outcome:
    """Read the model, warm up, run the method and write the result, in this process.

    Raises:
        NanogsError: The model cannot be read or the method refuses.
    """
    if job.size is not None:
        return _do_sized(job)
    from nanogs.threads import use_threads

    method = find_method(job.method)
    context = MethodContext(job.cameras, job.seed, job.trained)
    start = time.perf_counter()
    splats = load(job.model, render_mode=job.render_mode)
    read_seconds = time.perf_counter() - start
    asked = target_count(int(splats.finite().sum()), job.ratio, None)
    with use_threads(job.threads):
        _warm_up(method, splats, context)
        start = time.perf_counter()
        small = method(splats, asked, context)
        seconds = time.perf_counter() - start
    peak = peak_memory()
    write_model(small, job.output, overwrite=True)
    return Outcome("", len(small), asked, seconds, read_seconds, peak)


def _do_sized(job: Job) -> Outcome:
    """Make a file of at most the requested size, like `nanogs simplify --size`."""
    from nanogs.pipeline.files import simplify_blocks
    from nanogs.threads import use_threads

    context = MethodContext(job.cameras, job.seed, job.trained)
    arguments = preset_arguments(job.method, context)
    with use_threads(job.threads):
        splats = load(job.model, render_mode=job.render_mode)
        _warm_up(find_method(job.method), splats, context)
        encoded_bytes(splats.take(np.arange(min(_WARM_UP, len(splats)))), job.output)
    del splats
    report = simplify_blocks(
        job.model, job.output, size=job.size, threads=job.threads, overwrite=True,
        render_mode=job.render_mode, **arguments,
    )  # fmt: skip
    read = report.seconds.get("read", 0.0)
    made = report.achieved_count
    seconds = report.total_seconds - read
    return Outcome("", made, made, seconds, read, peak_memory(), report.notes)


def _warm_up(method: Method, splats: Splats, context: MethodContext) -> None:
    rows = np.flatnonzero(splats.finite())
    sample = splats.take(rows[:: max(1, len(rows) // _WARM_UP)][:_WARM_UP])
    # A failure on the sample occurs again in the measured run, which reports it.
    with suppress(NanogsError):
        few = MethodContext(context.cameras[:2], context.seed, trained=True)
        method(sample, max(1, len(sample) // 10), few)


def peak_memory() -> int | None:
    """Return this process's peak resident memory, bytes, or None if the system does not report it.

    On Linux from VmHWM, because ru_maxrss includes the memory of the process before exec.
    """
    status = Path("/proc/self/status")
    if status.exists():
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    try:
        import resource
    except ImportError:  # Windows
        return None
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else most * 1024


def _ending(code: int | None) -> str:
    if code is not None and code < 0:
        out_of_memory = ", often a lack of memory" if code == -9 else ""
        return f"signal {-code}{out_of_memory}"
    return f"exit code {code}"

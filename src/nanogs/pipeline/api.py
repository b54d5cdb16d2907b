"""`nanogs.simplify`: from a model and a wish to a smaller model and a report."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nanogs.bar import drawn
from nanogs.clock import StageClock
from nanogs.io import as_stored, encoded_bytes, registry
from nanogs.io.format import FormatOptions
from nanogs.io.models import Model, as_splats
from nanogs.pipeline.job import Job, NanPolicy, prepare_job
from nanogs.pipeline.outcome import Outcome
from nanogs.pipeline.presets import DEFAULT_PRESET, parameters, refuse_search
from nanogs.pipeline.target import Goal
from nanogs.progress import Progress, Tracker
from nanogs.quantities import as_bytes
from nanogs.report import SimplifyReport
from nanogs.splats import Splats, refuse_misaligned_elements

if TYPE_CHECKING:
    from nanogs.raster.camera import Camera


def simplify(
    model: Model,
    *,
    ratio: float | None = None,
    count: int | None = None,
    size: int | str | None = None,
    psnr: float | None = None,
    format: str = ".ply",  # noqa: A002 - what it is called everywhere
    format_options: FormatOptions | None = None,
    preset: str = DEFAULT_PRESET,
    cameras: Sequence["Camera"] | None = None,
    nan: NanPolicy = "drop",
    threads: int | None = None,
    max_memory: int | None = None,
    progress: Progress | bool | None = None,
    **overrides: Any,  # noqa: ANN401 - checked against the preset's parameters
) -> tuple[Splats, SimplifyReport]:
    """A smaller model of the same scene: of the ratio, the count, the size or the PSNR asked for.

    Exactly one of the four is given. A ratio and a count are met exactly.

    Args:
        model: The model, which is not changed, or a path.
        ratio: Compaction ratio in (0, 1]: ceil(ratio x finite splats) are delivered.
        count: Splats to deliver.
        size: Bytes that the saved file may have, a number or text like "20MB": as many splats as
            fit are delivered. Where only writing a file tells its size, results are written to
            memory until one fits that takes 98 % of it or more.
        psnr: dB that the result must reach as `nanogs compare` measures it at its defaults, on
            views that nothing is learnt from. A count is searched whose result lies from there to
            0.3 dB above (see `reach`), as a file of the format gives it back.
        format: Suffix of the file that `size` and `psnr` are about.
        format_options: What that file will be saved with, as `save` takes it.
        preset: Name of a preset.
        cameras: Views that matter, for presets that render; by default automatic.
        nan: What to do with splats that hold a NaN or an infinity (an infinite opacity logit is
            data and does not count): "drop" them and say so in the report, or raise.
        threads: Threads to use; all by default. The result does not depend on it.
        max_memory: Bytes that this process may take; by default what is free, less a tenth. More
            is refused before anything is computed.
        progress: True for a bar, in a notebook or on a terminal, or a function that is called with
            each `nanogs.progress.Step`: the stage, which of how many it is, and the
            fraction of the whole that is done; the last step has the fraction 1.
        **overrides: Parameters of the preset to replace, such as `k=8`.

    Returns:
        The smaller model, its rows in the order of the input, and the report.

    Raises:
        FormatError: The path cannot be read as a model.
        OptionError: An option is out of range, or the size is less than one splat takes.
        NotEnoughMemoryError: It takes more memory than is free or allowed.
        ModelError: No splat is usable, `nan="error"` and one is not, or a PSNR is asked for and
            nothing is visible.
    """
    start, clock = time.perf_counter(), StageClock()
    size = None if size is None else as_bytes(size)
    goal = Goal(ratio, count, size, psnr)
    parameters(preset, overrides)
    path = Path(f"model{registry.suffix_of(format)}")
    refuse_searches(goal, preset, path)
    splats = as_splats(model)
    # Here and not above: this brings Numba, which `--help` and `info` do without.
    from nanogs.pipeline.foreseen import simplify_stages
    from nanogs.threads import use_threads

    with use_threads(threads) as threads_used, drawn(progress) as tell:
        with clock.time("check"):
            job = prepare_job(splats, preset, overrides, cameras, nan)
            target = target_of(goal, splats, len(job.rows), path)
            refuse_misaligned_elements(splats, 1 if target is None else target)
            job.refuse_too_large(target, max_memory, judged=psnr is not None)
        tracker = Tracker(
            tell,
            simplify_stages(job.parameters, goal, len(job.rows), target, path.suffix),
        )
        if target is not None:
            outcome = job.deliverer(target, threads_used, clock, tracker)(target, clock, tracker)
            if size is not None:
                outcome = replace(outcome, achieved_size=registry.sizer(path)(splats, target))
        elif size is not None:
            encode = partial(encoded_bytes, path=path, format_options=format_options)
            outcome = _fit(job, size, encode, threads_used, clock, tracker)
        else:
            stored = partial(as_stored, path=path, format_options=format_options)
            outcome = _reach(job, goal.psnr or 0.0, stored, threads_used, clock, tracker)
        target = len(outcome.splats) if target is None else target
        tracker.finish()
    if size is not None and target == len(job.rows):
        from nanogs.pipeline.fit_size import WHOLE_FITS

        outcome = replace(outcome, notes=(*outcome.notes, WHOLE_FITS))
    return outcome.splats, job.report(goal, target, outcome, threads_used, clock, start)


def refuse_searches(goal: Goal, preset: str, path: Path) -> None:
    """Refuse, before anything is read, a wish that only a search can meet and a preset cannot.

    Args:
        goal: What is asked.
        preset: Name of a preset.
        path: What will be written; only its suffix counts.

    Raises:
        OptionError: The preset runs anew for every count, or the format is not written.
    """
    if goal.psnr is not None:
        refuse_search(preset, "a PSNR")
    elif goal.size is not None and registry.writable(path).file_bytes is None:
        known = registry.find(path)
        refuse_search(preset, f"the size of a {known.suffix if known else path.suffix} file")


def target_of(goal: Goal, splats: Splats, available: int, path: Path) -> int | None:
    """The count that a wish comes to; None where only measuring or writing can tell.

    Args:
        goal: What is asked.
        splats: The model.
        available: Its usable splats.
        path: What will be written; only its suffix counts.

    Raises:
        OptionError: It cannot be had from this model, or not in this format.
    """
    if goal.size is None:
        return goal.target(available, lambda _count: 0)
    if registry.writable(path).file_bytes is None:
        return None
    file_bytes = registry.sizer(path)
    return goal.target(available, lambda count: file_bytes(splats, count))


def _fit(
    job: Job,
    size: int,
    encode: Callable[[Splats], int],
    threads: int,
    clock: StageClock,
    progress: Tracker,
) -> Outcome:
    from nanogs.pipeline.fit_size import fit_size, guess_count
    from nanogs.pipeline.results import HeldResults

    def bytes_of(outcome: Outcome) -> int:
        with clock.time("encode"):
            return encode(outcome.splats)

    progress.begin("guess")
    with clock.time("encode"):
        guess = guess_count(job.splats.take(job.rows), len(job.rows), size, encode)
    results = HeldResults(job.build(threads, clock, progress), clock)
    outcome, found = fit_size(results, size, guess, bytes_of, progress)
    notes = (*outcome.notes, *found.leap(size, results.available))
    return replace(outcome, achieved_size=found.bytes, size_probes=found.probes, notes=notes)


def _reach(
    job: Job,
    psnr: float,
    stored: Callable[[Splats], Splats],
    threads: int,
    clock: StageClock,
    progress: Tracker,
) -> Outcome:
    from nanogs.pipeline.reach import reach_psnr
    from nanogs.pipeline.results import HeldResults
    from nanogs.scoring.held_out import held_out

    progress.begin("measure")
    with clock.time("measure"):
        views = held_out(job.splats, progress.part)

    def psnr_of(outcome: Outcome) -> float:
        with clock.time("measure"):
            return views.psnr(stored(outcome.splats))

    results = HeldResults(job.build(threads, clock, progress), clock)
    outcome, found = reach_psnr(results, psnr, psnr_of, progress)
    with clock.time("measure"):
        judged = views.judge(stored(outcome.splats))
    return replace(outcome, probes=found.probes, stop=found.stop, judged=judged)

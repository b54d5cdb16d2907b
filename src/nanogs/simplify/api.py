"""`nanogs.simplify`: from a model and a wish to a smaller model and a report."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nanogs.io import registry
from nanogs.report import SimplifyReport, StageClock
from nanogs.simplify.job import Job, NanPolicy, prepare_job, refuse_misaligned_elements
from nanogs.simplify.outcome import Outcome
from nanogs.simplify.presets import DEFAULT_PRESET, parameters, refuse_psnr
from nanogs.simplify.target import Goal
from nanogs.splats import Splats

if TYPE_CHECKING:
    from nanogs.render.camera import Camera


def simplify(
    splats: Splats,
    *,
    ratio: float | None = None,
    count: int | None = None,
    size: int | None = None,
    psnr: float | None = None,
    format: str = ".ply",  # noqa: A002 - what it is called everywhere
    preset: str = DEFAULT_PRESET,
    cameras: Sequence["Camera"] | None = None,
    nan: NanPolicy = "drop",
    threads: int | None = None,
    progress: Callable[[str, int], None] | None = None,
    **overrides: Any,  # noqa: ANN401 - checked against the preset's parameters
) -> tuple[Splats, SimplifyReport]:
    """A smaller model of the same scene: of the ratio, the count, the size or the PSNR asked for.

    Exactly one of the four is given. A ratio and a count are met exactly.

    Args:
        splats: The model; it is not changed.
        ratio: Compaction ratio in (0, 1]: ceil(ratio x finite splats) are delivered.
        count: Splats to deliver.
        size: Bytes that the saved file may have: as many splats as fit are delivered.
        psnr: dB that the result must reach on views of the original: the smallest count that
            does, to about 1 %, is found by bisection (see `reach`). The views are automatic ones
            or from `cameras`, 256 pixels along the longer side; the mean over them counts.
        format: Suffix of the file that `size` is about.
        preset: Name of a preset.
        cameras: Views that matter, for presets that render and for `psnr`; by default automatic.
        nan: What to do with splats that hold a NaN or an infinity (an infinite opacity logit is
            data and does not count): "drop" them and say so in the report, or raise.
        threads: Threads to use; all by default. The result does not depend on it.
        progress: Called before each stage with its name and the number of splats left.
        **overrides: Parameters of the preset to replace, such as `k=8`.

    Returns:
        The smaller model, its rows in the order of the input, and the report.

    Raises:
        OptionError: An option is out of range, or the size is less than one splat takes.
        ModelError: No splat is usable, `nan="error"` and one is not, or a PSNR is asked for and
            nothing is visible.
    """
    start, clock = time.perf_counter(), StageClock()
    goal = Goal(ratio, count, size, psnr)
    parameters(preset, overrides)
    if psnr is not None:
        refuse_psnr(preset)
    # Here and not above: this brings Numba, which `--help` and `info` do without.
    from nanogs.threads import use_threads

    with use_threads(threads) as threads_used:
        with clock.time("check"):
            job = prepare_job(splats, preset, overrides, cameras, nan, progress)
            target = target_of(goal, splats, len(job.rows), format)
            refuse_misaligned_elements(splats, 1 if target is None else target)
        if target is None:
            outcome = _reach(job, goal.psnr or 0.0, threads_used, clock)
            target = len(outcome.splats)
        else:
            outcome = job.deliverer(threads_used, clock)(target, clock)
    if size is not None and target == len(job.rows):
        whole = "The whole model fits into the size asked for; nothing was merged."
        outcome = replace(outcome, notes=(*outcome.notes, whole))
    return outcome.splats, job.report(goal, target, outcome, threads_used, clock, start)


def target_of(goal: Goal, splats: Splats, available: int, format: str) -> int | None:  # noqa: A002
    """The count that a wish comes to; None where only measuring can tell.

    Args:
        goal: What is asked.
        splats: The model.
        available: Its usable splats.
        format: Suffix of the output file.

    Raises:
        OptionError: It cannot be had from this model, or not in this format.
    """
    if goal.size is None:
        return goal.target(available, lambda _count: 0)
    file_bytes = registry.sizer(Path(f"model.{format.lstrip('.')}"))
    return goal.target(available, lambda count: file_bytes(splats, count))


def _reach(job: Job, psnr: float, threads: int, clock: StageClock) -> Outcome:
    from nanogs.simplify.reach import reach_psnr

    return reach_psnr(job.build(threads, clock), psnr, clock, job.progress)

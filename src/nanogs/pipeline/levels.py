"""`nanogs.levels`: simplify one model to several ratios, with the shared stages done once."""

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from nanogs.bar import show_progress, wants_bar
from nanogs.card.device import device_notes, use_device
from nanogs.clock import StageClock
from nanogs.errors import OptionError
from nanogs.io.models import Model, as_splats
from nanogs.pipeline.checks import refuse_device
from nanogs.pipeline.estimates.stage_weights import level_stage
from nanogs.pipeline.in_memory import CheckedModel, Deliver, NanPolicy, check_model
from nanogs.pipeline.options.presets import DEFAULT_PRESET
from nanogs.pipeline.options.target import Goal, target_count
from nanogs.pipeline.request import Request
from nanogs.progress import Progress, Tracker
from nanogs.quantities import as_bytes
from nanogs.report import SimplifyReport
from nanogs.splats import Splats, refuse_misaligned_elements

if TYPE_CHECKING:
    from nanogs.views.cameras import Cameras


def levels(
    model: Model,
    ratios: Iterable[float],
    *,
    preset: str = DEFAULT_PRESET,
    sh_degree: int | None = None,
    cameras: "Cameras | None" = None,
    up: Sequence[float] | None = None,
    nan: NanPolicy = "drop",
    device: str | None = None,
    threads: int | None = None,
    max_memory: int | str | None = None,
    progress: Progress | bool | None = None,
    **overrides: Any,  # noqa: ANN401 - checked against the preset's parameters
) -> Iterator[tuple[Splats, SimplifyReport]]:
    """Return an iterator over levels of detail, each the result of `simplify` for its ratio.

    The stages that all ratios share run once, when the first level is asked for; their seconds are
    in its report. A level is made when it is asked for, so only those the caller keeps take memory.

    Args:
        model: The model, which is not changed, or a path.
        ratios: Compaction ratios in (0, 1], from the finest level to the coarsest.
        preset: Name of a preset; `paper` grows no forest, so that each level is a separate run.
        sh_degree: As `simplify` takes it.
        cameras: As `simplify` takes it.
        up: As `simplify` takes it.
        nan: As `simplify` takes it.
        device: As `simplify` takes it.
        threads: Number of threads; all by default. The result does not depend on it.
        max_memory: As `simplify` takes it.
        progress: True for a bar, in a notebook or on a terminal, or a function that is called with
            each `nanogs.progress.Step`; a level is a stage, such as "level_0".
        **overrides: Parameters of the preset to replace, such as `k=8`.

    Returns:
        An iterator over (model, report), in the order of the ratios. All arguments have been
        checked when it is returned.

    Raises:
        FormatError: The path cannot be read as a model.
        OptionError: An option is out of range, or the device is not available or has nothing to do.
        ModelError: No splat is usable; `nan="error"` and one is not; or other elements of the file
            have a row for each splat, which would be lost.
        NotEnoughMemoryError: It takes more memory than is free or allowed.
    """
    ratios = checked_ratios(ratios)
    request = Request(
        goal=Goal(ratio=ratios[0]), ratios=ratios, preset=preset, overrides=overrides,
        sh_degree=sh_degree, cameras=cameras, up=up, nan=nan, device=device, threads=threads,
        max_memory=None if max_memory is None else as_bytes(max_memory),
    )  # fmt: skip
    return requested_levels(model, request, progress, judged=False)


def requested_levels(
    model: Model, request: Request, progress: Progress | bool | None, *, judged: bool
) -> Iterator[tuple[Splats, SimplifyReport]]:
    """Make levels as `levels` does, with memory for measuring them against the model if `judged`.

    Args:
        model: The model, which is not changed, or a path.
        request: The ratios, the preset and the other arguments of `levels`.
        progress: As `levels` takes it.
        judged: Whether the levels are compared with the model.

    Raises:
        NanogsError: As for `levels`.
    """
    wants_bar(progress)  # refuses what is no progress: the bar itself begins with the first level
    refuse_device(request.device, request.preset, request.parameters, request.goal)
    from nanogs.threads import use_threads  # imported here because it imports Numba

    with use_threads(request.threads):
        checked = check_model(
            as_splats(model), request.preset, request.overrides, request.cameras, request.up,
            request.nan, request.sh_degree, request.sharing,
        )  # fmt: skip
    counts = [target_count(len(checked.rows), ratio, None) for ratio in request.ratios]
    refuse_misaligned_elements(checked.splats, counts[-1])
    checked.refuse_too_large(counts[0], request.max_memory, judged=judged)
    wanted = [*zip(request.ratios, counts, strict=True)]
    return _deliver(checked, request, wanted, progress)


def checked_ratios(ratios: Iterable[float]) -> tuple[float, ...]:
    """Convert the ratios of levels to Python floats and check them.

    Raises:
        OptionError: There are none, one is out of range, or they are not strictly decreasing.
    """
    single = isinstance(ratios, str | bytes) or getattr(ratios, "ndim", 1) == 0
    if single or not isinstance(ratios, Iterable):
        raise OptionError(
            "The ratios of levels must be a sequence of numbers, such as [0.5, 0.1], not"
            f" {ratios!r}."
        )
    found = tuple(goal.ratio for ratio in ratios if (goal := Goal(ratio=ratio)).ratio is not None)
    if not found:
        raise OptionError("Give at least one ratio for the levels.")
    for finer, coarser in pairwise(found):
        if finer == coarser:
            raise OptionError(f"The ratio {finer:g} is given twice; give each level once.")
        if finer < coarser:
            raise OptionError(
                f"Levels go from fine to coarse, and {coarser:g} comes after {finer:g}; order them "
                "from the largest ratio to the smallest."
            )
    return found


def _deliver(
    checked: CheckedModel,
    request: Request,
    wanted: Sequence[tuple[float, int]],
    progress: Progress | bool | None,
) -> Iterator[tuple[Splats, SimplifyReport]]:
    """Yield the level of each ratio and count."""
    from nanogs.pipeline.estimates.durations import count_stages, levels_stages
    from nanogs.pipeline.rounded import rounded_for_file
    from nanogs.threads import use_threads  # imported here because it imports Numba

    device, threads, known = request.device, request.threads, request.result_format
    counts = [count for _, count in wanted]
    chosen, splats = checked.parameters, len(checked.rows)
    deliver: Deliver | None = None
    with show_progress(progress) as on_step:
        tracker = Tracker(on_step, levels_stages(chosen, splats, counts, known))
        for number, (ratio, count) in enumerate(wanted):
            start, clock = time.perf_counter(), StageClock()
            # Entered anew for each level, so that the caller's own number of threads applies
            # between two levels.
            with use_device(device) as used, use_threads(threads) as threads_used:
                deliver = deliver or checked.deliverer(counts[-1], threads_used, clock, tracker)
                tracker.begin(level_stage(number))
                part = tracker.within(0, 1, count_stages(chosen, splats, count, known))
                outcome = deliver(count, clock, part)
                if known is not None:  # a file for each level
                    outcome = rounded_for_file(
                        outcome, chosen, request.file, request.format_options or {},
                        request.frame, clock, part,
                    )  # fmt: skip
            report = checked.report(Goal(ratio), count, outcome, threads_used, clock, start)
            report = replace(report, notes=(*report.notes, *device_notes(device, used)))
            if number == len(wanted) - 1:
                tracker.finish()
            yield outcome.splats, report
            del outcome  # otherwise it would stay in memory while the next one is made

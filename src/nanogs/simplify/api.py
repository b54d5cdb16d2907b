"""`nanogs.simplify`: from a model and a wish to a smaller model and a report."""

import time
from collections.abc import Callable
from dataclasses import asdict
from typing import Any, Literal

import numpy as np

from nanogs._types import I64
from nanogs.errors import ModelError
from nanogs.report import SimplifyReport, StageClock
from nanogs.simplify.presets import DEFAULT_PRESET, parameters
from nanogs.simplify.target import target_count
from nanogs.splats import Splats

NanPolicy = Literal["drop", "error"]


def simplify(
    splats: Splats,
    *,
    ratio: float | None = None,
    count: int | None = None,
    preset: str = DEFAULT_PRESET,
    nan: NanPolicy = "drop",
    threads: int | None = None,
    progress: Callable[[str, int], None] | None = None,
    **overrides: Any,  # noqa: ANN401 - checked against the preset's parameters
) -> tuple[Splats, SimplifyReport]:
    """A smaller model of the same scene, with exactly the count asked for.

    Args:
        splats: The model; it is not changed.
        ratio: Compaction ratio in (0, 1]: ceil(ratio x finite splats) are delivered.
        count: Splats to deliver, in place of a ratio.
        preset: Name of a preset.
        nan: What to do with splats that hold a NaN or an infinity (an infinite opacity logit is
            data and does not count): "drop" them and say so in the report, or raise.
        threads: Threads to use; all by default. The result does not depend on it.
        progress: Called before each stage with its name and the number of splats left.
        **overrides: Parameters of the preset to replace, such as `k=8`.

    Returns:
        The smaller model, its rows in the order of the input, and the report.

    Raises:
        OptionError: An option is out of range.
        ModelError: No splat is usable, or `nan="error"` and one is not.
    """
    start, clock = time.perf_counter(), StageClock()
    chosen = parameters(preset, overrides)
    # Here and not above: these bring Numba, which `--help` and `info` do without.
    from nanogs.simplify.gaussians import activate, scene_origin, store
    from nanogs.simplify.pipeline import merge_to_count
    from nanogs.simplify.prune import prune
    from nanogs.threads import use_threads

    observe = progress or (lambda _stage, _count: None)
    with use_threads(threads) as threads_used:
        with clock.time("check"):
            rows = usable_rows(splats, nan)
            target = target_count(len(rows), ratio, count)
            _refuse_misaligned_elements(splats, target)
        observe("prune", len(rows))
        with clock.time("prune"):
            pruning = prune(splats.opacities()[rows], chosen.tau, target)
            kept = rows[pruning.keep]
        with clock.time("activate"):
            origin = scene_origin(splats.means[kept])
            # A list, so that no name here keeps the full set alive while the passes shrink it.
            working = [activate(splats, kept, origin)]
        result = merge_to_count(working.pop(), target, chosen, threads_used, observe)
        observe("store", len(result.gaussians))
        with clock.time("store"):
            small = store(result.gaussians, splats, origin)
    for one_pass in result.passes:
        clock.add(one_pass.seconds)
    report = SimplifyReport(
        preset=preset,
        parameters=asdict(chosen),
        input_count=len(splats),
        asked_ratio=ratio,
        asked_count=target,
        dropped_nonfinite=len(splats) - len(rows),
        pruned=len(rows) - len(kept),
        prune_threshold=pruning.threshold,
        prune_limited=pruning.limited,
        passes=result.passes,
        achieved_count=len(small),
        stop=result.stop,
        seconds=clock.seconds,
        total_seconds=time.perf_counter() - start,
        threads=threads_used,
        notes=tuple(splats.notes),
    )
    return small, report


def usable_rows(splats: Splats, nan: NanPolicy) -> I64:
    """(M,) int64: rows that are finite, ascending.

    Raises:
        ModelError: None is, or one is not and the policy is "error".
    """
    finite = splats.finite()
    rows = np.flatnonzero(finite)
    if len(rows) == 0:
        raise ModelError("No splat is usable: every one holds a NaN or an infinite value.")
    if nan == "error" and len(rows) < len(splats):
        first = int(np.flatnonzero(~finite)[0])
        raise ModelError(
            f"{len(splats) - len(rows)} splats hold a NaN or an infinite value, the first in row "
            f"{first}; --nan drop leaves them out."
        )
    return rows


def _refuse_misaligned_elements(splats: Splats, target: int) -> None:
    """An element with one row a splat would no longer fit the splats; others are untouched."""
    for element in splats.elements:
        if len(element.rows) == len(splats) > 1 and target < len(splats):
            raise ModelError(
                f"The element {element.name!r} has one row for each splat and would not fit the "
                "smaller model; remove it from the file first."
            )

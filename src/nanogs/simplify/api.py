"""`nanogs.simplify`: from a model and a wish to a smaller model and a report."""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from nanogs._types import I64
from nanogs.errors import ModelError
from nanogs.report import SimplifyReport, StageClock
from nanogs.simplify.presets import DEFAULT_PRESET, PaperParameters, parameters
from nanogs.simplify.target import target_count
from nanogs.splats import Splats

if TYPE_CHECKING:
    from nanogs.render.camera import Camera

NanPolicy = Literal["drop", "error"]


def simplify(
    splats: Splats,
    *,
    ratio: float | None = None,
    count: int | None = None,
    preset: str = DEFAULT_PRESET,
    cameras: Sequence["Camera"] | None = None,
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
        cameras: Views that matter, for presets that render; by default automatic ones.
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
    # Here and not above: this brings Numba, which `--help` and `info` do without.
    from nanogs.threads import use_threads

    observe = progress or (lambda _stage, _count: None)
    with use_threads(threads) as threads_used:
        with clock.time("check"):
            rows = usable_rows(splats, nan)
            target = target_count(len(rows), ratio, count)
            refuse_misaligned_elements(splats, target)
        if isinstance(chosen, PaperParameters):
            from nanogs.simplify.published import simplify_as_published

            outcome = simplify_as_published(
                splats, rows, target, chosen, threads_used, clock, observe
            )
        else:
            from nanogs.simplify.forest_pipeline import build_forest, deliver

            build = build_forest(splats, rows, chosen, cameras, threads_used, clock, observe)
            outcome = deliver(build, target, clock, observe)
    report = SimplifyReport(
        preset=preset,
        parameters=asdict(chosen),
        input_count=len(splats),
        asked_ratio=ratio,
        asked_count=target,
        dropped_nonfinite=len(splats) - len(rows),
        pruned=outcome.pruned,
        prune_threshold=outcome.prune_threshold,
        prune_limited=outcome.prune_limited,
        passes=outcome.passes,
        achieved_count=len(outcome.splats),
        stop=outcome.stop,
        seconds=clock.seconds,
        total_seconds=time.perf_counter() - start,
        threads=threads_used,
        candidates=outcome.candidates,
        refit=outcome.refit,
        notes=(*splats.notes, *outcome.notes),
    )
    return outcome.splats, report


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


def refuse_misaligned_elements(splats: Splats, target: int) -> None:
    """An element with one row a splat would no longer fit the splats; others are untouched."""
    for element in splats.elements:
        if len(element.rows) == len(splats) > 1 and target < len(splats):
            raise ModelError(
                f"The element {element.name!r} has one row for each splat and would not fit the "
                "smaller model; remove it from the file first."
            )

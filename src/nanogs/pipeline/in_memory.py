"""A checked model in memory that is to be simplified; `simplify`, `grow` and `levels` share it."""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from nanogs._types import I32
from nanogs.clock import StageClock
from nanogs.errors import NONE_USABLE, ModelError, OptionError
from nanogs.formatting import counted
from nanogs.io.files import splat_bytes
from nanogs.io.format import Format, Sharing
from nanogs.memory import allowed_memory, refuse_too_large
from nanogs.method.paper.parameters import PaperParameters
from nanogs.method.parameters import ForestParameters
from nanogs.pipeline.estimates.memory import plan_memory, plan_search
from nanogs.pipeline.options.cameras import are_asked, refuse_unused_views
from nanogs.pipeline.options.presets import Parameters, idle_notes, parameters, renders
from nanogs.pipeline.options.target import Goal
from nanogs.pipeline.options.views import RequestedViews, requested_views
from nanogs.pipeline.outcome import Outcome
from nanogs.progress import Tracker
from nanogs.quantities import as_bytes
from nanogs.report import SimplifyReport, StopReason
from nanogs.source import InMemory
from nanogs.splats import Splats
from nanogs.store.columns import row_bytes

if TYPE_CHECKING:
    from nanogs.pipeline.one_block import OneBlock
    from nanogs.views.cameras import Cameras

NanPolicy = Literal["drop", "error"]
Deliver = Callable[[int, StageClock, Tracker], Outcome]
"""Makes the result with a given number of splats, and reports and times the stages of this."""


@dataclass(frozen=True, slots=True, eq=False)
class CheckedModel:
    """A model, and how it is to be simplified.

    Attributes:
        splats: The model.
        rows: (M,) int32, its usable rows, ascending.
        preset: Name of the preset.
        parameters: Parameters of the method.
        asked: The views that the user asks for.
        sh_degree: Degree of the result's harmonics, or None if none is asked for.
        sharing: How the result's splats share harmonics, or None if each has its own.
    """

    splats: Splats
    rows: I32
    preset: str
    parameters: Parameters
    asked: RequestedViews
    sh_degree: int | None = None
    sharing: Sharing | None = None

    def refuse_too_large(
        self,
        target: int | None,
        max_memory: int | str | None,
        *,
        judged: bool = False,
        search: tuple[Goal, Format] | None = None,
    ) -> None:
        """Raise if there is not enough memory; the model itself is in memory already.

        Args:
            target: Number of splats of the largest result, or None if not known beforehand.
            max_memory: Bytes that this process may take, or text; None for what is free.
            judged: Whether results are compared with views of the original, whatever the preset.
            search: What is searched for by writing results, and in which format.

        Raises:
            NotEnoughMemoryError: There is not enough memory.
            OptionError: The limit is not a number of bytes.
        """
        splats = self.splats
        allowed = None if max_memory is None else as_bytes(max_memory)
        extra = row_bytes(InMemory(splats).columns) - splat_bytes(splats.sh_degree)
        most = len(splats) if target is None else target
        plan = plan_memory(
            len(splats), splats.sh_degree, extra, self.parameters, most, judged=judged
        )
        if search is not None:
            plan = plan_search(plan, len(splats), *search)
        held = plan.input_columns if allowed is None else 0
        refuse_too_large(
            "Simplifying this model", plan.peak - held, allowed_memory(allowed),
            "use nanogs.simplify_blocks, which works on files block by block",
        )  # fmt: skip

    def build(self, threads: int, clock: StageClock, progress: Tracker) -> "OneBlock":
        """Render the model's views and grow its forest, from which any count is made.

        Only for presets that grow a forest.

        Args:
            threads: Number of threads in use.
            clock: Accumulates the seconds of each stage.
            progress: Receives each stage.
        """
        from nanogs.pipeline.one_block import OneBlock, whole_settings
        from nanogs.pipeline.run import build

        assert isinstance(self.parameters, ForestParameters)  # noqa: S101 - the caller's choice
        settings = whole_settings(self.splats, self.parameters)
        settings = replace(
            settings, asked=self.asked, sh_degree=self.sh_degree, sharing=self.sharing
        )
        scene = OneBlock(self.splats, self.rows, settings, threads)
        build(scene, clock, progress)
        return scene

    def whole(self) -> Outcome:
        """Deliver all usable splats unmerged, with the degree of harmonics asked for."""
        kept = self.splats.take(self.rows)
        if self.sh_degree is not None:
            kept = kept.with_sh_degree(self.sh_degree)
        return Outcome(kept, (), StopReason.TARGET)

    def deliverer(
        self, smallest: int, threads: int, clock: StageClock, progress: Tracker
    ) -> Deliver:
        """Run the stages that all counts share, and return a function that delivers one count.

        Args:
            smallest: Smallest count that will be asked for; if it is the number of usable splats,
                no stage is run.
            threads: Number of threads in use.
            clock: Accumulates the seconds of the shared stages.
            progress: Receives these stages.
        """
        chosen = self.parameters
        if isinstance(chosen, PaperParameters):
            from nanogs.pipeline.published import simplify_as_published

            return partial(simplify_as_published, self.splats, self.rows, chosen)
        from nanogs.pipeline.run import deliver

        if smallest == len(self.rows):
            whole = self.whole()
            return lambda _target, _clock, _progress: whole
        return partial(deliver, self.build(threads, clock, progress))

    def report(
        self,
        goal: Goal,
        asked_count: int,
        outcome: Outcome,
        threads: int,
        clock: StageClock,
        start: float,
    ) -> SimplifyReport:
        """Make the report: the goal, the result, and the time taken.

        Args:
            goal: The target of the simplification.
            asked_count: The count that meets it.
            outcome: The result.
            threads: Number of threads used.
            clock: The seconds of the stages.
            start: `time.perf_counter()` at the start.
        """
        # The other fields of an outcome are those of the report, by the same names.
        reported = {each.name: getattr(outcome, each.name) for each in fields(outcome)}
        del reported["splats"], reported["fields"], reported["curvatures"]
        idle = idle_notes(self.preset, self.parameters)
        notes = (*self.splats.notes, *outcome.notes, *idle)
        return SimplifyReport(
            preset=self.preset,
            parameters=asdict(self.parameters),
            read_count=len(self.splats),
            input_count=len(self.splats),
            asked_count=asked_count,
            **goal.reported,
            dropped_nonfinite=len(self.splats) - len(self.rows),
            achieved_count=len(outcome.splats),
            seconds=clock.seconds,
            total_seconds=time.perf_counter() - start,
            threads=threads,
            **{**reported, **outcome.fields, "notes": notes},
        )


def check_model(
    splats: Splats,
    preset: str,
    overrides: dict[str, Any],
    cameras: "Cameras | None",
    up: Sequence[float] | None,
    nan: NanPolicy,
    sh_degree: int | None,
    sharing: Sharing | None = None,
) -> CheckedModel:
    """Do all checks that are possible before anything is computed, and find the usable rows.

    For a method that does not render, harmonics above `sh_degree` are removed here. `sharing` is
    that of the checked model.

    Raises:
        OptionError: There is no such preset, parameter or policy for NaN; or views are given that
            are not cameras, or to a preset that does not render.
        ModelError: No splat is usable, or `nan="error"` and one is not.
    """
    chosen = parameters(preset, overrides)
    check_nan(nan)
    refuse_unused_views(preset, chosen, given=are_asked(cameras, up))
    if sh_degree is not None and not renders(chosen):
        splats = splats.with_sh_degree(sh_degree)
    rows, asked = usable_rows(splats, nan), requested_views(cameras, up)
    return CheckedModel(splats, rows, preset, chosen, asked, sh_degree, sharing)


def check_nan(nan: str) -> None:
    """Refuse invalid values of `nan`, the treatment of splats with NaN or infinite values.

    Raises:
        OptionError: It is neither "drop" nor "error".
    """
    if nan not in ("drop", "error"):
        raise OptionError(f"`nan` must be 'drop' or 'error', not {nan!r}.")


def import_stages(chosen: Parameters) -> None:
    """Import the modules that a method needs, and Numba with them, ahead of time."""
    if isinstance(chosen, PaperParameters):
        import nanogs.pipeline.published
    else:
        import nanogs.pipeline.run  # noqa: F401


def usable_rows(splats: Splats, nan: NanPolicy) -> I32:
    """Return (M,) int32, the rows whose values are finite, ascending.

    Raises:
        ModelError: No row is finite, or one is not and the policy is "error".
    """
    finite = splats.finite()
    rows = np.flatnonzero(finite).astype(np.int32)
    if len(rows) == 0:
        raise ModelError(NONE_USABLE if len(splats) else "The model has no splats.")
    if nan == "error" and len(rows) < len(splats):
        first = int(np.flatnonzero(~finite)[0])
        raise ModelError(
            f"{counted(len(splats) - len(rows), 'splat holds', 'splats hold')} a NaN or an infinite"
            f' value, the first in row {first}; leave them out with `nan="drop"`.'
        )
    return rows

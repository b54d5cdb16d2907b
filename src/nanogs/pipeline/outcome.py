"""What the stages have found of a result, as reports have it."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from nanogs.fit.report import RefitReport
from nanogs.protocol import Judged
from nanogs.report import (
    CandidateReport,
    PassReport,
    ProbeReport,
    SizeProbeReport,
    StopReason,
)
from nanogs.splats import Splats

if TYPE_CHECKING:
    from nanogs.pipeline.whole import Whole


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """A smaller model and what its report needs; see `SimplifyReport` for the fields."""

    splats: Splats
    passes: tuple[PassReport, ...]
    stop: StopReason
    pruned: int = 0
    prune_threshold: float = 0.0
    prune_limited: bool = False
    shown: float | None = None
    candidates: tuple[CandidateReport, ...] = ()
    refit: RefitReport | None = None
    notes: tuple[str, ...] = ()
    judged: Judged | None = None
    probes: tuple[ProbeReport, ...] = ()
    achieved_size: int | None = None
    size_probes: tuple[SizeProbeReport, ...] = ()


def outcome_of(scene: "Whole", level: int) -> Outcome:
    """A result of a model in memory, whose stages are done; the scene keeps nothing of it."""
    from nanogs.pipeline.trials import reports_of

    small, refit = scene.taken(level)
    forest, notes = scene.forest, scene.views.notes if scene.settings.looks else ()
    if scene.fits(level) and scene.looks and refit is None:
        notes += ("The result was not fitted: one view cannot tell what helps.",)
    reached = scene.target(level) == scene.targets[level]
    return Outcome(
        splats=small,
        passes=forest.passes,
        stop=StopReason.TARGET if reached else forest.stop,
        shown=scene.shown if scene.merges(level) else None,
        candidates=reports_of(scene, level) if scene.tries(level) else (),
        refit=refit,
        notes=notes,
    )

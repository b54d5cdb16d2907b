"""The results of the stages, in the form that reports need."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from nanogs.fit.report import RefitReport
from nanogs.formatting import unseen_cause
from nanogs.io.rate_distortion import Curvatures
from nanogs.report import CandidateReport, PassReport, StopReason
from nanogs.splats import Splats

if TYPE_CHECKING:
    from nanogs.pipeline.one_block import OneBlock
    from nanogs.pipeline.scene import Scene


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """A smaller model and the data for its report; see `SimplifyReport` for its fields.

    Attributes:
        splats: The model.
        fields: Others of the report, by name: those that a search or a size determines.
        curvatures: How much the model's values show, if it was fitted; not reported.
    """

    splats: Splats
    passes: tuple[PassReport, ...]
    stop: StopReason
    pruned: int = 0
    prune_threshold: float = 0.0
    prune_limited: bool = False
    shown: float | None = None
    reassign_rounds: int | None = None
    candidates: tuple[CandidateReport, ...] = ()
    fit: RefitReport | None = None
    notes: tuple[str, ...] = ()
    fields: Mapping[str, Any] = field(default_factory=dict)
    curvatures: Curvatures | None = None


def outcome_of(scene: "OneBlock") -> Outcome:
    """Return the result of a model in memory, with report data."""
    stop = StopReason.TARGET if scene.target(0) == scene.asked_count else scene.forest.stop
    return Outcome(
        splats=scene.part(0, 0), stop=stop, curvatures=scene.curvatures, **report_fields(scene, 0)
    )


def report_fields(scene: "Scene", level: int) -> dict[str, Any]:
    """Return the report fields that the stages determine, by name.

    Args:
        scene: A model in memory, or a scene in blocks; all of its stages are done.
        level: Of the result.
    """
    from nanogs.pipeline.tasks.trials import reports_of  # imported late: it imports Numba

    looked = scene.views.notes if scene.settings.looks else ()
    shown = scene.shown if scene.merges(level) and scene.looks else None
    unseen = () if shown is None else _unseen(scene, shown)
    unfitted = scene.notes_on_fits(level) if scene.fits(level) and scene.looks else ()
    return {
        "passes": scene.passes,
        "shown": shown,
        "reassign_rounds": scene.reassign_rounds(level),
        "candidates": reports_of(scene, level) if scene.tries(level) else (),
        "fit": scene.fit_report(level) if scene.fits(level) else None,
        "notes": (*looked, *unseen, *unfitted),
    }


def _unseen(scene: "Scene", shown: float) -> tuple[str, ...]:
    """Return a note if some or all of the views show nothing of the model."""
    if shown == 0:
        fact = "No view shows the model, so nothing was chosen by how it looks"
    elif blind := scene.blind:
        show = "shows" if blind == 1 else "show"
        fact = f"{blind} of the {len(scene.views.kept)} views {show} nothing of the model"
    else:
        return ()
    return (f"{fact}; {unseen_cause(given=bool(scene.settings.asked.cameras))}.",)

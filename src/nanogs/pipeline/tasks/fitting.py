"""The fit of each block's part to renders of the block, with fixed surroundings.

The surroundings are the same coarse level in the renders of the original and of the part, so that
a part corrects its own errors alone, and two neighbours do not both correct the same error.
"""

from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from nanogs.findings import join_findings, of_plain, to_plain
from nanogs.fit.api import fit_to_views
from nanogs.fit.groups import ViewGroup
from nanogs.fit.report import GroupReport, RefitReport, RefitStop
from nanogs.fit.targets import Fitting, make_target
from nanogs.pipeline.options.presets import fit_parameters
from nanogs.pipeline.scene import FitViews, Scene, Task
from nanogs.pipeline.tasks.block_visibility import looks_at
from nanogs.pipeline.tasks.views import deciding_count, parts_of
from nanogs.raster.camera import Camera, pick_evenly
from nanogs.raster.rendering import concatenated, prepare
from nanogs.store.columns import count_of
from nanogs.store.tables import Record
from nanogs.views.light import SHOWN

if TYPE_CHECKING:
    from nanogs.pipeline.work import Work

FITTED = "fitted"  # fact of stage `fit`: `facts_of_fit`, or None if the block was not fitted
LEAST = 16.0  # pixels of a block that a view has to show


@dataclass(frozen=True, slots=True, eq=False)
class _BlockViews:
    """Crops of views to a block: for validation, to fit to, and further ones rendered later."""

    deciding: list[Camera]
    fitting: list[Camera]
    further: list[Camera]


def fit_part(scene: Scene, task: Task) -> Record:
    """Fit a block's part of a result and keep it; unchanged if too few views show the block."""
    block, level = task.number, task.level
    part, views = scene.part(block, level), scene.fit_views(block, level)
    if views is None:
        return scene.keep_fit(task.name, part, None, None)
    parameters = replace(
        fit_parameters(scene.settings.parameters),
        views=len(views.fitting),
        validation=sum(len(group.targets) for group in views.deciding),
    )
    entries = scene.settings.entries(len(part), scene.target(level))
    fitted, report = fit_to_views(
        part, views.fitting, views.deciding, parameters, views.original_count, scene.threads,
        scene.on_progress, entries,
    )  # fmt: skip
    return scene.keep_fit(task.name, fitted.splats, fitted.curvatures, report)


def fit_report(work: "Work", level: int) -> RefitReport | None:
    """Report the gains of the fits of all blocks, one group each; None if none was fitted."""
    records = work.of_blocks("fit", level)
    fits = {n: record.facts[FITTED] for n, record in enumerate(records) if record.facts[FITTED]}
    if not fits:
        return None
    groups = tuple(GroupReport(f"block {n}", (), *each["gained"]) for n, each in fits.items())
    improved = [each for each in fits.values() if each["improved"]]
    optimal = all(each["stop"] == RefitStop.OPTIMUM for each in fits.values())
    before, after = (
        float(np.mean([getattr(each, name) for each in groups]))
        for name in ("psnr_before", "psnr_after")
    )
    return RefitReport(
        parameters=asdict(fit_parameters(work.settings.parameters)),
        original_count=work.partition.splats,
        count=sum(map(count_of, records)),
        fit_views=tuple(camera.name for camera in (*work.views.kept, *work.views.further)),
        validation_views=(),  # each block has its own, out of those that show it well
        groups=groups,
        psnr_before=before,
        psnr_after=after,
        improved=bool(improved),
        rounds=(),
        stop=RefitStop.OPTIMUM if optimal else RefitStop.ROUNDS,
        seconds={},
        total_seconds=0.0,
        threads=work.threads,
        # That nothing improved a block is not worth a note if something improved another.
        notes=join_findings(map(of_plain, each["notes"]) for each in improved or fits.values()),
    )


def facts_of_fit(report: RefitReport) -> dict[str, Any]:
    """Return what `fit_report` needs of a block's report, as plain data for JSON."""
    return {
        "gained": [report.psnr_before, report.psnr_after],
        "improved": report.improved,
        "stop": report.stop.value,
        "notes": list(map(to_plain, report.notes)),
    }


def notes_on_fits(work: "Work", level: int) -> list[str]:
    """Return a note on the blocks that were not fitted; none if all were."""
    records = work.of_blocks("fit", level)
    left = sum(record.facts[FITTED] is None for record in records)
    if not left:
        return []
    if len(records) == 1:
        return ["The result was not fitted, because too few views show it."]
    were = "was" if left == 1 else "were"
    return [
        f"{left:,} of {len(records):,} blocks {were} not fitted, because too few views show them."
    ]


def fit_views(work: "Work", block: int, level: int) -> FitViews | None:
    """Render the views that show a block, to fit to and for validation; None if too few do.

    Args:
        work: The job; the part is done.
        block: Number of the block.
        level: Number of the level.
    """
    found = work.members(block, level, reassigned=work.chosen(level).reassigned)
    if found.visible is None:  # the scene shows nothing
        return None
    own, count, shown = prepare(found.splats), len(found.splats), found.visible >= SHOWN
    del found
    looked = looks_at(work, block)
    kept = parts_of(own, shown, [camera for camera, _ in looked])
    further = parts_of(own, shown, work.views.further)
    seen = _divided(kept, further, [light for _, light in looked])
    if not seen.fitting:
        return None
    others = work.surroundings(block)
    original = concatenated(own, others).with_buffers()
    del own
    fitting = Fitting(
        [make_target(original, camera, depth=False) for camera in seen.fitting],
        original if seen.further else None,
        seen.further,
        others,
    )
    held = tuple(make_target(original, camera, depth=False) for camera in seen.deciding)
    return FitViews(fitting, [ViewGroup("views", held)], count)


def _divided(
    kept: list[Camera | None], further: list[Camera | None], light: list[float]
) -> _BlockViews:
    """Divide the views of a block into those for validation, which must show it well, and others.

    Args:
        kept: Crop of each view to the block, None if the view does not show it.
        further: Likewise for the further views.
        light: Pixels of the block that each kept view shows.
    """
    seen = [(part, lit) for part, lit in zip(kept, light, strict=True) if part and lit >= LEAST]
    if len(seen) < 2:
        return _BlockViews([], [], [])
    middle = float(np.median([lit for _, lit in seen]))
    well = [part for part, lit in seen if lit >= middle]
    deciding = pick_evenly(well, deciding_count(len(seen)))
    fitting = [part for part, _ in seen if part not in deciding]
    return _BlockViews(deciding, fitting, [part for part in further if part])

"""The fit of each block's part to what views show of the block, its surroundings held as they are.

The surroundings are the same coarse level in the original's pictures and in those of the part, so
that a part learns its own errors alone, and those of two neighbours are not made good twice.
"""

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import numpy as np

from nanogs.fit.api import fit_to_views
from nanogs.fit.groups import Group
from nanogs.fit.report import GroupReport, RefitReport, RefitStop
from nanogs.fit.targets import Fitting, make_target
from nanogs.method.visibility import SHOWN
from nanogs.pipeline.coarse import surroundings
from nanogs.pipeline.look import looks_at
from nanogs.pipeline.memory_blocks import ROUGH
from nanogs.pipeline.parts import read_part
from nanogs.pipeline.views import deciding_count, parts_of
from nanogs.pipeline.weights import fit_parameters
from nanogs.progress import untold
from nanogs.raster.camera import Camera, spread
from nanogs.raster.rendering import prepare, together
from nanogs.splats import Splats
from nanogs.store.columns import columns_of, count_of
from nanogs.store.tables import Record, write_table

if TYPE_CHECKING:
    from nanogs.pipeline.work import Work

LEAST = 16.0  # pixels of a block that a view has to show


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """The parts of views that show a block: well enough to decide, others, and more to be drawn."""

    deciding: list[Camera]
    fitting: list[Camera]
    further: list[Camera]


def fit_part(work: "Work", name: str, block: int, level: int) -> Record:
    """Write a block's part as it is after the fit, and what was gained.

    Args:
        work: The job, the part done.
        name: Of the table.
        block: Its number.
        level: Of the result.
    """
    part = read_part(work.scratch, work.settings.layout, work.of_block("part", block, level))
    fitted, report = _fitted(work, part, block, level)
    facts = {"gained": [report.psnr_before, report.psnr_after] if report else None}
    return write_table(work.scratch, name, columns_of(fitted), facts)


def fit_report(work: "Work", level: int) -> RefitReport | None:
    """The gains of the fits of all blocks, each a group; None where no block could be fitted."""
    records = work.of_blocks("fit", level)
    gains = [(number, record.facts["gained"]) for number, record in enumerate(records)]
    groups = tuple(GroupReport(f"block {n}", (), *gained) for n, gained in gains if gained)
    if not groups:
        return None
    before, after = (
        float(np.mean([getattr(each, name) for each in groups]))
        for name in ("psnr_before", "psnr_after")
    )
    return RefitReport(
        parameters=asdict(fit_parameters(work.settings.parameters)),
        original_count=work.partition.splats,
        count=sum(map(count_of, records)),
        fit_views=tuple(camera.name for camera in (*work.views.kept, *work.views.further)),
        validation_views=(),  # each block has its own, of those that show it well
        groups=groups,
        psnr_before=before,
        psnr_after=after,
        improved=any(each.psnr_after > each.psnr_before for each in groups),
        rounds=(),
        stop=RefitStop.ROUNDS,
        seconds={},
        total_seconds=0.0,
        threads=work.threads,
        notes=(),
    )


def notes_on_fits(work: "Work", level: int) -> list[str]:
    """A sentence on the blocks that were not fitted; none where all were, or nothing was seen."""
    records = work.of_blocks("fit", level)
    left = sum(record.facts["gained"] is None for record in records)
    if not left or not work.looks:
        return []
    if len(records) == 1:
        return ["The result was not fitted: too few views show it."]
    were = "was" if left == 1 else "were"
    return [f"{left:,} of {len(records):,} blocks {were} not fitted: too few views show them."]


def _fitted(
    work: "Work", part: Splats, block: int, level: int
) -> tuple[Splats, RefitReport | None]:
    """The fitted part; or the same one, and None, where too few views show it."""
    found = work.members(block, level, reassigned=work.chosen(level).reassigned)
    if found.visible is None:  # the scene shows nothing
        return part, None
    own, count, visible = prepare(found.splats), len(found.splats), found.visible
    del found
    views = work.views
    looked = looks_at(work, block)
    kept = parts_of(own, visible >= SHOWN, [camera for camera, _ in looked])
    further = parts_of(own, visible >= SHOWN, views.further)
    seen = _sorted(kept, further, [light for _, light in looked])
    if not seen.fitting:
        return part, None
    others = surroundings(work, block, ROUGH)
    original = together(own, others)
    del own
    fitting = Fitting(
        [make_target(original, camera, depth=False) for camera in seen.fitting],
        original if seen.further else None,
        seen.further,
        others,
    )
    held = tuple(make_target(original, camera, depth=False) for camera in seen.deciding)
    del original
    return fit_to_views(
        part, fitting, [Group("views", held)], fit_parameters(work.settings.parameters), count,
        work.threads, untold,
    )  # fmt: skip


def _sorted(kept: list[Camera | None], further: list[Camera | None], light: list[float]) -> _Seen:
    """Which parts decide, and which are fitted to; what a view hardly shows it cannot decide."""
    seen = [(part, lit) for part, lit in zip(kept, light, strict=True) if part and lit >= LEAST]
    if len(seen) < 2:
        return _Seen([], [], [])
    middle = float(np.median([lit for _, lit in seen]))
    well = [part for part, lit in seen if lit >= middle]
    deciding = spread(well, deciding_count(len(seen)))
    fitting = [part for part, _ in seen if part not in deciding]
    return _Seen(deciding, fitting, [part for part in further if part])

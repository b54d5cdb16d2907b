"""Visibility of the splats of each block, for a scene that is kept in files."""

from dataclasses import astuple
from typing import TYPE_CHECKING

import numpy as np

from nanogs._types import F64
from nanogs.method.nodes import prominence
from nanogs.method.visibility import MissedLight, shown_prominence
from nanogs.pipeline.options.views import camera_of, plain_camera
from nanogs.pipeline.scene import LIGHT, Look, ViewLight
from nanogs.pipeline.tasks.blocks import leaves_of
from nanogs.pipeline.tasks.views import parts_of
from nanogs.raster.camera import Camera
from nanogs.raster.rendering import prepare
from nanogs.splats import Splats
from nanogs.store.tables import Record
from nanogs.views.automatic import automatic_cameras

if TYPE_CHECKING:
    from nanogs.pipeline.work import Work

VISIBLE = "visible"
DISTANT = 0.2  # share of a view's pixels: a block smaller than this in every view gets its own


def write_look(work: "Work", name: str, look: Look) -> Record:
    """Write the visibility of a block's splats, and how much of the block each view shows."""
    own = look.own
    assert own.visible is not None  # noqa: S101 - it was computed
    leaves, visible = leaves_of(own.splats, own.rows, work.units), own.visible[own.rows]
    prominences = prominence(leaves.coverages, leaves.means, work.units.viewers())
    counted = np.minimum(prominences, work.units.immense)
    facts = {
        "cameras": [plain_camera(camera) for camera, _ in look.lights],
        LIGHT: [light for _, light in look.lights],
        "discovery": astuple(look.missed_light),
        "prominence": float(prominences.sum()),
        "counted": float(counted.sum()),
        "visible": float((counted * visible).sum()),
        "shown": shown_prominence(prominences, visible, look.missed[own.rows]),
    }
    return work.write(name, {VISIBLE: own.visible}, facts)


def looks_at(work: "Work", block: int) -> list[ViewLight]:
    """Return the views that a block was rendered from, and how much of it each shows."""
    facts = work.of_block("look", block).facts
    cameras = map(camera_of, facts["cameras"])
    return list(map(ViewLight, cameras, map(float, facts[LIGHT])))


def closer_views(work: "Work", own: Splats) -> list[Camera]:
    """Choose views of a block alone, if it is small in all views of the scene, as of a city.

    Args:
        work: The job, its views chosen.
        own: Splats of the block.
    """
    parameters, kept = work.settings.parameters, work.views.kept
    if work.partition.blocks == 1 or not kept or work.settings.asked.cameras:
        return []
    drawn = prepare(own)
    least = DISTANT * kept[0].width * kept[0].height
    parts = [part for part in parts_of(drawn, drawn.keep, kept) if part]
    if not drawn.keep.any() or any(part.width * part.height > least for part in parts):
        return []
    size = max(parameters.view_size // 2, 16)
    count = -(-parameters.views // 2)
    return automatic_cameras(own, count, width=size, height=size, habit=False)


def typical_weight(work: "Work", hidden: float) -> float:
    """Compute the mean weight of all splats, the unit of node weights; 1 if all are 0.

    As in memory (`nodes.typical_weight`), one immense splat does not make all others equal.

    Args:
        work: The job, the visibility of all blocks known.
        hidden: Relative weight of a splat that no view shows; see `hidden_weight`.
    """
    facts = [record.facts for record in work.of_blocks("look")]
    every, visible = (sum(float(each[name]) for each in facts) for name in ("counted", "visible"))
    mean = (hidden * every + (1 - hidden) * visible) / work.partition.splats
    return mean if mean > 0 else 1.0


def hidden_weight(work: "Work") -> float:
    """Compute the weight of a splat that no view shows, over that of one in full sight."""
    blocks = [MissedLight(*record.facts["discovery"]) for record in work.of_blocks("look")]
    return sum(blocks, MissedLight()).hidden(work.settings.parameters.hidden)


def shown_share(work: "Work") -> float:
    """Compute the share of the prominence of all splats, in [0, 1], that views show."""
    facts = [record.facts for record in work.of_blocks("look")]
    total = sum(float(each["prominence"]) for each in facts)
    return sum(float(each["shown"]) for each in facts) / total if total > 0 else 0.0


def read_visible(work: "Work", block: int) -> F64:
    """Read (N,) the visibility of a block's splats."""
    with work.table("look", block) as table:
        visible: F64 = table.read(VISIBLE)
    return visible

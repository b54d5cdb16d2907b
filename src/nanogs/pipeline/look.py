"""What the views show of each block, with all others before and behind it."""

from typing import TYPE_CHECKING

from nanogs._types import F64
from nanogs.fit.views import choose_cameras
from nanogs.method.visibility import (
    Light,
    light_in,
    shown_coverage,
    visibility_of,
    visible_weights,
)
from nanogs.pipeline.asked import camera_of, plain_camera
from nanogs.pipeline.blocks import leaves_of
from nanogs.pipeline.coarse import surroundings
from nanogs.pipeline.memory_blocks import FINE
from nanogs.pipeline.views import parts_of
from nanogs.raster.camera import Camera
from nanogs.raster.rendering import prepare, render, together
from nanogs.splats import Splats
from nanogs.store.tables import Record, write_table

if TYPE_CHECKING:
    from nanogs.pipeline.work import Work

VISIBLE = "visible"
DISTANT = 0.2  # of a view's pixels, in a smaller part of which a block is too far away


def look_at_block(work: "Work", name: str, block: int) -> Record:
    """Write how visible each of a block's splats is, and how much of the block each view shows.

    Args:
        work: The job, its views chosen.
        name: Of the table.
        block: Its number.
    """
    own, rows = work.block(block, work.settings.layout.bare())  # what hides has no need of colours
    views, n = work.views, len(own)
    cameras = [*views.kept, *closer_views(work, own)]
    scene = together(prepare(own), surroundings(work, block, FINE))
    looked, light = Light(len(scene)), []
    for camera in cameras:
        view = render(scene, camera, contributions=True, sh_degree=0)
        looked.add(view)
        assert view.contributions is not None  # noqa: S101 - asked for
        light.append(float(view.contributions[:n].sum()))
    anywhere = light_in(scene, views.roaming) if views.roaming else None
    del scene
    visible, missed = visibility_of(looked, anywhere)
    visible, missed = visible[:n], missed[:n]  # the surroundings' are not asked for
    coverages = leaves_of(own, rows, work.frame).coverages
    weights = visible_weights(coverages, visible[rows], work.settings.parameters.hidden)
    facts = {
        "cameras": [plain_camera(camera) for camera in cameras],
        "light": light,
        "weight": float(weights.sum()),
        "coverage": float(coverages.sum()),
        "shown": shown_coverage(coverages, visible[rows], missed[rows]),
    }
    return write_table(work.scratch, name, {VISIBLE: visible}, facts)


def looks_at(work: "Work", block: int) -> list[tuple[Camera, float]]:
    """The views that a block was looked at, and how much of it each shows, pixels of alpha 1."""
    facts = work.of_block("look", block).facts
    cameras = map(camera_of, facts["cameras"])
    return list(zip(cameras, map(float, facts["light"]), strict=True))


def closer_views(work: "Work", own: Splats) -> list[Camera]:
    """Views of a block alone, where it is small in all those of the scene: a city is no object.

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
    return choose_cameras(own, None, -(-parameters.views // 2), 0, size)[0]


def typical_weight(work: "Work") -> float:
    """Mean of the weights of all splats, of which those of nodes are multiples."""
    facts = [record.facts for record in work.of_blocks("look")]
    mean = sum(float(each["weight"]) for each in facts) / work.partition.splats
    return mean if mean > 0 else 1.0


def shown_share(work: "Work") -> float:
    """Share of the coverage of all splats, in [0, 1], that views show."""
    facts = [record.facts for record in work.of_blocks("look")]
    total = sum(float(each["coverage"]) for each in facts)
    return sum(float(each["shown"]) for each in facts) / total if total > 0 else 0.0


def read_visible(work: "Work", block: int) -> F64:
    """(N,) how visible the block's splats are."""
    with work.table("look", block) as table:
        visible: F64 = table.read(VISIBLE)
    return visible

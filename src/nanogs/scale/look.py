"""What the views show of each block, with all others before and behind it."""

from typing import TYPE_CHECKING

import numpy as np

from nanogs._types import F64
from nanogs.fit.views import choose_cameras
from nanogs.method.visibility import SHOWN, Light, visible_weights
from nanogs.raster.camera import Camera
from nanogs.raster.rendering import prepare, render, together
from nanogs.scale.asked import camera_of, plain_camera
from nanogs.scale.blocks import leaves_of
from nanogs.scale.coarse import surroundings
from nanogs.scale.memory import FINE
from nanogs.scale.tables import Record, write_table
from nanogs.scale.views import parts_of
from nanogs.splats import Splats

if TYPE_CHECKING:
    from nanogs.scale.work import Work

VISIBLE = "visible"
SMALL = 0.2  # of a view's pixels, in whose parts a block is small


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
    looked, anywhere = Light(len(scene)), Light(len(scene))
    light = []
    for camera in cameras:
        view = render(scene, camera, contributions=True, sh_degree=0)
        looked.add(view)
        assert view.contributions is not None  # noqa: S101 - asked for
        light.append(float(view.contributions[:n].sum()))
    for camera in views.roaming:
        anywhere.add(render(scene, camera, contributions=True, sh_degree=0))
    del scene
    visible, missed = looked.shares()[:n], looked.whole[:n] == 0
    visible[missed] = 1.0
    if views.roaming:
        np.maximum(visible, anywhere.shares()[:n], out=visible)
        missed &= anywhere.whole[:n] == 0
    coverages = leaves_of(own, rows, work.frame).coverages
    weights = visible_weights(coverages, visible[rows], work.settings.parameters.hidden)
    facts = {
        "cameras": [plain_camera(camera) for camera in cameras],
        "light": light,
        "weight": float(weights.sum()),
        "coverage": float(coverages.sum()),
        "shown": float(coverages[((visible >= SHOWN) & ~missed)[rows]].sum()),
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
    least = SMALL * kept[0].width * kept[0].height
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

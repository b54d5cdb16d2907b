"""What the views show of each block, with all others before and behind it."""

from typing import TYPE_CHECKING

import numpy as np

from nanogs._types import F64
from nanogs.method.visibility import SHOWN, Light, visible_weights
from nanogs.raster.rendering import prepare, render, together
from nanogs.scale.blocks import leaves_of
from nanogs.scale.coarse import surroundings
from nanogs.scale.memory import FINE
from nanogs.scale.tables import Record, write_table

if TYPE_CHECKING:
    from nanogs.scale.work import Work

VISIBLE = "visible"


def look_at_block(work: "Work", name: str, block: int) -> Record:
    """Write how visible each of a block's splats is, and how much of the block each view shows.

    Args:
        work: The job, its views chosen.
        name: Of the table.
        block: Its number.
    """
    own, rows = work.block(block, work.settings.layout.bare())  # what hides has no need of colours
    views, n = work.views, len(own)
    scene = together(prepare(own), surroundings(work, block, FINE))
    near, anywhere = Light(len(scene)), Light(len(scene))
    light = []
    for camera in views.kept:
        view = render(scene, camera, contributions=True, sh_degree=0)
        near.add(view)
        assert view.contributions is not None  # noqa: S101 - asked for
        light.append(float(view.contributions[:n].sum()))
    for camera in views.roaming:
        anywhere.add(render(scene, camera, contributions=True, sh_degree=0))
    del scene
    visible, missed = near.shares()[:n], near.whole[:n] == 0
    visible[missed] = 1.0
    if views.roaming:
        np.maximum(visible, anywhere.shares()[:n], out=visible)
        missed &= anywhere.whole[:n] == 0
    coverages = leaves_of(own, rows, work.frame).coverages
    weights = visible_weights(coverages, visible[rows], work.settings.parameters.hidden)
    facts = {
        "light": light,
        "weight": float(weights.sum()),
        "coverage": float(coverages.sum()),
        "shown": float(coverages[((visible >= SHOWN) & ~missed)[rows]].sum()),
    }
    return write_table(work.scratch, name, {VISIBLE: visible}, facts)


def light_of(work: "Work", block: int) -> list[float]:
    """How much of a block each of the views shows, pixels of alpha 1."""
    return [float(light) for light in work.of_block("look", block).facts["light"]]


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

"""Coarse levels of the whole scene, which replace all other blocks when a block is rendered.

The fine one is used for occlusion, the rough one surrounds a part while it is fitted.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

from nanogs.method.store import store_groups
from nanogs.pipeline.scene import Task
from nanogs.pipeline.tasks.blocks import leaves_of
from nanogs.pipeline.tasks.cuts import cut_block
from nanogs.pipeline.tasks.parts import read_part
from nanogs.raster.rendering import PreparedSplats, prepare
from nanogs.splats import concatenate
from nanogs.store.columns import columns_of, count_of
from nanogs.store.tables import Record

if TYPE_CHECKING:
    from nanogs.pipeline.work import Work

GROWTH = 1.5  # most that its splats are enlarged, so that they still hide what is behind them


def write_coarse(work: "Work", task: Task) -> Record:
    """Write a block's splats of a coarse level, `FINE` or `ROUGH`, with harmonics of degree 0."""
    splats, rows = work.block(task.number)
    splats = replace(splats.with_sh_degree(0), extras={})
    groups = int(work.of_job("outline").facts["groups"][task.level][task.number])
    units = work.units
    leaves = leaves_of(splats, rows, units)
    rough = work.of_block("rough", task.number)
    labels = cut_block(work.scratch, rough, groups, rough, 0)
    stored = store_groups(leaves, labels, splats, units.centre(), units.dilation(), growth=GROWTH)
    return work.write(task.name, columns_of(stored.grown(GROWTH)), {})


def surroundings(work: "Work", block: int, level: int) -> PreparedSplats | None:
    """Prepare all other blocks for rendering with a block; None if there are none.

    Args:
        work: The job; the coarse levels are done.
        block: Number of the block.
        level: The coarse level that the others are read at, `FINE` or `ROUGH`.
    """
    if work.partition.blocks == 1:
        return None
    layout = work.settings.layout.bare()
    others = concatenate(
        [
            read_part(work.scratch, layout, record)
            for number, record in enumerate(work.of_blocks("coarse", level))
            if number != block and count_of(record)
        ]
    )
    return prepare(others)

"""Coarse levels of the whole scene: what a block sees of all others.

The finer one tells what hides what; the rougher one surrounds a part while it is fitted.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

from nanogs.method.store import store_groups
from nanogs.pipeline.blocks import leaves_of
from nanogs.pipeline.cuts import cut_block
from nanogs.pipeline.memory_blocks import COARSE_SHARES, most_coarse
from nanogs.pipeline.parts import read_part
from nanogs.pipeline.settings import Settings
from nanogs.raster.rendering import PreparedSplats, prepare
from nanogs.splats import Splats, concatenate
from nanogs.store.columns import columns_of, count_of
from nanogs.store.tables import Record, write_table

if TYPE_CHECKING:
    from nanogs.pipeline.work import Work

GROWTH = 1.5  # most that its splats grow: what they hide is hidden


def outline_counts(settings: Settings, blocks: int) -> list[int]:
    """Splats of each coarse level of a job, one a block at the least."""
    levels = range(len(COARSE_SHARES))
    return [max(most_coarse(n, settings.block, settings.splats), blocks) for n in levels]


def write_coarse(work: "Work", name: str, block: int, level: int) -> Record:
    """Write the splats that stand for a block where others are looked at, in one colour each.

    Args:
        work: The job, the rough forests and their budgets done.
        name: Of the table.
        block: Its number.
        level: Fine or rough.
    """
    splats, rows = work.block(block)
    splats = replace(splats.with_sh_degree(0), extras={})
    units, groups = work.units, int(work.of_job("outline").facts["groups"][level][block])
    leaves = leaves_of(splats, rows, units)
    labels = cut_block(work.scratch, work.of_block("rough", block), groups)
    stored = store_groups(leaves, labels, splats, units.centre(), units.dilation(), growth=GROWTH)
    return write_table(work.scratch, name, columns_of(stored.grown(GROWTH)), {})


def coarse_scene(work: "Work", level: int, but: int | None = None) -> Splats | None:
    """A coarse level of all blocks but one; None where there are no others.

    Args:
        work: The job, the coarse levels done.
        level: Fine or rough.
        but: What is left out; None for nothing.
    """
    if work.partition.blocks == 1:
        return None
    layout = work.settings.layout.bare()
    records = work.of_blocks("coarse", level)
    return concatenate(
        [
            read_part(work.scratch, layout, record)
            for number, record in enumerate(records)
            if number != but and count_of(record)
        ]
    )


def surroundings(work: "Work", block: int, level: int) -> PreparedSplats | None:
    """A coarse level of all other blocks, to be drawn; None where there are none."""
    scene = coarse_scene(work, level, block)
    return None if scene is None else prepare(scene)

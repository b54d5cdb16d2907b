"""Levels of detail of a block as chunks: the block's cells, and the files of each of its levels.

Each block has its own tree of cells, which is built from its finest level. Its coarser levels were
merged from the same splats, and are put into the same cells. If few splats are left of a block, its
files also hold those of the next blocks: which ones depends on the counts alone, so that any worker
can make the files. The sink decides how chunks are encoded.
"""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from nanogs._types import Array
from nanogs.block_layouts import BlockChunks
from nanogs.findings import of_plain, to_plain
from nanogs.pipeline.scene import Task
from nanogs.pipeline.tasks.parts import count_of_block, means_of_block, part_of_block
from nanogs.progress import PartProgress
from nanogs.splats import concatenate
from nanogs.store.tables import Record, Table, write_table

if TYPE_CHECKING:
    from nanogs.pipeline.work import Work


def write_cells(work: "Work", task: Task) -> Record:
    """Divide a block's finest level into cells; without splats the table is empty."""
    means = means_of_block(work, task.number)
    cells = work.settings.chunked.divide(means) if len(means) else {}
    return write_table(work.scratch, task.name, cells, {})


def write_chunks(work: "Work", task: Task) -> Record:
    """Write the files of a block at a level into a table, each as a column of bytes.

    If blocks share files, all of these are in the table of the first block that has cells.
    """
    block, level = task.number, task.level
    cells = _cells(work, block)
    made = BlockChunks(cells)
    together = _together(work, block, level) if cells else []
    if together:
        finer = work.of_block("chunk", block, level - 1).facts["chunks"] if level else None
        parts = [part_of_block(work, each, level) for each in together]
        blocks = [
            (len(part), _cells(work, each)) for part, each in zip(parts, together, strict=True)
        ]
        splats = parts[0] if len(parts) == 1 else concatenate(parts)
        del parts
        made = work.settings.chunked.encode(splats, blocks, finer, f"{level}_{block}_")
        del splats
    losses = [to_plain(loss) for loss in made.losses]
    facts = {"splats": made.splats, "losses": losses, "chunks": made.chunks}
    columns = ((file, np.frombuffer(data, np.uint8)) for file, data in made.files)
    return write_table(work.scratch, task.name, columns, facts)


def blocks_of(work: "Work", level: int, on_progress: PartProgress) -> Iterator[BlockChunks]:
    """Yield the blocks of a level as `write_chunks` wrote them; progress counts all levels."""
    levels, blocks = work.settings.levels, work.partition.blocks
    for block, record in enumerate(work.of_blocks("chunk", level)):
        on_progress(level * blocks + block, levels * blocks)
        facts = record.facts
        yield BlockChunks(
            _cells(work, block),
            facts["splats"],
            [*map(of_plain, facts["losses"])],
            _files(work, record),
            facts["chunks"],
        )


def _together(work: "Work", block: int, level: int) -> list[int]:
    """Return the blocks that share files, if `block` is the first of them; otherwise none.

    Blocks without any splats are left out; a block with splats in the finest level alone is not.
    """
    holding = [each for each in range(work.partition.blocks) if _has_cells(work, each)]
    counts = [count_of_block(work, each, level) for each in holding]
    for group in group_blocks(counts, work.settings.chunked.fewest):
        if holding[group.start] == block:
            return holding[group.start : group.stop]
    return []


def group_blocks(counts: Sequence[int], fewest: int) -> list[range]:
    """Group consecutive blocks until each group has `fewest` splats, if there are that many.

    Args:
        counts: Number of splats of each block.
        fewest: Least number of splats of a group; 0 makes each block a group of its own.

    Returns:
        The groups, as ranges of indices into `counts`.
    """
    ends, held = [0], 0
    for number, count in enumerate(counts, 1):
        held += count
        if held >= fewest:
            ends.append(number)
            held = 0
    if ends[-1] < len(counts):  # the remaining blocks join the last group
        ends[max(len(ends) - 1, 1) :] = [len(counts)]
    return [range(*pair) for pair in pairwise(ends)]


def _has_cells(work: "Work", block: int) -> bool:
    return bool(work.of_block("cells", block).columns)


def _cells(work: "Work", block: int) -> dict[str, Array]:
    with work.table("cells", block) as table:
        return {column: table.read(column) for column in table.record.columns}


def _files(work: "Work", record: Record) -> Iterator[tuple[str, bytes]]:
    with Table(work.scratch, record) as table:
        for name in record.columns:
            yield name, table.read(name).tobytes()

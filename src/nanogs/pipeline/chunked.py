"""The levels of a block as chunks: its cells, and the files of each of its levels.

Each block has a tree of cells of its own, made from its finest level; the splats of its coarser
levels, which are what its own became, are put into these cells. Where few are left of a block, its
files hold those of the next blocks too: which ones follows from counts alone, so that files can be
made anywhere. How chunks are made is the sink's business.
"""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from nanogs._types import Array
from nanogs.block_layouts import BlockChunks
from nanogs.findings import of_plain, to_plain
from nanogs.pipeline.parts import count_of_block, means_of_block, part_of_block
from nanogs.progress import Parts
from nanogs.splats import concatenate
from nanogs.store.tables import Record, Table, write_table

if TYPE_CHECKING:
    from nanogs.pipeline.work import Work


def write_cells(work: "Work", name: str, block: int) -> Record:
    """Divide a block's finest level.

    Args:
        work: The job, the parts of all levels done.
        name: Of the table, which is empty where the block holds nothing.
        block: Its number.
    """
    means = means_of_block(work, block, 0)
    cells = work.settings.chunked.divide(means) if len(means) else {}
    return write_table(work.scratch, name, cells, {})


def write_chunks(work: "Work", name: str, block: int, level: int) -> Record:
    """Write the files of a block at a level into a table, each as a column of bytes.

    Of blocks whose files are made together, the table of the first that holds anything has all.

    Args:
        work: The job, all cells and the chunks of the finer levels done.
        name: Of the table.
        block: Its number.
        level: Of the result.
    """
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
    return write_table(work.scratch, name, columns, facts)


def blocks_of(work: "Work", level: int, tell: Parts) -> Iterator[BlockChunks]:
    """The blocks of a level as `write_chunks` made them; told of those of all levels."""
    levels, blocks = work.settings.levels, work.partition.blocks
    for block, record in enumerate(work.of_blocks("chunk", level)):
        tell(level * blocks + block, levels * blocks)
        facts = record.facts
        yield BlockChunks(
            _cells(work, block),
            facts["splats"],
            [*map(of_plain, facts["losses"])],
            _files(work, record),
            facts["chunks"],
        )


def _together(work: "Work", block: int, level: int) -> list[int]:
    """The blocks that share files of which this one is the first; none if it is not the first.

    Blocks that hold nothing at all are left out; one of the finest level alone is not.
    """
    holding = [each for each in range(work.partition.blocks) if _has_cells(work, each)]
    counts = [count_of_block(work, each, level) for each in holding]
    for group in joined_up(counts, work.settings.chunked.fewest):
        if holding[group.start] == block:
            return holding[group.start : group.stop]
    return []


def joined_up(counts: Sequence[int], fewest: int) -> list[range]:
    """Neighbours put together until each group has so many, unless there are fewer in all.

    Args:
        counts: Of splats.
        fewest: Of a group; 0 leaves each by itself.
    """
    ends, held = [0], 0
    for number, count in enumerate(counts, 1):
        held += count
        if held >= fewest:
            ends.append(number)
            held = 0
    if ends[-1] < len(counts):  # what is left goes to the last group
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

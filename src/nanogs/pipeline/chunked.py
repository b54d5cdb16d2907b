"""The levels of a block as chunks for a viewer: its cells, and the files of each of its levels.

Each block has a tree of cells of its own, made from its finest level; the splats of its coarser
levels, which are what its own became, are put into these cells. Nothing is shared with other
blocks, so that their files can be made anywhere.
"""

import operator
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from nanogs._types import F64, I64
from nanogs.findings import Finding, Names
from nanogs.io.sog import write as sog_write
from nanogs.lod import streamed_sog, tiles
from nanogs.lod.boxes import Box
from nanogs.lod.cells import Cells, divide
from nanogs.lod.chunks import SortedLevel
from nanogs.lod.streamed_sog import Place
from nanogs.lod.tileset import Tile
from nanogs.pipeline.parts import means_of_block, part_of_block
from nanogs.pipeline.settings import SOG, Chunks
from nanogs.splats import Splats
from nanogs.store.scratch import Scratch
from nanogs.store.tables import Record, Table, write_table

if TYPE_CHECKING:
    from nanogs.pipeline.work import Work

_COUNTS = "counts"
_CELLS = ("axes", "planes", "children", "leaves")


def write_cells(work: "Work", name: str, block: int) -> Record:
    """Divide a block's finest level, and count the splats of every level in each cell.

    Args:
        work: The job, the parts of all levels done.
        name: Of the table, which is empty where the block holds nothing.
        block: Its number.
    """
    chunks = work.settings.chunked
    means = [means_of_block(work, block, level) for level in range(work.settings.levels)]
    if not len(means[0]):
        return write_table(work.scratch, name, {}, {})
    cells = divide(means[0], chunks.most)
    counts = [np.bincount(cells.leaf_of(each), minlength=cells.count) for each in means]
    columns = {column: getattr(cells, column) for column in _CELLS}
    return write_table(work.scratch, name, columns | {_COUNTS: np.stack(counts)}, {})


def read_cells(scratch: Scratch, record: Record) -> tuple[Cells, I64] | None:
    """A block's cells, and (levels, leaves) the splats in each; None for a block without any."""
    if not record.columns:
        return None
    with Table(scratch, record) as table:
        return Cells(**{column: table.read(column) for column in _CELLS}), table.read(_COUNTS)


def write_chunks(work: "Work", name: str, block: int, level: int) -> Record:
    """Write the files of a block at a level into a table, each as a column of bytes.

    Args:
        work: The job, all cells done.
        name: Of the table.
        block: Its number.
        level: Of the result.
    """
    chunks = work.settings.chunked
    found = read_cells(work.scratch, work.of_block("cells", block))
    if found is None:
        return write_table(work.scratch, name, {}, {"splats": 0, "losses": [], "chunks": []})
    cells, counts = found
    splats = part_of_block(work, block, level)
    described: list[Any] = []
    losses = _kept(_losses(chunks, splats)) if len(splats) else []
    facts = {"splats": len(splats), "losses": losses, "chunks": described}
    sorted_level = SortedLevel(splats, cells)
    del splats
    prefix = f"{level}_{block}_"
    if chunks.layout == SOG:
        files = _models(sorted_level, chunks, prefix, described)
    else:
        nodes = cut_of(cells, counts, chunks.most, level)
        files = _tiles(sorted_level, cells, nodes, chunks, prefix, described)
    columns = ((file, np.frombuffer(data, np.uint8)) for file, data in files)
    return write_table(work.scratch, name, columns, facts)


def cut_of(cells: Cells, counts: I64, most: int, level: int) -> list[int]:
    """The nodes of a level's tiles: each level is cut where the finer one was."""
    nodes: list[int] = []
    finer = cells.all_leaves()
    for each in counts[: level + 1]:
        nodes = cells.cut(each, most, finer)
        finer = frozenset(nodes)
    return nodes


def _models(
    level: SortedLevel, chunks: Chunks, prefix: str, described: list[Any]
) -> Iterator[tuple[str, bytes]]:
    for model in streamed_sog.encode(level, streamed_sog.CHUNKS_A_FILE * chunks.most, prefix):
        places = [[p.leaf, p.offset, p.splats, *_numbers(p.box)] for p in model.places]
        described.append([model.folder, places])
        yield from ((f"{model.folder}/{file}", data) for file, data in model.files.items())


def _tiles(
    level: SortedLevel,
    cells: Cells,
    nodes: Sequence[int],
    chunks: Chunks,
    prefix: str,
    described: list[Any],
) -> Iterator[tuple[str, bytes]]:
    form = tiles.form_of(plain=not chunks.spz)
    for node, tile, data in tiles.encode(level, cells, nodes, form, prefix):
        box = _numbers(tile.box) if tile.box else None
        described.append([node, tile.content, box, tile.width])
        if tile.content:
            yield tile.content, data


def places_of(record: Record) -> Iterator[tuple[str, list[Place]]]:
    """The folder of each model that `write_chunks` made, and what is where in it."""
    for folder, places in record.facts["chunks"]:
        yield folder, [Place(leaf, at, n, _box(box)) for leaf, at, n, *box in places]


def tiles_of(record: Record) -> dict[int, Tile]:
    """The tiles that `write_chunks` made, by their node; empty ones have the width 0."""
    return {
        node: Tile(content, _box(box) if box else None, width)
        for node, content, box, width in record.facts["chunks"]
    }


def losses_of(record: Record) -> list[str]:
    """Name what the files leave out of a block's level, in sentences that can be joined."""
    found: list[str] = []
    for template, value in record.facts["losses"]:
        if value is None:
            found.append(template)
        elif isinstance(value, list):
            found.append(Finding(template, Names(value), Names.union))
        else:
            found.append(Finding(template, value, operator.add))
    return found


def _losses(chunks: Chunks, splats: Splats) -> Sequence[str]:
    if chunks.layout == SOG:
        return sog_write.losses(splats)
    return tiles.form_of(plain=not chunks.spz).losses(splats)


def _kept(losses: Sequence[str]) -> list[list[Any]]:
    """Sentences as plain data: their templates and values."""
    kept = []
    for sentence in losses:
        if isinstance(sentence, Finding):
            names = isinstance(sentence.value, Names)
            kept.append([sentence.template, [*sentence.value] if names else sentence.value])
        else:
            kept.append([sentence, None])
    return kept


def _numbers(box: Box) -> list[float]:
    return [*box.low.tolist(), *box.high.tolist()]


def _box(numbers: Sequence[float]) -> Box:
    corners: F64 = np.array(numbers).reshape(2, 3)
    return Box(*corners)

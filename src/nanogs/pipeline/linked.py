"""The levels of a block as a tree, for results that are linked to one in the end.

Each block has a tree of its own, of what its levels are left with, down from a few roots: blocks
need nothing of each other. How levels are linked is the sink's business.
"""

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from nanogs._types import I64, Array
from nanogs.block_layouts import BlockTree
from nanogs.pipeline.parts import LevelSource
from nanogs.source import Layout, Source, Turned
from nanogs.source.base import joined_rows
from nanogs.splats import Splats
from nanogs.store.columns import columns_of, count_of, empty_columns, splats_of
from nanogs.store.scratch import Scratch
from nanogs.store.tables import Record, Streamed, Table, write_table

if TYPE_CHECKING:
    from nanogs.pipeline.work import Work

_ROOTS = 1 << 10  # of all blocks, about; each takes as many reads as there are layers in the end
_TOGETHER = 4  # splats that become one, step by step, up to the roots
_STRETCHES, _LONG = 64, 1024  # runs of rows of the finest level, and rows of each, in a sample
_ROWS = 1 << 14  # that are written at a time
_SPLATS, _CHILDREN, _ROOT = "splats-", "children-", "root-"


def linked_levels(work: "Work") -> int:
    """How many levels are linked block by block: those that blocks could be cut to."""
    levels = range(work.settings.levels)
    return sum(_count(work, level) <= work.target(level) for level in levels)


def write_tree(work: "Work", name: str, block: int) -> Record:
    """Link the levels of a block, and write all layers.

    Args:
        work: The job, the parts of all levels done.
        name: Of the table.
        block: Its number.
    """
    levels, steps = linked_levels(work), 0
    if levels < work.settings.levels:
        levels += 1  # cut as far as blocks can be: the rest is done above it
    else:
        while _count(work, levels - 1) > _ROOTS * _TOGETHER**steps:
            steps += 1
    some, linked = even_sample(work), work.settings.linked
    with ExitStack() as stack:
        parts = [stack.enter_context(LevelSource(work, level, block)) for level in range(levels)]
        tree = linked.link([_turned(work, each) for each in parts], some, work.threads, steps)
    columns: dict[str, Array | Streamed] = {}
    for number, (layer, children) in enumerate(zip(tree.layers, tree.children, strict=True)):
        shape = layer.count, _dtype(layer.columns).itemsize
        columns[f"{_SPLATS}{number}"] = Streamed(np.dtype(np.uint8), shape, _packed(layer))
        columns[f"{_CHILDREN}{number}"] = children(0, layer.count).astype("<u2")
    columns |= {_ROOT + key: column for key, column in tree.roots.items()}
    return write_table(work.scratch, name, columns, {"layers": len(tree.layers)})


def trees_of(work: "Work") -> list[BlockTree]:
    """The trees of all blocks, as `write_tree` made them."""
    return [_tree_of(work, record) for record in work.of_blocks("tree")]


def even_sample(work: "Work") -> Splats:
    """Splats of the finest level, spread over the scene in stretches."""
    with LevelSource(work, 0) as parts:
        long = min(_LONG, -(-parts.count // _STRETCHES))
        starts = np.linspace(0, parts.count - long, _STRETCHES).astype(np.int64)
        read = [_turned(work, parts).read(start, start + long) for start in np.unique(starts)]
    return replace(joined_rows(read), extras={}, notes=())


def _count(work: "Work", level: int) -> int:
    return sum(map(count_of, work.delivered(level)))


def _turned(work: "Work", source: Source) -> Source:
    """In the frame that results are turned to."""
    return Turned(source, *work.settings.frame) if work.settings.frame else source


def _tree_of(work: "Work", record: Record) -> BlockTree:
    layout, numbers = work.settings.result_layout, range(record.facts["layers"])
    layers = [_Layer(work.scratch, record, f"{_SPLATS}{number}", layout) for number in numbers]
    counts = [partial(_counts, work.scratch, record, f"{_CHILDREN}{number}") for number in numbers]
    with Table(work.scratch, record) as table:
        names = (name for name in record.columns if name.startswith(_ROOT))
        roots = {name.removeprefix(_ROOT): table.read(name) for name in names}
    return BlockTree(layers, counts, roots)


def _counts(scratch: Scratch, record: Record, column: str, start: int, stop: int) -> I64:
    with Table(scratch, record) as table:
        return table.read(column, start, stop).astype(np.int64)


class _Layer(Source):
    """The splats of a layer, whose file is open while they are read."""

    def __init__(self, scratch: Scratch, record: Record, column: str, layout: Layout) -> None:
        self._scratch, self._record, self._column = scratch, record, column
        self.count = record.columns[column].shape[0]
        self.columns = replace(layout, extras=())

    def _span(self, start: int, stop: int) -> Splats:
        """Some rows; see `Source`."""
        with Table(self._scratch, self._record) as table:
            rows = table.read(self._column, start, stop).view(_dtype(self.columns))[:, 0]
        columns = {name: np.ascontiguousarray(rows[name]) for name in rows.dtype.names or ()}
        return splats_of(columns, self.columns)


def _packed(layer: Source) -> Iterator[Array]:
    """All columns of some rows at a time, side by side."""
    dtype = _dtype(layer.columns)
    for block in layer.blocks(_ROWS):
        rows, columns = np.empty((len(block), 1), dtype), columns_of(block)
        for name in dtype.names or ():
            rows[name][:, 0] = columns[name]
        yield rows.view(np.uint8)


def _dtype(layout: Layout) -> "np.dtype[np.void]":
    """A splat without extra columns."""
    columns = empty_columns(replace(layout, extras=()), 0)
    return np.dtype([(name, each.dtype, each.shape[1:]) for name, each in columns.items()])

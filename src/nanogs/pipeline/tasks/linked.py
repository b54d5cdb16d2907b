"""The levels of detail of a block as a tree; the sink joins the trees of all blocks in the end.

Each block has its own tree, with the splats of its levels below a few roots, so that blocks are
independent of each other. The sink decides how levels are linked.
"""

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from nanogs._types import I64, Array
from nanogs.block_layouts import TOGETHER, BlockTree
from nanogs.pipeline.scene import Task
from nanogs.pipeline.tasks.parts import LevelSource
from nanogs.source import Layout, Source, turned_source
from nanogs.source.base import joined_rows
from nanogs.splats import Splats
from nanogs.store.columns import columns_of, empty_columns, splats_of
from nanogs.store.scratch import Scratch
from nanogs.store.tables import Record, Streamed, Table, write_table

if TYPE_CHECKING:
    from nanogs.pipeline.work import Work

_ROOTS = 1 << 10  # approximate number of roots of all blocks; each costs one read per layer
_STRETCHES, _LONG = 64, 1024  # a sample: number of runs of rows of the finest level, rows of each
_ROWS = 1 << 14  # rows that are written at a time
_SPLATS, _CHILDREN, _ROOT = "splats-", "children-", "root-"


def linked_levels(work: "Work") -> int:
    """Return the number of levels that are linked block by block: those blocks can be cut to."""
    levels = range(work.settings.levels)
    return sum(work.delivered_count(level) <= work.target(level) for level in levels)


def write_tree(work: "Work", task: Task) -> Record:
    """Link the levels of a block to a tree, and write all its layers to a table."""
    levels, steps = linked_levels(work), 0
    if levels < work.settings.levels:
        levels += 1  # the coarsest that blocks can be cut to; coarser levels are merged from it
    else:
        while work.delivered_count(levels - 1) > _ROOTS * TOGETHER**steps:
            steps += 1
    some, linked = even_sample(work), work.settings.linked
    with ExitStack() as stack:
        sources = (LevelSource(work, level, task.number) for level in range(levels))
        parts = [stack.enter_context(each) for each in sources]
        tree = linked.link([_turned(work, each) for each in parts], some, steps)
    columns: dict[str, Array | Streamed] = {}
    for number, (layer, children) in enumerate(zip(tree.layers, tree.children, strict=True)):
        shape = layer.count, _dtype(layer.columns).itemsize
        columns[f"{_SPLATS}{number}"] = Streamed(np.dtype(np.uint8), shape, _packed(layer))
        columns[f"{_CHILDREN}{number}"] = children(0, layer.count).astype("<u2")
    columns |= {_ROOT + key: column for key, column in tree.roots.items()}
    return write_table(work.scratch, task.name, columns, {"layers": len(tree.layers)})


def trees_of(work: "Work") -> list[BlockTree]:
    """Read the trees of all blocks that `write_tree` wrote."""
    return [_tree_of(work, record) for record in work.of_blocks("tree")]


def even_sample(work: "Work") -> Splats:
    """Read a sample of the finest level: runs of rows spread evenly over the scene."""
    with LevelSource(work, 0) as parts:
        long = min(_LONG, -(-parts.count // _STRETCHES))
        starts = np.linspace(0, parts.count - long, _STRETCHES).astype(np.int64)
        read = [_turned(work, parts).read(start, start + long) for start in np.unique(starts)]
    return replace(joined_rows(read), extras={}, notes=())


def _turned(work: "Work", source: Source) -> Source:
    """Turn a source to the frame of the results."""
    return turned_source(source, work.settings.frame)


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
    """The splats of a layer as a source, whose file is opened for each read."""

    def __init__(self, scratch: Scratch, record: Record, column: str, layout: Layout) -> None:
        self._scratch, self._record, self._column = scratch, record, column
        self.count = record.columns[column].shape[0]
        self.columns = replace(layout, extras=())

    def _span(self, start: int, stop: int) -> Splats:
        """Read rows `start` to `stop`; see `Source`."""
        with Table(self._scratch, self._record) as table:
            rows = table.read(self._column, start, stop).view(_dtype(self.columns))[:, 0]
        columns = {name: np.ascontiguousarray(rows[name]) for name in rows.dtype.names or ()}
        return splats_of(columns, self.columns)


def _packed(layer: Source) -> Iterator[Array]:
    """Yield the rows of a layer as bytes, `_ROWS` at a time, all columns of a row adjacent."""
    dtype = _dtype(layer.columns)
    for block in layer.blocks(_ROWS):
        rows, columns = np.empty((len(block), 1), dtype), columns_of(block)
        for name in dtype.names or ():
            rows[name][:, 0] = columns[name]
        yield rows.view(np.uint8)


def _dtype(layout: Layout) -> "np.dtype[np.void]":
    """Return the structured dtype of a splat without its extra columns."""
    columns = empty_columns(replace(layout, extras=()), 0)
    return np.dtype([(name, each.dtype, each.shape[1:]) for name, each in columns.items()])

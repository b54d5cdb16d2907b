"""Reading the splats of a block from the sorted segments, and making merge nodes of them."""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from nanogs._types import F64, I32, I64, Array
from nanogs.method.nodes import LIGHTEST, Nodes, activate_nodes, prominence, without_coverages
from nanogs.pipeline.tasks.partition import Partition
from nanogs.pipeline.tasks.units import Units
from nanogs.source import Layout
from nanogs.splats import Splats
from nanogs.store.columns import CODES, empty_columns, read_rows
from nanogs.store.scratch import Scratch
from nanogs.store.tables import Record, Table
from nanogs.views.light import visible_weights


def read_block(
    scratch: Scratch,
    segments: Sequence[Record],
    partition: Partition,
    block: int,
    columns: Mapping[str, Array],
    at: int = 0,
    rows: I64 | None = None,
) -> int:
    """Read the splats of a block into arrays, segment by segment.

    Args:
        scratch: Storage of the segments.
        segments: Their records.
        partition: Row range of each block in each segment.
        block: Number of the block.
        columns: Arrays to fill, keyed by column names of the tables.
        at: The first row to fill.
        rows: Rows of the block to read, ascending; all by default.

    Returns:
        The row after the last one filled.
    """
    start, found = 0, []
    for record, piece in zip(segments, partition.pieces(block), strict=True):
        stop = start + piece.stop - piece.start
        if rows is None:
            wanted: I64 | slice = piece
            count = stop - start
        else:
            inside = rows[np.searchsorted(rows, start) : np.searchsorted(rows, stop)]
            wanted, count = inside - start + piece.start, len(inside)
        if count:
            found.append((record, at, wanted))
        start, at = stop, at + count

    def fill(place: tuple[Record, int, I64 | slice]) -> None:
        record, at, wanted = place
        with Table(scratch, record) as table:
            read_rows(table, columns, at, wanted)

    if scratch.at_once == 1:
        for each in found:
            fill(each)
    else:
        with ThreadPoolExecutor(scratch.at_once) as pool:
            list(pool.map(fill, found))
    return at


@dataclass(frozen=True, slots=True, eq=False)
class Visibility:
    """The visibility of splats in the views, by which the weights of their nodes are scaled.

    Attributes:
        visible: (N,) visibility of each splat.
        hidden: Weight of a splat that no view shows, relative to a fully visible one.
        typical: Unit of the weights, which are divided by it, in square scene units.
    """

    visible: F64
    hidden: float
    typical: float


def leaves_of(
    splats: Splats,
    rows: I64 | I32,
    units: Units,
    weighing: Visibility | None = None,
    *,
    growing: bool = False,
) -> Nodes:
    """Make a merge node for each row, in the units shared by all blocks.

    Args:
        splats: N splats of a block, and perhaps of its halo.
        rows: (M,) rows of them, in the nodes' order.
        units: The units.
        weighing: The visibility of the splats; by default all count as fully visible.
        growing: As a forest needs them: without coverages, and with blurred covariances.
    """
    nodes = activate_nodes(
        splats, rows, units.centre(), units.dilation(), units.thinnest, blurred=growing
    )
    prominences = prominence(nodes.coverages, nodes.means, units.viewers())
    if weighing is None:
        weights = prominences / units.prominence
    else:
        weights = visible_weights(prominences, weighing.visible[rows], weighing.hidden)
        weights /= weighing.typical
    np.maximum(weights, LIGHTEST, out=nodes.weights)
    return without_coverages(nodes) if growing else nodes


def with_codes(layout: Layout, count: int) -> dict[str, Array]:
    """Return uninitialised columns for `count` splats and their Morton codes."""
    return empty_columns(layout, count) | {CODES: np.empty(count, np.uint64)}

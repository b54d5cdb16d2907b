"""Cutting a block's forest into groups, and the table of the groups' members and centres."""

import numpy as np

from nanogs._types import F32, F64, I32, Array
from nanogs.method.cut import label_groups
from nanogs.method.nodes import Nodes
from nanogs.method.reassign import NEIGHBOURS
from nanogs.neighbours import nearest_neighbours
from nanogs.pipeline.tasks.forests import CHILDREN, scores_of
from nanogs.store.scratch import Scratch
from nanogs.store.tables import Record, Sorted, read_column, write_table

LABELS, CENTRES, REACH = "labels", "centres", "reach"


def read_merges(scratch: Scratch, forest: Record, scored: Record, number: int) -> tuple[I32, F32]:
    """Read the merges of a block's forest, and their scores.

    Args:
        scratch: Storage of the forest.
        forest: Its record.
        scored: Record of the table that holds the scores.
        number: Of the scores in it.
    """
    children = read_column(scratch, forest, CHILDREN)
    return children, read_column(scratch, scored, scores_of(number))


def cut_block(scratch: Scratch, forest: Record, groups: int, scored: Record, number: int) -> I32:
    """Return (N,) int32, the group of each leaf of a block's forest, in Morton order.

    Args:
        scratch: Storage of the forest.
        forest: Its record.
        groups: Number of groups to keep.
        scored: Record of the table that holds the scores of the merges.
        number: Of the scores in it.
    """
    children, scores = read_merges(scratch, forest, scored, number)
    if len(children) == 0:
        return np.arange(int(forest.facts["splats"]), dtype=np.int32)
    return label_groups(int(forest.facts["splats"]), children, scores, groups)


def write_cut(scratch: Scratch, name: str, leaves: Nodes, labels: I32, groups: int) -> Record:
    """Write the groups of a block: the group of each row, and each group's centre and reach.

    Args:
        scratch: Storage to write to.
        name: Name of the table.
        leaves: The block's splats; only weights and centres are used.
        labels: (N,) the group of each leaf.
        groups: Number of groups.
    """
    totals = np.bincount(labels, leaves.weights, groups)
    centres = np.empty((groups, 3))
    for axis in range(3):
        sums = np.bincount(labels, leaves.weights * leaves.means[:, axis], groups)
        centres[:, axis] = sums / totals
    reach = _reach(centres)
    facts = {
        "groups": groups,
        "low": [float(value) for value in centres.min(axis=0)],
        "high": [float(value) for value in centres.max(axis=0)],
        "reach": float(reach.max()),
    }
    by_row = np.empty_like(labels)
    by_row[leaves.rows] = labels
    columns: dict[str, Array | Sorted] = {LABELS: by_row, CENTRES: centres, REACH: reach}
    return write_table(scratch, name, columns, facts)


def _reach(centres: F64) -> F64:
    """Return (G,) the distance from each group to the furthest one its splats may move to."""
    nearest = nearest_neighbours(centres, NEIGHBOURS)
    if nearest.shape[1] == 0:
        return np.zeros(len(centres))
    distances: F64 = np.linalg.norm(centres[nearest[:, -1]] - centres, axis=1)
    return distances

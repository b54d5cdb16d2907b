"""Reassignment across borders: a block's splats move between its groups and others nearby.

Each block does the rounds for its own splats and for those of its halo, which see the same groups
if the halo is deep enough; only the outcome for its own splats counts. So every splat is counted
once, regardless of what the neighbours found. One that ends in another block's group is handed
over.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from nanogs._types import F64, I32, I64, Array
from nanogs.method.growth import Cover
from nanogs.method.nodes import Nodes, without_features
from nanogs.method.reassign import reassign
from nanogs.method.store import cover_of
from nanogs.method.viewers import Dilation
from nanogs.pipeline.scene import ROUNDS
from nanogs.pipeline.tasks.cuts import LABELS
from nanogs.pipeline.tasks.halo import Halo
from nanogs.store.scratch import Scratch
from nanogs.store.tables import Record, Sorted, Table, write_table

GROUP = "group"
GONE = -1  # the label of a splat that was handed over
COVER = {name: f"cover_{name}" for name in ("means", "covariances", "alphas")}


@dataclass(frozen=True, slots=True, eq=False)
class BlockWithHalo:
    """A block and its halo: the block's splats and groups first, then those of the halo.

    Attributes:
        leaves: A node for each splat.
        labels: (V,) int32, the group of each leaf.
        own: Splats of the block itself.
        groups: Groups of the block itself.
        halo: Splats and groups of other blocks.
    """

    leaves: Nodes
    labels: I32
    own: int
    groups: int
    halo: Sequence[Halo]


class Reassigned(NamedTuple):
    """The result of reassigning the splats of a block and its halo.

    Attributes:
        after: (N,) int32, the group of each of the block's own rows, of which every group of the
            block keeps one.
        labels: (V,) int32, the group of each leaf, with `after` for the block's own.
        rounds: Number of rounds in which splats moved.
    """

    after: I32
    labels: I32
    rounds: int


def reassigned(area: BlockWithHalo, rounds: int, dilation: Dilation) -> Reassigned:
    """Reassign, and find the group in which each of the block's splats ends.

    Args:
        area: The block and its halo.
        rounds: Rounds of reassignment, at most.
        dilation: As `activate_nodes` takes it.
    """
    own = area.leaves.rows < area.own
    rows = area.leaves.rows[own]
    before, after = np.empty(area.own, np.int32), np.empty(area.own, np.int32)
    weights = np.empty(area.own)
    before[rows], weights[rows] = area.labels[own], area.leaves.weights[own]
    total = area.groups + sum(len(each.groups) for each in area.halo)
    blurs = dilation.blurs(area.leaves.means)
    moved, done = reassign(area.leaves, area.labels, total, rounds, blurs)
    after[rows] = moved[own]
    keep_every_group(after, before, weights, area.groups)
    moved[own] = after[rows]
    return Reassigned(after, moved, done)


def reassigned_cover(area: BlockWithHalo, labels: I32, dilation: Dilation) -> Cover:
    """Return a block's groups after reassignment, as covers of other blocks' groups.

    Args:
        area: The block and its halo.
        labels: (V,) the group of each leaf.
        dilation: As `activate_nodes` takes it.
    """
    own = labels < area.groups
    return cover_of(without_features(area.leaves, own), labels[own], area.groups, dilation)


def read_cover(table: Table, groups: I64) -> Cover:
    """Read some groups of the cover that `write_reassigned` was given."""
    return Cover(**{name: table.read(column)[groups] for name, column in COVER.items()})


def keep_every_group(after: I32, before: I32, weights: F64, groups: int) -> None:
    """Refill empty groups in place: each takes back its heaviest former member that can be spared.

    A splat can be spared unless it is the last one of its new group. If no former member can, the
    heaviest of all others that can is taken.

    Args:
        after: (N,) the group of each splat; those from `groups` on are other blocks'.
        before: (N,) the groups before, all below `groups`, and none of these empty.
        weights: (N,) of each splat.
        groups: Groups of the block.
    """
    sizes = np.bincount(after, minlength=groups)
    sizes[groups:] = len(after) + 1  # other blocks refill their own
    for group in np.flatnonzero(sizes[:groups] == 0):
        rows = np.flatnonzero((before == group) & (sizes[after] > 1))
        if len(rows) == 0:  # N is at least the number of groups, so one can be spared
            rows = np.flatnonzero(sizes[after] > 1)
        row = rows[np.argmax(weights[rows])]
        sizes[after[row]] -= 1
        sizes[group] += 1
        after[row] = group


def write_reassigned(
    scratch: Scratch,
    name: str,
    found: Reassigned,
    area: BlockWithHalo,
    columns: dict[str, Array],
    cover: Cover | None,
) -> Record:
    """Write the labels of a block's rows, and the rows that it hands over, block by block.

    Args:
        scratch: Where to write.
        name: Of the table.
        found: The result of reassignment.
        area: The block and its halo.
        columns: Of the splats of the block and its halo, codes among them.
        cover: The groups as covers of other blocks' groups, if growth depends on them.
    """
    after, start = found.after, area.groups
    rows: list[I64] = [np.empty(0, np.int64)]
    groups: list[I64] = [np.empty(0, np.int64)]
    handed: dict[str, list[int]] = {}
    count = 0
    for each in area.halo:
        gone = np.flatnonzero((after >= start) & (after < start + len(each.groups)))
        if len(gone):
            rows.append(gone)
            groups.append(each.groups[after[gone] - start])
            handed[str(each.block)] = [count, count + len(gone)]
            count += len(gone)
        start += len(each.groups)
    labels = np.where(after < area.groups, after, GONE).astype(np.int32)
    taken = np.concatenate(rows)
    table: dict[str, Array | Sorted] = {LABELS: labels, GROUP: np.concatenate(groups)}
    table |= {key: Sorted(column, taken) for key, column in columns.items()}
    if cover is not None:
        table |= {column: getattr(cover, name) for name, column in COVER.items()}
    facts = {"handed": handed, "seen": len(area.leaves) - area.own, ROUNDS: found.rounds}
    return write_table(scratch, name, table, facts)


def block_with_halo(
    leaves: Nodes, labels: I32, own: int, groups: int, halo: Sequence[Halo]
) -> BlockWithHalo:
    """Put a block and its halo together, from labels by row.

    Args:
        leaves: A node for each splat; rows are the block's own first, then those of each halo.
        labels: (N,) the group of each of the block's own rows.
        own: N.
        groups: Groups of the block.
        halo: Splats and groups of other blocks.
    """
    by_row, start = [labels], groups
    for each in halo:
        by_row.append(each.labels + np.int32(start))
        start += len(each.groups)
    return BlockWithHalo(leaves, np.concatenate(by_row)[leaves.rows], own, groups, halo)

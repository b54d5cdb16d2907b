"""The halo of a block: nearby groups of other blocks, and the splats in them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nanogs._types import F64, I32, I64
from nanogs.neighbours import nearest_to
from nanogs.pipeline.options.settings import MOST_HALO
from nanogs.pipeline.tasks.cuts import CENTRES, LABELS, REACH
from nanogs.store.scratch import Scratch
from nanogs.store.tables import Record, Table, read_column

# A splat may be reassigned to groups within the reach of its own group. In the first round, a
# block's splats depend on groups one reach around it; in the next, these depend on groups one reach
# farther.
REACHES = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Halo:
    """The groups and splats of another block that are near a block.

    Attributes:
        block: Number of the other block.
        groups: (H,) int64, its groups that are near, ascending.
        rows: (R,) int64, its splats in these groups, ascending.
        labels: (R,) int32, the group of each splat, as an index into `groups`.
    """

    block: int
    groups: I64
    rows: I64
    labels: I32


@dataclass(frozen=True, slots=True, eq=False)
class Near:
    """The groups of another block that are near a block.

    Attributes:
        block: Number of the other block.
        groups: (H,) int64, its groups that are near, ascending.
        distances: (H,) float64, distance to the nearest group of the block, divided by the reach
            of that group.
    """

    block: int
    groups: I64
    distances: F64


def find_halo(scratch: Scratch, cuts: Sequence[Record], block: int, splats: int) -> list[Halo]:
    """Find the nearest groups of all other blocks, with at most `MOST_HALO * splats` splats.

    Args:
        scratch: Storage of the cuts.
        cuts: Their records.
        block: Number of the block whose halo is wanted.
        splats: Number of splats of that block.

    Returns:
        One halo for each other block that has any such groups, in the order of the blocks.
    """
    found = near_groups(scratch, cuts, block)
    kept = _nearest(found, _sizes(scratch, cuts, found), int(MOST_HALO * splats))
    return [_members(scratch, cuts, each) for each in kept]


def near_groups(scratch: Scratch, cuts: Sequence[Record], block: int) -> list[Near]:
    """Find all groups of other blocks near a block, without the limit of `find_halo`."""
    with Table(scratch, cuts[block]) as table:
        centres, reach = table.read(CENTRES), table.read(REACH)
    around = REACHES * float(cuts[block].facts["reach"])
    low, high = centres.min(axis=0) - around, centres.max(axis=0) + around
    found = []
    for other, record in enumerate(cuts):
        if other == block or not _overlap(record, low, high):
            continue
        theirs = read_column(scratch, record, CENTRES)
        inside = np.flatnonzero(((theirs >= low) & (theirs <= high)).all(axis=1))
        distances, nearest = nearest_to(theirs[inside], centres)
        near = distances < REACHES * reach[nearest]
        if near.any():
            relative = distances[near] / reach[nearest[near]]
            found.append(Near(other, inside[near], relative))
    return found


def _overlap(record: Record, low: F64, high: F64) -> bool:
    """Return whether the bounding box of a block's centres intersects another box."""
    facts = record.facts
    return bool((np.array(facts["low"]) <= high).all() and (np.array(facts["high"]) >= low).all())


def _sizes(scratch: Scratch, cuts: Sequence[Record], found: Sequence[Near]) -> list[I64]:
    """Return, for each entry of `found`, the number of splats of each of its groups."""
    return [
        np.bincount(read_column(scratch, cuts[each.block], LABELS))[each.groups] for each in found
    ]


def _nearest(found: Sequence[Near], counts: Sequence[I64], most: int) -> list[Near]:
    """Keep the nearest groups of all blocks, with at most `most` splats in total."""
    if not found:
        return []
    distances = np.concatenate([each.distances for each in found])
    sizes = np.concatenate(counts)
    order = np.argsort(distances, kind="stable")
    taken = np.empty(len(order), np.bool_)
    taken[order] = np.cumsum(sizes[order]) <= most
    kept, start = [], 0
    for each in found:
        mask = taken[start : start + len(each.groups)]
        start += len(mask)
        if mask.any():
            kept.append(Near(each.block, each.groups[mask], each.distances[mask]))
    return kept


def _members(scratch: Scratch, cuts: Sequence[Record], near: Near) -> Halo:
    labels = read_column(scratch, cuts[near.block], LABELS)
    places = np.full(int(cuts[near.block].facts["groups"]), -1, np.int32)
    places[near.groups] = np.arange(len(near.groups), dtype=np.int32)
    found = places[labels]
    rows = np.flatnonzero(found >= 0)
    return Halo(near.block, near.groups, rows, found[rows])

"""The groups of other blocks that lie near those of a block, and the splats in them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nanogs._types import F64, I32, I64
from nanogs.neighbours import nearest_to
from nanogs.pipeline.cuts import CENTRES, LABELS, REACH
from nanogs.pipeline.settings import MOST_SEEN
from nanogs.store.scratch import Scratch
from nanogs.store.tables import Record, Table

# A splat may move to groups within the reach of its own. Groups one reach around a block decide on
# its splats in the first round; these depend on groups one reach farther in the next.
REACHES = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Halo:
    """The groups and splats of another block that lie near a block.

    Attributes:
        block: The other.
        groups: (H,) int64, its groups that lie near, ascending.
        rows: (R,) int64, its splats in these, ascending.
        labels: (R,) int32, the group of each, as a place in `groups`.
    """

    block: int
    groups: I64
    rows: I64
    labels: I32


@dataclass(frozen=True, slots=True, eq=False)
class Near:
    """The groups of another block that lie near a block.

    Attributes:
        block: The other.
        groups: (H,) int64, these groups of it, ascending.
        distances: (H,) float64, from the nearest group of the block, in reaches of that one.
    """

    block: int
    groups: I64
    distances: F64


def find_halo(
    scratch: Scratch, cuts: Sequence[Record], block: int, splats: int, threads: int
) -> list[Halo]:
    """Find what lies near a block in each of the others, in their order: the nearest groups.

    Args:
        scratch: Where the cuts are.
        cuts: Their records.
        block: Whose neighbours.
        splats: Of that block.
        threads: Threads for the nearest-neighbour query.
    """
    found = near_groups(scratch, cuts, block, threads)
    kept = _nearest(found, _sizes(scratch, cuts, found), int(MOST_SEEN * splats))
    return [_members(scratch, cuts, each) for each in kept]


def near_groups(scratch: Scratch, cuts: Sequence[Record], block: int, threads: int) -> list[Near]:
    """All groups near a block in each of the others, in their order; see `find_halo`."""
    with Table(scratch, cuts[block]) as table:
        centres, reach = table.read(CENTRES), table.read(REACH)
    around = REACHES * float(cuts[block].facts["reach"])
    low, high = centres.min(axis=0) - around, centres.max(axis=0) + around
    found = []
    for other, record in enumerate(cuts):
        if other == block or not _overlap(record, low, high):
            continue
        with Table(scratch, record) as table:
            theirs = table.read(CENTRES)
            inside = np.flatnonzero(((theirs >= low) & (theirs <= high)).all(axis=1))
            distances, nearest = nearest_to(theirs[inside], centres, threads)
            near = distances < REACHES * reach[nearest]
            if near.any():
                relative = distances[near] / reach[nearest[near]]
                found.append(Near(other, inside[near], relative))
    return found


def _overlap(record: Record, low: F64, high: F64) -> bool:
    """Whether the box of a block's centres meets another."""
    facts = record.facts
    return bool((np.array(facts["low"]) <= high).all() and (np.array(facts["high"]) >= low).all())


def _sizes(scratch: Scratch, cuts: Sequence[Record], found: Sequence[Near]) -> list[I64]:
    """Of each of these, how many splats its groups have."""
    sizes = []
    for each in found:
        with Table(scratch, cuts[each.block]) as table:
            sizes.append(np.bincount(table.read(LABELS))[each.groups])
    return sizes


def _nearest(found: Sequence[Near], counts: Sequence[I64], most: int) -> list[Near]:
    """The nearest groups of all, with no more splats than so many."""
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
    with Table(scratch, cuts[near.block]) as table:
        labels = table.read(LABELS)
    places = np.full(int(cuts[near.block].facts["groups"]), -1, np.int32)
    places[near.groups] = np.arange(len(near.groups), dtype=np.int32)
    found = places[labels]
    rows = np.flatnonzero(found >= 0)
    return Halo(near.block, near.groups, rows, found[rows])

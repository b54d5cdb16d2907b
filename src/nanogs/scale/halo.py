"""The groups of other blocks that lie near those of a block, and the splats in them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from nanogs._types import F64, I32, I64
from nanogs.scale.cuts import CENTRES, LABELS, REACH
from nanogs.scale.scratch import Scratch
from nanogs.scale.tables import Record, Table

# A splat moves to one of the nearest groups of its own: those of one reach around a block decide
# over its splats in the first round, and what is behind them over these in the next.
REACHES = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Halo:
    """What a block sees of another.

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


def find_halo(scratch: Scratch, cuts: Sequence[Record], block: int, threads: int) -> list[Halo]:
    """What a block sees of each of the others near it, in their order.

    Args:
        scratch: Where the cuts are.
        cuts: Their records.
        block: Whose neighbours.
        threads: Threads for the nearest-neighbour query.
    """
    with Table(scratch, cuts[block]) as table:
        centres, reach = table.read(CENTRES), table.read(REACH)
    tree = cKDTree(centres)
    around = REACHES * float(cuts[block].facts["reach"])
    low, high = centres.min(axis=0) - around, centres.max(axis=0) + around
    found = []
    for other, record in enumerate(cuts):
        if other == block or not _overlap(record, low, high):
            continue
        with Table(scratch, record) as table:
            theirs = table.read(CENTRES)
            candidates = np.flatnonzero(((theirs >= low) & (theirs <= high)).all(axis=1))
            distances, nearest = tree.query(theirs[candidates], workers=threads)
            groups = candidates[distances <= REACHES * reach[nearest]]
            if len(groups):
                found.append(_members(other, groups, table.read(LABELS), len(theirs)))
    return found


def _overlap(record: Record, low: F64, high: F64) -> bool:
    """Whether the box of a block's centres meets another."""
    facts = record.facts
    return bool((np.array(facts["low"]) <= high).all() and (np.array(facts["high"]) >= low).all())


def _members(block: int, groups: I64, labels: I32, count: int) -> Halo:
    places = np.full(count, -1, np.int32)
    places[groups] = np.arange(len(groups), dtype=np.int32)
    found = places[labels]
    rows = np.flatnonzero(found >= 0)
    return Halo(block, groups, rows, found[rows])

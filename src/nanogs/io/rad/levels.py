"""The levels of a tree in a `.rad` file: cuts through it, each a whole scene and ever coarser.

The height of a row is the number of steps to the farthest leaf below it. Level N has the rows of
height N or less whose parent is higher than N: level 0 has the leaves, and the last level only the
root. For a tree that nanogs built from levels, these levels result again, followed by coarser ones
up to the root.
"""

from typing import NamedTuple

import numpy as np

from nanogs._types import I32, I64
from nanogs.io.files import damaged
from nanogs.io.rad.header import CHILD_COUNT, CHILD_START, Header
from nanogs.io.rad.values import components

_MOST_LEVELS = 256  # Spark's trees of real scenes have some 20 to 40


class Heights(NamedTuple):
    """The range of levels that each of N rows is in.

    Attributes:
        own: (N,) height of the row: the first level that it is in.
        parents: (N,) height of its parent: the first level that it is no longer in.
    """

    own: I32
    parents: I32

    def counts(self) -> tuple[int, ...]:
        """Return the number of rows of each level."""
        most = int(self.parents.max())
        come = np.bincount(self.own, minlength=most)
        go = np.bincount(self.parents, minlength=most)[:most]
        return tuple(np.cumsum(come[:most] - go).tolist())


def heights(header: Header) -> Heights:
    """Compute the heights of all rows of a tree and of their parents.

    Raises:
        FormatError: The rows do not form a tree with the root first and children after parents, or
            it has far too many levels.
    """
    parents = _parents(header)
    own = np.zeros(header.count, np.int32)
    inner = np.zeros(header.count, bool)
    inner[parents[1:]] = True
    rows: I64 = np.flatnonzero(~inner)
    level = 0
    while len(rows := np.unique(parents[rows[rows > 0]])):
        level += 1
        if level > _MOST_LEVELS:
            raise damaged(header.path, f"its tree is more than {_MOST_LEVELS} levels high")
        own[rows] = level
    above = own[parents]
    above[0] = own[0] + 1
    return Heights(own, above)


def _parents(header: Header) -> I32:
    """Return (N,) the parent of each row; 0 for the root, which is row 0."""
    first, many = [], []  # first child and number of children of each row with children
    rows, base = [], 0
    for chunk in header.chunks:
        counts = components(chunk.properties[CHILD_COUNT], chunk.count, 1)[:, 0]
        starts = components(chunk.properties[CHILD_START], chunk.count, 1)[:, 0]
        inner = np.flatnonzero(counts)
        rows.append(inner + base)
        first.append(starts[inner])
        many.append(counts[inner])
        base += chunk.count
    held, starts, counts = map(np.concatenate, (rows, first, many))
    order = np.argsort(starts, kind="stable")
    held, starts, counts = held[order], starts[order], counts[order]
    ends = 1 + np.cumsum(counts)
    if not np.array_equal(starts, ends - counts) or (ends[-1:] if len(ends) else 1) != header.count:
        raise damaged(header.path, "the rows of its tree have several parents, or none")
    parents = np.zeros(header.count, np.int32)
    parents[1:] = np.repeat(held, counts)
    if (parents[1:] >= np.arange(1, header.count)).any():
        raise damaged(header.path, "a row of its tree comes before its parent")
    return parents

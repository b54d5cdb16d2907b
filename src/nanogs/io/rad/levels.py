"""The levels of a tree in a `.rad` file: whole scenes, each coarser than the one before.

The height of a row is the number of steps to the farthest leaf below it. Level N has the rows of
height N and less whose parent is higher: with N = 0 the leaves, and last the root alone. A tree
that nanogs made of levels gives these back, and goes on above the coarsest of them.
"""

from typing import NamedTuple

import numpy as np

from nanogs._types import I32, I64
from nanogs.errors import FormatError
from nanogs.io.rad.header import CHILD_COUNT, CHILD_START, Header
from nanogs.io.rad.values import components

_MOST_LEVELS = 256  # Spark's trees of real scenes have some 20 to 40


class Heights(NamedTuple):
    """Of N rows, in which levels they are.

    Attributes:
        own: (N,) the first of them.
        parents: (N,) the first in which they are not any more.
    """

    own: I32
    parents: I32

    def counts(self) -> tuple[int, ...]:
        """Rows of each level."""
        most = int(self.parents.max())
        come = np.bincount(self.own, minlength=most)
        go = np.bincount(self.parents, minlength=most)[:most]
        return tuple(np.cumsum(come[:most] - go).tolist())


def heights(header: Header) -> Heights:
    """Find the levels of all rows of a tree.

    Raises:
        FormatError: The rows are no tree whose root is first and whose children follow parents, or
            one of far too many levels.
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
            raise _damaged(header, f"its tree is more than {_MOST_LEVELS} levels high")
        own[rows] = level
    above = own[parents]
    above[0] = own[0] + 1
    return Heights(own, above)


def _parents(header: Header) -> I32:
    """(N,) the row of each one's parent; 0 for the root, which is row 0."""
    first, many = [], []  # of each row with children
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
        raise _damaged(header, "the rows of its tree have several parents, or none")
    parents = np.zeros(header.count, np.int32)
    parents[1:] = np.repeat(held, counts)
    if (parents[1:] >= np.arange(1, header.count)).any():
        raise _damaged(header, "a row of its tree comes before its parent")
    return parents


def _damaged(header: Header, what: str) -> FormatError:
    return FormatError(f"{header.path} is damaged: {what}; export or download it again.")

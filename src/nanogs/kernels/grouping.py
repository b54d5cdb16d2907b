"""Kernel that lists the members of groups."""

from nanogs._types import I32, I64
from nanogs.kernels.policy import kernel


@kernel
def group_members(labels: I32, starts: I64, members: I32 | I64) -> None:
    """List the rows of every group, ascending, by counting sort.

    labels: (N,) in [0, G); starts: (G + 1,) zeros, filled; members: (N,) filled: group g holds
    members[starts[g]:starts[g + 1]].
    """
    for label in labels:
        starts[label + 1] += 1
    for group in range(1, len(starts)):
        starts[group] += starts[group - 1]
    place = starts[:-1].copy()
    for row in range(len(labels)):
        members[place[labels[row]]] = row
        place[labels[row]] += 1

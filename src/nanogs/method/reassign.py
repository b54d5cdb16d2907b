"""Reassignment: move splats to the neighbouring group where they fit best.

Rounds of hard EM move all at once. They treat a splat as infinitely light: that its own group's
moments contain it, and that it changes those of another group, does not count. So single splats are
then moved by the exact change of the error, which matters in groups of few members.
"""

from collections.abc import Iterator

import numpy as np

from nanogs._types import F32, F64, I32
from nanogs.kernels.assign import assign_nearest, best_moves, invert_covariances, make_moves
from nanogs.kernels.forest import log_determinants
from nanogs.method.nodes import Nodes, gather, gather_groups, member_lists, squared, widen
from nanogs.neighbours import nearest_neighbours
from nanogs.sorting import stable_order

NEIGHBOURS = 12  # number of other groups that a splat may move to
LAMBDA_APP = 0.2  # weight of the squared colour distance relative to the log likelihood
MOVES_APP = 1.0  # the same in moves of single splats, as while the forest grows
MOVES = 2  # how often moves of single splats are made; each group takes part in one at a time


def reassign(leaves: Nodes, labels: I32, groups: int, rounds: int, blurs: F32) -> tuple[I32, int]:
    """Assign each splat to the group of highest likelihood, match moments again, and repeat.

    Then single splats are moved, if there are any rounds.

    A group that loses all its splats takes the worst fitting splat of a group with several, so that
    the number of groups is unchanged: that of the largest product of its weight and its distance
    from its group (see `assign_nearest`).

    Args:
        leaves: N nodes, one for each splat.
        labels: (N,) int32, the group of each in [0, groups), none empty.
        groups: Number of groups.
        rounds: Number of rounds; ends earlier when nothing moves.
        blurs: (N,) deviations by which shapes are blurred before they are compared, as while the
            forest grows (`Dilation.blurs`), scene units.

    Returns:
        (N,) int32, new labels, no group empty; and the number of rounds in which splats moved.
    """
    done = 0
    while done < rounds:
        moved = _one_round(leaves, labels, groups, blurs)
        if np.array_equal(moved, labels):
            break
        labels, done = moved, done + 1
    return (_move(leaves, labels, groups, blurs) if rounds else labels), done


def _blur_groups(merged: Nodes, leaves: Nodes, labels: I32, blurs: F32) -> None:
    """Blur the covariances of groups, in place, as the mixtures of their blurred members."""
    widths = squared(blurs)
    widths *= leaves.weights  # in place: this is where reassignment takes the most memory
    widen(merged.covariances, np.bincount(labels, widths, len(merged)) / merged.weights)


def _move(leaves: Nodes, labels: I32, groups: int, blurs: F32) -> I32:
    """Move single splats to where the error of all groups falls the most; see `best_moves`."""
    labels = labels.copy()
    targets, gains, log_dets = np.empty_like(labels), np.empty(len(labels)), np.empty(groups)
    candidates = None
    for _ in range(MOVES):
        starts, members = member_lists(labels, groups)
        merged = gather_groups(leaves, starts, members)
        sizes = np.diff(starts)
        del starts, members  # frees memory before more is taken
        _blur_groups(merged, leaves, labels, blurs)
        if candidates is None:  # moves hardly change which groups are near
            candidates = nearest_neighbours(merged.means, NEIGHBOURS)
        log_determinants(merged.covariances, log_dets)
        best_moves(
            labels, sizes, candidates,
            leaves.weights, leaves.means, leaves.covariances, blurs, leaves.features, leaves.rows,
            merged.weights, merged.means, merged.covariances, log_dets, merged.features, MOVES_APP,
            targets, gains,
        )  # fmt: skip
        del merged  # frees memory for the next ones
        rows = np.flatnonzero(gains > 0)
        # Positive numbers are ordered like their bits.
        order = rows[stable_order(~gains[rows].view(np.uint64))]
        if make_moves(order, targets, np.zeros(groups, np.bool_), labels) == 0:
            break
    return labels


def _one_round(leaves: Nodes, labels: I32, groups: int, blurs: F32) -> I32:
    merged = gather(leaves, labels, groups)
    _blur_groups(merged, leaves, labels, blurs)
    inverses, log_dets = np.empty((groups, 6)), np.empty(groups)
    invert_covariances(merged.covariances, inverses, log_dets)
    candidates = nearest_neighbours(merged.means, NEIGHBOURS)
    moved, distances = np.empty_like(labels), np.empty(len(labels))
    assign_nearest(
        labels,
        candidates,
        leaves.means,
        leaves.covariances,
        blurs,
        leaves.features,
        leaves.rows,
        merged.means,
        inverses,
        log_dets,
        merged.features,
        LAMBDA_APP,
        moved,
        distances,
    )
    misfits = np.multiply(distances, leaves.weights, out=distances)
    _refill(moved, misfits, groups)
    return moved


def _refill(labels: I32, misfits: F64, groups: int) -> None:
    """Refill empty groups in place, each with the worst fitting splat of a group with several.

    Args:
        labels: (N,) int32, the group of each splat; changed.
        misfits: (N,) misfit of each splat to its group; overwritten.
        groups: Number of groups.
    """
    sizes = np.bincount(labels, minlength=groups)
    empty = np.flatnonzero(sizes == 0)
    if len(empty) == 0:
        return
    worst = _ascending(np.negative(misfits, out=misfits), 2 * len(empty))
    for group in empty:
        # There are at least as many splats as groups, so some group has several.
        row = next(row for row in worst if sizes[labels[row]] > 1)
        sizes[labels[row]] -= 1
        sizes[group] += 1
        labels[row] = group


def _ascending(values: F64, first: int) -> Iterator[int]:
    """Iterate over rows by ascending value, ties by row; sorts the `first` few before the rest."""
    if first >= len(values):
        yield from np.argsort(values, kind="stable")
        return
    before = values < np.partition(values, first)[first]
    for part in (np.flatnonzero(before), np.flatnonzero(~before)):
        yield from part[np.argsort(values[part], kind="stable")]

"""Assign each splat of a finer level to a parent splat of the next coarser level.

Levels are made independently, without links between them. The parent of a splat is the most likely
one of the coarser splats near it: under the coarser splat's Gaussian, with the fine splat's own
covariance added, and a Gaussian of the difference of colours.
"""

from typing import NamedTuple

import numpy as np

from nanogs._types import F32, F64, I64
from nanogs.activations import SH_C0
from nanogs.kernels.nodes import covariances_of
from nanogs.method.nodes import FLATTEST
from nanogs.method.order import code_box, codes_in
from nanogs.neighbours import nearest_neighbours, nearest_to
from nanogs.source import Source

_NEAR = 8  # candidates besides the nearest coarser splat: that splat's nearest neighbours
_COLOUR = 0.15  # standard deviation of the change of a base colour by merging
_THINNEST = 1e-12  # scene units
_ROWS = 1 << 12  # splats at a time, which take a kilobyte each
_ROUNDS = 8  # rounds in which each childless splat takes the nearest spare child


class Shapes(NamedTuple):
    """The properties of N splats that decide on their links to a coarser level.

    Attributes:
        means: (N, 3) float64, scene units.
        covariances: (N, 6) float64, xx, xy, xz, yy, yz, zz, square scene units.
        colours: (N, 3) float32, the contribution of SH degree 0 to the colour.
    """

    means: F64
    covariances: F64
    colours: F32


def shapes_of(level: Source) -> Shapes:
    """Read the `Shapes` of a level, some rows at a time."""
    found = Shapes(
        np.empty((level.count, 3)),
        np.empty((level.count, 6)),
        np.empty((level.count, 3), np.float32),
    )
    at = 0
    for block in level.blocks():
        rows = slice(at, at + len(block))
        found.means[rows] = block.means
        covariances = np.empty((len(block), 6))
        covariances_of(block.scales(), block.unit_quats(), FLATTEST, _THINNEST, covariances)
        found.covariances[rows] = covariances
        found.colours[rows] = block.sh[:, 0] * np.float32(SH_C0)
        at += len(block)
    return found


def parents_of(fine: Shapes, coarse: Shapes) -> I64:
    """Return (N,) the row of each fine splat's parent; each coarse splat gets at least one child.

    Args:
        fine: N splats.
        coarse: M splats, M from 1 to N.
    """
    parents = _likeliest(fine, coarse)
    _give_to_childless(parents, fine.means, coarse.means)
    return parents


def _likeliest(fine: Shapes, coarse: Shapes) -> I64:
    _, nearest = nearest_to(fine.means, coarse.means)
    around = nearest_neighbours(coarse.means, _NEAR)
    parents = np.empty(len(fine.means), np.int64)
    for start in range(0, len(parents), _ROWS):
        rows = slice(start, min(start + _ROWS, len(parents)))
        near = nearest[rows]
        candidates = np.column_stack([near, around[near]])
        deltas = fine.means[rows, None] - coarse.means[candidates]
        blurred = coarse.covariances[candidates] + fine.covariances[rows, None]
        tints = fine.colours[rows, None] - coarse.colours[candidates]
        unlikely = _negative_log_likelihoods(deltas, blurred)
        unlikely += (tints.astype(np.float64) ** 2).sum(axis=-1) / _COLOUR**2
        best = unlikely.argmin(axis=1)
        parents[rows] = candidates[np.arange(len(best)), best]
    return parents


def _negative_log_likelihoods(deltas: F64, covariances: F64) -> F64:
    """Return (R, C) minus twice the log-density of Gaussians, up to a constant.

    Args:
        deltas: (R, C, 3) offsets from the Gaussian's centre, scene units.
        covariances: (R, C, 6), positive definite, square scene units.
    """
    xx, xy, xz, yy, yz, zz = np.moveaxis(covariances, -1, 0)
    x, y, z = np.moveaxis(deltas, -1, 0)
    a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    d, e, f = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    determinants = np.maximum(xx * a + xy * b + xz * c, np.finfo(np.float64).tiny)
    squares = x * x * a + y * y * d + z * z * f + 2 * (x * y * b + x * z * c + y * z * e)
    unlikely: F64 = squares / determinants + np.log(determinants)
    return unlikely


def _give_to_childless(parents: I64, fine: F64, coarse: F64) -> None:
    """Give each childless coarse splat a nearby child whose parent has others; in place."""
    lone = np.flatnonzero(np.bincount(parents, minlength=len(coarse)) == 0)
    for _ in range(_ROUNDS):
        if not len(lone):
            return
        spare = _spare(parents, fine, coarse)
        distances, nearest = nearest_to(coarse[lone], fine[spare])
        order = np.argsort(distances, kind="stable")
        _, first = np.unique(nearest[order], return_index=True)
        served = order[first]  # if several want the same child, the nearest one gets it
        parents[spare[nearest[served]]] = lone[served]
        lone = np.delete(lone, served)
    if not len(lone):
        return
    # Many childless splats in one place: pair them with spare children in Morton order.
    spare = _spare(parents, fine, coarse)
    box = code_box(fine)
    codes, wanted = codes_in(fine[spare], *box), codes_in(coarse[lone], *box)
    spare, lone = spare[np.argsort(codes, kind="stable")], lone[np.argsort(wanted, kind="stable")]
    places, turn = np.searchsorted(np.sort(codes), np.sort(wanted)), np.arange(len(lone))
    places = np.maximum.accumulate(places - turn) + turn
    places = np.minimum(places, len(spare) - len(lone) + turn)
    parents[spare[places]] = lone


def _spare(parents: I64, fine: F64, coarse: F64) -> I64:
    """Return the rows whose parent can spare them: all but the nearest child of each parent."""
    distances = ((fine - coarse[parents]) ** 2).sum(axis=1)
    order = np.lexsort((distances, parents))
    further: I64 = order[1:][np.diff(parents[order]) == 0]
    return np.sort(further)

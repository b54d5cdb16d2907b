"""Quaternions in "smallest three" form: the largest component is left out, as in most formats."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nanogs import parallel
from nanogs._types import F32, F64, I64, Array, Bool
from nanogs.activations import unit
from nanogs.slices import slices
from nanogs.splats import Splats

_SAME = 1e-6  # difference of components that are the same, in float32
# Difference of two components, in errors of one that is rounded, that rounding can reverse: the
# component that is restored has the errors of the three others, at most.
_RIVAL = 4.5


def whole_quats(small: F64, largest: I64) -> F64:
    """Restore (R, 4) unit quaternions from their three smallest components; the fourth is positive.

    Args:
        small: (R, 3) the three smallest components, in order.
        largest: (R,) index of the component that was left out; rows in which it is not 0 to 3 stay
            uninitialised.
    """
    left_out = np.sqrt(np.maximum(0, 1 - (small**2).sum(axis=1)))
    quats = np.empty((len(small), 4))
    for place in range(4):
        rows = largest == place
        quats[rows] = np.insert(small[rows], place, left_out[rows], axis=1)
    return quats


def with_w(xyz: F64) -> F64:
    """Restore (R, 4) unit quaternions, wxyz, from (R, 3) xyz; w is not negative."""
    w = np.sqrt(np.maximum(0, 1 - (xyz**2).sum(axis=1)))
    return np.column_stack([w, xyz])


def rotations_between(quats: F64, others: F64) -> F64:
    """Return (R, 3) the small rotations, radians, about a splat's own axes, from one to the other.

    Args:
        quats: (R, 4) unit quaternions, wxyz.
        others: (R, 4) unit quaternions near these, not near their negatives.
    """
    (w, x, y, z), (a, b, c, d) = quats.T, others.T
    parts = (
        w * b - x * a - y * d + z * c,
        w * c + x * d - y * a - z * b,
        w * d - x * c + y * b - z * a,
    )
    return 2 * np.stack(parts, axis=1)


def split_quats(quats: Array, left_out: I64 | None = None) -> tuple[I64, Array]:
    """Return the index of the component to leave out, (R,), and the other three in order, (R, 3).

    A quaternion whose component to leave out is negative is negated, so that no sign has to be
    stored.

    Args:
        quats: (R, 4) quaternions, with components in any order.
        left_out: (R,) indices of the components to leave out; by default the largest ones.
    """
    if left_out is None:
        left_out = np.abs(quats).argmax(axis=1)
    rows = np.arange(len(quats))
    signed = np.where(quats[rows, left_out, None] < 0, -quats, quats)
    return left_out, signed[np.arange(4) != left_out[:, None]].reshape(-1, 3)


@dataclass(frozen=True, slots=True)
class Rounding:
    """How a format rounds the three components of unit quaternions that it stores.

    Attributes:
        of: Returns (R, 3) float64 components as they are read back.
        error: The largest error of a component.
    """

    of: Callable[[F64], F64]
    error: float

    def keeps(self, small: F64) -> Bool:
        """Return an (R,) mask of the rows that rounding does not change."""
        same = np.abs(self.of(small) - small) < _SAME
        return np.asarray(same.all(axis=1))


def place_left_out(quats: F64, rounding: Rounding) -> I64:
    """Return the index, (R,), of the component to leave out: the largest one before rounding.

    Rounding can make another one the largest. A quaternion that another choice keeps as it is was
    read from a file with that choice, which is made again, so that its bytes do not change.

    Args:
        quats: (R, 4) unit quaternions.
        rounding: How the file rounds components.
    """
    places: I64 = np.abs(quats).argmax(axis=1)
    # Twice the usual difference: rounding may only just bring components within it.
    rows = np.flatnonzero(_rivals(quats, 2 * _RIVAL * rounding.error).sum(axis=1) > 1)

    def choose_unchanged(some: F64) -> None:
        kept = _rivals(some, _RIVAL * rounding.error)
        for place in range(4):
            found = np.flatnonzero(kept[:, place])
            left_out = np.full(len(found), place)
            kept[found, place] = rounding.keeps(split_quats(some[found], left_out)[1])
        read = kept.any(axis=1)
        places[rows[read]] = kept[read].argmax(axis=1)

    choose_unchanged(quats[rows])
    # Rounding may give a quaternion that another choice would keep too: the first is always made.
    small = split_quats(quats[rows], places[rows])[1]
    choose_unchanged(whole_quats(rounding.of(small), places[rows]))
    return places


def _rivals(quats: F64, apart: float) -> Bool:
    """Return an (R, 4) mask of the components that are smaller than the largest by at most that."""
    size = np.abs(quats)
    return np.asarray(size >= size.max(axis=1, keepdims=True) - apart)


def minimise_rotation(
    splats: Splats, rounding: Rounding | None = None, *, third_stays: bool = False
) -> tuple[F64, F32]:
    """Permute and flip the axes of each splat so that its rotation angle is as small as possible.

    An ellipsoid has 24 equivalent descriptions, which differ in the order and the signs of its
    axes. In the one with the largest w, w is always the component that is left out, and the others
    are within ±0.383: they take four and a half bits less.

    Rounding can make another description the one with the largest w. A rotation that rounding keeps
    as it is was read from a file with almost the largest w; it is kept, so that a file that is read
    and written again does not change.

    Args:
        splats: N splats.
        rounding: How the file rounds the rotations; by default not at all.
        third_stays: Only use the 8 descriptions in which the third axis stays the third, as 2DGS
            needs, whose rasteriser takes it as the normal of a splat. w is still the largest
            component, but the others may be as large.

    Returns:
        (N, 4) float64 rotations, unit wxyz with positive w, and (N, 3) float32 log-scales.
    """
    quats, scales = np.empty((len(splats), 4)), np.empty_like(splats.log_scales)

    def turn(rows: slice) -> None:
        whole = unit(splats.quats[rows]).astype(np.float64)
        nearest = _nearest_with_third(whole) if third_stays else _nearest_symmetry(whole)
        quats[rows], scales[rows] = _turned(whole, nearest, splats.log_scales[rows], rounding)

    parallel.for_each(
        slices(len(splats)), turn
    )  # in slices, also to limit the memory of temporaries
    return quats, scales


def _turned(
    quats: F64, nearest: F64, log_scales: F32, rounding: Rounding | None
) -> tuple[F64, F32]:
    """Compute `minimise_rotation` for some rows of unit quaternions and log-scales.

    Args:
        quats: (R, 4) unit quaternions.
        nearest: (R, 4) the symmetry to turn each by, replaced where rows stay as they were read.
        log_scales: (R, 3).
        rounding: See `minimise_rotation`.
    """
    read = _rows_read(quats, nearest, rounding) if rounding else np.empty(0, np.int64)
    nearest[read] = 1, 0, 0, 0
    w, x, y, z = (quats * nearest).T  # `turned` is the product of quats and nearest's conjugate
    a, b, c, d = nearest.T
    w0, x0, y0, z0 = quats.T
    turned = np.stack(
        [
            w + x + y + z,
            x0 * a - w0 * b - y0 * d + z0 * c,
            y0 * a - w0 * c - z0 * b + x0 * d,
            z0 * a - w0 * d - x0 * c + y0 * b,
        ],
        axis=1,
    )
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    turned[read] = quats[read]  # with the signs of zeros
    return turned, np.take_along_axis(log_scales, _axes_turned(nearest), axis=1)


def _nearest_symmetry(quats: F64) -> F64:
    """Find the nearest of the 24 rotational symmetries of a cube for each rotation, (N, 4).

    Their quaternions have one, two or four non-zero components, of equal magnitude.
    """
    sizes = np.abs(quats)
    order = np.argsort(-sizes, axis=1, kind="stable")
    ranked = np.take_along_axis(sizes, order, axis=1)
    parts = np.array([1, 2, 4])
    reached = np.cumsum(ranked, axis=1)[:, parts - 1] / np.sqrt(parts)
    kept = parts[reached.argmax(axis=1)][:, None]
    places = np.argsort(order, axis=1)
    signs = np.where(quats < 0, -1.0, 1.0)
    result: F64 = np.where(places < kept, signs / np.sqrt(kept), 0.0)
    return result


def _nearest_with_third(quats: F64) -> F64:
    """Find the nearest of the 8 symmetries that map the third axis to itself, (N, 4).

    They have one non-zero component, or two of equal magnitude: w and z, or x and y.
    """
    sizes = np.abs(quats)
    pairs = [np.where(sides, sizes, 0) for sides in ((1, 0, 0, 1), (0, 1, 1, 0))]
    alone = np.where(np.arange(4) == sizes.argmax(axis=1)[:, None], sizes, 0)
    kept = np.stack([alone, *pairs])  # in turn, the components of the best symmetry of each kind
    reached = kept.sum(axis=2) / np.sqrt([[1], [2], [2]])
    best = kept[reached.argmax(axis=0), np.arange(len(quats))] > 0
    signs = np.where(quats < 0, -1.0, 1.0)
    result: F64 = np.where(best, signs, 0) / np.sqrt(best.sum(axis=1, keepdims=True))
    return result


def _rows_read(quats: F64, nearest: F64, rounding: Rounding) -> I64:
    """Find the rows that were read from such a file: kept by rounding, with about the largest w."""
    # Rounding moves a unit quaternion, and so its products, by little more than twice the error.
    least = (quats * nearest).sum(axis=1) - _RIVAL * rounding.error
    rows = np.flatnonzero(quats[:, 0] >= least)
    return rows[rounding.keeps(quats[rows, 1:])]


def _axes_turned(quats: F64) -> I64:
    """For the conjugate of a cube symmetry, compute to which axis each axis is mapped, (N, 3)."""
    w, x, y, z = quats.T
    second = [x * y - z * w, 0.5 - x * x - z * z, y * z + x * w]  # rows of the matrix, halved
    third = [x * z + y * w, y * z - x * w, 0.5 - x * x - y * y]
    along = 2 * np.abs(np.stack(second, axis=1)) + 4 * np.abs(np.stack(third, axis=1))
    result: I64 = np.rint(along).astype(np.int64)
    return result

"""Quaternions in "smallest three" form: the largest component is left out, as in most formats."""

from collections.abc import Callable

import numpy as np

from nanogs import parallel
from nanogs._types import F32, F64, I64, Array
from nanogs.activations import unit
from nanogs.slices import slices
from nanogs.splats import Splats

_SAME = 1e-6  # difference of components that are the same, in float32


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


def place_left_out(quats: F64, rounded: Callable[[F64], F64], error: float) -> I64:
    """Return the index, (R,), of the component to leave out: the largest one before rounding.

    Rounding can make another one the largest. A quaternion that another choice keeps as it is was
    read from a file with that choice, which is made again, so that its bytes do not change.

    Args:
        quats: (R, 4) unit quaternions.
        rounded: Rounds components, (R, 3), as the file does.
        error: The largest error of a rounded component.
    """
    size = np.abs(quats)
    places: I64 = size.argmax(axis=1)
    # The component that is restored has the errors of the three others, at most.
    rivals = size >= size.max(axis=1, keepdims=True) - 4.5 * error
    rows = np.flatnonzero(rivals.sum(axis=1) > 1)
    unchanged = np.zeros((len(rows), 4), bool)
    for place in range(4):
        found = rivals[rows, place]
        left_out = np.full(found.sum(), place)
        small = split_quats(quats[rows[found]], left_out)[1]
        unchanged[found, place] = (np.abs(rounded(small) - small) < _SAME).all(axis=1)
    read = unchanged.any(axis=1) & ~unchanged[np.arange(len(rows)), places[rows]]
    places[rows[read]] = unchanged[read].argmax(axis=1)
    return places


def minimise_rotation(splats: Splats) -> tuple[F64, F32]:
    """Permute and flip the axes of each splat so that its rotation angle is as small as possible.

    An ellipsoid has 24 equivalent descriptions, which differ in the order and the signs of its
    axes. In the one with the largest w, w is always the component that is left out, and the others
    are within ±0.383: they take four and a half bits less.

    Args:
        splats: N splats.

    Returns:
        (N, 4) float64 rotations, unit wxyz with positive w, and (N, 3) float32 log-scales.
    """
    quats, scales = np.empty((len(splats), 4)), np.empty_like(splats.log_scales)

    def turn(rows: slice) -> None:
        whole = unit(splats.quats[rows]).astype(np.float64)
        quats[rows], scales[rows] = _turned(whole, splats.log_scales[rows])

    parallel.for_each(
        slices(len(splats)), turn
    )  # in slices, also to limit the memory of temporaries
    return quats, scales


def _turned(quats: F64, log_scales: F32) -> tuple[F64, F32]:
    """Compute `minimise_rotation` for some rows of unit quaternions and log-scales."""
    nearest = _nearest_symmetry(quats)
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
    scales = np.take_along_axis(log_scales, _axes_turned(nearest), axis=1)
    return turned / np.linalg.norm(turned, axis=1, keepdims=True), scales


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


def _axes_turned(quats: F64) -> I64:
    """For the conjugate of a cube symmetry, compute to which axis each axis is mapped, (N, 3)."""
    w, x, y, z = quats.T
    second = [x * y - z * w, 0.5 - x * x - z * z, y * z + x * w]  # rows of the matrix, halved
    third = [x * z + y * w, y * z - x * w, 0.5 - x * x - y * y]
    along = 2 * np.abs(np.stack(second, axis=1)) + 4 * np.abs(np.stack(third, axis=1))
    result: I64 = np.rint(along).astype(np.int64)
    return result

"""Rotations whose largest part is left out, as most packed formats have them."""

import numpy as np

from nanogs import spread
from nanogs._types import F32, F64, I64, Array
from nanogs.slices import slices
from nanogs.splats import Splats
from nanogs.stored import unit


def whole_quats(small: F64, largest: I64) -> F64:
    """(R, 4) quaternions of unit length, the part that was left out positive and in its place.

    Args:
        small: (R, 3) the other parts, in order.
        largest: (R,) the place of the part that was left out; a row of any other stays junk.
    """
    left_out = np.sqrt(np.maximum(0, 1 - (small**2).sum(axis=1)))
    quats = np.empty((len(small), 4))
    for place in range(4):
        rows = largest == place
        quats[rows] = np.insert(small[rows], place, left_out[rows], axis=1)
    return quats


def split_quats(quats: Array) -> tuple[I64, Array]:
    """The place of the largest part, (R,), and the other three in order, (R, 3).

    All change their sign where the largest is negative: then it need not be told.

    Args:
        quats: (R, 4) rotations, in any order of parts.
    """
    rows, largest = np.arange(len(quats)), np.abs(quats).argmax(axis=1)
    signed = np.where(quats[rows, largest, None] < 0, -quats, quats)
    return largest, signed[np.arange(4) != largest[:, None]].reshape(-1, 3)


def least_turned(splats: Splats) -> tuple[F64, F32]:
    """The same splats with other axes first, so that they are turned as little as possible.

    An ellipsoid can be written in 24 ways, by which of its axes is the first and by their signs.
    With the one whose w is the largest, w is the part that is left out of every rotation, and the
    others lie within ±0.383: they take four and a half bits less.

    Args:
        splats: N splats.

    Returns:
        (N, 4) float64 rotations, unit wxyz with positive w, and (N, 3) float32 log-scales.
    """
    quats, scales = np.empty((len(splats), 4)), np.empty_like(splats.log_scales)

    def turn(rows: slice) -> None:
        whole = unit(splats.quats[rows]).astype(np.float64)
        quats[rows], scales[rows] = _turned(whole, splats.log_scales[rows])

    spread.each(slices(len(splats)), turn)  # so many at a time, for the sake of memory, too
    return quats, scales


def _turned(quats: F64, log_scales: F32) -> tuple[F64, F32]:
    """`least_turned` of some rows."""
    nearest = _nearest_symmetry(quats)
    w, x, y, z = (quats * nearest).T  # as `nearest` is undone: quats times its conjugate
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
    """(N, 4): of the 24 turns of a cube, the one nearest to each rotation.

    They have one part that is not zero, or two, or all four, and these alike.
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
    """(N, 3): the axis on which each axis lies after the conjugate of a turn of a cube."""
    w, x, y, z = quats.T
    second = [x * y - z * w, 0.5 - x * x - z * z, y * z + x * w]  # rows of half the matrix
    third = [x * z + y * w, y * z - x * w, 0.5 - x * x - y * y]
    along = 2 * np.abs(np.stack(second, axis=1)) + 4 * np.abs(np.stack(third, axis=1))
    result: I64 = np.rint(along).astype(np.int64)
    return result

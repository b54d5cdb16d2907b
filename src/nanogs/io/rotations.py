"""Rotations whose largest part is left out, as most packed formats have them."""

import numpy as np

from nanogs._types import F64, I64, Array


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

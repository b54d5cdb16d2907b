"""Rotations of `.spz`: three bytes each in version 2, four in versions 3 and 4."""

import math

import numpy as np

from nanogs._types import F32, F64, U8
from nanogs.io.rotations import Rounding, minimise_rotation, place_left_out, split_quats
from nanogs.io.spz.codes import ZERO, codes_of_grid, stepped
from nanogs.io.spz.read import MAGNITUDE
from nanogs.splats import Splats


def as_they_are(block: Splats) -> tuple[F32, F32]:
    """Return the rotations, (R, 4) unit wxyz, and the (R, 3) log-scales, with axes unchanged."""
    return block.unit_quats(), block.log_scales


def unit_or_read(block: Splats, rounding: Rounding) -> tuple[F32, F32]:
    """Do as `as_they_are`, but do not normalise rotations that were read with w = 0.

    Their three bytes may stand for a length a little above 1, and are written again like this.
    """
    quats = block.unit_quats()
    rows = np.flatnonzero(block.quats[:, 0] == 0)
    stored = block.quats[rows]
    near = np.abs(np.linalg.norm(stored.astype(np.float64), axis=1) - 1) < 2 * rounding.error
    read = near & rounding.keeps(stored[:, 1:].astype(np.float64))
    quats[rows[read]] = stored[read]
    return quats, block.log_scales


def smallest_rotations(block: Splats, rounding: Rounding) -> tuple[F32, F32]:
    """Return rotations and log-scales with the axes reordered so that rotations are small."""
    quats, log_scales = minimise_rotation(block, rounding)
    return quats.astype(np.float32), log_scales


def xyz_rotations(quats: F32, step: int) -> U8:
    """Encode (R, 4) unit wxyz as (R, 3) codes of xyz, with the sign for which w is positive."""
    return _xyz_codes(np.where(quats[:, :1] < 0, -quats[:, 1:], quats[:, 1:]), step)


def _xyz_codes(xyz: F32 | F64, step: int) -> U8:
    return stepped((xyz.astype(np.float64) + 1) * 127.5, step, ZERO)


def xyz_rounding(step: int) -> Rounding:
    """Return how the rotations of version 2 are rounded."""
    return Rounding(lambda xyz: _xyz_codes(xyz, step) / 127.5 - 1, step / 255)


def xyz_components(step: int) -> F64:
    """Return the values of x, y and z that `xyz_rotations` can store, ascending."""
    return codes_of_grid(step, ZERO) / 127.5 - 1


def packed_rotations(quats: F32, rounding: Rounding, step: int) -> U8:
    """Encode (R, 4) unit wxyz as (R, 4) bytes, the layout of versions 3 and 4.

    It is the index of the largest component, then sign and magnitude of each other one; magnitudes
    are multiples of the step.
    """
    xyzw = quats[:, [1, 2, 3, 0]].astype(np.float64)
    largest, small = split_quats(xyzw, place_left_out(xyzw, rounding))
    # A magnitude of 0 has a sign too, which is read as that of a zero.
    parts = _magnitudes(small, step).astype(np.uint32) | np.signbit(small).astype(np.uint32) << 9
    packed = largest.astype(np.uint32) << 30 | parts[:, 0] << 20 | parts[:, 1] << 10 | parts[:, 2]
    result: U8 = packed.astype("<u4")[:, None].view(np.uint8)
    return result


def _magnitudes(small: F64, step: int) -> F64:
    """Return the 9-bit magnitudes, multiples of the step, of components from -√½ to √½."""
    exact = np.minimum(np.abs(small) / np.sqrt(0.5), 1) * (MAGNITUDE / step)
    whole: F64 = np.minimum(np.rint(exact), MAGNITUDE // step) * step
    return whole


def packed_rounding(step: int) -> Rounding:
    """Return how the rotations of versions 3 and 4 are rounded."""
    one = np.sqrt(0.5) / MAGNITUDE
    return Rounding(lambda v: np.copysign(_magnitudes(v, step) * one, v), step / 2 * one)


def packed_components(step: int) -> F64:
    """Return the values of the smaller components that `packed_rotations` can store, ascending."""
    codes = np.arange(-(MAGNITUDE // step), MAGNITUDE // step + 1)
    return codes * np.float64(step * math.sqrt(0.5) / MAGNITUDE)

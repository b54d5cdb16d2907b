"""Bit interleaving for Morton codes (Morton 1966) of three axes."""

import numpy as np

from nanogs._types import U64

_SPREADING = tuple(
    (np.uint64(shift), np.uint64(mask))
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    )
)


def interleaved_bits(values: U64, axis: int) -> U64:
    """Put two zero bits between the low 21 bits of each value, shifted by the axis; in place."""
    for shift, mask in _SPREADING:
        values |= values << shift
        values &= mask
    values <<= np.uint64(axis)
    return values

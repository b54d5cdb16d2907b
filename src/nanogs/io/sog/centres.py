"""Codes of centres in SOG: signed logarithms of the coordinates, 16 bits each; and their order.

Where splats are so large that they need no finer centres, some of the last bits are left out.
"""

import math
from typing import NamedTuple

import numpy as np

from nanogs import parallel
from nanogs._types import F32, F64, I64, U16
from nanogs.errors import UnstorableError
from nanogs.io.precision import Precision
from nanogs.io.sog.codes import sizes_as_decoded
from nanogs.io.sog.meta import LAST_CODE
from nanogs.morton import interleaved_bits
from nanogs.slices import slices
from nanogs.splats import Splats

_LARGEST_LOGARITHM = math.log1p(float(np.finfo(np.float32).max))  # of a centre, log(1 + |x|)


class Grid(NamedTuple):
    """The codes of centres: signed logarithms in equal steps.

    Attributes:
        places: (N, 3) float64, places of the centres in steps from the lowest.
        low: (3,) least signed logarithm of each axis.
        high: (3,) greatest one.
        range: (3,) their range, or 1 where it is zero.
        spare: Number of last bits that all codes leave out.
    """

    places: F64
    low: F64
    high: F64
    range: F64
    spare: int

    @property
    def steps(self) -> int:
        """The highest place, of the greatest signed logarithm."""
        return LAST_CODE >> self.spare


def grid_of(splats: Splats, scales: F32, precision: Precision) -> Grid:
    """Place the centres on the grid of a file.

    Args:
        splats: N splats.
        scales: (256,) codebook of the log-scales.
        precision: Precision of the file; it states the bits to leave out, or they are computed.

    Raises:
        UnstorableError: The bits that were asked for do not leave a file that can be read.
    """
    places = _logarithms(splats)
    low, high, range_ = _bounds(places)
    spare = _spare(splats, scales, precision, low, range_)
    grid = Grid(places, low, high, range_, spare)

    def place(rows: slice) -> None:
        places[rows] = (places[rows] - low) / range_ * grid.steps

    parallel.for_each(slices(len(splats)), place)
    return grid


def _logarithms(splats: Splats) -> F64:
    """Compute the signed logarithms of the coordinates, sign(x) log(1 + |x|), (N, 3)."""
    logarithms = np.empty((len(splats), 3))

    def take(rows: slice) -> None:
        some, means = logarithms[rows], splats.means[rows].astype(np.float32)  # as they are read
        np.copysign(np.log1p(np.abs(means, dtype=np.float64), out=some), means, out=some)

    parallel.for_each(slices(len(splats)), take)
    return logarithms


def _bounds(logarithms: F64) -> tuple[F64, F64, F64]:
    """Return the minimum, the maximum and the range of each axis, (3,); a range of zero is 1."""
    low, high = logarithms.min(axis=0), logarithms.max(axis=0)
    return low, high, np.where(high > low, high - low, 1)


def _spare(splats: Splats, scales: F32, precision: Precision, low: F64, range_: F64) -> int:
    """Compute the bits to drop from centres; signed logarithms begin at `low` and span `range_`.

    Args:
        splats: N splats.
        scales: (256,) codebook of the log-scales.
        precision: Precision of the file; if it states the bits, nothing is decoded.
        low: (3,) least signed logarithm of each axis.
        range_: (3,) range of these.

    Raises:
        UnstorableError: The bits that were asked for do not leave a file that can be read.
    """
    apart = range_ / LAST_CODE

    def steps(block: Splats) -> F64:
        """Return the steps of x, (R, 3): a step d of log(1 + |x|) is a step (1 + |x|) d of x."""
        return (1 + np.abs(block.means, dtype=np.float64)) * apart

    stated = precision.spare is not None
    decoded = [] if stated else [sizes_as_decoded(splats, scales, precision)]
    found = precision.spare_bits(decoded, steps)
    if not found or (low + _stretched(range_, 1 << found)).max() <= _LARGEST_LOGARITHM:
        return found
    if not stated:
        return 0
    raise UnstorableError(
        f"Centres are so near to the end of single precision that `spare_bits={found}` leaves no"
        " room for them in .sog; give 0, or scale the model down."
    )


def _stretched(range_: F64, step: int) -> F64:
    """Return the range of all codes, of which the last that is used is mapped to the maximum."""
    return range_ * (LAST_CODE / (LAST_CODE // step * step))


def rounded_centres(splats: Splats, grid: Grid, step: int) -> F32:
    """Return the centres, (N, 3), rounded to places that are multiples of the step.

    Those at both ends of an axis stay, since the grid spans them.
    """
    ends = (grid.places <= 0) | (grid.places >= grid.steps)
    places = np.minimum(np.rint(grid.places / step), grid.steps // step) * step
    logarithms = grid.low + places / grid.steps * grid.range
    rounded = np.copysign(np.expm1(np.abs(logarithms)), logarithms)
    return np.where(ends, splats.means, rounded).astype(np.float32)


def centre_codes(
    splats: Splats, scales: F32, precision: Precision
) -> tuple[U16, dict[str, list[float]]]:
    """Quantise the coordinates' signed logarithms to (N, 3) codes.

    Args:
        splats: N splats.
        scales: (256,) codebook of the log-scales.
        precision: Precision of the file.

    Returns:
        The codes; and `mins` and `maxs` of `meta.json`, the logarithms of the codes 0 and 65,535.

    Raises:
        UnstorableError: As for `grid_of`.
    """
    grid = grid_of(splats, scales, precision)
    codes = np.empty((len(splats), 3), np.uint16)

    def encode_rows(rows: slice) -> None:
        codes[rows] = np.rint(grid.places[rows]) * (1 << grid.spare)

    parallel.for_each(slices(len(splats)), encode_rows)
    highest = grid.low + _stretched(grid.range, 1 << grid.spare)
    highest = np.where(grid.high > grid.low, highest, grid.high)
    return codes, {"mins": grid.low.tolist(), "maxs": highest.tolist()}


def morton_order(codes: U16, groups: I64 | None) -> I64:
    """Return the row order by group, then by Morton code; ties keep their order.

    Args:
        codes: (N, 3) codes of the centres.
        groups: (N,) group numbers, or None if there is only one.
    """
    key = np.zeros(len(codes), np.uint64)
    for axis in range(3):
        key |= interleaved_bits(codes[:, axis].astype(np.uint64), axis)
    return np.argsort(key, kind="stable") if groups is None else np.lexsort((key, groups))

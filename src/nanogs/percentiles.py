"""Exact percentiles of many values in little memory, in one pass or two.

The bits of non-negative float32 values sort like the values. For many values a radix selection is
used: the first pass counts the upper 16 bits, and the second one counts the lower 16 bits of the
values whose upper half a percentile falls into.
"""

from collections.abc import Sequence

import numpy as np

from nanogs._types import F32, I64, U32

HELD = 4_000_000  # up to this number of values are stored, and one pass is enough
_HALVES = 1 << 16


class Percentiles:
    """Percentiles of a stream of float32 values, none of them negative or NaN.

    Attributes:
        again: Whether a second pass with `add_second_pass` is needed.
    """

    def __init__(self, most: int, shares: Sequence[float]) -> None:
        """Start without values.

        Args:
            most: Largest number of values.
            shares: The percentiles to compute, 0 to 100.
        """
        self.again = most > HELD
        self._shares = shares
        self._held: F32 = np.empty(0 if self.again else most, np.float32)
        self._count = 0
        self._upper: I64 = np.zeros(_HALVES, np.int64)
        self._lower: dict[int, I64] = {}

    def add(self, values: F32) -> None:
        """Add (N,) float32 values, in the first pass."""
        if self.again:
            self._upper += np.bincount(_bits(values) >> 16, minlength=_HALVES)
        else:
            self._held[self._count : self._count + len(values)] = values
        self._count += len(values)

    def add_second_pass(self, values: F32) -> None:
        """Add the same values again, in the second pass, when all have been added."""
        if not self._lower:
            ends = np.cumsum(self._upper)
            halves = {int(np.searchsorted(ends, rank, side="right")) for rank in self._ranks()}
            self._lower = {half: np.zeros(_HALVES, np.int64) for half in halves}
        bits = _bits(values)
        upper = bits >> 16
        for half in self._lower:
            self._lower[half] += np.bincount(bits[upper == half] & 0xFFFF, minlength=_HALVES)

    def values(self) -> list[float] | None:
        """Return the percentiles, interpolated between two values; None if there are no values."""
        if not self._count:
            return None
        if not self.again:
            held = self._held[: self._count]
            return np.percentile(held, self._shares, overwrite_input=True).tolist()  # type: ignore[no-any-return]
        found = []
        for share in self._shares:
            place = share / 100 * (self._count - 1)
            low, high = (self._ranked(int(rank)) for rank in (np.floor(place), np.ceil(place)))
            found.append(low if low == high else low + (high - low) * (place % 1))
        return found

    def _ranks(self) -> set[int]:
        places = [share / 100 * (self._count - 1) for share in self._shares]
        return {int(rank) for place in places for rank in (np.floor(place), np.ceil(place))}

    def _ranked(self, rank: int) -> float:
        """Return the value at a rank, from 0, in ascending order."""
        ends = np.cumsum(self._upper)
        half = int(np.searchsorted(ends, rank, side="right"))
        within = rank - int(ends[half] - self._upper[half])
        lower = int(np.searchsorted(np.cumsum(self._lower[half]), within, side="right"))
        return float(np.array([half << 16 | lower], np.uint32).view(np.float32)[0])


def _bits(values: F32) -> U32:
    return np.abs(np.ascontiguousarray(values, np.float32)).view(np.uint32)

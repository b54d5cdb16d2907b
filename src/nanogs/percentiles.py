"""Exact percentiles of any number of values in little memory: values are told twice where need be.

Bits of a float32 that is not negative sort as it does. Of many values the upper halves are counted;
then, of those that a percentile falls among, the lower ones: a radix selection.
"""

from collections.abc import Sequence

import numpy as np

from nanogs._types import F32, I64, U32

HELD = 4_000_000  # values that are held, so that they need not be told twice
_HALVES = 1 << 16


class Percentiles:
    """The values so far. None may be negative or NaN.

    Attributes:
        again: Whether they have to be told once more, after all have been.
    """

    def __init__(self, most: int, shares: Sequence[float]) -> None:
        """Begin without a value.

        Args:
            most: Values that there will be at most.
            shares: Percentages, of which the values are asked for.
        """
        self.again = most > HELD
        self._shares = shares
        self._held: F32 = np.empty(0 if self.again else most, np.float32)
        self._count = 0
        self._upper: I64 = np.zeros(_HALVES, np.int64)
        self._lower: dict[int, I64] = {}

    def add(self, values: F32) -> None:
        """Take (N,) float32 into account."""
        if self.again:
            self._upper += np.bincount(_bits(values) >> 16, minlength=_HALVES)
        else:
            self._held[self._count : self._count + len(values)] = values
        self._count += len(values)

    def add_again(self, values: F32) -> None:
        """Take the same values into account once more, when all have been added."""
        if not self._lower:
            ends = np.cumsum(self._upper)
            halves = {int(np.searchsorted(ends, rank, side="right")) for rank in self._ranks()}
            self._lower = {half: np.zeros(_HALVES, np.int64) for half in halves}
        bits = _bits(values)
        upper = bits >> 16
        for half in self._lower:
            self._lower[half] += np.bincount(bits[upper == half] & 0xFFFF, minlength=_HALVES)

    def values(self) -> list[float] | None:
        """The percentiles asked for, interpolated between two values; None without values."""
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
        """The value before which so many others come."""
        ends = np.cumsum(self._upper)
        half = int(np.searchsorted(ends, rank, side="right"))
        within = rank - int(ends[half] - self._upper[half])
        lower = int(np.searchsorted(np.cumsum(self._lower[half]), within, side="right"))
        return float(np.array([half << 16 | lower], np.uint32).view(np.float32)[0])


def _bits(values: F32) -> U32:
    return np.abs(np.ascontiguousarray(values, np.float32)).view(np.uint32)

"""How finely packed files keep values: each kind as finely as it is worth beside the others.

A bit less of a value takes an eighth of a byte off each splat, whatever the value; what it costs on
views differs much. At equal cost alphas need most steps, then scales, rotations and colours, and
centres as many as splats are small.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from nanogs._types import F64
from nanogs.splats import Splats

FEWEST_BITS, MOST_BITS = 4, 8
MOST_SPARE_BITS = 6  # of 16, that a centre may do without
_SHARE_OF_SIZE = 0.02  # largest step of centres at 8 bits, over the middle axis of splats
_AREA_POWER = 0.75
_LEAST_SIZE = 1e-150  # added to sizes, so that neither they nor their squares are zero
_CODES = 256
_VISIBILITY = (1e-3, 1e3)  # of the mean: least and most that a splat counts


@dataclass(frozen=True, slots=True)
class Precision:
    """How finely values are kept.

    Attributes:
        bits: Of a part of a rotation, 4 to 8, from which all else follows.
        spare: Bits that centres do without, 0 to 6; by default as many as `spare_bits` finds.
    """

    bits: int
    spare: int | None = None

    @property
    def rotation_step(self) -> int:
        """Codes of eight bits from one that is used to the next."""
        return 1 << (MOST_BITS - self.bits)

    @property
    def scales(self) -> int:
        """Values that log-scales may have: half a bit more than a rotation."""
        return min(_CODES, 3 << (self.bits - 1))

    @property
    def colours(self) -> int:
        """Values that base colours may have: half a bit less."""
        return 3 << (self.bits - 2)

    @property
    def alphas(self) -> int:
        """Steps from alpha 0 to 1: a bit more, as light from behind passes many splats."""
        return min(_CODES, 2 << self.bits) - 1

    def spare_bits(self, blocks: Iterable[Splats], steps: Callable[[Splats], F64]) -> int:
        """Bits that centres do without: by default those that large splats have no use for.

        Args:
            blocks: All splats.
            steps: How far codes are apart where the centres of R splats are, (R, 3) or (1, 1).
        """
        if self.spare is not None:
            return self.spare
        moved = counted = 0.0
        for block in blocks:
            scales = np.sort(block.scales().astype(np.float64), axis=1)[:, 1:] + _LEAST_SIZE
            shares = np.minimum(((steps(block) / scales[:, :1]) ** 2).mean(axis=1), 1)
            seen = block.opacities() * scales.prod(axis=1)
            moved += float((seen * shares).sum())
            counted += float(seen.sum())
        share = math.sqrt(moved / counted) if counted else 0.0
        allowed = _SHARE_OF_SIZE * (1 << (MOST_BITS - self.bits))
        spare = math.floor(math.log2(allowed / max(share, allowed / 2**MOST_SPARE_BITS)))
        return max(spare, 0)


FINEST = Precision(MOST_BITS)


def visibility(splats: Splats) -> F64:
    """(N,) how much an error of a splat's colour counts on views, within limits.

    Squared errors grow with alpha squared and with the area, of which large splats show only a
    part: hence a power below 1. Weighed so, views come several dB nearer to the original than with
    equal weights, and 0.1 to 1.3 dB nearer than with alpha times area.
    """
    scales = np.sort(splats.scales().astype(np.float64), axis=1)
    mass: F64 = splats.opacities() ** 2 * (scales[:, 1] * scales[:, 2]) ** _AREA_POWER
    typical = float(mass.mean()) or 1.0
    return np.clip(mass / typical, *_VISIBILITY)

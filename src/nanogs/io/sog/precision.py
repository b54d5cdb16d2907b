"""How finely a SOG file keeps values: each kind as finely as it is worth beside the others.

A bit less of a value takes an eighth of a byte off each splat, whatever the value; what it costs on
views differs much. At equal cost, rotations need most steps, then scales, colours and alphas, and
centres as many as splats are small.
"""

import math
from dataclasses import dataclass

import numpy as np

from nanogs._types import F64
from nanogs.splats import Splats

FEWEST_BITS, MOST_BITS = 4, 8
MOST_CENTRE_BITS = 6  # of 16, that a centre may do without
_SHARE_OF_SIZE = 0.02  # of a splat's middle size that a step of its centre takes at 8 bits
_VISIBILITY = (1e-3, 1e3)  # of the mean: least and most that a splat counts


@dataclass(frozen=True, slots=True)
class Precision:
    """Bits of a part of a rotation, 4 to 8, from which all else follows."""

    bits: int = MOST_BITS

    @property
    def rotation_step(self) -> int:
        """Codes from one that is used to the next."""
        return 1 << (MOST_BITS - self.bits)

    @property
    def scales(self) -> int:
        """Entries of the codebook of log-scales: a half bit less than a rotation has."""
        return 3 << (self.bits - 2)

    @property
    def colours(self) -> int:
        """Entries of the codebook of base colours: a bit less."""
        return 1 << (self.bits - 1)

    @property
    def alphas(self) -> int:
        """Steps from alpha 0 to 1: a bit less."""
        return (1 << (self.bits - 1)) - 1

    def centre_step(self, splats: Splats, steps: F64) -> int:
        """Codes from one that is used to the next: a power of two.

        Args:
            splats: N splats.
            steps: (3,) how far apart codes are, as logarithms of coordinates.
        """
        sizes = np.maximum(np.sort(splats.scales().astype(np.float64), axis=1)[:, 1], 1e-300)
        apart = (1 + np.abs(splats.means.astype(np.float64))) * steps
        shares = np.minimum(((apart / sizes[:, None]) ** 2).mean(axis=1), 1)
        mean = math.sqrt(np.average(shares, weights=visibility(splats)))
        allowed = _SHARE_OF_SIZE * self.rotation_step
        spare = math.floor(math.log2(allowed / max(mean, allowed / 2**MOST_CENTRE_BITS)))
        return 1 << max(spare, 0)


FINEST = Precision()


def visibility(splats: Splats) -> F64:
    """(N,) how much a splat counts on views: alpha times area, within limits.

    Views come nearer to the original by several dB than with all splats alike.
    """
    scales = np.sort(splats.scales().astype(np.float64), axis=1)
    mass: F64 = splats.opacities() * scales[:, 1] * scales[:, 2]
    typical = float(mass.mean()) or 1.0
    return np.clip(mass / typical, *_VISIBILITY)

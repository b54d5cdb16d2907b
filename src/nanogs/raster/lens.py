"""How the lenses of real cameras bend what a pinhole would see.

The formulas are those of OpenCV (calib3d, "Detailed Description") and COLMAP (sensor/models.h): x
and y are those of a pinhole at distance 1, r² = x² + y². Renderers draw what a pinhole sees.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from nanogs._types import F64
from nanogs.formatting import counted

if TYPE_CHECKING:
    from nanogs.raster.camera import Camera


@dataclass(frozen=True, slots=True)
class Lens:
    """A lens by the name and the parameters of its model.

    Attributes:
        name: What the file calls the model.
        fisheye: Whether the polynomial is one of the angle from the axis and not of r².
        above: Its coefficients of the powers from the first on; k1, k2, k3 and so on.
        below: Those of the polynomial that it is divided by.
        tangential: p1 and p2.
        known: Whether these are all that the model has; otherwise only the pinhole is of use.
    """

    name: str
    fisheye: bool = False
    above: tuple[float, ...] = ()
    below: tuple[float, ...] = ()
    tangential: tuple[float, float] = (0.0, 0.0)
    known: bool = True

    def bends(self) -> bool:
        """Whether it does anything to a picture."""
        return self.fisheye or not self.known or any((*self.above, *self.below, *self.tangential))

    def distorted(self, x: F64, y: F64) -> tuple[F64, F64]:
        """Move points of a pinhole's picture at distance 1 as the lens does; of any shape."""
        square = x * x + y * y
        factor = self._factor(np.sqrt(square))
        p1, p2 = self.tangential
        return (
            x * factor + 2 * p1 * x * y + p2 * (square + 2 * x * x),
            y * factor + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
        )

    def turns_back(self, reach: float) -> bool:
        """Whether a point farther from the axis, up to a distance, is moved to nearer it."""
        radii = np.linspace(0, reach, 512)
        return bool((np.diff(radii * self._factor(radii)) <= 0).any())

    def _factor(self, radii: F64) -> F64:
        """The factor of the distance from the axis."""
        base = np.arctan(radii) if self.fisheye else radii
        power = base * base
        factor = _polynomial(self.above, power) / _polynomial(self.below, power)
        if not self.fisheye:
            return factor
        return np.divide(base * factor, radii, out=np.ones_like(radii), where=radii > 0)


def _polynomial(coefficients: Sequence[float], power: F64) -> F64:
    """1 + c1 p + c2 p² and so on."""
    total = np.zeros_like(power)
    for coefficient in reversed(coefficients):
        total = (total + coefficient) * power
    return 1 + total


def lens_notes(cameras: "Sequence[Camera]") -> list[str]:
    """A sentence if some of the cameras have lenses, which no renderer of ours looks through."""
    bent = sum(camera.lens is not None for camera in cameras)
    if not bent:
        return []
    which = counted(bent, "camera")
    return [f"The lens distortion of {which} is left out: views are those of pinholes."]

"""Lens distortion of real cameras, relative to a pinhole camera.

The formulas are those of OpenCV (calib3d, "Detailed Description") and COLMAP (sensor/models.h): x
and y are pinhole coordinates at distance 1, r² = x² + y². Renderers draw undistorted views.
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
    """The distortion model of a lens, by its name and parameters.

    Attributes:
        name: Name of the model in the file.
        fisheye: Whether the polynomial is in the squared angle from the axis rather than in r².
        above: Coefficients of the numerator polynomial from the first power on: k1, k2, k3, ...
        below: The same of the denominator polynomial.
        tangential: p1 and p2.
        known: Whether these are all parameters of the model; otherwise only the pinhole part of
            the camera is usable.
    """

    name: str
    fisheye: bool = False
    above: tuple[float, ...] = ()
    below: tuple[float, ...] = ()
    tangential: tuple[float, float] = (0.0, 0.0)
    known: bool = True

    def bends(self) -> bool:
        """Return whether the lens distorts a picture at all."""
        return self.fisheye or not self.known or any((*self.above, *self.below, *self.tangential))

    def distorted(self, x: F64, y: F64) -> tuple[F64, F64]:
        """Distort pinhole coordinates at distance 1, arrays of any shape."""
        square = x * x + y * y
        factor = self._factor(np.sqrt(square))
        p1, p2 = self.tangential
        return (
            x * factor + 2 * p1 * x * y + p2 * (square + 2 * x * x),
            y * factor + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
        )

    def turns_back(self, reach: float) -> bool:
        """Return whether the distorted radius fails to increase with the radius, up to `reach`."""
        radii = np.linspace(0, reach, 512)
        return bool((np.diff(radii * self._factor(radii)) <= 0).any())

    def _factor(self, radii: F64) -> F64:
        """Return the distorted radius over the radius."""
        base = np.arctan(radii) if self.fisheye else radii
        power = base * base
        factor = _polynomial(self.above, power) / _polynomial(self.below, power)
        if not self.fisheye:
            return factor
        return np.divide(base * factor, radii, out=np.ones_like(radii), where=radii > 0)


def _polynomial(coefficients: Sequence[float], power: F64) -> F64:
    """Evaluate 1 + c1 p + c2 p² + ..."""
    total = np.zeros_like(power)
    for coefficient in reversed(coefficients):
        total = (total + coefficient) * power
    return 1 + total


def lens_notes(cameras: "Sequence[Camera]") -> list[str]:
    """Return a note for the user if some cameras have lens distortion, which renderers ignore."""
    bent = sum(camera.lens is not None for camera in cameras)
    if not bent:
        return []
    which = counted(bent, "camera")
    return [f"The lens distortion of {which} is ignored: views are rendered with pinhole cameras."]

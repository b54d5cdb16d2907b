"""How viewers switch between levels of detail, and the quality of a level where it is first drawn.

Each viewer has its own rule. All are expressed here by the pixel footprint: the scene units that a
pixel covers at the drawn surface. A level is drawn from a certain footprint on, up to that of the
next coarser level. The numbers are the viewers' defaults.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

from nanogs.formatting import number_text

SCREEN = 1024  # assumed pixels along the shorter side of a viewer's window
# The PlayCanvas engine 2.23: `lodBaseDistance`, scene units, and `lodMultiplier` of a streamed SOG,
# for a field of view of 45 degrees along the shorter side; distances to the boxes of chunks.
BASE_DISTANCE, MULTIPLIER = 5.0, 3.0
HALF_FIELD = math.tan(math.radians(22.5))
# CesiumJS 1.145: `maximumScreenSpaceError` of a tileset, largest error of a tile in pixels.
ERROR_PIXELS = 16.0
# Spark 2.2: `lodRenderScale`, least width of a splat in pixels; its width here is two deviations.
SPLAT_PIXELS, SPLAT_WIDTH = 1.0, 2.0

# Limits of quality that people rate good, 4 of 5: they notice a difference, but it does not disturb
# them. From Zinner, Hohlfeld, Abboud, Hossfeld, "Impact of frame rate and resolution on objective
# QoE metrics", QoMEX 2010, where good is 33 to 45 dB and 0.95 to 0.99.
GOOD_PSNR, GOOD_SSIM = 33.0, 0.95

PixelOf: TypeAlias = Callable[[int, float], float]
"""Function that returns the footprint of a pixel, in scene units, at the distance where a viewer
starts to draw a level. Its arguments are the level's number, 1 or more, and the standard deviation
of a typical splat of the level along its longest axis, in scene units."""


@dataclass(frozen=True, slots=True)
class SwitchQuality:
    """Quality of a level against the original at the distance where a viewer starts to draw it.

    Attributes:
        distance: Distance, scene units, at which a pixel has the switch's footprint, for a window
            of `SCREEN` pixels and 45 degrees.
        psnr: Mean over the views, dB; infinite if every one equals the original's.
        ssim: Mean over the views.
        views: Number of views: the default ones of `nanogs compare`, moved nearer or farther until
            pixels have that footprint.
        pixels: Mean width of their images.
    """

    distance: float
    psnr: float
    ssim: float
    views: int
    pixels: float

    @property
    def seen(self) -> bool:
        """Whether the switch is visible: the quality is below what people rate good."""
        return self.psnr < GOOD_PSNR or self.ssim < GOOD_SSIM

    @property
    def text(self) -> str:
        """The scores and their distance, such as "35.10 dB / 0.9713 from 15 units on"."""
        return f"{self.marks} from {self.distance_text} units on"

    @property
    def distance_text(self) -> str:
        """The distance in three digits, such as "15" or "7.27"."""
        return f"{float(f'{self.distance:.3g}'):,g}"

    @property
    def marks(self) -> str:
        """PSNR and SSIM, such as "35.10 dB / 0.9713"."""
        return f"{number_text(self.psnr)} dB / {number_text(self.ssim, 4)}"


def streamed_distance(level: int) -> float:
    """Return the distance, scene units, from which PlayCanvas draws a level of a streamed SOG.

    Args:
        level: 1 or more; the finest, 0, is drawn at smaller distances.
    """
    return BASE_DISTANCE * MULTIPLIER ** (level - 1)


def streamed_pixel(level: int) -> float:
    """Return the footprint of a pixel, scene units, at `streamed_distance`."""
    return 2 * HALF_FIELD * streamed_distance(level) / SCREEN


def distance_of(pixel: float) -> float:
    """Return the distance at which a pixel has a footprint, for `SCREEN` pixels and 45 degrees.

    Both are in scene units.
    """
    return pixel * SCREEN / (2 * HALF_FIELD)


def tile_pixel(error: float) -> float:
    """Return the footprint of a pixel, scene units, from which CesiumJS draws a tile.

    Args:
        error: The tile's `geometricError`, scene units.
    """
    return error / ERROR_PIXELS


def tree_pixel(deviation: float) -> float:
    """Return the footprint of a pixel, scene units, from which Spark draws a splat undivided.

    Args:
        deviation: Standard deviation of the splat along its longest axis, scene units.
    """
    return SPLAT_WIDTH * deviation / SPLAT_PIXELS

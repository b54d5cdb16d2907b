"""How viewers choose among levels of detail, and how a level looks where they begin to draw it.

Each viewer has a rule of its own; what they have in common is the size of a pixel: how many scene
units it shows of what is drawn there. A level is drawn wherever a pixel shows that much or more,
until the next coarser one is. The numbers are the viewers' defaults.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

from nanogs.formatting import number_text

SCREEN = 1024  # pixels along the shorter side of a viewer's window, where that matters
# The PlayCanvas engine 2.23: `lodBaseDistance`, scene units, and `lodMultiplier` of a streamed SOG,
# for a field of view of 45 degrees along the shorter side; distances to the boxes of chunks.
BASE_DISTANCE, MULTIPLIER = 5.0, 3.0
HALF_FIELD = math.tan(math.radians(22.5))
# CesiumJS 1.145: `maximumScreenSpaceError` of a tileset, pixels that a tile's error may have.
ERROR_PIXELS = 16.0
# Spark 2.2: `lodRenderScale`, pixels that a splat has at least; here its width is two deviations.
SPLAT_PIXELS, SPLAT_WIDTH = 1.0, 2.0

# What people call good, 4 of 5: a difference that they notice and that does not disturb them. Both
# from Zinner, Hohlfeld, Abboud, Hossfeld, "Impact of frame rate and resolution on objective QoE
# metrics", QoMEX 2010, where good is 33 to 45 dB and 0.95 to 0.99.
GOOD_PSNR, GOOD_SSIM = 33.0, 0.95

PixelOf: TypeAlias = Callable[[int, float], float]
"""Scene units that a pixel shows where a viewer begins to draw a level: of its number, 1 or more,
and of the deviation of a typical splat of it along its longest axis, scene units."""


@dataclass(frozen=True, slots=True)
class Switch:
    """A level where a viewer begins to draw it, held against the original there.

    Attributes:
        distance: From how far a window of `SCREEN` pixels and 45 degrees shows as much in a pixel,
            scene units.
        psnr: Mean over the views, dB; None where every one equals the original's.
        ssim: Mean over the views.
        views: Number of views: those of `nanogs compare` at its defaults, from which the camera
            goes as much nearer or farther as makes pixels show so much.
        pixels: Mean width of their pictures.
    """

    distance: float
    psnr: float | None
    ssim: float
    views: int
    pixels: float

    @property
    def seen(self) -> bool:
        """Whether one sees the level come, by what people call good."""
        return (self.psnr is not None and self.psnr < GOOD_PSNR) or self.ssim < GOOD_SSIM

    @property
    def text(self) -> str:
        """Scores at the distance they were measured at: "35.10 dB / 0.9713 from 15 units on"."""
        return f"{self.marks} from {self.distance_text} units on"

    @property
    def distance_text(self) -> str:
        """The distance to three digits: "15", "7.27"."""
        return f"{float(f'{self.distance:.3g}'):,g}"

    @property
    def marks(self) -> str:
        """PSNR and SSIM: "35.10 dB / 0.9713"."""
        psnr = "equal" if self.psnr is None else f"{number_text(self.psnr)} dB"
        return f"{psnr} / {number_text(self.ssim, 4)}"


def streamed_distance(level: int) -> float:
    """From how far on the PlayCanvas engine draws a level of a streamed SOG, scene units.

    Args:
        level: 1 or more; the finest, 0, is drawn from anywhere nearer.
    """
    return BASE_DISTANCE * MULTIPLIER ** (level - 1)


def streamed_pixel(level: int) -> float:
    """Scene units that a pixel shows at `streamed_distance`."""
    return 2 * HALF_FIELD * streamed_distance(level) / SCREEN


def distance_of(pixel: float) -> float:
    """From how far a pixel shows so many scene units, on `SCREEN` pixels and 45 degrees."""
    return pixel * SCREEN / (2 * HALF_FIELD)


def tile_pixel(error: float) -> float:
    """Scene units that a pixel shows where CesiumJS begins to draw a tile.

    Args:
        error: The tile's `geometricError`, scene units.
    """
    return error / ERROR_PIXELS


def tree_pixel(deviation: float) -> float:
    """Scene units that a pixel shows where Spark's tree no longer divides a splat.

    Args:
        deviation: Of the splat along its longest axis, scene units.
    """
    return SPLAT_WIDTH * deviation / SPLAT_PIXELS

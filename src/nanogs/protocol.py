"""How a PSNR was measured; every PSNR that is printed or stored names it. Does not import Numba."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from nanogs.errors import OptionError
from nanogs.formatting import counted, number_text

Background = tuple[float, float, float]
Kind = Literal["auto", "orbit", "inside", "roam", "given", "photographs"]

# The default protocol of every PSNR: of `compare`, `view`, `simplify` and `lod`.
VIEWS = 8
ROAMING = 24  # number of roaming views, which differ more from each other
PIXELS = 512  # width and height of a view
UNMEASURED = "The PSNR cannot be measured: "  # first words of a reason
BLACK: Background = (0.0, 0.0, 0.0)
WHITE: Background = (1.0, 1.0, 1.0)


def plain_background(colour: Iterable[float]) -> Background:
    """Convert a caller's background colour to a tuple of Python floats.

    Raises:
        OptionError: It is not three numbers from 0 to 1.
    """
    try:
        red, green, blue = map(float, colour)
    except (TypeError, ValueError):
        red = green = blue = math.nan  # refused below
    if not all(map(math.isfinite, (red, green, blue))):
        raise OptionError(f"background must be three finite numbers, not {colour!r}.")
    if not all(0 <= value <= 1 for value in (red, green, blue)):
        raise OptionError(
            f"background must be red, green and blue from 0 to 1, not {colour!r}; divide 8-bit"
            " values by 255."
        )
    return red, green, blue


@dataclass(frozen=True, slots=True)
class Protocol:
    """The set of views that a PSNR and an SSIM are averaged over.

    Values of different protocols cannot be compared.

    Attributes:
        views: Number of views in the mean.
        pixels: Width and height of the first view.
        kind: Source of the views: "auto", "orbit", "inside" and "roam" are chosen from the original
            model, "given" ones come from a file or the caller, "photographs" from a data set.
        split: "test" for held-out views, or "train"; None for given ones.
        background: RGB in [0, 1] behind the splats, and behind the photographs' transparent parts.
        sizes: Number of different image sizes: given views and photographs may mix several.
    """

    views: int = VIEWS
    pixels: tuple[int, int] = (PIXELS, PIXELS)
    kind: Kind = "auto"
    split: str | None = "test"
    background: Background = BLACK
    sizes: int = 1

    @property
    def label(self) -> str:
        """Short text for tables, such as "auto 512"."""
        return f"{self.kind} {size_text(self.pixels)}"

    @property
    def text(self) -> str:
        """Full text, such as "8 held-out views of 512 pixels"."""
        behind = ""
        if self.background != BLACK or self.kind == "photographs":
            behind = f" over {background_text(self.background)}"
        others = f" and {counted(self.sizes - 1, 'other size')}" if self.sizes > 1 else ""
        size = f"{size_text(self.pixels)} pixels{others}"
        return f"{self.views} {self._views_text()} of {size}{behind}"

    def _views_text(self) -> str:
        many = "" if self.views == 1 else "s"
        if self.kind == "photographs":
            return f"{self.split} photograph{many}"
        if self.kind == "given":
            return f"given view{many}"
        return f"held-out {'roaming ' if self.kind == 'roam' else ''}view{many}"


@dataclass(frozen=True, slots=True)
class Judged:
    """PSNR and SSIM of a model against its original.

    Attributes:
        psnr: Mean over the views, dB; infinite if all are bit-identical.
        ssim: Mean over the views.
        protocol: The views.
    """

    psnr: float
    ssim: float
    protocol: Protocol

    @classmethod
    def usual(cls, psnr: float, ssim: float, views: int) -> "Judged":
        """Make scores by the default protocol, on a number of views."""
        return cls(psnr, ssim, Protocol(views=views))

    @property
    def text(self) -> str:
        """The PSNR and its protocol, such as "36.12 dB on 8 held-out views of 512 pixels"."""
        return f"{number_text(self.psnr)} dB on {self.protocol.text}"


@dataclass(frozen=True, slots=True)
class PackingLoss:
    """Loss of quality by the compression of the file format alone, on the views of the scores.

    Attributes:
        format: Suffix of the file's format.
        psnr_cost: PSNR of the model minus that of its file, both against the original, dB. Infinite
            if the model equals the original, minus infinite if its file does, which happens for the
            file that the original was read from.
        ssim_cost: The same for SSIM.
        psnr: PSNR of the file against the model that was packed, mean over the views, dB.
        ssim: The same for SSIM.
        of: Name of the model that was packed, if it has one.
    """

    format: str
    psnr_cost: float
    ssim_cost: float
    psnr: float
    ssim: float
    of: str = ""

    @property
    def text(self) -> str:
        """The cost in words, such as "packing alone costs 0.18 dB"."""
        if self.psnr_cost == math.inf:
            return "the loss is packing alone"
        return f"packing alone costs {number_text(self.psnr_cost)} dB"


def usual_views(kind: str) -> int:
    """Return the default number of views of a kind."""
    return ROAMING if kind == "roam" else VIEWS


def size_text(pixels: tuple[int, int]) -> str:
    """Format width and height, or one number if they are equal: "64 x 48", "512"."""
    width, height = pixels
    return f"{width}" if width == height else f"{width} x {height}"


def background_text(background: Background) -> str:
    """Return a background colour's name, or #rrggbb."""
    return {BLACK: "black", WHITE: "white"}.get(background, hex_text(background))


def hex_text(background: Background) -> str:
    """Format a background colour as #rrggbb."""
    return "#" + "".join(f"{round(255 * part):02x}" for part in background)

"""How a PSNR was measured: what every number that is printed or stored names. No Numba here."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from nanogs.errors import OptionError
from nanogs.formatting import counted, number_text

Background = tuple[float, float, float]
Kind = Literal["auto", "orbit", "inside", "roam", "given", "photographs"]

# The protocol of every PSNR that is not asked for in another way: `compare` and `view` at their
# defaults, `simplify`, `lod`.
VIEWS = 8
ROAMING = 24  # views, where they roam: they differ more
PIXELS = 512  # along both sides of a view
UNMEASURED = "The PSNR cannot be measured: "  # begins the reason, where it is asked for
BLACK: Background = (0.0, 0.0, 0.0)
WHITE: Background = (1.0, 1.0, 1.0)


def plain_background(colour: Iterable[float]) -> Background:
    """A background as a caller gives it, in numbers of Python's.

    Raises:
        OptionError: It is not three finite numbers.
    """
    try:
        red, green, blue = map(float, colour)
    except (TypeError, ValueError):
        red = green = blue = math.nan  # which is no colour either
    if not all(map(math.isfinite, (red, green, blue))):
        raise OptionError(f"background must be three finite numbers, not {colour!r}.")
    return red, green, blue


@dataclass(frozen=True, slots=True)
class Protocol:
    """The pictures that a PSNR and an SSIM are the means over; values do not compare across these.

    Attributes:
        views: Number of views in the mean.
        pixels: Width and height of the first view.
        kind: Where the views are from: "auto", "orbit", "inside" and "roam" are found from the
            original model, "given" ones come from a file or the caller, "photographs" from a data
            set.
        split: "test" for views that nothing is learnt from, "train"; None for given ones.
        background: RGB in [0, 1] behind the splats, and behind the photographs' transparent parts.
        sizes: How many sizes the views have, of which given ones and photographs may mix several.
    """

    views: int = VIEWS
    pixels: tuple[int, int] = (PIXELS, PIXELS)
    kind: Kind = "auto"
    split: str | None = "test"
    background: Background = BLACK
    sizes: int = 1

    @property
    def label(self) -> str:
        """Two words, for tables: "auto 512"."""
        return f"{self.kind} {size_text(self.pixels)}"

    @property
    def text(self) -> str:
        """A few words, such as "8 held-out views of 512 pixels"."""
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
    """A model held against its original.

    Attributes:
        psnr: Mean over the views, dB; infinite where all are the same to the last bit.
        ssim: Mean over the views.
        protocol: The views.
    """

    psnr: float
    ssim: float
    protocol: Protocol

    @classmethod
    def usual(cls, psnr: float, ssim: float, views: int) -> "Judged":
        """Marks by the usual protocol, on so many views."""
        return cls(psnr, ssim, Protocol(views=views))

    @property
    def text(self) -> str:
        """The PSNR and its protocol: "36.12 dB on 8 held-out views of 512 pixels"."""
        return f"{number_text(self.psnr)} dB on {self.protocol.text}"


@dataclass(frozen=True, slots=True)
class PackingLoss:
    """Loss of quality by packing alone, on the views of a model's scores.

    Attributes:
        format: Suffix of the file's format.
        psnr_cost: The model's PSNR less that of its file, both against the original, dB: what
            packing costs. Infinite where the model equals the original, minus infinite where its
            file does, as that which the original was read from.
        ssim_cost: The same of SSIM.
        psnr: Of the file against the model that was packed, mean over the views, dB.
        ssim: The same of SSIM.
        of: Name of the model that was packed, where it has one.
    """

    format: str
    psnr_cost: float
    ssim_cost: float
    psnr: float
    ssim: float
    of: str = ""

    @property
    def text(self) -> str:
        """The cost in a few words: "packing alone costs 0.18 dB"."""
        if self.psnr_cost == math.inf:
            return "the loss is packing alone"
        return f"packing alone costs {number_text(self.psnr_cost)} dB"


def usual_views(kind: str) -> int:
    """How many views of a kind there are unless told otherwise."""
    return ROAMING if kind == "roam" else VIEWS


def size_text(pixels: tuple[int, int]) -> str:
    """Width and height, or one number for both: "512", "64 x 48"."""
    width, height = pixels
    return f"{width}" if width == height else f"{width} x {height}"


def background_text(background: Background) -> str:
    """A background's name, or #rrggbb."""
    return {BLACK: "black", WHITE: "white"}.get(background, hex_text(background))


def hex_text(background: Background) -> str:
    """A background as #rrggbb."""
    return "#" + "".join(f"{round(255 * part):02x}" for part in background)

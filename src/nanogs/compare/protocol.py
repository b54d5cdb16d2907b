"""How a PSNR was measured: what every number that is printed or stored names. No Numba here."""

from dataclasses import dataclass
from typing import Literal

from nanogs.formatting import number_text

Background = tuple[float, float, float]
Kind = Literal["auto", "orbit", "inside", "given", "photographs"]

# The protocol of every PSNR that is not asked for in another way: `compare` and `view` at their
# defaults, `simplify`, `lod`.
VIEWS = 8
PIXELS = 512  # along both sides of a view
BLACK: Background = (0.0, 0.0, 0.0)
WHITE: Background = (1.0, 1.0, 1.0)


@dataclass(frozen=True, slots=True)
class Protocol:
    """The pictures that a PSNR and an SSIM are the means over; values do not compare across these.

    Attributes:
        views: Number of views in the mean.
        pixels: Width and height of the first view.
        kind: Where the views are from: "auto", "orbit" and "inside" are found from the original
            model, "given" ones come from a file or the caller, "photographs" from a data set.
        split: "test" for views that nothing is learnt from, "train"; None for given ones.
        background: RGB in [0, 1] behind the splats, and behind the photographs' transparent parts.
    """

    views: int = VIEWS
    pixels: tuple[int, int] = (PIXELS, PIXELS)
    kind: Kind = "auto"
    split: str | None = "test"
    background: Background = BLACK

    @property
    def text(self) -> str:
        """A few words, such as "8 held-out views of 512 pixels"."""
        width, height = self.pixels
        size = f"{width}" if width == height else f"{width} x {height}"
        behind = ""
        if self.background != BLACK or self.kind == "photographs":
            behind = f" over {background_text(self.background)}"
        return f"{self.views} {self._views_text()} of {size} pixels{behind}"

    def _views_text(self) -> str:
        many = "" if self.views == 1 else "s"
        if self.kind == "photographs":
            return f"{self.split} photograph{many}"
        return f"given view{many}" if self.kind == "given" else f"held-out view{many}"


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

    @property
    def text(self) -> str:
        """The PSNR and its protocol: "36.12 dB on 8 held-out views of 512 pixels"."""
        return f"{number_text(self.psnr)} dB on {self.protocol.text}"


def background_text(background: Background) -> str:
    """Its name, or #rrggbb."""
    names = {BLACK: "black", WHITE: "white"}
    shown = "#" + "".join(f"{round(255 * part):02x}" for part in background)
    return names.get(background, shown)

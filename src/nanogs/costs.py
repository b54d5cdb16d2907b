"""Cost of drawing a model, which depends on more than the number of its splats."""

from dataclasses import asdict, astuple, dataclass
from typing import Any

from nanogs.formatting import number_text
from nanogs.protocol import Protocol

LARGEST = 0.01  # share of the splats that counts as the largest


@dataclass(frozen=True, slots=True)
class DrawCost:
    """Cost of rendering a model on a set of views.

    A splat *covers* a pixel if its alpha there is 1/255 or more, even if other splats hide it.
    Viewers that draw splats as triangles shade each covered pixel of each splat; tile rasterisers,
    such as those of 3DGS and gsplat, sort the tile pairs and stop at a pixel once its transmittance
    is used up.

    Attributes:
        splats_a_pixel: Splats that cover a pixel, mean over all pixels of all views.
        most_a_pixel: The 99th percentile of the same: 99 % of the pixels are covered by this number
            of splats or fewer.
        tile_pairs: Pairs of a splat and a tile of 16 x 16 pixels in whose list it is because it may
            cover one of its pixels, mean over the views.
        largest_share: Share of all tile pairs, in [0, 1], that come from the largest hundredth of
            the model's splats, which are those with the most pairs over all views.
        drawn: Splats that can cover any pixel, mean over the views.
        protocol: The views; the background does not matter.
    """

    splats_a_pixel: float
    most_a_pixel: int
    tile_pairs: float
    largest_share: float
    drawn: float
    protocol: Protocol

    @classmethod
    def usual(
        cls, a_pixel: float, most: float, pairs: float, largest: float, drawn: float
    ) -> "DrawCost":
        """Make a cost of its numbers, measured on the default views of `nanogs compare`."""
        return cls(a_pixel, int(most), pairs, largest, drawn, Protocol())

    @property
    def numbers(self) -> tuple[float, ...]:
        """The numbers in the order of the fields, without the protocol."""
        return astuple(self)[:-1]

    def share_of(self, original: "DrawCost") -> float:
        """Return `splats_a_pixel` over that of the original on the same views; 0 if that is 0."""
        return self.splats_a_pixel / original.splats_a_pixel if original.splats_a_pixel else 0.0

    @property
    def text(self) -> str:
        """The numbers in one line of text, without the protocol."""
        return (
            f"{self.pixel_text} splats a pixel (mean, 99th percentile),"
            f" {number_text(self.tile_pairs, 0)} tile pairs a view, {self.largest_share:.0%} of"
            f" them by the largest {LARGEST:.0%} of the splats"
        )

    @property
    def pixel_text(self) -> str:
        """Splats per pixel, mean and 99th percentile, such as "12.3, 45"."""
        return f"{number_text(self.splats_a_pixel, 1)}, {self.most_a_pixel:,}"

    def to_dict(self) -> dict[str, Any]:
        """Return the cost as plain dictionaries, lists, numbers and strings."""
        return asdict(self)

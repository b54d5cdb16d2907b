"""Cost of drawing a model: numbers that a count of splats does not tell."""

from dataclasses import asdict, astuple, dataclass
from typing import Any

from nanogs.formatting import number_text
from nanogs.protocol import Protocol

LARGEST = 0.01  # share of the splats that are called the largest


@dataclass(frozen=True, slots=True)
class DrawCost:
    """Cost of drawing pictures of a model, on some views.

    A splat *covers* a pixel where its alpha there is 1/255 or more, whatever stands before it.
    Viewers that draw splats as triangles shade each of these; tile rasterisers, as those of 3DGS
    and gsplat, sort the tile pairs and stop at a pixel once nothing shines through.

    Attributes:
        splats_a_pixel: Splats that cover a pixel, mean over all pixels of all views.
        most_a_pixel: The 99th percentile: 99 % of the pixels are covered by so many or fewer.
        tile_pairs: Pairs of a splat and a tile of 16 x 16 pixels that it is listed for, as it may
            cover a pixel of it, mean over the views.
        largest_share: Share of all tile pairs that the largest hundredth of the model's splats
            makes, those of the most pairs over all views, in [0, 1].
        drawn: Splats that can reach a pixel, mean over the views.
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
        """Numbers in their order, on the views of `nanogs compare` at its defaults."""
        return cls(a_pixel, int(most), pairs, largest, drawn, Protocol())

    @property
    def numbers(self) -> tuple[float, ...]:
        """The numbers in their order, without the views."""
        return astuple(self)[:-1]

    def share_of(self, original: "DrawCost") -> float:
        """Splats a pixel as a share of those of another model on the same views; 0 of nothing."""
        return self.splats_a_pixel / original.splats_a_pixel if original.splats_a_pixel else 0.0

    @property
    def text(self) -> str:
        """The numbers in a line, without the views."""
        return (
            f"{self.pixel_text} splats a pixel (mean, 99th percentile),"
            f" {number_text(self.tile_pairs, 0)} tile pairs a view, {self.largest_share:.0%} of"
            f" them by the largest {LARGEST:.0%} of the splats"
        )

    @property
    def pixel_text(self) -> str:
        """Splats a pixel, mean and 99th percentile: "12.3, 45"."""
        return f"{number_text(self.splats_a_pixel, 1)}, {self.most_a_pixel:,}"

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionaries, lists, numbers and strings."""
        return asdict(self)

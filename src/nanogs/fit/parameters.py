"""Parameters of a refit; none is in scene units, so that none depends on a scene's scale."""

import math
from dataclasses import dataclass

from nanogs.ranges import check_ranges, parameter

KEPT = 64  # views in memory at most: 67 MB for 512 x 512 pixels
FINER = 0.7  # usual `finer`: people look at larger pictures than views have, and from nearer


@dataclass(frozen=True, slots=True)
class RefitParameters:
    """Parameters of `nanogs.refit`.

    Attributes:
        views: Number of views of the original to fit to, by default one for every step; of given
            cameras, at most this many are used.
        validation: Number of further views, at most, that only decide how much of each round is
            kept; see `held`.
        size: Pixels along the longer side of a view; larger given cameras are reduced to it.
        finer: Width of a pixel that automatic views show, over that of a picture of their size: the
            geometric mean of all views (`fit.views.choose_cameras`). Below 1 results are
            better in larger pictures and from nearer, and worse in small ones.
        rounds: Rounds at most; of each, the part is kept that improves the validation views.
        steps: Steps per round, each on one view.
        rate: Initial learning rate, above 0; 1 goes the whole way to the minimum of the quadratic
            model.
        damping: Fraction of each diagonal curvature that is added to it.
        floor: Fraction of a splat's largest curvature that is added to the diagonal curvatures of
            all of its shape parameters, above 0, so that a parameter that no view determines does
            not move.
        ridge: Strength of the pull of the base colour back to the input's, as a fraction of the
            splat's weight.
        band_ridge: The same for the higher harmonics.
        halves: Whether a step uses only half of its view's pixels, every other block of 4 x 4, and
            the other half when the view is used again: half of the work, and little is lost if
            views are used more than once.
        seed: Random seed of the order of the views.
    """

    views: int = parameter(320, 1, views=True, help="Number of automatic views.")
    validation: int = parameter(6, 1)
    size: int = parameter(
        512, 16, 8192, unit=" pixels", option="pixels", views=True,
        help="Pixels along the longer side of a view; larger cameras are reduced to it.",
    )  # fmt: skip
    finer: float = parameter(FINER, 0, 1, above=True, views=True)
    rounds: int = parameter(5, 1, help="Rounds of steps; more take longer and fit better.")
    steps: int = parameter(64, 1)
    rate: float = parameter(1.0, above=True)
    damping: float = parameter(0.1)
    floor: float = parameter(0.02, above=True)
    ridge: float = parameter(0.02)
    band_ridge: float = parameter(0.3)
    halves: bool = False
    seed: int = parameter(0, high=math.inf)

    def __post_init__(self) -> None:
        """Refuse values that are out of range."""
        check_ranges(self)

    @property
    def kept(self) -> int:
        """Number of views to fit to that stay in memory; the others are rendered when used."""
        return min(self.views, KEPT)

    @property
    def held(self) -> int:
        """Number of validation views: `validation`, but at most a third of `views` (at least 1)."""
        return min(self.validation, max(1, self.views // 3))

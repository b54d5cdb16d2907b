"""Parameters of a refit; every number is without unit, so none depends on a scene's scale."""

from dataclasses import dataclass

from nanogs.ranges import check_ranges, parameter

KEPT = 64  # views in memory at the most: of 512 pixels 67 MB


@dataclass(frozen=True, slots=True)
class RefitParameters:
    """Parameters of `nanogs.refit`.

    Attributes:
        views: Views of the original to fit to, by default one for every step; of given cameras, at
            most so many.
        validation: Further views that only decide what is kept, at most; see `held`.
        size: Pixels along the longer side of a view; larger given cameras are reduced to it.
        rounds: Rounds at most; of each is kept what brings the validation views nearer.
        steps: Steps a round, each on one view.
        rate: Length of the first steps, above 0; 1 for the whole way to the minimum of their
            quadratic.
        damping: Share of each curvature added to it.
        floor: Share of a splat's largest curvature added to all of its parameters of shape, above
            0: what no view determines stays where it is.
        ridge: Pull of the base colour back to the input's, as a share of its weight.
        band_ridge: The same for the higher harmonics.
        halves: Whether a step follows half of its view's pixels, every other block of 4 x 4, and
            the other half when the view comes again: half of the work, and little is lost where
            views come again.
        seed: Order of the views.
    """

    views: int = parameter(320, 1, views=True, help="Number of automatic views.")
    validation: int = parameter(6, 1)
    size: int = parameter(
        512, 16, 8192, unit=" pixels", option="pixels", views=True,
        help="Pixels along the longer side of a view; larger cameras are reduced to it.",
    )  # fmt: skip
    rounds: int = parameter(5, 1, help="Rounds of steps; more take longer and fit better.")
    steps: int = parameter(64, 1)
    rate: float = parameter(1.0, above=True)
    damping: float = parameter(0.1)
    floor: float = parameter(0.02, above=True)
    ridge: float = parameter(0.02)
    band_ridge: float = parameter(0.3)
    halves: bool = False
    seed: int = parameter(0)

    def __post_init__(self) -> None:
        """Refuse values that mean nothing."""
        check_ranges(self)

    @property
    def kept(self) -> int:
        """Views to fit to that stay in memory; more are drawn whenever their turn comes."""
        return min(self.views, KEPT)

    @property
    def held(self) -> int:
        """Views that decide: a third of those fitted to where these are few."""
        return min(self.validation, max(1, self.views // 3))

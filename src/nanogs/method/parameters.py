"""Parameters of the default method."""

from dataclasses import dataclass

from nanogs.ranges import check_ranges, parameter

USUAL_BALANCE = 0.8  # the safest where nothing is measured
PICTURES = 64  # that are kept at most: 3 MB each at 896 pixels
BALANCES = (0.5, 1.0)  # one between them is hardly ever better than both


@dataclass(frozen=True, slots=True)
class ForestParameters:
    """The parameters of the default method (`docs/method.md`).

    Attributes:
        k: Neighbours of each node in the graph.
        lambda_app: Weight of the colour's error beside the geometry's while the forest grows.
        balance: Of the cut, from groups of equal size (0) to groups of equal error (1). Where
            results are measured 0.5 and 1 are tried, and this beside them if it is not the usual
            one.
        rounds: Rounds of reassignment after the cut.
        pixels: Across a splat's surroundings, the ball about it that holds a quarter of the alpha,
            where the model is seen as a whole: rasterisers widen what is thinner than a pixel, and
            what is merged must cover as much there and four times as near.
        hidden: Weight of a splat that no view sees over that of one in full sight, above 0; 1
            weighs all alike.
        growth: Most that a merged splat's two longer axes may grow where an opaque one would cover
            too little; where nothing is measured, pieces of flat sheets grow by what they need, up
            to 1.8.
        measure: Render the original: weigh splats by what is seen of them, and choose between
            results by how they look.
        steps: Of fitting the result to the original, each on one view; a long fit is made in
            rounds of about 32, so that it may take a few more; 0 fits nothing.
        views: Views of the original to look at, where it is rendered: for what is hidden, to choose
            by and to fit to; one in six of them decides.
        further: More views to fit to, few of which are kept, and many drawn when their turn comes.
        halves: Whether a step of the fit follows half of its view's pixels, every other block of
            4 x 4: half of the work, and less than 0.1 dB lost where steps are few.
        roaming: Small views from anywhere in free space, that only say what is hidden.
        view_size: Pixels along the longer side of a view.
    """

    k: int = parameter(5, 1, help="Neighbours in the graph.")
    lambda_app: float = parameter(1.0, help="Weight of the colours.")
    balance: float = parameter(
        USUAL_BALANCE, 0, 1, help="From groups of equal size (0) to groups of equal error (1)."
    )
    rounds: int = parameter(2, help="Rounds of reassignment after the cut.")
    pixels: float = parameter(512.0, above=True)
    hidden: float = parameter(0.03, 0, 1, above=True)
    growth: float = parameter(1.25, 1)
    measure: bool = True
    steps: int = parameter(
        28, help="Steps of fitting the result to renders of the original; 0 fits nothing."
    )
    views: int = parameter(14, 1, views=True, help="Views of the original to look at.")
    further: int = parameter(16, views=True)
    halves: bool = True
    roaming: int = parameter(0, views=True)
    view_size: int = parameter(
        896, 16, 8192, unit=" pixels", views=True,
        help="Pixels along the longer side of these views; fewer for results that are seen small.",
    )  # fmt: skip

    def __post_init__(self) -> None:
        """Refuse values that mean nothing."""
        check_ranges(self)

    @property
    def pictured(self) -> int:
        """How many of `further` are drawn beforehand and kept: all, or none where they are many.

        What is drawn while a result is fitted takes memory beside all that the fit holds.
        """
        return self.further if self.steps and self.views + self.further <= PICTURES else 0

    @property
    def balances(self) -> tuple[float, ...]:
        """The balances of the cuts that are tried, at least one."""
        if not self.measure:
            return (self.balance,)
        return tuple(sorted({*BALANCES, self.balance} - {USUAL_BALANCE}))

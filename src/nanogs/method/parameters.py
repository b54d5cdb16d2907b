"""Parameters of the default method."""

import math
from dataclasses import dataclass

from nanogs.errors import require

USUAL_BALANCE = 0.8  # the safest where nothing is measured
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
        further: More views to fit to, each drawn when its turn comes.
        roaming: Small views from anywhere in free space, that only say what is hidden.
        view_size: Pixels along the longer side of a view.
    """

    k: int = 8
    lambda_app: float = 1.0
    balance: float = USUAL_BALANCE
    rounds: int = 2
    pixels: float = 512.0
    hidden: float = 0.03
    growth: float = 1.25
    measure: bool = True
    steps: int = 28
    views: int = 14
    further: int = 0
    roaming: int = 0
    view_size: int = 896

    def __post_init__(self) -> None:
        """Refuse values that mean nothing."""
        require(self.k >= 1, "k", self.k, "at least 1")
        require(0 <= self.lambda_app < math.inf, "lambda_app", self.lambda_app, "0 or more")
        require(0 <= self.balance <= 1, "balance", self.balance, "from 0 to 1")
        require(self.rounds >= 0, "rounds", self.rounds, "0 or more")
        require(0 < self.pixels < math.inf, "pixels", self.pixels, "above 0, and finite")
        require(0 < self.hidden <= 1, "hidden", self.hidden, "above 0, at most 1")
        require(1 <= self.growth < math.inf, "growth", self.growth, "1 or more, and finite")
        require(self.steps >= 0, "steps", self.steps, "0 or more")
        require(self.views >= 1, "views", self.views, "at least 1")
        require(self.further >= 0, "further", self.further, "0 or more")
        require(self.roaming >= 0, "roaming", self.roaming, "0 or more")
        require(16 <= self.view_size <= 8192, "view_size", self.view_size, "16 to 8192 pixels")

    @property
    def balances(self) -> tuple[float, ...]:
        """The balances of the cuts that are tried, at least one."""
        if not self.measure:
            return (self.balance,)
        return tuple(sorted({*BALANCES, self.balance} - {USUAL_BALANCE}))

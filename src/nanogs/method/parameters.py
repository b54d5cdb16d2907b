"""Parameters of the default method."""

from dataclasses import dataclass

from nanogs.fit.parameters import FINER
from nanogs.ranges import check_ranges, parameter

USUAL_BALANCE = 0.8  # the safest if nothing is rendered
PICTURES = 64  # most views that are rendered in advance and kept: 3 MB each at 896 pixels
MOST_CORRECTIONS = 4  # each is a stage of its own
BALANCES = (0.5, 1.0)  # one between them is hardly ever better than both


@dataclass(frozen=True, slots=True)
class ForestParameters:
    """The parameters of the default method (`docs/method.md`).

    Attributes:
        k: Number of neighbours of each node in the graph.
        lambda_app: Weight of the colour error relative to the geometry error while the forest
            grows.
        balance: Balance of the cut, from groups of equal size (0) to groups of equal error (1). If
            the method is guided, 0.5 and 1 are tried, and this value too unless it is the default.
        rounds: Rounds of reassignment after the cut.
        pixels: Diameter in pixels of a splat's surroundings, the ball around it that holds a
            quarter of the alpha, in a view of the whole model. It sets the size of a pixel:
            rasterisers widen splats thinner than a pixel, and merged splats must cover as much in
            that view and in one four times as near.
        hidden: Weight of a splat that no view sees relative to a fully visible one, above 0; 1
            weights all alike.
        growth: Largest factor by which a merged splat's two longer axes may grow if an opaque one
            would cover too little; if the method is not guided, pieces of flat sheets grow by as
            much as they need, up to 1.8.
        corrections: How often, at most, the errors that the cut follows are corrected by those that
            groups show in views, if the method is guided; as long as this helps.
        guided: Whether renders of the original guide the method: they weight splats by their
            visibility, correct errors of the cut, and decide which result is chosen.
        steps: Number of steps of fitting the result to the original, each on one view; a long fit
            is made in rounds of about 32 and may take a few more; 0 fits nothing.
        views: Number of views of the original, if it is rendered: to find hidden splats, to choose
            by and to fit to; one in six of them is held out to decide.
        further: Number of further views to fit to. Few are rendered in advance and kept, many are
            rendered when their turn comes.
        finer: Width of a pixel that automatic views show, over that of a picture of their size: the
            geometric mean of all views (`fit.views.choose_cameras`). Below 1 results are better in
            larger pictures and from nearer, and worse in small ones.
        halves: Whether a step of the fit uses half of its view's pixels, every other block of
            4 x 4: half the work, and a loss of less than 0.1 dB if there are few steps.
        around: Number of small views from all around the model, from above and below too, that are
            only used to find hidden splats; there are none beside given cameras, nor where as many
            `views` or more are from all around already.
        view_size: Pixels along the longer side of a view.
    """

    k: int = parameter(5, 1, help="Nearest neighbours that a splat may merge with.")
    lambda_app: float = parameter(1.0, help="Weight of colour in the cost of a merge.")
    balance: float = parameter(
        USUAL_BALANCE, 0, 1, help="Cut into groups of equal size (0) to groups of equal error (1)."
    )
    rounds: int = parameter(2, help="Rounds of reassignment after the cut.")
    pixels: float = parameter(512.0, above=True)
    hidden: float = parameter(0.02, 0, 1, above=True)
    growth: float = parameter(1.25, 1)
    corrections: int = parameter(1, 0, MOST_CORRECTIONS)
    guided: bool = True
    steps: int = parameter(
        28, help="Steps of fitting the result to renders of the original; 0 fits nothing."
    )
    views: int = parameter(
        14, 1, views=True, help="Views of the original to choose and fit results by."
    )
    further: int = parameter(16, views=True)
    finer: float = parameter(FINER, 0, 1, above=True, views=True)
    halves: bool = True
    around: int = parameter(12, views=True)
    view_size: int = parameter(
        896, 16, 8192, unit=" pixels", views=True,
        help="Pixels along the longer side of these views; fewer for results that are seen small.",
    )  # fmt: skip

    def __post_init__(self) -> None:
        """Check the ranges of the parameters."""
        check_ranges(self)

    @property
    def pictured(self) -> int:
        """Number of `further` views that are rendered in advance and kept: all if few, else none.

        Views that are rendered during a fit take memory in addition to that of the fit.
        """
        return self.further if self.steps and self.views + self.further <= PICTURES else 0

    @property
    def balances(self) -> tuple[float, ...]:
        """Balances of the cuts to try, at least one."""
        if not self.guided:
            return (self.balance,)
        return tuple(sorted({*BALANCES, self.balance} - {USUAL_BALANCE}))

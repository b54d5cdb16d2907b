"""Parameters of a refit; every number is without unit, so none depends on a scene's scale."""

import math
from dataclasses import dataclass

from nanogs.errors import OptionError

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

    views: int = 320
    validation: int = 6
    size: int = 512
    rounds: int = 5
    steps: int = 64
    rate: float = 1.0
    damping: float = 0.1
    floor: float = 0.02
    ridge: float = 0.02
    band_ridge: float = 0.3
    halves: bool = False
    seed: int = 0

    @property
    def kept(self) -> int:
        """Views to fit to that stay in memory; more are drawn whenever their turn comes."""
        return min(self.views, KEPT)

    @property
    def held(self) -> int:
        """Views that decide: a third of those fitted to where these are few."""
        return min(self.validation, max(1, self.views // 3))

    def check(self) -> None:
        """Refuse what makes no sense.

        Raises:
            OptionError: A parameter is out of range.
        """
        for name in ("views", "validation", "rounds", "steps"):
            if getattr(self, name) < 1:
                raise OptionError(f"{name} must be 1 or more, not {getattr(self, name)}.")
        if not 16 <= self.size <= 8192:
            raise OptionError(f"A view size is from 16 to 8192 pixels, not {self.size}.")
        if self.seed < 0:
            raise OptionError(f"seed must be 0 or more, not {self.seed}.")
        for name in ("rate", "floor"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise OptionError(f"{name} must be a finite number above 0, not {value}.")
        for name in ("damping", "ridge", "band_ridge"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise OptionError(f"{name} must be a finite number from 0 on, not {value}.")

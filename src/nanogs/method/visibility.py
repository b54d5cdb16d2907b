"""How much of a model its views show, and how much they have missed."""

from dataclasses import dataclass

from nanogs._types import F64, Bool
from nanogs.views.light import SHOWN, SplatContributions

NEW = 0.01  # share of light seen by only one view, above which the views are taken as incomplete


@dataclass(frozen=True, slots=True)
class MissedLight:
    """Statistics that estimate how much of a model the views have missed.

    The share of new light in further views is about the share of these views' light that is seen by
    one view alone (Good, "The population frequencies of species and the estimation of population
    parameters", 1953).

    Attributes:
        once: Light of splats that only one view shows, in units of whole pictures.
        light: Light of all splats, in the same units.
        unseen: Unoccluded light of splats that are inside views but shown by none.
    """

    once: float = 0.0
    light: float = 0.0
    unseen: float = 0.0

    def __add__(self, other: "MissedLight") -> "MissedLight":
        """Add the statistics of two parts of a scene."""
        return MissedLight(
            self.once + other.once, self.light + other.light, self.unseen + other.unseen
        )

    def hidden(self, least: float) -> float:
        """Return the weight of an unseen splat relative to a fully visible one, in (0, 1].

        It is the share of their light that further views of the same kind would show of unseen
        splats, on average. If such views would show little that is new, unseen splats are taken as
        hidden and the weight is `least`.

        Args:
            least: The least weight.
        """
        if self.once <= NEW * self.light or self.unseen <= 0:
            return least
        return max(least, min(self.once / self.unseen, 1.0))


def missed_light_of(looked: SplatContributions, count: int) -> MissedLight:
    """Compute the statistics of missed light for the first `count` splats.

    Args:
        looked: Light in the views of the model. Views from all around it are not counted: from
            afar they show something of everything, but little of what is seen inside it.
        count: Number of splats.
    """
    picture = looked.pixels / max(looked.views, 1) or 1.0
    times = looked.times[:count]
    seen, whole = looked.contributions[:count] / picture, looked.unoccluded[:count] / picture
    return MissedLight(
        float(seen[times == 1].sum()), float(seen.sum()), float(whole[times == 0].sum())
    )


def shown_share(prominences: F64, visible: F64, missed: Bool) -> float:
    """Compute the share of all prominence, in [0, 1], of splats that the views show.

    Args:
        prominences: (N,) from `nodes.prominence`.
        visible: (N,) visibilities in [0, 1].
        missed: (N,) bool, splats outside all views.
    """
    total = float(prominences.sum())
    return shown_prominence(prominences, visible, missed) / total if total > 0 else 0.0


def shown_prominence(prominences: F64, visible: F64, missed: Bool) -> float:
    """Sum the prominence of the splats that the views show; arguments as for `shown_share`."""
    return float(prominences[(visible >= SHOWN) & ~missed].sum())

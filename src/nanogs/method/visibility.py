"""Views of the original: how visible each splat is, and what a result is held against."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from nanogs._types import F64, Bool
from nanogs.errors import ModelError
from nanogs.formatting import counted
from nanogs.progress import Parts, untold
from nanogs.raster.camera import Camera
from nanogs.raster.rendering import PreparedSplats, Rendering, render
from nanogs.splats import Splats
from nanogs.views.roam import roaming_cameras

LUMA = np.array([0.299, 0.587, 0.114], np.float32)  # ITU-R BT.601; grey takes a third of the work
SHOWN = 0.01  # of a splat that reaches the views, from which it counts as shown
SMALL = 128  # pixels of a roaming view
NEW = 0.01  # share of the light of a further view that is new, from which views leave out much
DECIDING = 6  # one view in so many decides which candidate is chosen and whether a fit is kept


class Light:
    """How much of N splats reaches views."""

    def __init__(self, count: int) -> None:
        self.seen, self.whole = np.zeros(count), np.zeros(count)
        self.times = np.zeros(count, np.uint8)  # views that show each, more than one as 2
        self.views = self.pixels = 0

    def add(self, view: Rendering) -> None:
        """Count a view, rendered with contributions."""
        assert view.contributions is not None  # noqa: S101 - asked for
        assert view.unhidden is not None  # noqa: S101 - asked for
        self.seen += view.contributions
        self.whole += view.unhidden
        self.times += view.contributions > SHOWN * view.unhidden
        np.minimum(self.times, 2, out=self.times)
        self.views += 1
        self.pixels += view.alpha.size

    def shares(self) -> F64:
        """(N,) float64 in [0, 1], of the alpha of each in the views that it lies in; 0 in none."""
        shares = np.zeros(len(self.seen))
        np.divide(self.seen, self.whole, out=shares, where=self.whole > 0)
        return np.minimum(shares, 1.0, out=shares)


@dataclass(frozen=True, slots=True)
class Discovery:
    """How much views have shown that no other of them does, which says what they leave out.

    Of what further views will show, about as much is new as of these views' light one view alone
    has (Good, "The population frequencies of species and the estimation of population
    parameters", 1953).

    Attributes:
        once: Light of splats that one view alone shows, pictures.
        light: Light of all splats, pictures.
        unseen: Light of splats that lie in views of which none shows them, if nothing hid them.
    """

    once: float = 0.0
    light: float = 0.0
    unseen: float = 0.0

    def __add__(self, other: "Discovery") -> "Discovery":
        """Of both parts of a scene."""
        return Discovery(
            self.once + other.once, self.light + other.light, self.unseen + other.unseen
        )

    def hidden(self, least: float) -> float:
        """Weight of a splat that no view shows, over that of one in full sight, in (0, 1].

        Further views of the same kind would show the unseen ones, on average, so much of their
        light. Where little is new it is not asked: what is unseen then is hidden.

        Args:
            least: What it is at least.
        """
        if self.once <= NEW * self.light or self.unseen <= 0:
            return least
        return max(least, min(self.once / self.unseen, 1.0))


def discovery_of(looked: Light, anywhere: Light | None, count: int) -> Discovery:
    """How much views leave out of the first `count` splats; lights as in `visibility_of`."""
    lights = [looked] if anywhere is None else [looked, anywhere]
    seen, whole, times = np.zeros(count), np.zeros(count), np.zeros(count, np.uint8)
    for light in lights:
        picture = light.pixels / max(light.views, 1) or 1.0
        seen += light.seen[:count] / picture
        whole += light.whole[:count] / picture
        times += light.times[:count]
    return Discovery(
        float(seen[times == 1].sum()), float(seen.sum()), float(whole[times == 0].sum())
    )


def light_in(prepared: PreparedSplats, cameras: Sequence[Camera]) -> Light:
    """Render views that are not kept, and add up the light of each splat in them."""
    light = Light(len(prepared))
    for camera in cameras:
        light.add(render(prepared, camera, contributions=True, sh_degree=0))
    return light


def visibility_of(looked: Light, anywhere: Light | None) -> tuple[F64, Bool]:
    """How visible splats are, and which lie in no view.

    Args:
        looked: Light in the views of the model; a splat that lies in none counts as visible.
        anywhere: Light in roaming views, which can only make splats more visible; None without.

    Returns:
        (N,) float64 in [0, 1], and (N,) bool.
    """
    visible, missed = looked.shares(), looked.whole == 0
    visible[missed] = 1.0
    if anywhere is not None:
        np.maximum(visible, anywhere.shares(), out=visible)
        missed &= anywhere.whole == 0
    return visible, missed


def roaming_views(
    splats: Splats, count: int, tell: Parts = untold
) -> tuple[list[Camera], tuple[str, ...]]:
    """Small roaming cameras to look from, and a note where fewer of them were found."""
    found: list[Camera] = []
    with suppress(ModelError):  # none was found, which the note says
        found = roaming_cameras(splats, count, width=SMALL, height=SMALL, split="fit", tell=tell)
    lacking = f"Of {counted(count, 'roaming view')} to look from {len(found)} were found."
    return found, (lacking,) if len(found) < count else ()


def visible_weights(prominences: F64, visible: F64, hidden: float) -> F64:
    """(N,) float64: how much splats are seen, less where others hide them.

    Args:
        prominences: (N,) how large screens show each, as `nodes.prominence` has it.
        visible: (N,) in [0, 1].
        hidden: Weight of what is not seen at all, over that of what is in full sight.
    """
    weights: F64 = prominences * (hidden + (1 - hidden) * visible)
    return weights


def shown_share(prominences: F64, visible: F64, missed: Bool) -> float:
    """Share of all prominence, in [0, 1], that belongs to splats which the views show.

    Args:
        prominences: (N,) how large screens show each, as `nodes.prominence` has it.
        visible: (N,) in [0, 1].
        missed: (N,) which lie in no view.
    """
    total = float(prominences.sum())
    return shown_prominence(prominences, visible, missed) / total if total > 0 else 0.0


def shown_prominence(prominences: F64, visible: F64, missed: Bool) -> float:
    """Prominence of the splats that the views show; the arguments are those of `shown_share`."""
    return float(prominences[(visible >= SHOWN) & ~missed].sum())

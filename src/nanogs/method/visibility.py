"""Views of the original: how visible each splat is, and what a result is held against."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from nanogs._types import F64, Bool
from nanogs.errors import ModelError
from nanogs.fit.groups import Group, split
from nanogs.fit.targets import Target, as_target
from nanogs.fit.views import choose_cameras
from nanogs.formatting import counted
from nanogs.method.parameters import ForestParameters
from nanogs.metrics import psnr, ssim
from nanogs.progress import Parts, each, untold
from nanogs.raster.camera import Camera
from nanogs.raster.rendering import PreparedSplats, Rendering, prepare, render
from nanogs.splats import Splats
from nanogs.views.roam import roaming_cameras

LUMA = np.array([0.299, 0.587, 0.114], np.float32)  # ITU-R BT.601; a third of the work
SHOWN = 0.01  # of a splat that reaches the views, from which it counts as shown
SMALL = 128  # pixels of a roaming view
DECIDING = 6  # one view in so many also decides: what is chosen, and whether a fit is kept


@dataclass(frozen=True, slots=True, eq=False)
class OriginalViews:
    """The original as some views show it.

    Attributes:
        visible: (N,) float64 in [0, 1], the share of each splat's alpha that reaches the views in
            which it lies; 1 for one that lies in none.
        missed: (N,) bool, the splats that lie in no view.
        deciding: Views to choose by and to judge a fit by, at least one, in groups.
        fitting: Views to fit to; none of the others.
        further: Cameras of more views to fit to, which are not rendered yet.
        notes: What the user should know, one sentence each.
    """

    visible: F64
    missed: Bool
    deciding: tuple[Group, ...]
    fitting: tuple[Target, ...]
    further: tuple[Camera, ...] = ()
    notes: tuple[str, ...] = ()


def look(
    splats: Splats,
    cameras: Sequence[Camera] | None,
    parameters: ForestParameters,
    tell: Parts = untold,
) -> OriginalViews:
    """Render the original once.

    Args:
        splats: N splats.
        cameras: The views; None for automatic ones.
        parameters: `views`, `view_size`, `further` and `roaming` are used; roaming views only where
            no cameras are given.
        tell: Told of the views rendered.

    Raises:
        ModelError: No splat is visible.
    """
    count, further = parameters.views, parameters.further if parameters.steps else 0
    looked, rest = choose_cameras(splats, cameras, count, further, parameters.view_size)
    wandering = 0 if cameras else parameters.roaming
    prepared = prepare(splats)
    light = Light(len(splats))
    views: list[Target] = []
    total = len(looked) + wandering
    for camera in each(looked, lambda done, _: tell(done, total)):
        # Distances tell near views from far ones where the user gave both; automatic ones differ
        # little in theirs.
        view = render(prepared, camera, contributions=True, depth=bool(cameras))
        light.add(view)
        views.append(as_target(view, camera))
    fitting, deciding = split(views, max(1, len(views) // DECIDING))
    notes: tuple[str, ...] = ()
    anywhere: Light | None = None
    if wandering:
        found, notes = roaming_views(
            splats, wandering, lambda done, _: tell(len(looked) + done, total)
        )
        anywhere = light_in(prepared, found)
    visible, missed = visibility_of(light, anywhere)
    return OriginalViews(visible, missed, deciding, fitting, tuple(rest), notes)


class Light:
    """How much of N splats reaches views."""

    def __init__(self, count: int) -> None:
        self.seen, self.whole = np.zeros(count), np.zeros(count)

    def add(self, view: Rendering) -> None:
        """Count a view, rendered with contributions."""
        assert view.contributions is not None  # noqa: S101 - asked for
        assert view.unhidden is not None  # noqa: S101 - asked for
        self.seen += view.contributions
        self.whole += view.unhidden

    def shares(self) -> F64:
        """(N,) float64 in [0, 1], of the alpha of each in the views that it lies in; 0 in none."""
        shares = np.zeros(len(self.seen))
        np.divide(self.seen, self.whole, out=shares, where=self.whole > 0)
        return np.minimum(shares, 1.0, out=shares)


def light_in(prepared: PreparedSplats, cameras: Sequence[Camera]) -> Light:
    """The light of splats in views that are not kept."""
    light = Light(len(prepared))
    for camera in cameras:
        light.add(render(prepared, camera, contributions=True, sh_degree=0))
    return light


def visibility_of(looked: Light, anywhere: Light | None) -> tuple[F64, Bool]:
    """How visible splats are, and which lie in no view.

    Args:
        looked: In the views that are looked from; a splat that lies in none counts as visible.
        anywhere: In roaming views, which can only show more; None without any.

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


def visible_weights(coverages: F64, visible: F64, hidden: float) -> F64:
    """(N,) float64: footprints, less where they are hidden.

    Args:
        coverages: (N,) alpha times footprint.
        visible: (N,) in [0, 1].
        hidden: Weight of what is not seen at all, over that of what is in full sight.
    """
    weights: F64 = coverages * (hidden + (1 - hidden) * visible)
    return weights


def shown_share(coverages: F64, visible: F64, missed: Bool) -> float:
    """Share of all footprints, in [0, 1], that splats have which the views show.

    Args:
        coverages: (N,) alpha times footprint.
        visible: (N,) in [0, 1].
        missed: (N,) which lie in no view.
    """
    total = float(coverages.sum())
    return shown_coverage(coverages, visible, missed) / total if total > 0 else 0.0


def shown_coverage(coverages: F64, visible: F64, missed: Bool) -> float:
    """Sum of the footprints that views show; the arguments are those of `shown_share`."""
    return float(coverages[(visible >= SHOWN) & ~missed].sum())


def judge(small: Splats, views: OriginalViews) -> tuple[float, float]:
    """Mean PSNR (dB, at most 100) and mean SSIM of the luma of a result on the views that decide.

    Args:
        small: The result.
        views: From `look`.
    """
    prepared = prepare(small)
    scores = []
    for view in (view for group in views.deciding for view in group.targets):
        wanted = view.image[..., :3] / np.float32(255)
        shown = render(prepared, view.camera).shown()
        grey = ssim(wanted @ LUMA, shown @ LUMA)
        scores.append((min(psnr(wanted, shown), 100.0), grey))
    means = np.mean(scores, axis=0)
    return float(means[0]), float(means[1])

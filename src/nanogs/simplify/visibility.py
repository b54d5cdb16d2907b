"""What views of the original show: how visible each splat is, and what a result is held against."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nanogs._types import F32, F64
from nanogs.metrics import psnr, ssim
from nanogs.progress import Parts, each, untold
from nanogs.render.camera import Camera, spread
from nanogs.render.rasterize import prepare, render
from nanogs.render.views import automatic_cameras
from nanogs.splats import Splats

SIZE = 256  # pixels; visibility needs no more, and the choice is between models of one kind
LUMA = np.array([0.299, 0.587, 0.114], np.float32)  # ITU-R BT.601; a third of the work
JUDGED = 2  # every second view is also one to choose by


@dataclass(frozen=True, slots=True, eq=False)
class OriginalView:
    """One view of the original.

    Attributes:
        camera: Where it was looked at from.
        image: (H, W, 3) float32 in [0, 1], over black.
        alpha: (H, W) float32.
    """

    camera: Camera
    image: F32
    alpha: F32


@dataclass(frozen=True, slots=True, eq=False)
class OriginalViews:
    """The original as some views show it.

    Attributes:
        visible: (N,) float64 in [0, 1], the share of each splat's alpha that reaches the views in
            which it lies; 1 for one that lies in none.
        all: Every view.
    """

    visible: F64
    all: tuple[OriginalView, ...]

    @property
    def judging(self) -> tuple[OriginalView, ...]:
        """The views to judge by."""
        return self.all[::JUDGED]

    @property
    def other(self) -> tuple[OriginalView, ...]:
        """The views that nothing was chosen by."""
        return tuple(view for i, view in enumerate(self.all) if i % JUDGED)


def look(
    splats: Splats,
    cameras: Sequence[Camera] | None = None,
    count: int = 12,
    tell: Parts = untold,
) -> OriginalViews:
    """Render the original once.

    Args:
        splats: N splats.
        cameras: The views; by default automatic ones.
        count: How many of them at most.
        tell: Told of the views rendered.

    Raises:
        ModelError: No splat is visible.
    """
    if cameras:
        chosen = [camera.reduced(SIZE) for camera in spread(cameras, count)]
    else:
        chosen = automatic_cameras(splats, count, width=SIZE, height=SIZE, habit=False)
    prepared = prepare(splats)
    seen, whole = np.zeros(len(splats)), np.zeros(len(splats))
    views = []
    for camera in each(chosen, tell):
        view = render(prepared, camera, contributions=True)
        assert view.contributions is not None  # noqa: S101 - asked for
        assert view.unhidden is not None  # noqa: S101 - asked for
        seen += view.contributions
        whole += view.unhidden
        views.append(OriginalView(camera, view.shown(), view.alpha))
    visible = np.ones(len(splats))
    np.divide(seen, whole, out=visible, where=whole > 0)
    return OriginalViews(np.minimum(visible, 1.0), tuple(views))


def visible_weights(coverages: F64, visible: F64, hidden: float) -> F64:
    """(N,) float64: footprints, less where they are hidden.

    Args:
        coverages: (N,) alpha times footprint.
        visible: (N,) in [0, 1].
        hidden: Weight of what is not seen at all, over that of what is in full sight.
    """
    weights: F64 = coverages * (hidden + (1 - hidden) * visible)
    return weights


def judge(small: Splats, views: OriginalViews) -> tuple[float, float]:
    """Mean PSNR (dB, at most 100) and mean SSIM of the luma of a result on the views to judge by.

    Args:
        small: The result.
        views: From `look`.
    """
    prepared = prepare(small)
    scores = []
    for view in views.judging:
        shown = render(prepared, view.camera).shown()
        grey = ssim(view.image @ LUMA, shown @ LUMA)
        scores.append((min(psnr(view.image, shown), 100.0), grey))
    means = np.mean(scores, axis=0)
    return float(means[0]), float(means[1])

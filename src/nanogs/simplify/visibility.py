"""What views of the original show: how visible each splat is, and what a result is held against."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from nanogs._types import F64, Bool
from nanogs.errors import ModelError
from nanogs.formatting import counted
from nanogs.metrics import psnr, ssim
from nanogs.progress import Parts, each, untold
from nanogs.refit.groups import Group, split
from nanogs.refit.targets import Target, as_target
from nanogs.render.camera import Camera, apart, spread
from nanogs.render.rasterize import prepare, render
from nanogs.render.roam import roaming_cameras
from nanogs.render.views import automatic_cameras
from nanogs.splats import Splats

LUMA = np.array([0.299, 0.587, 0.114], np.float32)  # ITU-R BT.601; a third of the work
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


@dataclass(frozen=True, slots=True)
class Chosen:
    """Cameras of views of the original.

    Attributes:
        looked: Of those that are rendered at once.
        further: Of more views to fit to.
        notes: What the user should know, one sentence each.
    """

    looked: list[Camera]
    further: list[Camera]
    notes: tuple[str, ...] = ()


def look(
    splats: Splats,
    cameras: Sequence[Camera] | None = None,
    count: int = 14,
    size: int = 768,
    near: float = 0.0,
    further: int = 0,
    tell: Parts = untold,
) -> OriginalViews:
    """Render the original once.

    Args:
        splats: N splats.
        cameras: The views; by default automatic ones.
        count: How many of them at most.
        size: Pixels along the longer side of a view at most.
        near: Share of the views that are found which roam in free space (see `roam`).
        further: How many more cameras to choose, at most, for views to fit to.
        tell: Told of the views rendered.

    Raises:
        ModelError: No splat is visible.
    """
    chosen = (
        _given(cameras, count, further, size)
        if cameras
        else _found(splats, count, further, near, size)
    )
    prepared = prepare(splats)
    seen, whole = np.zeros(len(splats)), np.zeros(len(splats))
    views: list[Target] = []
    for camera in each(chosen.looked, tell):
        view = render(prepared, camera, contributions=True, depth=True)
        assert view.contributions is not None  # noqa: S101 - asked for
        assert view.unhidden is not None  # noqa: S101 - asked for
        seen += view.contributions
        whole += view.unhidden
        views.append(as_target(view, camera))
    visible = np.ones(len(splats))
    np.divide(seen, whole, out=visible, where=whole > 0)
    fitting, deciding = split(views, max(1, len(views) // DECIDING))
    return OriginalViews(
        np.minimum(visible, 1.0), whole == 0, deciding, fitting, tuple(chosen.further), chosen.notes
    )


def _given(cameras: Sequence[Camera], count: int, further: int, size: int) -> Chosen:
    """The user's cameras, those that are looked from spread over them."""
    reduced = [camera.reduced(size) for camera in spread(cameras, count + further)]
    return Chosen(*apart(reduced, count))


def _found(splats: Splats, count: int, further: int, near: float, size: int) -> Chosen:
    """Automatic views and roaming ones, and a note where fewer of these were found."""
    looked, roaming = round(near * count), round(near * (count + further))
    around = automatic_cameras(
        splats, count + further - roaming, width=size, height=size, habit=False
    )
    if not roaming:
        return Chosen(around[:count], around[count:])
    found: list[Camera] = []
    with suppress(ModelError):  # none was found, which the note says
        found = roaming_cameras(splats, roaming, width=size, height=size, split="fit")
    lacking = f"Of {counted(roaming, 'roaming view')} to learn from {len(found)} were found."
    return Chosen(
        around[: count - looked] + found[:looked],
        around[count - looked :] + found[looked:],
        (lacking,) if len(found) < roaming else (),
    )


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
    """Share of all footprints that reaches the views, in [0, 1].

    Args:
        coverages: (N,) alpha times footprint.
        visible: (N,) in [0, 1].
        missed: (N,) which lie in no view.
    """
    total = float(coverages.sum())
    shown = float((coverages * visible)[~missed].sum())
    return shown / total if total > 0 else 0.0


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

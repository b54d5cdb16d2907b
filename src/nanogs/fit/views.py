"""The views of a refit: choose cameras, render the original, hold out validation views."""

from collections.abc import Sequence

import numpy as np

from nanogs.errors import ModelError, OptionError
from nanogs.fit.groups import ViewGroup, split
from nanogs.fit.parameters import RefitParameters
from nanogs.fit.targets import Fitting, Target, make_target
from nanogs.formatting import unseen_cause
from nanogs.progress import PartProgress, each
from nanogs.raster.camera import Camera, pick_evenly, split_evenly
from nanogs.raster.rendering import prepare, render
from nanogs.splats import Splats
from nanogs.views.automatic import Survey, all_around, cameras_of, survey

OVERLAP = 0.02  # smallest share of the original's alpha that the small model must cover
AROUND = 3  # one in so many of the further automatic views is from all around the model
FINEST = 0.5  # least width of a pixel that views show, over that of a picture of their size


def view_targets(
    original: Splats,
    small: Splats,
    cameras: Sequence[Camera] | None,
    parameters: RefitParameters,
    on_progress: PartProgress,
) -> tuple[Fitting, tuple[ViewGroup, ...], tuple[str, ...]]:
    """Return the views to fit to, the groups of validation views, and notes for the report.

    Validation views are in groups by picture size and distance.

    Raises:
        OptionError: There are fewer than two cameras.
        ModelError: Fewer than two views show the original, or the small model is elsewhere.
    """
    if cameras is not None and len(cameras) < 2:
        raise OptionError(
            f"A refit needs at least two cameras, one of them for validation, not {len(cameras)}."
        )
    kept, more = parameters.kept + parameters.held, parameters.views - parameters.kept
    chosen, further = choose_cameras(
        cameras or survey(original, habit=False), kept, more, parameters.size, parameters.finer
    )
    prepared = prepare(original).with_buffers()
    targets = [make_target(prepared, camera) for camera in each(chosen, on_progress)]
    targets = [target for target in targets if target.shows]
    cause = unseen_cause(given=bool(cameras))
    blind = len(chosen) - len(targets)
    if len(targets) < 2:
        others = "other cameras, or none to use automatic ones"
        raise ModelError(
            f"The original is visible in fewer than two views; {cause}: give"
            f" {others if cameras else 'cameras nearer to it, or larger views'}."
        )
    fitting, deciding = split(targets, parameters.validation)
    _refuse_elsewhere(small, [target for group in deciding for target in group.targets])
    looked = " looked at" if further else ""  # further views are rendered when a step needs them
    unseen = (
        f"The original is not visible in {blind} of {len(chosen)} views{looked}, so the fit leaves"
        f" them out; {cause}."
    )
    views = Fitting(fitting, prepared if further else None, further)
    return views, deciding, (unseen,) if blind else ()


def choose_cameras(
    cameras: Sequence[Camera] | Survey, kept: int, further: int, size: int, finer: float
) -> tuple[list[Camera], list[Camera]]:
    """Choose the cameras whose views are kept in memory, and further ones to fit to.

    Both are spread evenly over the user's cameras, or are automatic ones, with one in `AROUND`
    of the further ones from all around the model, even if it is a room or stands on a ground. The
    further automatic ones show some pixels of larger pictures (`Camera.sharpened`).

    Args:
        cameras: The user's cameras, or the analysis of the original that automatic ones need.
        kept: Number of cameras whose views are kept, at most.
        further: Number of further cameras, at most.
        size: Pixels along the longer side of a view, at most.
        finer: See `RefitParameters`; a single pixel's width is at least `FINEST`.
    """
    if isinstance(cameras, Survey):
        around = range(kept, kept + further, AROUND)
        others = [number for number in range(kept + further) if number not in around]
        found = cameras_of(cameras, others, size, size)
        for number, camera in zip(
            around, cameras_of(all_around(cameras), around, size, size), strict=True
        ):
            found.insert(number, camera)
        factor = max(finer ** ((kept + further) / max(further, 1)), FINEST)
        return found[:kept], [camera.sharpened(factor) for camera in found[kept:]]
    return split_evenly(
        [camera.reduced(size) for camera in pick_evenly(cameras, kept + further)], kept
    )


def _refuse_elsewhere(small: Splats, targets: Sequence[Target]) -> None:
    """Raise `ModelError` if the small model does not cover the pixels of the original."""
    prepared = prepare(small)
    shared = total = 0.0
    for target in targets:
        alpha = render(prepared, target.camera).alpha
        wanted = target.image[..., 3] / np.float32(255)
        shared += float(np.minimum(alpha, wanted).sum(dtype=np.float64))
        total += float(wanted.sum(dtype=np.float64))
    if shared < OVERLAP * total:
        raise ModelError(
            "The small model is hardly visible where the original is; give two models of the same"
            " scene, in the same coordinates."
        )

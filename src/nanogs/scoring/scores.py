"""Scores of models on views: PSNR, SSIM, depth error and further metrics."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from nanogs._types import F32
from nanogs.costs import DrawCost
from nanogs.errors import ModelError, OptionError
from nanogs.formatting import undrawn
from nanogs.metrics import depth_error, flip, lpips, psnr, ssim
from nanogs.metrics.depth import COVERED
from nanogs.progress import PartProgress, ignore_progress
from nanogs.protocol import Background, PackingLoss
from nanogs.raster.camera import Camera
from nanogs.raster.rendering import PreparedSplats, Rendering
from nanogs.scoring.photo_views import PhotoViews
from nanogs.views.streamed import Streamed, renderings

HIGHEST = 100.0  # dB; cap of a view's PSNR in means
EXTRA_METRICS: Mapping[str, Callable[[F32, F32], float]] = {"flip": flip, "lpips": lpips}

OnView = Callable[["ReferenceView", "Rendering", "ViewScore"], None]
"""Called with a view, a model's rendering of it, and its score."""


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceView:
    """A reference image that renders are compared with: a render of the original or a photograph.

    Attributes:
        camera: The camera.
        image: (H, W, 3) float32 in [0, 1].
        rendering: The reference model's rendering; None for a photograph.
    """

    camera: Camera
    image: F32
    rendering: Rendering | None = None


@dataclass(frozen=True, slots=True)
class ViewScore:
    """A model's score on one view.

    Attributes:
        view: Name of the camera.
        psnr: Peak signal-to-noise ratio, dB; infinite for equal images.
        ssim: Structural similarity, 1 for equal images.
        depth: Mean relative depth error against the reference model; None for a photograph, if no
            pixel is covered in both, or if a depth of one that is exceeds single precision.
        extras: Further metrics by name.
    """

    view: str
    psnr: float
    ssim: float
    depth: float | None
    extras: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ModelScore:
    """A model's scores on all views, and their means.

    Attributes:
        name: Its name.
        splats: Number of splats.
        file_bytes: Size of its file, or None.
        psnr: Mean over the views, dB; see `mean_psnr`.
        least_psnr: PSNR of the worst view, dB.
        least_view: Name of that view.
        ssim: Mean over the views.
        depth: Mean over the views that have one, or None.
        extras: Means of further metrics by name.
        views: Scores view by view.
        notes: Remarks that matter for reading the numbers.
        packed: The loss due to packing alone if the model was read back from a packed file; else
            None.
        cost: Draw cost on these views, or None if it was not measured.
    """

    name: str
    splats: int
    file_bytes: int | None
    psnr: float
    least_psnr: float
    least_view: str
    ssim: float
    depth: float | None
    extras: dict[str, float]
    views: tuple[ViewScore, ...]
    notes: tuple[str, ...] = ()
    packed: PackingLoss | None = None
    cost: DrawCost | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return plain dictionaries, lists, numbers and strings."""
        return asdict(self)


def check_metrics(names: Sequence[str]) -> None:
    """Compute each further metric once, so that it fails now and not after models were rendered.

    Raises:
        OptionError: There is no such metric, or its package is not installed.
    """
    _refuse_unknown(names)
    image = np.zeros((64, 64, 3), np.float32)
    for name in names:
        EXTRA_METRICS[name](image, image)


def _refuse_unknown(metrics: Iterable[str]) -> None:
    for name in metrics:
        if name not in EXTRA_METRICS:
            raise OptionError(
                f"There is no metric {name!r}; choose from {', '.join(EXTRA_METRICS)}."
            )


def reference_views(
    reference: PreparedSplats | Streamed,
    cameras: Iterable[Camera],
    background: Background,
    on_progress: PartProgress = ignore_progress,
    *,
    depth: bool = True,
) -> tuple[list[ReferenceView], list[str]]:
    """Render the reference from each camera, and leave out views in which nothing is visible.

    Args:
        reference: The reference model.
        cameras: The views.
        background: RGB in [0, 1].
        on_progress: Receives the progress in views rendered.
        depth: Keep the renderings, to measure depth errors; otherwise only the images.

    Returns:
        The views, and the names of those that show nothing.

    Raises:
        ModelError: No view shows anything.
    """
    views, empty = [], []
    known = list(cameras)
    shown = renderings(
        reference, known, background=background, depth=depth, on_progress=on_progress
    )
    for rendering, camera in zip(shown, known, strict=True):
        if rendering.alpha.any():
            kept = rendering if depth else None
            views.append(ReferenceView(camera, rendering.shown(), kept))
        else:
            empty.append(camera.name)
    if not views:
        raise ModelError("The reference is seen in none of the views; choose other cameras.")
    return views, empty


def score(
    name: str,
    model: PreparedSplats | Streamed,
    views: Sequence[ReferenceView],
    background: Background,
    *,
    file_bytes: int | None = None,
    extras: Sequence[str] = (),
    on_view: OnView | None = None,
) -> ModelScore:
    """Score a model on the views.

    Args:
        name: Name of the model.
        model: The model.
        views: From `reference_views`, or photographs.
        background: RGB in [0, 1], the same as that of the views.
        file_bytes: Size of the model's file.
        extras: Names in `EXTRA_METRICS`.
        on_view: Called with each view, its rendering and its score.

    Raises:
        OptionError: A metric does not exist, or its package is not installed.
    """
    _refuse_unknown(extras)
    scores = []
    notes: dict[str, None] = {}
    skipped = 0
    cameras: Sequence[Camera]
    if isinstance(views, PhotoViews):  # each access to a view reads its photograph
        cameras, with_depth = views.cameras, False
    else:
        cameras = [view.camera for view in views]
        with_depth = any(view.rendering is not None for view in views)
    shown = renderings(model, cameras, background=background, depth=with_depth)
    for rendering, view in zip(shown, views, strict=True):
        skipped = rendering.skipped
        scores.append(_score_view(view, rendering, extras))
        notes.update(dict.fromkeys(rendering.notes))
        if on_view:
            on_view(view, rendering, scores[-1])
    if skipped:
        notes[undrawn(skipped)] = None
    worst = min(scores, key=lambda entry: entry.psnr)
    return ModelScore(
        name=name,
        splats=len(model),
        file_bytes=file_bytes,
        psnr=mean_psnr([entry.psnr for entry in scores]),
        least_psnr=mean_psnr([worst.psnr]),
        least_view=worst.view,
        ssim=float(np.mean([entry.ssim for entry in scores])),
        depth=_mean([entry.depth for entry in scores if entry.depth is not None]),
        extras={
            extra: float(np.mean([entry.extras[extra] for entry in scores])) for extra in extras
        },
        views=tuple(scores),
        notes=tuple(notes),
    )


def mean_psnr(values: Sequence[float]) -> float:
    """Average PSNRs, dB: infinite if all are, else each counts as at most 100 dB.

    Otherwise one view without any error would make the mean infinite.
    """
    if all(map(math.isinf, values)):
        return math.inf
    return float(np.mean([min(value, HIGHEST) for value in values]))


def _score_view(view: ReferenceView, rendering: Rendering, extras: Sequence[str]) -> ViewScore:
    image = rendering.shown()
    return ViewScore(
        view=view.camera.name,
        psnr=psnr(view.image, image),
        ssim=ssim(view.image, image),
        depth=_depth(view.rendering, rendering),
        extras={extra: EXTRA_METRICS[extra](view.image, image) for extra in extras},
    )


def _depth(reference: Rendering | None, rendering: Rendering) -> float | None:
    if reference is None or reference.depth is None or rendering.depth is None:
        return None
    covered = (reference.alpha > COVERED) & (rendering.alpha > COVERED)
    finite = np.isfinite(reference.depth) & np.isfinite(rendering.depth)  # not beyond float32
    if not covered.any() or not finite[covered].all():
        return None
    return depth_error(rendering.depth, rendering.alpha, reference.depth, reference.alpha)


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None

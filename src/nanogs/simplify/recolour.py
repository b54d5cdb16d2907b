"""Recolour: give merged splats the colours with which they look most like the original.

A merged splat has the mean colour of its members. What the members show is not that mean: they
hide each other, are cut off at black where a colour falls below it, and leave gaps where the
merged ones do not. Two steps of least squares on the views' pixels set the mean colours right.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from nanogs._types import F32, F64, Bool
from nanogs.kernels.harmonics import C0
from nanogs.progress import Parts, each, untold
from nanogs.render.rasterize import Projection, blend, prepare, probe, project
from nanogs.report import RecolourReport
from nanogs.simplify.choose import quality
from nanogs.simplify.visibility import OriginalView, OriginalViews, judge
from nanogs.splats import Splats

WHITE = 0.25  # share of white in the background; viewers show black, mostly
# Opaque pixels of which the colour that a splat has already counts as much; the second is tried
# where the views differ so much that the first does not help.
PRIORS = (1.0, 10.0)


def recolour(
    small: Splats,
    merged: Bool,
    views: OriginalViews,
    before: tuple[float, float],
    tell: Parts = untold,
) -> tuple[Splats, RecolourReport | None]:
    """Fit the colours to the views that nothing was chosen by, then to those that judge.

    The first step is kept, and the second made, only if the model then looks more like the
    original on the views that judge, which the first has not seen.

    Args:
        small: The chosen model, N splats.
        merged: (N,) which of them may change: those of one member keep their bytes.
        views: Of the original.
        before: The model's PSNR and SSIM on the views that judge.
        tell: Told of three parts: a step, its judgement, and the second step.

    Returns:
        The model, and what the first step gained; None where there are too few views to tell.
    """
    if not views.other:
        return small, None
    first = _pulls(small, views.other, tell, 0)
    for prior in PRIORS:
        moved = _moved(small, merged, *first, prior)
        after = judge(moved, views)
        if quality(*after) > quality(*before):
            pulls, curvatures = _pulls(moved, views.judging, tell, 2)
            # The views of the first step, which show what they should now, hold on to that.
            small = _moved(moved, merged, pulls, curvatures + first[1], prior)
            return small, RecolourReport(*before, *after, kept=True)
    return small, RecolourReport(*before, *after, kept=False)


def _pulls(
    small: Splats, views: Sequence[OriginalView], tell: Parts, before: int
) -> tuple[F64, F64]:
    """(N, 3) what pulls at the colours, sum w r, and (N, 1) what holds them, sum w A; see below."""
    prepared = prepare(small)
    pulls, curvatures = np.zeros((len(small), 3)), np.zeros((len(small), 1))
    for view in each(views, lambda done, count: tell(before + done / count, 3)):
        shown = project(prepared, view.camera)
        totals = probe(shown, view.camera, _planes(shown, view))
        pulls += totals[:, :3]
        curvatures += totals[:, 3:]
    return pulls, curvatures


def _moved(small: Splats, merged: Bool, pulls: F64, curvatures: F64, prior: float) -> Splats:
    """The model after one step for all splats at the same time.

    The colour of splat k enters a pixel with the weight w_k = T alpha, and the weights of a pixel
    add up to its alpha A. Least squares for pixels that all lack r of what they should show,

        dc_k = sum w_k r / (sum w_k A + prior),

    never go too far: the quadratic with these curvatures lies above the true one (De Pierro, 1995).
    """
    sh = small.sh.copy()
    changes: F64 = pulls[merged] / (curvatures[merged] + prior) / C0
    sh[merged, 0] += changes.astype(np.float32)
    return replace(small, sh=sh)


def _planes(shown: Projection, view: OriginalView) -> F32:
    """(4, H, W): what the colours of the pixels lack, and their alpha."""
    image, left, _ = blend(shown, view.camera, shown.features, np.zeros(3, np.float32))
    alpha = 1 - left
    # Over white, what the alpha lacks is lacking less.
    lack = view.image - np.minimum(image, 1.0) - WHITE * (view.alpha - alpha)[..., None]
    planes = np.empty((4, *alpha.shape), np.float32)
    planes[:3], planes[3] = np.moveaxis(lack, 2, 0), alpha
    return planes

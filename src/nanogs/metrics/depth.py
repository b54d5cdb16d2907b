"""The error of a depth image."""

import numpy as np

from nanogs._types import F
from nanogs.errors import ModelError, OptionError
from nanogs.metrics._images import check_arrays

COVERED = 0.5  # alpha above which a pixel shows a surface rather than the background


def depth_error(depth: F, alpha: F, reference_depth: F, reference_alpha: F) -> float:
    """Compute the mean of |depth - reference| / reference over the pixels that both images cover.

    A pixel is covered if its alpha is above 0.5; the expected depth of other pixels means little.

    Args:
        depth: (H, W) scene units along the viewing axis, as in the `depth` that
            `nanogs.raster.rendering.render` returns if it is called with `depth=True`.
        alpha: (H, W) in [0, 1].
        reference_depth: (H, W), positive where covered.
        reference_alpha: (H, W).

    Returns:
        A ratio, 0 for equal depths.

    Raises:
        OptionError: They are no arrays, or the shapes differ.
        ModelError: No pixel is covered in both, or a covered depth is not finite and positive.
    """
    check_arrays(depth, alpha, reference_depth, reference_alpha)
    shapes = {depth.shape, alpha.shape, reference_depth.shape, reference_alpha.shape}
    if len(shapes) != 1:
        raise OptionError(f"Depth and alpha images must have the same size, not {sorted(shapes)}.")
    if np.isnan(alpha).any() or np.isnan(reference_alpha).any():
        raise ModelError("An alpha image holds NaN; which pixels it covers is unknown.")
    covered = (alpha > COVERED) & (reference_alpha > COVERED)
    if not covered.any():
        raise ModelError("The images cover no pixel in common; choose a view that shows the model.")
    a = depth[covered].astype(np.float64)
    b = reference_depth[covered].astype(np.float64)
    if not (np.isfinite(a).all() and np.isfinite(b).all() and (b > 0).all()):
        raise ModelError("A covered pixel has a depth that is not finite and positive.")
    return float(np.mean(np.abs(a - b) / b))

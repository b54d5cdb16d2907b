"""Global significance, the pruning score of LightGaussian, without its fine-tuning.

Fan et al., "LightGaussian: Unbounded 3D Gaussian Compression with 15x Reduction and 200+ FPS",
2023 (arXiv 2311.17245), section 3.2: the sum of a splat's blending weights in the training views,
times its opacity, times a power of its volume. The volume is divided by the 90th percentile of all
volumes and clamped to [0, 1], so that a few huge background splats do not win by size alone.
"""

from collections.abc import Sequence

import numpy as np

from nanogs._types import F64, Bool
from nanogs.errors import OptionError
from nanogs.raster.camera import Camera
from nanogs.splats import Splats

BETA = 0.1
_PERCENTILE = 90.0


def significance(splats: Splats, cameras: Sequence[Camera]) -> F64:
    """Compute the global significance of each splat.

    Args:
        splats: N splats.
        cameras: The views to learn from.

    Returns:
        (N,) float64, 0 or more; 0 for a splat that is not finite or seen in no view.

    Raises:
        OptionError: There is no camera.
    """
    contributions = view_contributions(splats, cameras)
    finite = splats.finite()
    weights = np.zeros(len(splats))
    opacities = splats.opacities()[finite]
    weights[finite] = opacities * normalised_volumes(splats, finite) ** BETA
    return contributions * weights


def view_contributions(splats: Splats, cameras: Sequence[Camera]) -> F64:
    """Sum transmittance x alpha of each splat over pixels and views; (N,) float64.

    Args:
        splats: N splats.
        cameras: The views.

    Raises:
        OptionError: There is no camera.
    """
    from nanogs.raster.rendering import prepare, render  # imports Numba

    if not cameras:
        raise OptionError("Significance needs views to learn from; give at least one camera.")
    prepared = prepare(splats)
    total = np.zeros(len(splats))
    for camera in cameras:
        seen = render(prepared, camera, contributions=True).contributions
        assert seen is not None  # noqa: S101 - asked for
        total += seen
    return total


def normalised_volumes(splats: Splats, rows: Bool) -> F64:
    """Divide volumes by their 90th percentile and clamp them; (M,) float64 in [0, 1].

    Args:
        splats: N splats.
        rows: (N,) the M rows to use, all finite.
    """
    logs = splats.log_scales[rows].astype(np.float64).sum(axis=1)
    # In logarithms, because the product of three scales must not under- or overflow, be the scene
    # in millimetres or in light years. A scale of 0 is a log-scale of -inf and a volume of 0.
    percentile = np.percentile(logs, _PERCENTILE, method="higher") if len(logs) else 0.0
    if percentile == -np.inf:
        return np.zeros(len(logs))
    volumes: F64 = np.exp(np.minimum(logs - percentile, 0.0))
    return volumes

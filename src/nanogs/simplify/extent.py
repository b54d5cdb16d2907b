"""The size of a scene, and of a pixel that it is likely to be seen with."""

import numpy as np

from nanogs._types import F64
from nanogs.kernels.project import DILATION
from nanogs.render.occupancy import quantiles
from nanogs.splats import RenderMode

_SHARE = 0.9  # of the alpha lies within the core's radius
_SAMPLE = 40_000  # splats looked at; a stride thins larger models
_ROUNDS = 32
_SETTLED = 1e-9  # of the radius


def core_radius(means: F64, alphas: F64) -> float:
    """Distance from the centre within which 90 % of the alpha lies, scene units.

    The centre is the geometric median (Weiszfeld 1937): strays do not move it, and it turns and
    moves with the scene.

    Args:
        means: (N, 3) float64, scene units.
        alphas: (N,) float64, weights, 0 or more.
    """
    step = len(means) // _SAMPLE + 1
    means, alphas = means[::step], alphas[::step]
    weights = alphas if alphas.sum() > 0 else np.ones(len(means))
    centre = np.median(means, axis=0)
    for _ in range(_ROUNDS):
        distances = np.linalg.norm(means - centre, axis=1)
        # Of most of the splats, whatever a few that strayed far away add to the average.
        scale = float(np.median(distances)) or float(np.average(distances, weights=weights))
        if scale == 0:
            return 0.0
        pull = weights / np.maximum(distances, 1e-6 * scale)
        moved = np.average(means, axis=0, weights=pull)
        settled = np.linalg.norm(moved - centre) <= _SETTLED * scale
        centre = moved
        if settled:
            break
    return quantiles(np.linalg.norm(means - centre, axis=1), weights, _SHARE)[0]


def dilation(means: F64, alphas: F64, mode: RenderMode, pixels: float) -> float:
    """Standard deviation that a rasteriser adds to a splat on the screen, scene units.

    It depends on the view; this is that of a view in which the core is `pixels` across. A
    MIP model's rasteriser takes back from the opacity what it adds to the size: 0.

    Args:
        means: (N, 3) float64, scene units.
        alphas: (N,) float64 in [0, 1].
        mode: The rasteriser the model was trained for.
        pixels: Across the core's diameter.
    """
    if mode is RenderMode.MIP:
        return 0.0
    pixel = 2 * core_radius(means, alphas) / pixels
    return float(np.sqrt(DILATION)) * pixel

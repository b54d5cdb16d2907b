"""Render from which depths the light of a picture comes, on the CPU."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nanogs import parallel
from nanogs._types import F32, F64
from nanogs.raster.camera import Camera
from nanogs.raster.rendering import PreparedSplats, blend, project
from nanogs.slices import SLICE_STEPS, slices

_MOST = 3  # ranges of a picture, since the kernels blend three or four channels


@dataclass(frozen=True, slots=True, eq=False)
class LightByDepth:
    """A picture of the shares of light from ranges of depth.

    Attributes:
        shares: (H, W, R) float32 in [0, 1], light of the splats in each range, by their centres.
        alpha: (H, W) float32, light of all splats, 1 - transmittance.
        contributions: (N,) float64, sum of transmittance x alpha over the pixels. None unless asked
            for.
    """

    shares: F32
    alpha: F32
    contributions: F64 | None


def light_by_depth(
    prepared: PreparedSplats,
    camera: Camera,
    ranges: Sequence[tuple[float, float]],
    *,
    contributions: bool = False,
) -> LightByDepth:
    """Render the share of each pixel's light that comes from some ranges of depth.

    Args:
        prepared: The model, N splats.
        camera: The camera.
        ranges: Up to three ranges [near, far) of depth along the viewing axis, scene units.
        contributions: Whether to return each splat's contribution to the image.

    Raises:
        OptionError: The camera is invalid.
    """
    assert len(ranges) <= _MOST  # noqa: S101 - callers' choice
    with np.errstate(over="ignore"):  # depths are float32, whose largest is less than a limit's
        limits = [(np.float32(near), np.float32(far)) for near, far in ranges]
    projected = project(prepared, camera, sh_degree=0)
    depths = projected.features[:, 3]
    features = np.zeros((len(depths), _MOST), np.float32)

    def select(rows: slice) -> None:
        with np.errstate(invalid="ignore"):  # rows that are not drawn are not initialised
            for channel, (near, far) in enumerate(limits):
                features[rows, channel] = (depths[rows] >= near) & (depths[rows] < far)

    parallel.for_each(slices(len(depths), SLICE_STEPS), select)
    probes = np.ones((1 if contributions else 0, camera.height, camera.width), np.float32)
    image, transmittance, sums = blend(
        projected, camera, features, np.zeros(_MOST, np.float32), probes
    )
    shown = sums[:, 0] if contributions else None
    return LightByDepth(image[..., : len(ranges)], 1 - transmittance, shown)

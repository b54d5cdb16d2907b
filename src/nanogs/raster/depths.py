"""Render from which depths the light of a picture comes, on the device in use."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nanogs import parallel
from nanogs._types import F32
from nanogs.card.device import engine_in_use
from nanogs.raster.camera import Camera
from nanogs.raster.light import HostLight, SplatLight
from nanogs.raster.rendering import PreparedSplats, blend, project, view_on
from nanogs.slices import SLICE_STEPS, slices

_MOST = 3  # ranges of a picture, since the kernels blend three or four channels


@dataclass(frozen=True, slots=True, eq=False)
class LightByDepth:
    """A picture of the shares of light from ranges of depth.

    Attributes:
        shares: (H, W, R) float32 in [0, 1], light of the splats in each range, by their centres.
        alpha: (H, W) float32, light of all splats, 1 - transmittance.
        light: The light of each splat; None unless asked for. On the CPU it has no `whole`.
    """

    shares: F32
    alpha: F32
    light: "SplatLight | None"


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
        contributions: Whether the light of each splat is asked for.

    Raises:
        OptionError: The camera is invalid.
    """
    assert len(ranges) <= _MOST  # noqa: S101 - callers' choice
    with np.errstate(over="ignore"):  # depths are float32, whose largest is less than a limit's
        limits = [(np.float32(near), np.float32(far)) for near, far in ranges]
    engine = engine_in_use()
    if engine is not None:
        view = view_on(engine, prepared, camera, sh_degree=0)
        drawn, left = view.blend(view.within(limits), np.zeros(_MOST, np.float32))
        shares, transmittance = view.to_host(drawn, len(ranges)), left.numpy()
        return LightByDepth(shares, 1 - transmittance, view if contributions else None)
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
    light = HostLight(sums[:, 0]) if contributions else None
    return LightByDepth(image[..., : len(ranges)], 1 - transmittance, light)

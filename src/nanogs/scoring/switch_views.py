"""Scoring levels of detail at the distance at which a viewer switches to them.

Each view of `nanogs compare` at its defaults keeps its position and direction. Its focal length is
changed instead, so that a pixel covers as many scene units as it does at the distance of the
switch: for a larger distance the image gets smaller, for a smaller one its centre is cropped.
Moving the camera could lead through walls.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nanogs.errors import ModelError
from nanogs.protocol import BLACK
from nanogs.raster.camera import Camera
from nanogs.scoring.held_out import as_drawn
from nanogs.scoring.scores import reference_views, score
from nanogs.source import Source, source_of
from nanogs.splats import Splats
from nanogs.switches import SwitchQuality, distance_of
from nanogs.views.streamed import renderings

LEAST_PIXELS = 32  # along the shorter side; on fewer, SSIM with its window of 11 means nothing
_LOOKS = 128  # pixels along the side of the depth images
_SAMPLE = 1 << 16  # most splats for the median deviation
_OPAQUE = 0.5  # alpha above which a pixel's depth is used


@dataclass(frozen=True, slots=True, eq=False)
class SwitchViews:
    """The views, with the size of a pixel in scene units for each.

    Attributes:
        original: The model; a source is read some rows at a time.
        cameras: The views in which something opaque is visible.
        footprints: Width of a pixel of each view at the median depth of opaque pixels, scene units.
        max_memory: Bytes that this process may take if models are read some rows at a time; by
            default the free memory.
    """

    original: Splats | Source
    cameras: Sequence[Camera]
    footprints: Sequence[float]
    max_memory: int | None = None

    def judge(self, level: Splats | Source, pixel: float) -> SwitchQuality | None:
        """Score a level against the original; None if no magnified view shows anything.

        Args:
            level: The level.
            pixel: Scene units that a pixel covers when a viewer switches to the level, above 0.

        Raises:
            FormatError: A source cannot be read.
            NotEnoughMemoryError: There is not enough memory to render a source.
        """
        pairs = zip(self.cameras, self.footprints, strict=True)
        cameras = [magnified(camera, shown / pixel) for camera, shown in pairs]
        drawn = as_drawn(self.original, self.max_memory)
        try:
            views, _ = reference_views(drawn, cameras, BLACK, depth=False)
        except ModelError:
            return None
        del drawn
        means = score("", as_drawn(level, self.max_memory), views, BLACK)
        width = float(np.mean([view.camera.width for view in views]))
        return SwitchQuality(distance_of(pixel), means.psnr, means.ssim, len(views), width)


def switch_views(
    original: Splats | Source, cameras: Sequence[Camera], max_memory: int | None = None
) -> SwitchViews:
    """Measure the median depth of each view, once for any number of levels.

    Args:
        original: The model; a source is read some rows at a time.
        cameras: The views; those in which nothing opaque is visible are left out.
        max_memory: See `SwitchViews`.

    Raises:
        FormatError: The source cannot be read.
        ModelError: No view shows anything opaque.
        NotEnoughMemoryError: There is not enough memory to render the source.
    """
    drawn = as_drawn(original, max_memory)
    small = [camera.reduced(_LOOKS) for camera in cameras]
    found = []
    for camera, view in zip(cameras, renderings(drawn, small, depth=True), strict=True):
        assert view.depth is not None  # noqa: S101 - asked for
        opaque = view.depth[view.alpha > _OPAQUE]
        if len(opaque):
            found.append((camera, float(np.median(opaque)) / camera.fx))
    if not found:
        raise ModelError("No view shows anything opaque, so that no distance is known.")
    kept, footprints = zip(*found, strict=True)
    return SwitchViews(original, kept, footprints, max_memory)


def magnified(camera: Camera, factor: float) -> Camera:
    """Multiply a view's focal length in pixels, without more pixels.

    Args:
        camera: The view.
        factor: Above 0. Below 1 the image is scaled down by it, to at least `LEAST_PIXELS` along
            its shorter side; above 1 the centre of the larger image is cropped to the view's size.
    """
    factor = max(factor, LEAST_PIXELS / min(camera.width, camera.height))
    width, height = round(camera.width * factor), round(camera.height * factor)
    larger = camera.resized(width, height)
    if factor <= 1:
        return larger
    left, top = (width - camera.width) // 2, (height - camera.height) // 2
    return larger.cropped(left, top, camera.width, camera.height)


def typical_deviation(model: Splats | Source) -> float:
    """Compute the median over splats of the largest scale, scene units.

    Of more than 65,536 splats, an evenly spaced sample is used.

    Args:
        model: At least one splat.

    Raises:
        FormatError: The source cannot be read.
    """
    source = source_of(model)
    some = source.take(np.arange(0, source.count, source.count // _SAMPLE + 1))
    return float(np.median(some.scales().max(axis=1)))

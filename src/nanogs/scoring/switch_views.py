"""Levels held against their original where a viewer begins to draw them.

Each view of `nanogs compare` at its defaults stays where it is and looks the same way. Its focal
length is changed, so that a pixel shows as much of what is in view as it does where the viewer
switches: from farther away the whole picture is smaller, from nearer its middle is drawn. To walk
there would lead through walls.
"""

import math
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
from nanogs.switches import Switch, distance_of
from nanogs.views.streamed import renderings

LEAST_PIXELS = 32  # of a picture: of fewer SSIM, whose window has 11, says nothing
_LOOKS = 128  # pixels of the pictures in which it is measured how far away things are
_SAMPLE = 1 << 16  # splats that say what is typical
_OPAQUE = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class SwitchViews:
    """The views, and how much a pixel shows of what is in them.

    Attributes:
        original: The model; a source is read some rows at a time.
        cameras: The views in which something opaque is seen.
        pixels: Of each the scene units that a pixel shows, in the median of what is opaque.
        max_memory: Bytes that this process may take, where models are read some rows at a time; by
            default what is free.
    """

    original: Splats | Source
    cameras: Sequence[Camera]
    pixels: Sequence[float]
    max_memory: int | None = None

    def judge(self, level: Splats | Source, pixel: float) -> Switch | None:
        """Hold a level against the original; None where there nothing is seen.

        Args:
            level: The level.
            pixel: Scene units that a pixel shows where a viewer begins to draw it, above 0.

        Raises:
            FormatError: A source cannot be read.
            NotEnoughMemoryError: A source cannot be rendered in so little memory.
        """
        pairs = zip(self.cameras, self.pixels, strict=True)
        cameras = [magnified(camera, shown / pixel) for camera, shown in pairs]
        drawn = as_drawn(self.original, self.max_memory)
        try:
            views, _ = reference_views(drawn, cameras, BLACK, depth=False)
        except ModelError:
            return None
        del drawn
        means = score("", as_drawn(level, self.max_memory), views, BLACK)
        psnr = None if math.isinf(means.psnr) else means.psnr
        width = float(np.mean([view.camera.width for view in views]))
        return Switch(distance_of(pixel), psnr, means.ssim, len(views), width)


def switch_views(
    original: Splats | Source, cameras: Sequence[Camera], max_memory: int | None = None
) -> SwitchViews:
    """Look how far away things are in the views, once for any number of levels.

    Args:
        original: The model; of a source some rows are read at a time.
        cameras: The views; those in which nothing opaque is seen are left out.
        max_memory: See `SwitchViews`.

    Raises:
        FormatError: The source cannot be read.
        ModelError: They show nothing opaque.
        NotEnoughMemoryError: The source cannot be rendered in so little memory.
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
    kept, pixels = zip(*found, strict=True)
    return SwitchViews(original, kept, pixels, max_memory)


def magnified(camera: Camera, factor: float) -> Camera:
    """A view with a focal length so many times as long, and at most as many pixels.

    Args:
        camera: The view.
        factor: Above 0. Below 1 the picture is as much smaller, down to `LEAST_PIXELS` along its
            shorter side; above 1 it is the middle of the larger picture.
    """
    factor = max(factor, LEAST_PIXELS / min(camera.width, camera.height))
    width, height = round(camera.width * factor), round(camera.height * factor)
    larger = camera.resized(width, height)
    if factor <= 1:
        return larger
    left, top = (width - camera.width) // 2, (height - camera.height) // 2
    return larger.cropped(left, top, camera.width, camera.height)


def typical_deviation(model: Splats | Source) -> float:
    """The median over splats of the deviation along their longest axis, scene units.

    Of more than 65,536 splats, evenly spread ones stand for all.

    Args:
        model: At least one splat.

    Raises:
        FormatError: The source cannot be read.
    """
    source = source_of(model)
    some = source.take(np.arange(0, source.count, source.count // _SAMPLE + 1))
    return float(np.median(some.scales().max(axis=1)))

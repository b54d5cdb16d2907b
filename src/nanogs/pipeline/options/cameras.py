"""Cameras that the user asks for, for presets that render. Numba is imported only if needed."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from nanogs.errors import OptionError
from nanogs.pipeline.options.presets import Parameters, renders

if TYPE_CHECKING:
    from nanogs.raster.camera import Camera
    from nanogs.splats import Splats
    from nanogs.views.cameras import Cameras

AUTO = "auto"  # the source that is used unless another is asked for


def fit_cameras(
    splats: "Splats", source: str, up: Sequence[float] | None, count: int, size: int
) -> "list[Camera] | None":
    """Return cameras to fit to, from a file or of a kind; None if nothing was asked for.

    Args:
        splats: The model.
        source: As `nanogs.views.cameras.cameras_for` takes it.
        up: Up direction of automatic views, or None.
        count: Number of automatic views.
        size: Width and height of automatic views in pixels.

    Raises:
        NanogsError: The source is no camera file, or cannot be read.
    """
    if source == AUTO and up is None:
        return None
    from nanogs.views.cameras import cameras_for

    return cameras_for(splats, source, count=count, width=size, height=size, up=up, split="fit")


def are_asked(cameras: "Cameras | None", up: Sequence[float] | None) -> bool:
    """Return whether certain views are asked for: cameras other than "auto", or an up direction."""
    automatic = cameras is None or (isinstance(cameras, str) and cameras == AUTO)
    return not automatic or up is not None


def refuse_unused_views(preset: str, chosen: Parameters, *, given: bool) -> None:
    """Raise if views are given to a preset that does not render.

    Args:
        preset: Name of the preset.
        chosen: Its parameters.
        given: Whether the user asked for certain views.

    Raises:
        OptionError: Views are given, and nothing is rendered.
    """
    if given and not renders(chosen):
        raise OptionError(
            "`views`, `view_size`, `cameras` and `up` have no effect, because the preset"
            f" {preset} renders nothing here; leave them out or choose another preset."
        )

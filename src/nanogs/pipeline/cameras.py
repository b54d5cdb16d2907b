"""The views that the user asks for, for presets that render. No Numba before they are wanted."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from nanogs.errors import OptionError
from nanogs.method.parameters import ForestParameters
from nanogs.pipeline.presets import Parameters, renders

if TYPE_CHECKING:
    from nanogs.raster.camera import Camera
    from nanogs.splats import Splats


def fit_cameras(
    splats: "Splats", source: str, up: Sequence[float] | None, count: int, size: int
) -> "list[Camera] | None":
    """Cameras to learn from, from a file or of a kind; None where nothing was asked for.

    Args:
        splats: The model.
        source: As `render.source.cameras_for` takes it.
        up: Up direction of automatic views, or None.
        count: Number of automatic views.
        size: Pixels along either side of automatic views.

    Raises:
        NanogsError: The source is no camera file, or cannot be read.
    """
    if source == "auto" and up is None:
        return None
    from nanogs.views.cameras import cameras_for

    return cameras_for(splats, source, count=count, width=size, height=size, up=up, split="fit")


def requested_cameras(
    splats: "Splats", source: str, up: Sequence[float] | None, chosen: Parameters
) -> "list[Camera] | None":
    """Cameras for a preset; None where it chooses its own or renders none.

    Args:
        splats: The model.
        source: As `render.source.cameras_for` takes it.
        up: Up direction of automatic views, or None.
        chosen: Parameters of the method.

    Raises:
        NanogsError: The source is no camera file, or cannot be read.
    """
    if not isinstance(chosen, ForestParameters):
        return None
    return fit_cameras(splats, source, up, chosen.views, chosen.view_size)


def refuse_unused_views(preset: str, chosen: Parameters, *, given: bool) -> None:
    """Views mean nothing where nothing is rendered.

    Args:
        preset: Its name.
        chosen: Its parameters.
        given: Whether the user asked for certain views.

    Raises:
        OptionError: They are given, and nothing is rendered.
    """
    if given and not renders(chosen):
        raise OptionError(
            f"The preset {preset} renders nothing here, so that `views`, `cameras` and `up` mean "
            "nothing to it; leave them out or choose another preset."
        )

"""The views that the user asks for, for presets that render. No Numba before they are wanted."""

import os
from collections.abc import Sequence
from os import PathLike
from typing import TYPE_CHECKING

from nanogs.errors import OptionError
from nanogs.method.parameters import ForestParameters
from nanogs.pipeline.presets import Parameters, renders

if TYPE_CHECKING:
    from nanogs.raster.camera import Camera
    from nanogs.splats import Splats
    from nanogs.views.cameras import Cameras


def fit_cameras(
    splats: "Splats", source: str, up: Sequence[float] | None, count: int, size: int
) -> "list[Camera] | None":
    """Cameras to learn from, from a file or of a kind; None where nothing was asked for.

    Args:
        splats: The model.
        source: As `nanogs.views.cameras.cameras_for` takes it.
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


def chosen_cameras(
    splats: "Splats",
    given: "Cameras | None",
    up: Sequence[float] | None,
    chosen: Parameters,
) -> "Sequence[Camera] | None":
    """Cameras that a caller of the library names or gives; None for those of the preset's choice.

    Args:
        splats: The model.
        given: As `nanogs.simplify` takes them.
        up: Up direction of automatic views, or None.
        chosen: Parameters of the method.

    Raises:
        NanogsError: They are no cameras, or none, or cannot be read.
    """
    if given is None or isinstance(given, str | PathLike):
        return requested_cameras(splats, os.fspath(given or "auto"), up, chosen)
    from nanogs.views.cameras import given_cameras

    return given_cameras(given)


def requested_cameras(
    splats: "Splats", source: str, up: Sequence[float] | None, chosen: Parameters
) -> "list[Camera] | None":
    """Cameras for a preset; None where it chooses its own or renders none.

    Args:
        splats: The model.
        source: As `nanogs.views.cameras.cameras_for` takes it.
        up: Up direction of automatic views, or None.
        chosen: Parameters of the method.

    Raises:
        NanogsError: The source is no camera file, or cannot be read.
    """
    if not isinstance(chosen, ForestParameters) or not renders(chosen):
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
            f"The preset {preset} renders nothing here, so that `views`, `view_size`, `cameras` and"
            " `up` mean nothing to it; leave them out or choose another preset."
        )

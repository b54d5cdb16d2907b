"""Cameras by source: found from the model, or read from a file."""

import os
from collections.abc import Iterable, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, TypeAlias

from nanogs.errors import OptionError
from nanogs.protocol import Kind as Origin
from nanogs.ranges import is_number
from nanogs.raster.camera import Camera
from nanogs.source import Source
from nanogs.splats import Splats
from nanogs.views.automatic import Kind, Split, automatic_cameras
from nanogs.views.stand_in import stand_in

Cameras: TypeAlias = str | PathLike[str] | Camera | Sequence[Camera]
"""Where to look from: "auto", "orbit", "inside", "roam", a file or folder of them, or cameras."""

AUTOMATIC: dict[str, Kind] = {"auto": "auto", "orbit": "orbit", "inside": "inside"}
FOUND: dict[str, Origin] = {**AUTOMATIC, "roam": "roam"}  # all that are found from the model


class FoundCameras(list[Camera]):
    """Cameras that were found from a model, which tell no more of where viewers stand than it."""


def cameras_for(
    model: Splats | Source,
    source: str,
    *,
    count: int,
    width: int,
    height: int,
    up: Sequence[float] | None = None,
    split: Split = "test",
) -> list[Camera]:
    """Cameras for a model.

    Args:
        model: The model; of a source the same cameras are found as of the model held whole.
        source: A name in `FOUND`, or a camera file or data-set folder; all its cameras.
        count: Number of automatic views.
        width: Width of automatic views, pixels.
        height: Height of automatic views, pixels.
        up: Up direction of automatic views; found from the model by default.
        split: Of automatic views; `fit` and `test` have none in common.

    Returns:
        The cameras, `FoundCameras` unless the source is a file; of roaming ones fewer than `count`
        where no more are found.

    Raises:
        NanogsError: The source is neither, or cannot be read.
    """
    if source in AUTOMATIC:
        kind = AUTOMATIC[source]
        return FoundCameras(
            automatic_cameras(
                model, count, width=width, height=height, kind=kind, up=up, split=split
            )
        )
    if source == "roam":
        from nanogs.views.roam import roaming_cameras  # brings Numba

        some = stand_in(model)
        return FoundCameras(
            roaming_cameras(some, count, width=width, height=height, up=up, split=split)
        )
    return cameras_from(source)


def cameras_from(source: str) -> list[Camera]:
    """All cameras of a file or data-set folder.

    Raises:
        NanogsError: There is none, or it cannot be read.
    """
    if not Path(source).exists():
        raise OptionError(
            f"There is no camera file {source!r}; give a file, or one of {', '.join(FOUND)}."
        )
    from nanogs.datasets.dataset import cameras_from_file

    return cameras_from_file(Path(source))


def chosen_cameras(
    model: Splats | Source,
    cameras: Cameras,
    views: int,
    pixels: int | tuple[int, int],
    up: Sequence[float] | None,
) -> tuple[list[Camera], Origin]:
    """The views that `render` and `compare` are asked for, and where they are from.

    The arguments are those of `render`.

    Raises:
        NanogsError: As for `render`.
    """
    if not isinstance(cameras, str | PathLike):
        return given_cameras(cameras), "given"
    source = os.fspath(cameras)
    width, height = picture_size(pixels)
    count = view_count(views)
    found = cameras_for(model, source, count=count, width=width, height=height, up=up)
    return found, FOUND.get(source, "given")


def picture_size(pixels: int | Sequence[int]) -> tuple[int, int]:
    """Width and height of automatic views, of which one number stands for both.

    Raises:
        OptionError: They are no whole numbers; what is below 1 is refused with the cameras.
    """
    sides: list[Any] = list(pixels) if isinstance(pixels, Iterable) else [pixels, pixels]
    if len(sides) != 2 or not all(is_number(side, whole=True) for side in sides):
        raise OptionError(
            f"`pixels` must be a whole number, or two of them, width and height, not {pixels!r}."
        )
    width, height = map(int, sides)
    return width, height


def view_count(views: int) -> int:
    """How many automatic views are asked for.

    Raises:
        OptionError: It is no whole number; what is below 1 is refused with the cameras.
    """
    if not is_number(views, whole=True):
        raise OptionError(f"`views` must be a whole number, not {views!r}.")
    return int(views)


def known_cameras(cameras: Cameras) -> str | list[Camera]:
    """How cameras are found from the model, or those that were given or are in a file.

    Raises:
        NanogsError: There is no such file, it cannot be read, or they are no cameras.
    """
    if not isinstance(cameras, str | PathLike):
        return given_cameras(cameras)
    source = os.fspath(cameras)
    return source if source in FOUND else cameras_from(source)


def given_cameras(cameras: Camera | Sequence[Camera]) -> list[Camera]:
    """One camera or several; of those that were found from a model this stays known.

    Raises:
        OptionError: They are no cameras, or none.
    """
    if isinstance(cameras, FoundCameras) and cameras:
        return cameras
    several = list(cameras) if isinstance(cameras, Iterable) else []
    given = [cameras] if isinstance(cameras, Camera) else several
    if not given or not all(isinstance(camera, Camera) for camera in given):
        raise OptionError(
            'Cameras are "auto", "orbit", "inside", "roam", a path, or at least one nanogs.Camera.'
        )
    return given

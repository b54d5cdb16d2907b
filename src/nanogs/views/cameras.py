"""Selection of cameras: automatic ones, those of a file or data set, or given ones."""

import os
from collections.abc import Iterable, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, TypeAlias

from nanogs.errors import OptionError
from nanogs.paths import exists, why_refused
from nanogs.protocol import PIXELS, VIEWS
from nanogs.protocol import Kind as Origin
from nanogs.ranges import is_number, one_or_several
from nanogs.raster.camera import NEAR, Camera
from nanogs.source import Source, refuse_no_model, source_of
from nanogs.splats import Splats
from nanogs.views.automatic import Kind, Split, automatic_cameras
from nanogs.views.decimated import decimated

Cameras: TypeAlias = str | PathLike[str] | Camera | Sequence[Camera]
"""Cameras, or a name of them: "auto", "orbit", "inside", "roam", or a file or folder of cameras."""

KINDS: dict[str, Kind] = {"auto": "auto", "orbit": "orbit", "inside": "inside"}
FOUND: dict[str, Origin] = {**KINDS, "roam": "roam"}  # all automatic cameras

_OF_NERFSTUDIO = (
    "The model was exported by nerfstudio, which trains in other coordinates than those of its data"
    " set: if pictures do not show what the photographs show, copy the dataparser_transforms.json"
    " of the training run beside the cameras."
)


def cameras_for(
    model: Splats | Source,
    name: str,
    *,
    count: int,
    width: int,
    height: int,
    up: Sequence[float] | None = None,
    split: Split = "test",
) -> list[Camera]:
    """Choose automatic cameras for a model, or read all cameras of a file.

    Args:
        model: The model; a source gives the same cameras as the model in memory.
        name: A name in `FOUND`, or a camera file or data-set folder.
        count: Number of automatic views.
        width: Width of automatic views, pixels.
        height: Height of automatic views, pixels.
        up: Up direction of automatic views; found from the model by default.
        split: Split of automatic views; `fit` and `test` have none in common.

    Returns:
        The cameras; fewer than `count` if not enough roaming ones are found.

    Raises:
        NanogsError: `model` is no model, or the name is none of these, or cannot be read.
    """
    refuse_no_model(model)
    if name in KINDS:
        kind = KINDS[name]
        return automatic_cameras(
            model, count, width=width, height=height, kind=kind, up=up, split=split
        )
    if name == "roam":
        from nanogs.views.roam import roaming_cameras  # imports Numba

        some = decimated(model)
        return roaming_cameras(some, count, width=width, height=height, up=up, split=split)
    return cameras_from(name)


def cameras_from(path: str) -> list[Camera]:
    """Read all cameras of a file or data-set folder.

    Raises:
        NanogsError: There is no such file, or it cannot be read.
    """
    if refusal := why_refused(path):
        raise OptionError(f"The cameras {path} cannot be read ({refusal}); check the path.")
    if not exists(path):
        raise OptionError(
            f"There is no camera file {path!r}; give a file, or one of {', '.join(FOUND)}."
        )
    from nanogs.datasets.dataset import cameras_from_file

    return cameras_from_file(Path(path))


def frame_notes(cameras: Sequence[Camera], model: Splats | Source) -> list[str]:
    """Return a note for the user if cameras of a file may be in another frame than the model.

    Models of nerfstudio are, unless it was told not to change coordinates. Cameras of files are
    recognised by their near plane, which automatic ones scale with the model.
    """
    comments = " ".join(source_of(model).columns.comments).lower()
    made = "nerfstudio" in comments or "nerstudio" in comments  # as its exporter spells it
    unchanged = [camera for camera in cameras if camera.near == NEAR and not camera.changed_by]
    if not (made and unchanged):
        return []
    return [_OF_NERFSTUDIO]


def chosen_cameras(
    model: Splats | Source,
    cameras: Cameras,
    views: int,
    pixels: int | tuple[int, int],
    up: Sequence[float] | None,
) -> tuple[list[Camera], Origin]:
    """Return the requested cameras, and their origin for reports.

    The arguments are those of `render`.

    Raises:
        NanogsError: See `render`.
    """
    if not isinstance(cameras, str | PathLike):
        return given_cameras(cameras), "given"
    name = os.fspath(cameras)
    width, height = picture_size(pixels)
    count = view_count(views)
    found = cameras_for(model, name, count=count, width=width, height=height, up=up)
    return found, FOUND.get(name, "given")


def picture_size(pixels: int | Sequence[int]) -> tuple[int, int]:
    """Return width and height of automatic views; a single number is used for both.

    Raises:
        OptionError: They are no whole numbers; sizes below 1 are refused with the cameras.
    """
    sides: list[Any] = list(pixels) if isinstance(pixels, Iterable) else [pixels, pixels]
    if len(sides) != 2 or not all(is_number(side, whole=True) for side in sides):
        raise OptionError(
            f"`pixels` must be a whole number, or two of them, width and height, not {pixels!r}."
        )
    width, height = map(int, sides)
    return width, height


def view_count(views: int) -> int:
    """Return the requested number of automatic views as an int.

    Raises:
        OptionError: It is no whole number; one below 1 is refused with the cameras.
    """
    if not is_number(views, whole=True):
        raise OptionError(f"`views` must be a whole number, not {views!r}.")
    return int(views)


def known_cameras(
    cameras: Cameras,
    up: Sequence[float] | None = None,
    views: int | None = None,
    pixels: int | tuple[int, int] = PIXELS,
) -> str | list[Camera]:
    """Return the name of a kind of automatic cameras, or the cameras given or in a file.

    Raises:
        NanogsError: There is no such file, it cannot be read, they are no cameras, or one of the
            other arguments, which are for automatic ones, is given beside them.
    """
    if not isinstance(cameras, str | PathLike):
        found = given_cameras(cameras)
    elif (name := os.fspath(cameras)) in FOUND:
        return name
    else:
        found = cameras_from(name)
    refuse_beside_given(up, views, [pixels])
    return found


def refuse_beside_given(
    up: Sequence[float] | None, views: int | None, pixels: Sequence[int | tuple[int, int]]
) -> None:
    """Refuse options of automatic cameras beside given ones, unless they are the defaults.

    Args:
        up: The up direction.
        views: The number of views; None for the usual one.
        pixels: The sizes of views.

    Raises:
        OptionError: One is given, or is not valid.
    """
    usual = {
        "up": up is None,
        "views": views is None or view_count(views) == VIEWS,
        "pixels": [picture_size(size) for size in pixels] == [picture_size(PIXELS)],
    }
    for name, is_usual in usual.items():
        if not is_usual:
            raise OptionError(
                f"`{name}` cannot be combined with given cameras, which are views of their own;"
                " leave one of them out."
            )


def given_cameras(cameras: Camera | Sequence[Camera]) -> list[Camera]:
    """Convert one camera or several to a list.

    Raises:
        OptionError: They are no cameras, there are none, or one is invalid.
    """
    given = one_or_several(cameras)
    if not given or not all(isinstance(camera, Camera) for camera in given):
        raise OptionError(
            'Cameras must be "auto", "orbit", "inside", "roam", a path, or at least one'
            " nanogs.Camera."
        )
    check_cameras(given)
    return given


def check_cameras(cameras: Iterable[Camera]) -> None:
    """Refuse cameras that cannot be rendered from, before anything is computed.

    Raises:
        OptionError: The size or a number of one is invalid.
    """
    from nanogs.raster.checks import check_camera  # imports Numba

    for camera in cameras:
        check_camera(camera)

"""`transforms*.json`: NeRF-Synthetic as Blender exports it, and nerfstudio's extension of it."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from nanogs._types import F64
from nanogs.datasets import fields
from nanogs.datasets.frame import Frame
from nanogs.datasets.nerfstudio import find_change, moved, test_images
from nanogs.datasets.photos import find_photo, photo_size
from nanogs.errors import FormatError
from nanogs.raster.lens import Lens

_MIN_ANGLE = 1e-6  # radians; smaller angles give absurd focal lengths
_DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
_FISHEYE = "OPENCV_FISHEYE"
# nerfstudio's names of camera models that are a pinhole, with or without lens distortion.
_PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")


def read_transforms(path: Path) -> list[Frame]:
    """Read the cameras of a `transforms*.json`.

    `transform_matrix` is camera to world with OpenGL axes. The focal length is `fl_x` in pixels,
    else 0.5 w / tan(camera_angle_x / 2) with the angle in radians. The vertical one likewise is
    `fl_y` or follows from `h` and camera_angle_y, and equals the horizontal one if neither is
    present. `cx` and `cy` default to the image's centre. Each key may be given per frame or once
    for all frames. The size is `w` and `h`; for a file without them it is the photographs' size.

    If there is a `dataparser_transforms.json` beside the file, the cameras are returned in the
    coordinates of nerfstudio's model (see `nerfstudio.find_change`).

    Args:
        path: The JSON file; `file_path` is relative to its folder, with or without suffix.

    Returns:
        The frames in the file's order; `photo_path` is None if the photograph does not exist.

    Raises:
        FormatError: The file is malformed, a camera model is not a pinhole with a lens, a pose is
            not rigid, an image is listed twice, a photograph has another size than its frame
            states, or no size is known.
    """
    return _frames(path, _document(path))


def split_transforms(path: Path) -> tuple[list[Frame], list[Frame]]:
    """Read the frames of nerfstudio's `transforms.json`: those for training, and those for testing.

    Raises:
        FormatError: See `read_transforms` and `nerfstudio.test_images`.
    """
    document = _document(path)
    frames = _frames(path, document)
    names = [frame.camera.name for frame in frames]
    held_out = test_images(names, document, str(path))
    return (
        [frame for frame in frames if frame.camera.name not in held_out],
        [frame for frame in frames if frame.camera.name in held_out],
    )


def _document(path: Path) -> dict[str, Any]:
    return fields.entry(fields.read_json(path), str(path))


def _frames(path: Path, document: dict[str, Any]) -> list[Frame]:
    shared = {key: value for key, value in document.items() if key != "frames"}
    rows = fields.entries(document.get("frames"), f"{path}, frames")
    frames = [_frame(path, index, {**shared, **row}) for index, row in enumerate(rows)]
    change = find_change(path.parent, shared, str(path))
    if change is not None:
        frames = [replace(frame, camera=moved(frame.camera, change)) for frame in frames]
    fields.refuse_repeats((frame.camera.name for frame in frames), str(path), "image")
    found = (frame.photo_path for frame in frames if frame.photo_path is not None)
    fields.refuse_repeats(found, str(path), "photograph")
    return frames


def _frame(path: Path, index: int, row: dict[str, Any]) -> Frame:
    where = f"{path}, frame {index}"
    listed = fields.path(row.get("file_path"), f"{where}, file_path")
    photo = find_photo(path.parent, listed)
    lens = _lens(row, where)
    size = _size(row, where, photo)
    pose = _pose(row.get("transform_matrix"), where)
    centre = (row.get("cx", size[0] / 2), row.get("cy", size[1] / 2))
    camera = fields.pinhole(where, listed, size, _focal(row, size, where), centre, pose, lens)
    return Frame(camera, photo, masked=bool(row.get("mask_path")))


def _size(row: dict[str, Any], where: str, photo: Path | None) -> tuple[int, int]:
    if "w" in row or "h" in row:
        stated = fields.side(row.get("w"), f"{where}, w"), fields.side(row.get("h"), f"{where}, h")
        if photo is not None and photo_size(photo) != stated:
            raise FormatError(
                f"{photo}: is {photo_size(photo)} pixels, but {where} states {stated}; use the"
                " photographs that the cameras were made for."
            )
        return stated
    if photo is None:
        raise FormatError(
            f"{where}: the image size is unknown, because there is neither 'w' and 'h' nor the"
            " photograph; add 'w' and 'h', in pixels, or put the photographs where file_path says."
        )
    return photo_size(photo)


def _focal(row: dict[str, Any], size: tuple[int, int], where: str) -> tuple[float, float]:
    fx = _focal_along("x", row, size[0], where)
    if "fl_y" in row or "camera_angle_y" in row:
        return fx, _focal_along("y", row, size[1], where)
    return fx, fx


def _focal_along(axis: str, row: dict[str, Any], side: int, where: str) -> float:
    if f"fl_{axis}" in row:
        return fields.number(row[f"fl_{axis}"], f"{where}, fl_{axis}")
    name = f"camera_angle_{axis}"
    angle = fields.number(row.get(name), f"{where}, {name}")
    if not _MIN_ANGLE <= angle < math.pi:
        raise FormatError(
            f"{where}: {name} is {angle:g}, but must be an angle between 0 and pi radians; export"
            " the cameras again."
        )
    return 0.5 * side / math.tan(0.5 * angle)


def _pose(value: object, where: str) -> F64:
    camera_to_world = fields.matrix(value, (4, 4), f"{where}, transform_matrix")
    if np.abs(camera_to_world[3] - (0, 0, 0, 1)).max() > fields.RIGID_TOLERANCE:
        raise FormatError(
            f"{where}: the last row of its transform_matrix is not 0 0 0 1; export the cameras"
            " again, with the matrix in row-major order."
        )
    rotation = camera_to_world[:3, :3] * fields.OPENGL_AXES  # columns are the camera's axes
    return fields.inverted(rotation, camera_to_world[:3, 3], where)


def _lens(row: dict[str, Any], where: str) -> Lens:
    """Read the lens of a camera from the keys that nerfstudio and instant-ngp use.

    Raises:
        FormatError: The camera model is not a pinhole with a lens, or a parameter is not finite.
    """
    model = row.get("camera_model", "PINHOLE")
    if model not in (*_PINHOLES, _FISHEYE):
        raise FormatError(
            f"{where}: its camera model {fields.shown(model)} is not a pinhole camera; export the"
            " cameras as pinhole cameras."
        )
    given = {key: fields.number(row.get(key, 0.0), f"{where}, {key}") for key in _DISTORTION}
    radial = [given[f"k{power}"] for power in range(1, 7)]
    if model == _FISHEYE or row.get("is_fisheye"):
        return Lens(_FISHEYE, fisheye=True, above=tuple(radial[:4]), known=not any(radial[4:]))
    # Programs define k4 and above differently.
    tangential = given["p1"], given["p2"]
    return Lens(model, above=tuple(radial[:3]), tangential=tangential, known=not any(radial[3:]))

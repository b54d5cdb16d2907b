"""nerfstudio's change of coordinates, its test photographs, and its camera paths.

Before training, nerfstudio orients, centres and scales the cameras of a data set, so that its
models are in other coordinates than the `transforms.json`. It writes the change into the folder of
the training run, as `dataparser_transforms.json`. Conventions are those of
nerfstudio/data/dataparsers/nerfstudio_dataparser.py and base_dataparser.py.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from nanogs._types import F64
from nanogs.datasets import fields
from nanogs.errors import FormatError
from nanogs.paths import is_file
from nanogs.pose import Pose
from nanogs.raster.camera import Camera

CHANGE_FILE = "dataparser_transforms.json"
_TRAINED = 0.9  # share of the images that nerfstudio trains on by default
_NEAR = 0.01  # scene units, as nerfstudio renders splats
_REMEDY = "copy it again from the folder of the training run"


def find_change(
    folder: Path, saved: Mapping[str, Any] | None = None, where: str = ""
) -> Pose | None:
    """Read the change of coordinates in a folder; None if there is none.

    Args:
        folder: The folder, which may hold a `dataparser_transforms.json`.
        saved: Content of the `transforms.json` whose cameras are to be changed. It may itself state
            a change from the original coordinates (`applied_transform`, `applied_scale`), which the
            file in `folder` includes. By default cameras are in the original coordinates.
        where: That file, for messages.

    Raises:
        FormatError: A file is damaged, or its change is not a rotation, a translation and a scale.
    """
    path = folder / CHANGE_FILE
    if not is_file(path):
        return None
    document = fields.entry(fields.read_json(path), str(path))
    whole = _rigid(document.get("transform"), f"{path}, transform")
    scale = _scale(document.get("scale"), f"{path}, scale")
    if saved is not None:
        if "applied_transform" in saved:
            applied = _rigid(saved["applied_transform"], f"{where}, applied_transform")
            whole = whole @ np.linalg.inv(applied)
        scale /= _scale(saved.get("applied_scale", 1.0), f"{where}, applied_scale")
    return Pose(whole[:3, :3], np.full(3, scale), scale * whole[:3, 3])


def moved(camera: Camera, change: Pose) -> Camera:
    """Return the camera that sees the changed scene as `camera` sees the scene.

    Args:
        camera: The camera.
        change: The change of the scene, with a uniform scale.
    """
    scale, pose = float(change.scale[0]), np.eye(4)
    pose[:3, :3] = camera.world_to_camera[:3, :3] @ change.rotation.T
    pose[:3, 3] = scale * camera.world_to_camera[:3, 3] - pose[:3, :3] @ change.shift
    return replace(camera, world_to_camera=pose, near=scale * camera.near, changed_by=CHANGE_FILE)


def read_camera_path(path: Path) -> list[Camera]:
    """Read a `camera_path.json`, which nerfstudio's viewer writes, in coordinates of the model.

    It holds `render_width` and `render_height`, pixels, and for each camera of `camera_path` 16
    numbers `camera_to_world`, row by row with OpenGL axes, and `fov`, the vertical field of view in
    degrees.

    Args:
        path: The JSON file.

    Raises:
        FormatError: The file is malformed, a pose is not rigid, or the path is not for a
            perspective camera.
    """
    document = fields.entry(fields.read_json(path), str(path))
    kind = document.get("camera_type", "perspective")
    if kind != "perspective":
        raise FormatError(
            f"{path}, camera_type: is {fields.shown(kind)}; save the path for a perspective camera."
        )
    width = fields.side(document.get("render_width"), f"{path}, render_width")
    height = fields.side(document.get("render_height"), f"{path}, render_height")
    rows = fields.entries(document.get("camera_path"), f"{path}, camera_path")
    cameras = []
    for number, row in enumerate(rows):
        where = f"{path}, camera {number}"
        listed = fields.matrix([row.get("camera_to_world")], (1, 16), f"{where}, camera_to_world")
        camera_to_world = listed.reshape(4, 4)
        pose = fields.inverted(
            camera_to_world[:3, :3] * fields.OPENGL_AXES, camera_to_world[:3, 3], where
        )
        angle = fields.number(row.get("fov"), f"{where}, fov")
        if not 0 < angle < 180:
            raise FormatError(
                f"{where}, fov: is {fields.shown(row['fov'])}, but must be between 0 and 180"
                " degrees; save the path again."
            )
        focal = height / 2 / math.tan(math.radians(angle) / 2)
        camera = fields.pinhole(
            where, f"path_{number:03}", (width, height), (focal, focal), (width / 2, height / 2),
            pose,
        )  # fmt: skip
        cameras.append(replace(camera, near=_NEAR))
    return cameras


def refuse_lone(document: object, path: Path) -> None:
    """Refuse files of nerfstudio that say something of cameras, but lack a part of them.

    Raises:
        FormatError: The content is that of such a file.
    """
    beside = f"give the transforms.json of the data set, with {CHANGE_FILE} beside it"
    if isinstance(document, dict) and {"transform", "scale"} <= document.keys():
        raise FormatError(f"{path}: holds a change of coordinates, but no cameras; {beside}.")
    first = document[0] if isinstance(document, list) and document else None
    if isinstance(first, dict) and {"file_path", "transform"} <= first.keys():
        raise FormatError(f"{path}: holds poses without focal lengths; {beside}.")


def test_images(names: Sequence[str], document: Mapping[str, Any], where: str) -> set[str]:
    """Return the names of the images of a `transforms.json` that nerfstudio does not train on.

    Those in `test_filenames`, if it has a list of them, else those that are not in
    `train_filenames`. Without lists a tenth of them, by nerfstudio's default: of the images sorted
    by name, it trains on nine tenths, spread evenly.

    Args:
        names: The normalised `file_path` of all frames.
        document: Content of the file.
        where: The file, for messages.

    Raises:
        FormatError: Such a list is not a list of names, or has one that is not in `names`.
    """
    tested, trained = (
        _listed(names, document.get(key), f"{where}, {key}")
        for key in ("test_filenames", "train_filenames")
    )
    if tested is not None:
        return tested
    if trained is None:
        ordered = sorted(names)
        rows = np.linspace(0, len(names) - 1, math.ceil(_TRAINED * len(names)), dtype=int)
        trained = {ordered[row] for row in rows.tolist()}
    return set(names) - trained


def _listed(names: Sequence[str], listed: object, where: str) -> set[str] | None:
    if listed is None:
        return None
    if not isinstance(listed, list):
        raise FormatError(
            f"{where}: is {fields.shown(listed)} where a list is needed; export the cameras again."
        )
    found = {fields.path(name, where) for name in listed}
    if missing := sorted(found - set(names)):
        raise FormatError(
            f"{where}: lists {missing[0]}, of which there is no frame; export the cameras again."
        )
    return found


def _rigid(value: object, where: str) -> F64:
    """Return a (4, 4) matrix of a rotation and a translation, of which three rows are given."""
    found = np.eye(4)
    found[:3] = fields.matrix(value, (3, 4), where)
    if not fields.is_rotation(found[:3, :3]):
        raise FormatError(f"{where}: is not a rotation and a translation; {_REMEDY}.")
    return found


def _scale(value: object, where: str) -> float:
    scale = fields.number(value, where)
    if not scale > 0:
        raise FormatError(f"{where}: is {fields.shown(value)}, but must be positive; {_REMEDY}.")
    return scale

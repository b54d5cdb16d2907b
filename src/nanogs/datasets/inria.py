"""`cameras.json`, which the reference 3DGS trainer writes beside its models."""

from collections import Counter
from pathlib import Path
from typing import Any

from nanogs.datasets import fields
from nanogs.raster.camera import Camera


def read_cameras_json(path: Path) -> list[Camera]:
    """Read the cameras of a training run.

    An entry holds `id`, `img_name`, `width` and `height` in pixels, `position` (the camera's centre
    in scene units), `rotation` (3x3, camera to world, OpenCV axes), `fx` and `fy` in pixels. The
    format has no principal point: it is the image's centre.

    Args:
        path: The JSON file.

    Returns:
        The cameras in the file's order. The trainer gives a training and a test view the same name
        if their files have the same name; the entry's id is appended to such names.

    Raises:
        FormatError: The file is malformed, or an entry is incomplete, repeated or not rigid.
    """
    rows = fields.entries(fields.read_json(path), str(path))
    places = [f"{path}, entry {index}" for index in range(len(rows))]
    ids = [
        int(fields.number(row.get("id", index), f"{place}, id"))
        for index, (row, place) in enumerate(zip(rows, places, strict=True))
    ]
    fields.refuse_repeats(ids, str(path), "id")
    names = [
        fields.text(row.get("img_name"), f"{place}, img_name")
        for row, place in zip(rows, places, strict=True)
    ]
    often = Counter(names)
    names = [
        f"{name}-{key}" if often[name] > 1 else name for name, key in zip(names, ids, strict=True)
    ]
    fields.refuse_repeats(names, str(path), "image")
    return [_camera(*each) for each in zip(rows, places, names, strict=True)]


def _camera(row: dict[str, Any], where: str, name: str) -> Camera:
    rotation = fields.matrix(row.get("rotation"), (3, 3), f"{where}, rotation")
    position = fields.matrix([row.get("position")], (1, 3), f"{where}, position")[0]
    width = fields.side(row.get("width"), f"{where}, width")
    height = fields.side(row.get("height"), f"{where}, height")
    focal = (
        fields.number(row.get("fx"), f"{where}, fx"),
        fields.number(row.get("fy"), f"{where}, fy"),
    )
    pose = fields.inverted(rotation, position, where)
    return fields.pinhole(where, name, (width, height), focal, (width / 2, height / 2), pose)

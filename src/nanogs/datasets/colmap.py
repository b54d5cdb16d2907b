"""COLMAP's sparse models, binary or text."""

import math
from pathlib import Path

import numpy as np

from nanogs._types import F64
from nanogs.activations import rotations
from nanogs.datasets import fields
from nanogs.datasets.colmap_binary import read_cameras_binary, read_images_binary
from nanogs.datasets.colmap_models import ColmapCamera, ColmapImage, intrinsics, lens_of
from nanogs.datasets.colmap_text import read_cameras_text, read_images_text
from nanogs.errors import FormatError
from nanogs.paths import is_file
from nanogs.raster.camera import Camera


def find_model(folder: Path) -> Path | None:
    """Return the sparse model in `folder/sparse/0`, `folder/sparse` or `folder`, else None."""
    candidates = (folder / "sparse" / "0", folder / "sparse", folder)
    return next((path for path in candidates if _encoding(path)), None)


def read_model(folder: Path) -> list[Camera]:
    """Read the cameras of a sparse model.

    Args:
        folder: Folder with `cameras.bin` and `images.bin`, or the two as `.txt`; the binary pair is
            read if both exist.

    Returns:
        One camera for each image, sorted by image name, with the image size that COLMAP used.

    Raises:
        FormatError: Files are missing or damaged, an image is listed twice or refers to a missing
            camera, a number is not finite, or a pose is not rigid.
    """
    cameras, images = _read(folder)
    if not images:
        raise FormatError(f"{folder}: holds no registered image; run COLMAP's mapper again.")
    fields.refuse_repeats((camera.camera_id for camera in cameras), str(folder), "camera")
    fields.refuse_repeats((image.image_id for image in images), str(folder), "image id")
    fields.refuse_repeats((image.name for image in images), str(folder), "image")
    by_id = {camera.camera_id: camera for camera in cameras}
    return [_join(image, by_id, folder) for image in sorted(images, key=lambda image: image.name)]


def scaled(camera: Camera, size: tuple[int, int], where: str) -> Camera:
    """Scale a camera's intrinsics to a photograph that was resized after COLMAP was run.

    Args:
        camera: The camera at the original size.
        size: The photograph's width and height in pixels.
        where: The photograph, for the message.

    Raises:
        FormatError: The photograph's aspect ratio differs by more than the rounding of its sides.
    """
    if size == (camera.width, camera.height):
        return camera
    # One factor must give both sides, each rounded up or down by less than a pixel.
    lowest = max((size[0] - 1) / camera.width, (size[1] - 1) / camera.height)
    highest = min((size[0] + 1) / camera.width, (size[1] + 1) / camera.height)
    if lowest > highest:
        raise FormatError(
            f"{where}: is {size[0]}x{size[1]} pixels, which is not a scaled version of the"
            f" {camera.width}x{camera.height} of its camera; use the photographs that COLMAP was"
            " run on."
        )
    return camera.resized(*size)


def _encoding(folder: Path) -> str | None:
    for suffix in (".bin", ".txt"):
        if all(is_file(folder / (stem + suffix)) for stem in ("cameras", "images")):
            return suffix
    return None


def _read(folder: Path) -> tuple[list[ColmapCamera], list[ColmapImage]]:
    encoding = _encoding(folder)
    if encoding == ".bin":
        binary = folder / "cameras.bin", folder / "images.bin"
        return read_cameras_binary(binary[0]), read_images_binary(binary[1])
    if encoding == ".txt":
        text = folder / "cameras.txt", folder / "images.txt"
        return read_cameras_text(text[0]), read_images_text(text[1])
    raise FormatError(
        f"{folder}: lacks cameras and images as .bin or .txt; give a COLMAP sparse model."
    )


def _join(image: ColmapImage, cameras: dict[int, ColmapCamera], folder: Path) -> Camera:
    where = f"{folder}, image {fields.shown(image.name)}"
    fields.text(image.name, where)
    if image.camera_id not in cameras:
        raise FormatError(
            f"{where}: refers to camera {image.camera_id}, which is not in the model; "
            "export the model again from COLMAP."
        )
    camera = cameras[image.camera_id]
    focal, centre = intrinsics(camera)
    lens = lens_of(camera, f"{where}: camera {camera.camera_id}")
    return fields.pinhole(where, image.name, camera.size, focal, centre, _pose(image, where), lens)


def _pose(image: ColmapImage, where: str) -> F64:
    limit = fields.MAX_DISTANCE
    quaternion = [fields.number(value, f"{where}, rotation", limit) for value in image.quaternion]
    norm = math.hypot(*quaternion)
    if abs(norm - 1) > fields.RIGID_TOLERANCE:
        raise FormatError(
            f"{where}: its rotation is a quaternion of length {norm:g}, not 1; "
            "export the model again from COLMAP."
        )
    unit = [value / norm for value in quaternion]  # as COLMAP does on reading
    pose = np.eye(4)
    pose[:3, :3] = rotations(np.array([unit]))[0]
    pose[:3, 3] = [fields.number(t, f"{where}, translation", limit) for t in image.translation]
    return pose

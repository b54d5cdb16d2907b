"""COLMAP's `cameras.bin` and `images.bin`: little-endian, counts before entries.

A count is checked against the remaining bytes before anything of its size is read.
"""

import mmap
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from nanogs.datasets.colmap_models import MODELS, ColmapCamera, ColmapImage, unknown_model
from nanogs.errors import FormatError
from nanogs.io.files import HEAD_BYTES, refuse_stand_in

_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")  # id, model, width, height
_IMAGE = struct.Struct("<I7dI")  # id, quaternion wxyz, translation, camera id
_POINT_BYTES = 24  # an observation: x, y and the id of a 3D point
_SHORTEST_CAMERA = _CAMERA.size + 3 * 8
_SHORTEST_IMAGE = _IMAGE.size + 1 + _COUNT.size


class _Cursor:
    """A read position in a memory-mapped file; reading past the end raises a `FormatError`."""

    def __init__(self, path: Path, data: mmap.mmap) -> None:
        self.path = path
        self._data = data
        self._at = 0

    def take(self, layout: struct.Struct) -> tuple[Any, ...]:
        self.skip(layout.size)
        return layout.unpack_from(self._data, self._at - layout.size)

    def skip(self, size: int) -> None:
        if size > len(self._data) - self._at:
            raise self.truncated()
        self._at += size

    def count(self, smallest: int) -> int:
        """Read a count of entries of at least `smallest` bytes each."""
        (count,) = self.take(_COUNT)
        if count * smallest > len(self._data) - self._at:
            raise self.truncated()
        return int(count)

    def name(self) -> str:
        """Read a NUL-terminated string."""
        end = self._data.find(b"\0", self._at)
        if end < 0:
            raise self.truncated()
        raw = self._data[self._at : end]
        self._at = end + 1
        try:
            return raw.decode("utf-8")
        except UnicodeDecodeError as error:
            raise FormatError(
                f"{self.path}: holds an image name that is not UTF-8; rename the photograph and "
                "run COLMAP again."
            ) from error

    def finish(self) -> None:
        if self._at != len(self._data):
            raise FormatError(
                f"{self.path}: has more data after its last entry; export the model again from"
                " COLMAP."
            )

    def truncated(self) -> FormatError:
        return FormatError(
            f"{self.path}: ends before its last entry; copy it again or export it from COLMAP."
        )


@contextmanager
def _mapped(path: Path) -> Iterator[_Cursor]:
    # Memory-mapped, because observations make up nearly all of images.bin and are skipped.
    try:
        with path.open("rb") as file:
            data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except ValueError as error:
        raise FormatError(f"{path}: is empty; copy it again or export it from COLMAP.") from error
    except OSError as error:
        raise FormatError(f"{path}: cannot be read ({error.strerror}); check the path.") from error
    with data:
        refuse_stand_in(path, data[:HEAD_BYTES], "file of cameras")
        yield _Cursor(path, data)


def read_cameras_binary(path: Path) -> list[ColmapCamera]:
    """Read `cameras.bin` in the file's order.

    Raises:
        FormatError: It is missing, truncated or too long, or names an unknown camera model.
    """
    with _mapped(path) as cursor:
        cameras = [_camera(cursor) for _ in range(cursor.count(_SHORTEST_CAMERA))]
        cursor.finish()
    return cameras


def read_images_binary(path: Path) -> list[ColmapImage]:
    """Read `images.bin` in the file's order, without the observations.

    Raises:
        FormatError: It is missing, truncated or too long, or a name is not UTF-8.
    """
    with _mapped(path) as cursor:
        images = [_image(cursor) for _ in range(cursor.count(_SHORTEST_IMAGE))]
        cursor.finish()
    return images


def _camera(cursor: _Cursor) -> ColmapCamera:
    camera_id, number, width, height = cursor.take(_CAMERA)
    if not 0 <= number < len(MODELS):
        raise unknown_model(str(cursor.path), number)
    model = MODELS[number]
    params = cursor.take(struct.Struct(f"<{model.count}d"))
    return ColmapCamera(camera_id, model, (width, height), params)


def _image(cursor: _Cursor) -> ColmapImage:
    image_id, *pose, camera_id = cursor.take(_IMAGE)
    name = cursor.name()
    cursor.skip(_POINT_BYTES * cursor.count(_POINT_BYTES))
    return ColmapImage(image_id, tuple(pose[:4]), tuple(pose[4:]), camera_id, name)

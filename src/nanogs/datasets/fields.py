"""Validation of values from camera files: JSON, numbers, poses, and pinhole cameras.

Each function that takes `where`, the file and the entry in it, begins its messages with it.
"""

import json
import posixpath
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from nanogs._types import F64
from nanogs.errors import FormatError, NoViewsError
from nanogs.io.files import HEAD_BYTES, refuse_stand_in
from nanogs.raster.camera import Camera
from nanogs.raster.lens import Lens

# OpenGL cameras look along -z with y up, ours along +z with y down.
OPENGL_AXES = np.array([1.0, -1.0, -1.0])
RIGID_TOLERANCE = 1e-3  # largest entry of |RᵀR - I| that counts as rounding
MAX_SIDE = 65_536  # pixels; larger means a damaged file, for which a renderer would allocate
MAX_PIXELS = 1e9  # largest focal length and principal point, so that scaling stays finite
MAX_DISTANCE = 1e12  # scene units; squares of much larger values overflow in single precision


def read_text(path: Path) -> str:
    """Read a UTF-8 file, which may begin with a byte order mark, as programs on Windows write.

    Raises:
        FormatError: The file is missing, unreadable or not UTF-8, or a placeholder such as a Git
            LFS pointer; see `refuse_stand_in`.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise FormatError(
            f"{path}: cannot be read ({error.strerror or error}); check the path."
        ) from error
    except ValueError as error:
        raise FormatError(f"{path}: is not UTF-8 text; export the cameras again.") from error
    refuse_stand_in(path, text[:HEAD_BYTES].encode(), "file of cameras")
    return text


def read_json(path: Path) -> Any:  # noqa: ANN401 - callers check the shape
    """Read a JSON file.

    Raises:
        FormatError: The file is missing, unreadable or not JSON.
    """
    try:
        return json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{path}: is not JSON ({error}); export the cameras again.") from error


def entry(value: object, where: str) -> dict[str, Any]:
    """Return a JSON object, refusing anything else with a `FormatError`."""
    if not isinstance(value, dict):
        raise FormatError(
            f"{where}: holds {shown(value)} where a JSON object is needed; export the cameras"
            " again."
        )
    return value


def entries(value: object, where: str) -> list[dict[str, Any]]:
    """Return a list of at least one JSON object, refusing anything else with a `FormatError`.

    Raises:
        NoViewsError: The list is empty.
    """
    if not isinstance(value, list) or not value:
        problem = NoViewsError if value == [] else FormatError
        raise problem(
            f"{where}: needs a list of at least one camera, not {shown(value)}; "
            "export the cameras again."
        )
    return [entry(item, f"{where}, entry {row}") for row, item in enumerate(value)]


def text(value: object, where: str) -> str:
    """Return a non-empty string, refusing anything else with a `FormatError`."""
    if not isinstance(value, str) or not value:
        raise FormatError(f"{where}: is {shown(value)} where a name is needed; export it again.")
    return value


def path(value: object, where: str) -> str:
    """Return a non-empty relative path in its shortest form, refusing anything else."""
    return posixpath.normpath(text(value, where))


def number(value: object, where: str, limit: float = MAX_PIXELS) -> float:
    """Return a finite number of at most `limit` in size, refusing others with a `FormatError`."""
    # bool is a subclass of int; an int too large for a float must not raise an OverflowError.
    plain = isinstance(value, int | float) and not isinstance(value, bool)
    if not plain or not -limit <= value <= limit:  # type: ignore[operator]
        raise FormatError(
            f"{where}: is {shown(value)} where a finite number is needed; export the cameras again."
        )
    return float(value)  # type: ignore[arg-type]


def side(value: object, where: str) -> int:
    """Return an image side in pixels, 1 to `MAX_SIDE`, refusing others with a `FormatError`."""
    size = number(value, where)
    if not 1 <= size <= MAX_SIDE or not size.is_integer():
        raise FormatError(
            f"{where}: is {shown(value)} where an image side of 1 to {MAX_SIDE} pixels is needed; "
            "export the cameras again."
        )
    return int(size)


def matrix(value: object, shape: tuple[int, int], where: str) -> F64:
    """Return nested JSON lists as a float64 array of `shape`.

    Raises:
        FormatError: The shape differs, or a value is not a finite number.
    """
    rows = value if isinstance(value, list) else []
    flat = [item for row in rows if isinstance(row, list) and len(row) == shape[1] for item in row]
    if len(rows) != shape[0] or len(flat) != shape[0] * shape[1]:
        raise FormatError(
            f"{where}: is not a {shape[0]}x{shape[1]} matrix; export the cameras again."
        )
    return np.array([number(item, where, MAX_DISTANCE) for item in flat]).reshape(shape)


def is_rotation(matrix: F64) -> bool:
    """Return whether a (3, 3) matrix is a rotation, within `RIGID_TOLERANCE`."""
    off = matrix.T @ matrix - np.eye(3)
    # `<=`, so that NaN fails; the determinant, because mirrors are orthonormal too.
    return bool(np.abs(off).max() <= RIGID_TOLERANCE and np.linalg.det(matrix) > 0)


def inverted(rotation: F64, position: F64, where: str) -> F64:
    """Compute a world-to-camera matrix from a camera's axes and centre.

    Args:
        rotation: (3, 3) float64, camera to world; columns are the axes in OpenCV convention.
        position: (3,) float64, the camera's centre in scene units.
        where: The file and entry.

    Returns:
        (4, 4) float64, rigid. Rotations that are orthonormal within `RIGID_TOLERANCE` are inverted
        without orthonormalising them, as in the reference trainer.

    Raises:
        FormatError: The rotation scales, shears or mirrors, or a value is not finite.
    """
    if not is_rotation(rotation):
        raise FormatError(
            f"{where}: its pose is not a rotation and a translation; "
            "export the cameras without scale, shear or mirroring."
        )
    camera_to_world = np.eye(4)
    camera_to_world[:3, :3] = rotation
    camera_to_world[:3, 3] = position
    world_to_camera: F64 = np.linalg.inv(camera_to_world).astype(np.float64, copy=False)
    return world_to_camera


def pinhole(
    where: str,
    name: str,
    size: tuple[int, int],
    focal: tuple[float, float],
    centre: tuple[float, float],
    world_to_camera: F64,
    lens: Lens | None = None,
) -> Camera:
    """Build a camera from intrinsics, which are checked.

    Args:
        where: The file and entry.
        name: Name of the view in reports.
        size: Width and height in pixels.
        focal: Focal lengths fx and fy in pixels.
        centre: Principal point cx and cy, pixels from the image's top left corner.
        world_to_camera: (4, 4) float64, rigid.
        lens: Its lens; one without distortion is dropped.

    Raises:
        FormatError: A focal length is not positive or a value is not finite.
    """
    width, height = (side(value, f"{where}, size") for value in size)
    fx, fy = (number(value, f"{where}, focal length") for value in focal)
    cx, cy = (number(value, f"{where}, principal point") for value in centre)
    if fx <= 0 or fy <= 0:
        raise FormatError(
            f"{where}: its focal length is {min(fx, fy):g} where a positive number of pixels is "
            "needed; export the cameras again."
        )
    bent = lens if lens and lens.bends() else None
    return Camera(width, height, fx, fy, cx, cy, world_to_camera, name, lens=bent)


def refuse_repeats(names: Iterable[object], where: str, noun: str) -> None:
    """Raise a `FormatError` if a name occurs twice, because it would count twice in a mean."""
    seen = set()
    for name in names:
        if name in seen:
            raise FormatError(f"{where}: lists {noun} {name} twice; remove one of the entries.")
        seen.add(name)


def shown(value: object) -> str:
    """Format a value for a message: short, even if it is a whole file's content."""
    if isinstance(value, dict | list):
        return f"a {type(value).__name__} of {len(value)}"
    if isinstance(value, int) and abs(value) > MAX_DISTANCE:
        return "a huge integer"  # Python limits the digits of integers that it prints
    printed = repr(value)
    return printed if len(printed) <= 40 else printed[:37] + "..."

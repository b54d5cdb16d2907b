"""Undistortion: remove lens distortion from photographs, for a pinhole camera."""

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np

from nanogs._types import F32, F64
from nanogs.errors import FormatError
from nanogs.raster.camera import Camera
from nanogs.raster.lens import Lens

_STEP, _STEPS = 1.01, 140  # factors of focal lengths that are tried: powers, up to about 4
_ROWS = 256  # rows of an image that are resampled at a time

Intrinsics = tuple[int, int, float, float, float, float]


def straightened(camera: Camera, where: str) -> Camera:
    """Return the pinhole camera for a camera's undistorted photograph, which has no empty border.

    Pose, size and principal point stay the same. Focal lengths are increased if the undistorted
    photograph would otherwise not cover the whole image.

    Args:
        camera: A camera with a lens; one without is returned unchanged.
        where: The photograph, for the message.

    Raises:
        FormatError: The lens model is not supported, or its distortion is too strong.
    """
    lens = camera.lens
    if lens is None:
        return camera
    if not lens.known:
        raise FormatError(
            f"{where}: the distortion of its camera's lens, {lens.name}, cannot be removed from the"
            " photograph; undistort photographs and cameras with colmap image_undistorter."
        )
    inside = camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy
    zoom = _zoom(lens, inside)
    if zoom is None:
        raise FormatError(
            f"{where}: the distortion of its camera's lens, {lens.name}, is too strong to be"
            " removed from the photograph; undistort photographs and cameras with colmap"
            " image_undistorter."
        )
    return replace(camera, fx=camera.fx * zoom, fy=camera.fy * zoom, lens=None)


def undistorted(photo: F32, camera: Camera, straight: Camera) -> F32:
    """Resample a photograph for the pinhole camera, with bilinear interpolation.

    Args:
        photo: (H, W, C) float32.
        camera: The camera that took it, with its lens.
        straight: The pinhole camera from `straightened`.

    Returns:
        (H, W, C) float32.
    """
    assert camera.lens is not None, "a camera without a lens needs none of this"  # noqa: S101
    out = np.empty_like(photo)
    columns = np.arange(straight.width) + 0.5
    for start in range(0, straight.height, _ROWS):
        rows = np.arange(start, min(start + _ROWS, straight.height)) + 0.5
        u, v = np.meshgrid(columns, rows)
        x, y = (u - straight.cx) / straight.fx, (v - straight.cy) / straight.fy
        x, y = camera.lens.distorted(x, y)
        across, down = x * camera.fx + camera.cx - 0.5, y * camera.fy + camera.cy - 0.5
        out[start : start + len(rows)] = _bilinear(photo, across, down)
    return out


def _bilinear(photo: F32, across: F64, down: F64) -> F32:
    """Interpolate the photograph at coordinates (R, W); pixel centres are integers. (R, W, C)."""
    height, width = photo.shape[:2]
    across, down = np.clip(across, 0, width - 1), np.clip(down, 0, height - 1)
    left, top = across.astype(np.int64), down.astype(np.int64)
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    along = (across - left).astype(np.float32)[..., None]
    below = (down - top).astype(np.float32)[..., None]
    upper = photo[top, left] * (1 - along) + photo[top, right] * along
    lower = photo[bottom, left] * (1 - along) + photo[bottom, right] * along
    result: F32 = upper * (1 - below) + lower * below
    return result


@lru_cache(maxsize=64)
def _zoom(lens: Lens, inside: Intrinsics) -> float | None:
    """Return the least factor of focal lengths for full coverage, or None if none suffices."""
    for step in range(_STEPS):
        if _reaches(lens, inside, _STEP**step):
            return _STEP**step
    return None


def _reaches(lens: Lens, inside: Intrinsics, zoom: float) -> bool:
    """Return whether the photograph covers a pinhole's image at focal lengths times `zoom`."""
    width, height, fx, fy, cx, cy = inside
    u, v = _border(width, height)
    x, y = (u - cx) / (fx * zoom), (v - cy) / (fy * zoom)
    if lens.turns_back(float(np.sqrt(x * x + y * y).max())):
        return False
    bent_x, bent_y = lens.distorted(x, y)
    across, down = bent_x * fx + cx, bent_y * fy + cy
    inner = (across >= 0) & (across <= width) & (down >= 0) & (down <= height)
    return bool(inner.all()) and all(map(math.isfinite, (fx * zoom, fy * zoom)))


def _border(width: int, height: int) -> tuple[F64, F64]:
    """Return the coordinates u and v of the centres of all border pixels."""
    columns, rows = np.arange(width) + 0.5, np.arange(height) + 0.5
    u = np.concatenate([columns, columns, np.full(height, 0.5), np.full(height, width - 0.5)])
    v = np.concatenate([np.full(width, 0.5), np.full(width, height - 0.5), rows, rows])
    return u, v

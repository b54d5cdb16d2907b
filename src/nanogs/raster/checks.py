"""Checks of what a model is rendered with, before any kernel is called: kernels check nothing."""

import numpy as np

from nanogs._types import F32
from nanogs.errors import OptionError
from nanogs.kernels.project import LARGEST
from nanogs.ranges import is_number
from nanogs.raster.camera import Camera

_ROUNDING = 0.01  # largest entry of |RRᵀ - I| of a camera; those of files are nearer


def check_camera(camera: Camera) -> None:
    """Raise an error if a camera cannot be rendered from.

    Raises:
        OptionError: It is no camera, or its size or one of its numbers is invalid.
    """
    if not isinstance(camera, Camera):
        raise OptionError(f"A camera must be a nanogs.Camera, not {type(camera).__name__}.")
    if not (1 <= camera.width <= LARGEST and 1 <= camera.height <= LARGEST):
        raise OptionError(
            f"A camera needs 1 to {LARGEST:,} pixels along each side, not"
            f" {camera.width} x {camera.height}."
        )
    least = min(camera.fx, camera.fy, camera.near, camera.dilation)
    if not (np.isfinite(camera.intrinsics).all() and least > 0):
        raise OptionError(
            f"Camera {camera.name!r} needs finite intrinsics; focal lengths, near and dilation must"
            " be above 0."
        )
    if camera.whole is not None and not min(camera.whole[2:]) > 0:
        raise OptionError(f"Camera {camera.name!r} needs a `whole` picture of a size above 0.")
    if camera.world_to_camera.shape != (4, 4) or not np.isfinite(camera.world_to_camera).all():
        raise OptionError(f"Camera {camera.name!r} needs a finite 4 x 4 world_to_camera.")
    turn, last = camera.world_to_camera[:3, :3], camera.world_to_camera[3]
    if max(np.abs(turn @ turn.T - np.eye(3)).max(), np.abs(last - (0, 0, 0, 1)).max()) > _ROUNDING:
        raise OptionError(
            f"world_to_camera of camera {camera.name!r} is not a rotation and a translation, with"
            " the translation in the last column; give one without scale or shear."
        )


def background_of(background: tuple[float, float, float], *, depth: bool) -> F32:
    """Return the background to blend over, (3,) float32, or (4,) with depth, whose value is 0.

    Raises:
        OptionError: It is not three finite numbers.
    """
    try:
        values = np.array([*background, 0.0], np.float32)
    except (TypeError, ValueError):
        values = np.empty(0, np.float32)  # is refused below
    if values.shape != (4,) or not np.isfinite(values).all():
        raise OptionError(f"background must be three finite numbers, not {background!r}.")
    return values if depth else values[:3]


def evaluated_degree(own: int, sh_degree: int | None) -> int:
    """Return the degree of spherical harmonics to evaluate: at most that of the model.

    Args:
        own: Degree of the model, 0 to 4.
        sh_degree: Degree asked for; None for that of the model.

    Raises:
        OptionError: It is not a whole number of 0 or more.
    """
    if sh_degree is None:
        return own
    if not (is_number(sh_degree, whole=True) and sh_degree >= 0):
        raise OptionError(f"sh_degree must be a whole number of 0 or more, not {sh_degree!r}.")
    return min(int(sh_degree), own)

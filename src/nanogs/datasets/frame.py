"""A camera together with the photograph taken from it."""

from dataclasses import dataclass
from pathlib import Path

from nanogs.raster.camera import Camera


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One view of a data set.

    Attributes:
        camera: The camera, with intrinsics in pixels of the photograph.
        photo_path: The image file, or None if only the camera is known.
        taken_by: The camera with lens distortion that took the photograph, if `camera` is the
            pinhole for the undistorted photograph; else None.
        masked: Whether the data set has a mask of pixels for training, which is not read.
    """

    camera: Camera
    photo_path: Path | None
    taken_by: Camera | None = None
    masked: bool = False

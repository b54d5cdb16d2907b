"""A camera together with the photograph taken from it."""

from dataclasses import dataclass
from pathlib import Path

from nanogs.raster.camera import Camera


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One view of a data set.

    Attributes:
        camera: Its intrinsics are in pixels of the photograph.
        photo_path: The image file, or None where only the camera is known.
        taken_by: The camera with the lens that the photograph was taken through, where `camera` is
            the pinhole that stands in for it.
    """

    camera: Camera
    photo_path: Path | None
    taken_by: Camera | None = None

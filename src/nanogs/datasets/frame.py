"""A camera together with the photograph taken from it."""

from dataclasses import dataclass
from pathlib import Path

from nanogs.render.camera import Camera


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One view of a data set.

    Attributes:
        camera: Its intrinsics are in pixels of the photograph.
        photo_path: The image file, or None where only the camera is known.
    """

    camera: Camera
    photo_path: Path | None

"""Pinhole cameras."""

from dataclasses import dataclass

from nanogs._types import F64

NEAR = 0.2  # the reference rasteriser culls what is nearer, in scene units


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """A pinhole camera in the OpenCV convention: x right, y down, z forward.

    A point p in the world lands at u = fx x/z + cx, v = fy y/z + cy with (x, y, z) = R p + t; the
    centre of the pixel in column i and row j is at (i + 0.5, j + 0.5).

    Attributes:
        width: Image width in pixels.
        height: Image height in pixels.
        fx: Focal length in pixels, horizontally.
        fy: Focal length in pixels, vertically.
        cx: Principal point, pixels from the left edge of the image.
        cy: Principal point, pixels from the top edge of the image.
        world_to_camera: (4, 4) float64, rigid; its upper rows are [R | t], t in scene units.
        name: What reports and files call this view.
        near: Splats whose centre is not farther than this are culled, scene units.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_to_camera: F64
    name: str = ""
    near: float = NEAR

    @property
    def position(self) -> F64:
        """(3,) float64: the camera's centre in scene units."""
        rotation = self.world_to_camera[:3, :3]
        position: F64 = -rotation.T @ self.world_to_camera[:3, 3]
        return position

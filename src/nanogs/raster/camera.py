"""Pinhole cameras."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from nanogs._arrays import as_array
from nanogs._types import F64
from nanogs.errors import ModelError, OptionError
from nanogs.ranges import is_number
from nanogs.raster.lens import Lens, lens_notes

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

Item = TypeVar("Item")

NEAR = 0.2  # scene units; the reference rasteriser culls splats that are nearer
DILATION = 0.3  # pixels²; of the reference rasteriser


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """A pinhole camera in the OpenCV convention: x right, y down, z forward.

    A point p in the world lands at u = fx x/z + cx, v = fy y/z + cy with (x, y, z) = R p + t; the
    centre of the pixel in column i and row j is at (i + 0.5, j + 0.5).

    Numbers may be those of NumPy or tensors of one number, and the matrix may be nested lists or a
    tensor; it is copied.

    Attributes:
        width: Image width in pixels.
        height: Image height in pixels.
        fx: Focal length in pixels, horizontally.
        fy: Focal length in pixels, vertically.
        cx: Principal point, pixels from the left edge of the image.
        cy: Principal point, pixels from the top edge of the image.
        world_to_camera: (4, 4) float64, rigid, or a mirror for a model in a left-handed frame; its
            upper rows are [R | t], t in scene units.
        name: Name of the view in reports and files.
        near: Near plane, scene units: splats whose centre is not farther are culled. Cameras of
            files have the default, 0.2, that of the reference rasteriser.
        lens: Lens distortion of the picture that the camera took; renderers ignore it.
        whole: Principal point, width and height of the whole picture that this view is a crop of,
            pixels; None if it is not a crop. Projections of splats are approximate near the edges
            of a picture; those in a crop are the same as in the whole picture.
        changed_by: Name of the file by which the camera was moved to other coordinates than those
            of the file that it was read from; empty if it was not.
        dilation: Variance, pixels², that rasterisers add to both variances of a splat on screen.
            With f² times the usual value the view shows every n-th pixel, for n = 1 / f, of each
            row and column of a picture n times as large (see `sharpened`).

    Raises:
        OptionError: A field has another type. Values are checked where the camera is used.
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
    lens: Lens | None = None
    whole: tuple[float, float, float, float] | None = None
    changed_by: str = ""
    dilation: float = DILATION

    if TYPE_CHECKING:  # the constructor accepts more types than the fields have

        def __init__(
            self,
            width: int,
            height: int,
            fx: float,
            fy: float,
            cx: float,
            cy: float,
            world_to_camera: ArrayLike,
            name: str = ...,
            near: float = ...,
            lens: Lens | None = ...,
            whole: Sequence[float] | None = ...,
            changed_by: str = ...,
            dilation: float = ...,
        ) -> None: ...

    def __post_init__(self) -> None:
        """Convert numbers to Python's and the matrix to an array, and refuse all else."""
        for name in ("width", "height", "fx", "fy", "cx", "cy", "near", "dilation"):
            object.__setattr__(self, name, self._number(name, getattr(self, name)))
        object.__setattr__(self, "world_to_camera", self._matrix())
        for name in ("name", "changed_by"):
            if not isinstance(getattr(self, name), str):
                raise self._refusal(name, "text", repr(getattr(self, name)))
        if not isinstance(self.lens, Lens | None):
            raise self._refusal("lens", "a nanogs.raster.lens.Lens or None", repr(self.lens))
        if self.whole is not None:
            if not isinstance(self.whole, Iterable):
                raise self._refusal("whole", "four numbers", repr(self.whole))
            whole = tuple(self._number("whole", value) for value in self.whole)
            if len(whole) != 4:
                raise self._refusal("whole", "four numbers", str(whole))
            object.__setattr__(self, "whole", whole)

    def _number(self, name: str, value: Any) -> float:  # noqa: ANN401 - whatever a caller gives
        if getattr(value, "ndim", None) == 0:  # of NumPy, or a tensor
            value = value.item()
        whole = name in ("width", "height")
        if not is_number(value, whole=whole):
            wanted = "a whole number of pixels" if whole else "a number"
            raise self._refusal(name, wanted, repr(value))
        return int(value) if whole else float(value)

    def _matrix(self) -> F64:
        try:
            matrix = as_array("world_to_camera", self.world_to_camera)
        except ModelError as error:
            raise OptionError(str(error)) from None
        if matrix.dtype.kind not in "fiu":
            raise self._refusal("world_to_camera", "a (4, 4) array of numbers", str(matrix.dtype))
        return matrix.astype(np.float64)

    def _refusal(self, name: str, wanted: str, given: str) -> OptionError:
        return OptionError(f"{name} of camera {self.name!r} must be {wanted}, not {given}.")

    @property
    def intrinsics(self) -> F64:
        """(12,) float64 for kernels.

        They are fx, fy, cx, cy, width, height, near, the four of `whole`, which are cx, cy, width
        and height of this view if it is not a crop, and the dilation.
        """
        own = (self.cx, self.cy, self.width, self.height)
        whole = self.whole or own
        return np.array([self.fx, self.fy, *own, self.near, *whole, self.dilation], np.float64)

    @property
    def position(self) -> F64:
        """(3,) float64: the camera's centre in scene units."""
        rotation = self.world_to_camera[:3, :3]
        position: F64 = -rotation.T @ self.world_to_camera[:3, 3]
        return position

    def sharpened(self, factor: float) -> "Camera":
        """Return a view of as many pixels, evenly taken from those of a larger picture.

        Args:
            factor: Width of a pixel of that picture over that of a pixel here, above 0.
        """
        return replace(self, dilation=self.dilation * factor**2)

    def reduced(self, size: int) -> "Camera":
        """Reduce the view to at most `size` pixels along the longer side."""
        factor = size / max(self.width, self.height)
        if factor >= 1:
            return self
        width, height = max(1, round(self.width * factor)), max(1, round(self.height * factor))
        return self.resized(width, height)

    def resized(self, width: int, height: int) -> "Camera":
        """Scale the view to other numbers of pixels; a crop stays the same part of its whole."""
        along, down = width / self.width, height / self.height
        whole = self.whole
        if whole is not None:
            whole = whole[0] * along, whole[1] * down, whole[2] * along, whole[3] * down
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * along,
            fy=self.fy * down,
            cx=self.cx * along,
            cy=self.cy * down,
            whole=whole,
        )

    def cropped(self, left: int, top: int, width: int, height: int) -> "Camera":
        """Crop the view, pixel for pixel.

        Args:
            left: Number of pixels left of the crop.
            top: Number of pixels above the crop.
            width: Width of the crop in pixels.
            height: Height of the crop in pixels.
        """
        return replace(
            self,
            width=width,
            height=height,
            cx=self.cx - left,
            cy=self.cy - top,
            whole=self.whole or (self.cx, self.cy, self.width, self.height),
        )


def camera_notes(cameras: Sequence[Camera]) -> list[str]:
    """Return notes for the user on cameras of files: moved ones, and ignored lens distortion."""
    notes = lens_notes(cameras)
    for file in sorted({camera.changed_by for camera in cameras if camera.changed_by}):
        notes.append(f"Cameras were moved to the coordinates of nerfstudio's model, by {file}.")
    return notes


def split_evenly(items: Sequence[Item], count: int) -> tuple[list[Item], list[Item]]:
    """Split items into at most `count` of them, spread evenly, and all the others."""
    rows = set(pick_evenly(range(len(items)), count))
    return (
        [item for row, item in enumerate(items) if row in rows],
        [item for row, item in enumerate(items) if row not in rows],
    )


def pick_evenly(items: Sequence[Item], count: int) -> list[Item]:
    """Pick at most `count` of the items, spread evenly."""
    n, count = len(items), min(count, len(items))
    return [items[(2 * place + 1) * n // (2 * count)] for place in range(count)]

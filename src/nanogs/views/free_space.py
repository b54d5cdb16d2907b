"""Free space: the positions where a camera may be placed.

A position is free if it is in no opaque splat and is visible from a position known to be free. So
the hollow inside of an object is not free, because it is not visible from outside, and a room is
free if one position in it is.
"""

import numpy as np

from nanogs import parallel
from nanogs._types import F32, F64
from nanogs.raster.camera import Camera
from nanogs.raster.depths import light_by_depth
from nanogs.raster.rendering import PreparedSplats
from nanogs.slices import SLICE_STEPS, slices
from nanogs.views.poses import look_at

# Alpha of a splat from which a position is inside it, and alpha between two positions from which
# they do not see each other.
OPAQUE = 0.5
GUIDES = 3  # number of known free positions from which a new one is tested
PIXELS = 16  # width and height of the image from one position towards another
FOCAL = 80.0  # focal length in pixels: a field of view of 11 degrees
MIDDLE = 4  # width and height in pixels of the centre of an image
FIRM = 2 * np.log(1 / OPAQUE)  # squared radius, in deviations, beyond which alpha is below OPAQUE


class FreeSpace:
    """The known free space of a model, as a list of free positions."""

    def __init__(self, splats: PreparedSplats) -> None:
        """Start without known positions.

        Args:
            splats: The model, N splats.
        """
        self._splats = splats
        self._places: list[F64] = []
        with np.errstate(invalid="ignore", over="ignore"):
            squares = (splats.factors**2).sum(axis=1)  # (N, 3) squared deviations along the axes
            self._reaches = FIRM * squares.max(axis=1, initial=0.0)

    def add(self, place: F64) -> None:
        """Add a position (3,), scene units, that is known to be free."""
        self._places.append(place)

    def has(self, camera: Camera, target: F64) -> bool:
        """Return whether a camera's position is in free space.

        Args:
            camera: The camera to test.
            target: (3,) float64, a point that it sees, scene units. It is tested from the known
                positions whose direction from this point is most similar.
        """
        position = camera.position
        if self._in_splat(position):
            return False
        back = _unit(position - target)
        likely = sorted(self._places, key=lambda place: -float(_unit(place - target) @ back))
        return any(self._sees(camera, place) for place in likely[:GUIDES])

    def _sees(self, camera: Camera, place: F64) -> bool:
        """Return whether half of the light or more from a position (3,) reaches the camera.

        The direction in which the camera looks does not matter.
        """
        position = camera.position
        # A float64 of NumPy, since distances may exceed the depths' float32.
        distance = np.linalg.norm(place - position)
        if distance <= camera.near:
            return True
        pose = look_at(position, place, camera.world_to_camera[1, :3])
        half = PIXELS / 2
        there = Camera(PIXELS, PIXELS, FOCAL, FOCAL, half, half, pose, near=camera.near)
        light = light_by_depth(self._splats, there, [(0.0, float(distance))])
        return bool(middle(light.shares)[0] <= OPAQUE)

    def _in_splat(self, place: F64) -> bool:
        """Return whether a position (3,) is inside a splat, where its alpha is `OPAQUE` or more."""
        splats = self._splats

        def holds(part: slice) -> bool:
            with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
                offsets = (splats.means[part] - place).astype(np.float32)
                near = np.einsum("ni,ni->n", offsets, offsets) <= self._reaches[part]
                rows = np.flatnonzero(near & splats.keep[part])
                factors = splats.factors[part][rows]
                along = np.einsum("nij,ni->nj", factors, offsets[rows]) / (factors**2).sum(axis=1)
                alphas = splats.opacities[part][rows] * np.exp(-(along**2).sum(axis=1) / 2)
            return bool((alphas >= OPAQUE).any())

        return any(parallel.map_ordered(slices(len(splats), SLICE_STEPS), holds))


def middle(image: F32) -> F32:
    """Return the (C,) means over the centre of an image (H, W, C)."""
    top, left = (max(0, (side - MIDDLE) // 2) for side in image.shape[:2])
    part: F32 = image[top : top + MIDDLE, left : left + MIDDLE].mean(axis=(0, 1))
    return part


def _unit(vector: F64) -> F64:
    length = float(np.linalg.norm(vector))
    unit: F64 = vector / length if length else vector
    return unit

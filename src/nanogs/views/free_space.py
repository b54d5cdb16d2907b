"""Free space: where a camera may stand.

A place is free if it is in no opaque splat and one that is known to be free sees it. So the hollow
inside of a thing is not free, as nothing outside sees it, and a room is, if a place in it is.
"""

import numpy as np

from nanogs._types import F32, F64
from nanogs.raster.camera import Camera
from nanogs.raster.rendering import PreparedSplats, blend, project
from nanogs.views.poses import look_at

OPAQUE = 0.5  # alpha from which a place is in a splat, and share of the light that hides a place
GUIDES = 3  # free places that a new one is looked for from
PIXELS = 16  # along each side of the picture from one place to another
FOCAL = 80.0  # pixels: its field of view is 11 degrees
MIDDLE = 4  # pixels along each side of what counts as the middle of a picture
FIRM = 2 * np.log(1 / OPAQUE)  # squared radius, in deviations, beyond which alpha is lower


class FreeSpace:
    """The free space of a model, as far as it is known."""

    def __init__(self, splats: PreparedSplats) -> None:
        """Begin with no place.

        Args:
            splats: The model, N splats.
        """
        self._splats = splats
        self._places: list[F64] = []
        with np.errstate(invalid="ignore", over="ignore"):
            squares = (splats.factors**2).sum(axis=1)  # (N, 3) squared deviations along the axes
            self._reaches = FIRM * squares.max(axis=1, initial=0.0)

    def add(self, place: F64) -> None:
        """Take a place (3,), scene units, for free."""
        self._places.append(place)

    def has(self, camera: Camera, target: F64) -> bool:
        """Whether a camera stands in it.

        Args:
            camera: The camera, whose position is in question.
            target: (3,) float64, a point that it sees, scene units. Those known places are asked
                that see it from nearly the same side.
        """
        position = camera.position
        if self._in_splat(position):
            return False
        back = _unit(position - target)
        likely = sorted(self._places, key=lambda place: -float(_unit(place - target) @ back))
        return any(self._sees(camera, place) for place in likely[:GUIDES])

    def _sees(self, camera: Camera, place: F64) -> bool:
        """Whether half of the light or more comes from a place (3,), wherever the camera looks."""
        position = camera.position
        distance = float(np.linalg.norm(place - position))
        if distance <= camera.near:
            return True
        pose = look_at(position, place, camera.world_to_camera[1, :3])
        half = PIXELS / 2
        there = Camera(PIXELS, PIXELS, FOCAL, FOCAL, half, half, pose, near=camera.near)
        view = project(self._splats, there, sh_degree=0)
        features = np.zeros((len(self._splats), 3), np.float32)
        features[:, 0] = view.features[:, 3] < distance
        image, _, _ = blend(view, there, features, np.zeros(3, np.float32))
        return bool(middle(image)[0] <= OPAQUE)

    def _in_splat(self, place: F64) -> bool:
        """Whether a place (3,) is where a single splat is opaque."""
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            offsets = (self._splats.means - place).astype(np.float32)
            near = np.einsum("ni,ni->n", offsets, offsets) <= self._reaches
            rows = np.flatnonzero(near & self._splats.keep)
            factors = self._splats.factors[rows]
            along = np.einsum("nij,ni->nj", factors, offsets[rows]) / (factors**2).sum(axis=1)
            alphas = self._splats.opacities[rows] * np.exp(-(along**2).sum(axis=1) / 2)
        return bool((alphas >= OPAQUE).any())


def middle(image: F32) -> F32:
    """(C,) means over the middle of an image (H, W, C)."""
    top, left = (max(0, (side - MIDDLE) // 2) for side in image.shape[:2])
    part: F32 = image[top : top + MIDDLE, left : left + MIDDLE].mean(axis=(0, 1))
    return part


def _unit(vector: F64) -> F64:
    length = float(np.linalg.norm(vector))
    unit: F64 = vector / length if length else vector
    return unit

"""Free space: where a camera may stand.

A place is free if it is in no opaque splat and one that is known to be free sees it. So the hollow
inside of a thing is not free, as nothing outside sees it, and a room is, if a place in it is.
"""

from collections.abc import Sequence

import numpy as np

from nanogs._types import F32, F64
from nanogs.render.camera import Camera
from nanogs.render.poses import look_at
from nanogs.render.rasterize import PreparedSplats, blend, project

OPAQUE = 0.5  # alpha from which a place is in a splat, and share of the light that hides a place
GUIDES = 3  # free places that a new one is looked for from
PIXELS = 16  # along each side of the picture from one place to another
FOCAL = 80.0  # pixels: its field of view is 11 degrees
MIDDLE = 4  # pixels along each side of what counts as the middle of a picture
FIRM = 2 * np.log(1 / OPAQUE)  # squared radius, in deviations, beyond which alpha is lower


def in_free_space(
    splats: PreparedSplats, camera: Camera, target: F64, places: Sequence[F64]
) -> bool:
    """Whether a camera stands in free space.

    Args:
        splats: The model.
        camera: The camera, whose position is in question.
        target: (3,) float64, a point that it sees, scene units.
        places: Free places, (3,) float64 each; those that see the target from nearly the same side
            are asked.
    """
    position = camera.position
    if _in_splat(splats, position):
        return False
    back = _unit(position - target)
    likely = sorted(places, key=lambda place: -float(_unit(place - target) @ back))
    return any(sees(splats, camera, place) for place in likely[:GUIDES])


def sees(splats: PreparedSplats, camera: Camera, place: F64) -> bool:
    """Whether half of the light or more comes from a place (3,) to a camera, wherever it looks."""
    position = camera.position
    distance = float(np.linalg.norm(place - position))
    if distance <= camera.near:
        return True
    pose = look_at(position, place, camera.world_to_camera[1, :3])
    half = PIXELS / 2
    there = Camera(PIXELS, PIXELS, FOCAL, FOCAL, half, half, pose, near=camera.near)
    view = project(splats, there)
    features = np.zeros((len(splats), 3), np.float32)
    features[:, 0] = view.features[:, 3] < distance
    image, _, _ = blend(view, there, features, np.zeros(3, np.float32))
    return bool(middle(image)[0] <= OPAQUE)


def middle(image: F32) -> F32:
    """(C,) means over the middle of an image (H, W, C)."""
    top, left = (max(0, (side - MIDDLE) // 2) for side in image.shape[:2])
    part: F32 = image[top : top + MIDDLE, left : left + MIDDLE].mean(axis=(0, 1))
    return part


def _in_splat(splats: PreparedSplats, place: F64) -> bool:
    """Whether a place (3,) is where a single splat is opaque."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        offsets = (splats.means - place).astype(np.float32)
        squares = (splats.factors**2).sum(axis=1)  # (N, 3) squared deviations along the axes
        near = (offsets**2).sum(axis=1) <= FIRM * squares.max(axis=1)
        rows = np.flatnonzero(near & splats.keep)
        along = np.einsum("nij,ni->nj", splats.factors[rows], offsets[rows])
        depths = (along**2 / squares[rows] ** 2).sum(axis=1)
        alphas = splats.opacities[rows] * np.exp(-depths / 2)
    return bool((alphas >= OPAQUE).any())


def _unit(vector: F64) -> F64:
    length = float(np.linalg.norm(vector))
    unit: F64 = vector / length if length else vector
    return unit

"""Roaming cameras, as of viewers who walk freely: anywhere in free space, near objects and far.

A target is drawn among the splats with a probability proportional to its light in the images so far
(those of automatic views, and of the cameras already found): so insides of rooms are found as well
as outsides of objects, and hidden splats are never a target. The camera is placed in a random
direction from the target, at a log-uniform distance, and is kept if

- its image shows the target in the centre,
- nothing is very near the camera, and enough of the image is covered,
- it is in free space (see `free_space`).

All lengths and directions are relative to the model's own extent and frame (see `up_frame`):
moving, turning or scaling a model does the same to its cameras.
"""

import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from nanogs._types import F64, Bool
from nanogs.card.device import CPU, use_device
from nanogs.errors import ModelError, OptionError
from nanogs.raster.camera import Camera
from nanogs.raster.depths import light_by_depth
from nanogs.raster.light import light_in_view
from nanogs.raster.rendering import PreparedSplats, prepare
from nanogs.splats import Splats, refuse_other
from nanogs.views.automatic import automatic_cameras, check_views, survey
from nanogs.views.free_space import FreeSpace, middle
from nanogs.views.poses import look_at

FOV = 60.0  # degrees, along the longer side
NEAREST, FARTHEST = 0.12, 1.5  # distance from the target over the radius
HELD = 0.9  # share of the splats within the radius
AWAY = 2.5  # largest distance of cameras from the centre in radii, even if a sky is farther
TRIES = 60  # for each requested camera
SEEDS = 16  # number of automatic views that the search starts with
SIZE = 96  # pixels along the longer side of the images that candidates are tested by
HIT = 0.5  # least share of the light in the centre that comes from about the target's depth
ABOUT = 0.1  # tolerance of that depth over the distance of the target
HUGGING = 0.2  # depth over the distance of the target below which splats are too near the camera
HUGGED = 0.05  # largest share of the image that such splats may hide
COVERED = 1 / 3  # least share of the image that shows splats
NEAR = 0.02  # near plane over the distance of the target


@dataclass(frozen=True, slots=True, eq=False)
class SearchedModel:
    """The model and its extent, for the search.

    Attributes:
        splats: N splats, activated.
        centre: (3,) float64, median of the splats in the core, scene units.
        radius: Distance from the centre that holds 90 % of them, scene units, more than 0.
        frame: (3, 3) float64, axes of the model's own frame as rows, up last.
        reachable: (N,) bool, splats near enough to be a target.
    """

    splats: PreparedSplats
    centre: F64
    radius: float
    frame: F64
    reachable: Bool


@dataclass(slots=True)
class SearchState:
    """The state of the search.

    Attributes:
        weights: (N,) light of each splat, summed over the images so far; that of each image is
            normalised to a sum of 1.
        free: The known free space.
        cameras: The cameras found.
    """

    weights: F64
    free: FreeSpace
    cameras: list[Camera]


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A camera to be tested.

    Attributes:
        camera: The camera.
        target: (3,) float64, centre of the splat that it looks at, scene units.
        distance: Distance of the camera from the target, scene units.
    """

    camera: Camera
    target: F64
    distance: float


def roaming_cameras(
    splats: Splats,
    count: int = 24,
    *,
    width: int = 512,
    height: int = 512,
    fov: float | None = None,
    up: Sequence[float] | None = None,
    split: str = "fit",
) -> list[Camera]:
    """Draw random cameras from the free space in which the model is visible, near and far.

    The same arguments give the same cameras, and the first n cameras of a larger set are the
    smaller set.

    Args:
        splats: The model, N splats.
        count: Number of cameras, 1 or more.
        width: Width of the images, in pixels.
        height: Height of the images, in pixels.
        fov: Field of view along the longer side, in degrees; 60 by default.
        up: (3,) up direction of the images in scene coordinates; by default the model's own (see
            `up_frame.frame_from_model`).
        split: Name that seeds the random numbers: other names give other cameras. "test" is
            reserved for measuring results, so nothing may be fitted to it.

    Returns:
        At most `count` cameras named `fit_roam_000` and so on, after `split`: fewer if not enough
        were found in `TRIES` tries for each.

    Raises:
        ModelError: It is no `Splats`, no splat is visible, or no camera was found.
        OptionError: An argument is out of range.
    """
    refuse_other(splats)
    if not isinstance(split, str):
        raise OptionError(f"The split of views must be a name, not {split!r}.")
    check_views(count, width, height, fov)
    small = _small_camera(width, height, FOV if fov is None else fov)
    scene = _scene(splats, up)
    with use_device(CPU):  # the rounding of another device can find other cameras
        known = _begin(scene, splats, up, split)
        for candidate in _candidates(scene, known, small, split, TRIES * count):
            _add_if_accepted(scene, known, candidate)
            if len(known.cameras) == count:
                break
    if not known.cameras:
        raise ModelError(
            f"No roaming view was found in {TRIES * count:,} tries, because nothing fills a third"
            " of a picture from any place in free space; choose automatic views or give cameras."
        )
    return [
        replace(camera.resized(width, height), name=f"{split}_roam_{i:03}")
        for i, camera in enumerate(known.cameras)
    ]


def _small_camera(width: int, height: int, fov: float) -> Camera:
    """Make a camera, at the origin, with few pixels in all, as candidates are tested by."""
    focal = SIZE / 2 / np.tan(np.radians(fov) / 2)
    wide, high = (max(1, round(side * SIZE / max(width, height))) for side in (width, height))
    along, down = (side * SIZE / max(width, height) for side in (width, height))
    return Camera(
        wide, high, focal * wide / along, focal * high / down, wide / 2, high / 2, np.eye(4)
    )


def _scene(splats: Splats, up: Sequence[float] | None) -> SearchedModel:
    """Measure the model's frame, centre and radius."""
    found = survey(splats, "orbit", up, habit=False)
    rows, turn = found.core.rows, found.turn[:3, :3]  # without skies and strays
    points = found.sampled.points[rows]
    extents = np.linalg.norm(found.sampled.arms[rows, 0], axis=1)
    median = np.median(points, axis=0)
    radius = float(np.quantile(np.linalg.norm(points - median, axis=1) + extents, HELD)) or 1.0
    centre = median @ turn
    with np.errstate(invalid="ignore"):
        distances = np.linalg.norm(splats.means.astype(np.float64) - centre, axis=1)
        reachable = distances <= (AWAY + FARTHEST) * radius
    return SearchedModel(prepare(splats), centre, radius, turn, reachable)


def _begin(
    scene: SearchedModel, splats: Splats, up: Sequence[float] | None, split: str
) -> SearchState:
    """Start the search with automatic views, whose positions are known to be free."""
    known = SearchState(np.zeros(len(splats)), FreeSpace(scene.splats), [])
    automatic = automatic_cameras(
        splats, SEEDS, width=SIZE, height=SIZE, up=up, habit=False,
        split="test" if split == "test" else "fit",
    )  # fmt: skip
    for camera in automatic:
        _add(known, camera.position, light_in_view(scene.splats, camera).contributions())
    return known


def _add(known: SearchState, place: F64, contributions: F64) -> None:
    """Add a free position, and the contributions (N,) of the splats to the image from there."""
    total = contributions.sum()
    if total > 0:
        known.weights += contributions / total
        known.free.add(place)


def _candidates(
    scene: SearchedModel, known: SearchState, small: Camera, split: str, tries: int
) -> Iterator[Candidate]:
    """Draw candidates: targets, directions and distances; `known` may grow during the iteration.

    Args:
        scene: The model.
        known: The state of the search.
        small: The camera, from `_small_camera`, that is placed.
        split: Seeds the random numbers.
        tries: Number of candidates to draw; those too far away are left out.
    """
    random = np.random.default_rng(zlib.crc32(split.encode()))
    found, summed = -1, np.zeros(1)
    for draw in random.random((tries, 4)):
        if len(known.cameras) != found:
            found, summed = len(known.cameras), np.cumsum(known.weights * scene.reachable)
        if not summed[-1] > 0:
            return
        row = int(np.searchsorted(summed, draw[0] * summed[-1], side="right"))
        target = scene.splats.means[row].astype(np.float64)
        distance = scene.radius * NEAREST * (FARTHEST / NEAREST) ** draw[3]
        position = target + distance * _direction(draw[1], draw[2]) @ scene.frame
        if np.linalg.norm(position - scene.centre) <= AWAY * scene.radius:
            pose = look_at(position, target, scene.frame[2])
            camera = replace(small, world_to_camera=pose, near=NEAR * distance)
            yield Candidate(camera, target, distance)


def _direction(height: float, turn: float) -> F64:
    """Map two numbers in [0, 1) to a (3,) unit direction, uniform over the sphere."""
    z, angle = 2 * height - 1, 2 * np.pi * turn
    level = np.sqrt(1 - z * z)
    return np.array([level * np.cos(angle), level * np.sin(angle), z])


def _add_if_accepted(scene: SearchedModel, known: SearchState, candidate: Candidate) -> None:
    """Test a candidate, and add its camera to the state if it passes."""
    contributions, camera = _shown(scene.splats, candidate), candidate.camera
    if contributions is not None and known.free.has(camera, candidate.target):
        known.cameras.append(camera)
        _add(known, camera.position, contributions)


def _shown(splats: PreparedSplats, candidate: Candidate) -> F64 | None:
    """Render a candidate; return the contributions (N,), or None if the image is rejected."""
    distance = candidate.distance
    ranges = [((1 - ABOUT) * distance, (1 + ABOUT) * distance), (0.0, HUGGING * distance)]
    image = light_by_depth(splats, candidate.camera, ranges, contributions=True)
    hit = middle(image.shares)[0] >= HIT
    free = image.shares[..., 1].mean() <= HUGGED and image.alpha.mean() >= COVERED
    return image.contributions if hit and free else None

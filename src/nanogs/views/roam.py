"""Cameras of viewers who walk freely: anywhere in free space, near to things and far from them.

A target is drawn among the splats, each as likely as it has weight in the pictures so far (those of
automatic views, and of the views already found): so insides of rooms are found as well as outsides
of things, and what nothing shows is never looked at. The camera stands in a direction drawn from
the whole sphere, at a distance drawn evenly in its logarithm, and is kept if

- the target is what its picture shows in the middle,
- nothing hugs the lens, and enough of the picture is covered,
- it stands in free space (see `free_space`).

All is measured in the model's own extent and frame (see `stance`): moving, turning or scaling a
model does the same to its cameras.
"""

import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from nanogs._types import F64, Bool
from nanogs.errors import ModelError, OptionError
from nanogs.progress import Parts, untold
from nanogs.raster.camera import Camera
from nanogs.raster.rendering import PreparedSplats, blend, prepare, project, render
from nanogs.splats import Splats
from nanogs.views.automatic import automatic_cameras, survey
from nanogs.views.free_space import FreeSpace, middle
from nanogs.views.poses import look_at

FOV = 60.0  # degrees, of the longer side
NEAREST, FARTHEST = 0.12, 1.5  # from the target, over the radius
HELD = 0.9  # share of the splats within the radius
AWAY = 2.5  # radii from the middle within which cameras stand, however far away a sky is
TRIES = 60  # for each camera asked for
SEEDS = 16  # automatic views that the search begins with
SIZE = 96  # pixels along the longer side of the pictures that candidates are judged by
HIT = 0.5  # share of the light in the middle that comes from about the target's depth, at least
ABOUT = 0.1  # of the distance, before and behind the target
LENS = 0.2  # of the distance: what is nearer to the camera than this hugs the lens
HUGGED = 0.05  # share of the picture that may be hidden by that
COVERED = 1 / 3  # share of the picture that shows something, at least
NEAR = 0.02  # near plane over the distance


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """A model as the search sees it.

    Attributes:
        splats: N splats, activated.
        centre: (3,) float64, the middle of those in the core, scene units.
        radius: Distance from there that holds 90 % of them, scene units, more than 0.
        frame: (3, 3) float64, the model's own directions in rows, up last.
        reachable: (N,) bool, splats near enough to be looked at from where cameras may stand.
    """

    splats: PreparedSplats
    centre: F64
    radius: float
    frame: F64
    reachable: Bool


@dataclass(slots=True)
class Known:
    """The findings of the search so far.

    Attributes:
        weights: (N,) float64, light of each splat in the pictures so far, where that of a picture
            adds up to 1.
        free: Free space.
        cameras: The views found.
    """

    weights: F64
    free: FreeSpace
    cameras: list[Camera]


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A view that may be kept.

    Attributes:
        camera: The view.
        target: (3,) float64, the centre of what it looks at, scene units.
        distance: From there to the camera, scene units.
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
    fov: float = FOV,
    up: Sequence[float] | None = None,
    split: str = "fit",
    tell: Parts = untold,
) -> list[Camera]:
    """Draw cameras from all free space from which something of the model is seen, near and far.

    The same arguments give the same cameras, and the first n of a larger set are the smaller.

    Args:
        splats: The model, N splats.
        count: Number of cameras, 1 or more.
        width: Of the images, in pixels.
        height: Of the images, in pixels.
        fov: Field of view along the longer side, in degrees.
        up: (3,) direction in scene coordinates that is up in the images; by default the model's own
            (see `stance.own_stance`).
        split: Name that all that is drawn depends on: other names have other cameras. "test" is
            what results are judged by, so nothing may be learnt from it.
        tell: Told of the cameras found.

    Returns:
        At most `count` cameras named `fit_roam_000` and so on: fewer where so few were found in
        `TRIES` tries for each.

    Raises:
        ModelError: No splat is visible, or no camera was found.
        OptionError: An argument is out of range.
    """
    lens = _lens(count, width, height, fov)
    scene = _scene(splats, up)
    known = _begin(scene, splats, up, split)
    for candidate in _candidates(scene, known, lens, split, TRIES * count):
        if _keeps(scene, known, candidate):
            tell(len(known.cameras), count)
        if len(known.cameras) == count:
            break
    if not known.cameras:
        raise ModelError(
            f"No roaming view was found in {TRIES * count:,} tries: from no free place something"
            " fills a third of a picture; choose automatic views or give cameras."
        )
    return [
        replace(camera.resized(width, height), name=f"{split}_roam_{i:03}")
        for i, camera in enumerate(known.cameras)
    ]


def _lens(count: int, width: int, height: int, fov: float) -> Camera:
    """The camera, at the origin, with the few pixels that candidates are judged by."""
    if count < 1 or width < 1 or height < 1:
        raise OptionError(
            f"Cameras need a count and a size of 1 or more, not {count} of {width} x {height}."
        )
    if not 1 <= fov <= 170:
        raise OptionError(f"The field of view must be 1 to 170 degrees, not {fov}.")
    focal = SIZE / 2 / np.tan(np.radians(fov) / 2)
    wide, high = (max(1, round(side * SIZE / max(width, height))) for side in (width, height))
    along, down = (side * SIZE / max(width, height) for side in (width, height))
    return Camera(
        wide, high, focal * wide / along, focal * high / down, wide / 2, high / 2, np.eye(4)
    )


def _scene(splats: Splats, up: Sequence[float] | None) -> Scene:
    """Measure the model."""
    found = survey(splats, "orbit", up, habit=False)
    rows, turn = found.core.rows, found.turn[:3, :3]  # without skies and strays
    points = found.matter.points[rows]
    extents = np.linalg.norm(found.matter.arms[rows, 0], axis=1)
    middle = np.median(points, axis=0)
    radius = float(np.quantile(np.linalg.norm(points - middle, axis=1) + extents, HELD)) or 1.0
    centre = middle @ turn
    with np.errstate(invalid="ignore"):
        distances = np.linalg.norm(splats.means.astype(np.float64) - centre, axis=1)
        reachable = distances <= (AWAY + FARTHEST) * radius
    return Scene(prepare(splats), centre, radius, turn, reachable)


def _begin(scene: Scene, splats: Splats, up: Sequence[float] | None, split: str) -> Known:
    """Look at the model from automatic views, whose places are free."""
    known = Known(np.zeros(len(splats)), FreeSpace(scene.splats), [])
    automatic = automatic_cameras(
        splats, SEEDS, width=SIZE, height=SIZE, up=up, habit=False,
        split="test" if split == "test" else "fit",
    )  # fmt: skip
    for camera in automatic:
        view = render(scene.splats, camera, contributions=True, sh_degree=0, here=True)
        assert view.contributions is not None  # noqa: S101 - asked for
        _add(known, camera.position, view.contributions)
    return known


def _add(known: Known, place: F64, contributions: F64) -> None:
    """Note a place as free, and weigh splats by their light in the picture from there."""
    total = contributions.sum()
    if total > 0:
        known.weights += contributions / total
        known.free.add(place)


def _candidates(
    scene: Scene, known: Known, lens: Camera, split: str, tries: int
) -> Iterator[Candidate]:
    """Draw targets, directions and distances; what is known may grow meanwhile."""
    random = np.random.default_rng(zlib.crc32(split.encode()))
    for draw in random.random((tries, 4)):
        summed = np.cumsum(known.weights * scene.reachable)
        if not summed[-1] > 0:
            return
        row = int(np.searchsorted(summed, draw[0] * summed[-1], side="right"))
        target = scene.splats.means[row].astype(np.float64)
        distance = scene.radius * NEAREST * (FARTHEST / NEAREST) ** draw[3]
        position = target + distance * _direction(draw[1], draw[2]) @ scene.frame
        if np.linalg.norm(position - scene.centre) <= AWAY * scene.radius:
            pose = look_at(position, target, scene.frame[2])
            camera = replace(lens, world_to_camera=pose, near=NEAR * distance)
            yield Candidate(camera, target, distance)


def _direction(height: float, turn: float) -> F64:
    """(3,) unit: the point of the sphere for two numbers in [0, 1), even over its area."""
    z, angle = 2 * height - 1, 2 * np.pi * turn
    level = np.sqrt(1 - z * z)
    return np.array([level * np.cos(angle), level * np.sin(angle), z])


def _keeps(scene: Scene, known: Known, candidate: Candidate) -> bool:
    """Keep a candidate if it shows what it should from free space."""
    contributions = _shown(scene.splats, candidate)
    camera = candidate.camera
    if contributions is None or not known.free.has(camera, candidate.target):
        return False
    known.cameras.append(camera)
    _add(known, camera.position, contributions)
    return True


def _shown(splats: PreparedSplats, candidate: Candidate) -> F64 | None:
    """(N,) light of each splat in the picture; None for one that is not to be kept."""
    camera, distance = candidate.camera, candidate.distance
    view = project(splats, camera, sh_degree=0)
    depths = view.features[:, 3]
    features = np.ones((len(depths), 3), np.float32)
    with np.errstate(invalid="ignore"):  # rows that are not drawn hold junk
        features[:, 0] = np.abs(depths - distance) <= ABOUT * distance
        features[:, 1] = depths < LENS * distance
    ones = np.ones((1, camera.height, camera.width), np.float32)
    image, _, totals = blend(view, camera, features, np.zeros(3, np.float32), ones)
    hit = middle(image)[0] >= HIT
    free = image[..., 1].mean() <= HUGGED and image[..., 2].mean() >= COVERED
    return totals[:, 0] if hit and free else None

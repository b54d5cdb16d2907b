"""Automatic cameras for a model without any: around objects, inside rooms.

All lengths are relative to the model's extent and all directions to its own frame, so that moving,
scaling or turning a model does the same to its cameras, provided that the up direction turns too
(see `up_frame`). Directions come from one low-discrepancy sequence, whose even members are for
fitting and whose odd members are for testing: the two sets are disjoint, and the first n cameras of
a larger set are the smaller set.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from nanogs._types import F64, I64
from nanogs.errors import OptionError
from nanogs.ranges import is_number
from nanogs.raster.camera import Camera
from nanogs.source import Source, refuse_no_model, source_of
from nanogs.splats import Splats
from nanogs.views import inside, orbit
from nanogs.views.heading import seen_from, without_surroundings
from nanogs.views.occupancy import Core, SplatSample, find_core, sample
from nanogs.views.poses import UP
from nanogs.views.up import detect_up, stated_up
from nanogs.views.up_frame import ALL_AROUND, UPRIGHT, frame_from_model, frame_from_up

Kind = Literal["auto", "orbit", "inside"]
Split = Literal["fit", "test"]

ORBIT_FOV = 50.0  # degrees, along the longer side
INSIDE_FOV = 75.0


@dataclass(frozen=True, slots=True)
class Survey:
    """Analysis of a model, by which cameras are placed.

    Attributes:
        sampled: A sample of its visible splats, in the model's own frame.
        core: The dense part of the sample, without surroundings and strays, in that frame.
        orbit: What cameras around it look at, in that frame.
        turn: (4, 4) float64, from scene coordinates to that frame, in which up is along z.
        kind: Kind of cameras: "orbit" or "inside".
        band: Lowest and highest elevation of cameras around it, radians.
    """

    sampled: SplatSample
    core: Core
    orbit: orbit.Orbit
    turn: F64
    kind: Kind
    band: tuple[float, float]

    @property
    def looks_all_around(self) -> bool:
        """Whether its cameras look at the model from all around, from above and below too."""
        return self.kind == "orbit" and self.band == ALL_AROUND


def automatic_cameras(
    model: Splats | Source,
    count: int = 8,
    *,
    width: int = 512,
    height: int = 512,
    kind: Kind = "auto",
    up: Sequence[float] | F64 | None = None,
    habit: bool = True,
    fov: float | None = None,
    split: Split = "fit",
) -> list[Camera]:
    """Choose cameras from the model alone; the same arguments give the same cameras.

    With `auto` a model is taken as a room, and viewed from inside, if most of its area is in the
    six outer slabs of a box (turned about `up` to fit best), in four of them or more and not mostly
    in one, with some area well inside. All other models are viewed from around, at a range of
    distances: some views crop the model, some show it whole with its surroundings (see `orbit`).
    Skies and strays far away are ignored (see `occupancy.find_core`). If something near the camera
    blocks a view, the camera is moved nearer and higher.

    Args:
        model: The model, or a source, which is read twice and gives the same cameras.
        count: Number of cameras, 1 or more.
        width: Width of the images, in pixels.
        height: Height of the images, in pixels.
        kind: `orbit` or `inside`, or `auto` to let the model decide.
        up: (3,) up direction in scene coordinates, of any length; by default away from the ground
            that the model stands on if it is clear, else z if its comments state that it is
            vertical, else (0, -1, 0) (see `up.detect_up`).
        habit: Without `up`, whether to search for it along the axes only, with the usual direction
            if nothing is clear, as for images to look at. If False, the model alone decides, in any
            direction, and cameras are placed all around it if nothing is clear: turning any model
            then turns its cameras (see `up_frame.frame_from_model`).
        fov: Field of view along the longer side, in degrees; by default 50 around and 75 inside.
        split: `fit` and `test` give disjoint sets that cover the same ground.

    Returns:
        `count` cameras named `fit_000` and so on, after `split`; `near` is set to the scale of the
        scene.

    Raises:
        FormatError: The source cannot be read.
        ModelError: No splat is visible, so that every view would be empty.
        OptionError: An argument is out of range.
    """
    check_views(count, width, height, fov)
    if split not in ("fit", "test"):
        raise OptionError(f"The split of views must be fit or test, not {split!r}.")
    scene = survey(model, kind, up, habit=habit)
    return cameras_of(scene, range(count), width, height, fov=fov, split=split)


def cameras_of(
    scene: Survey,
    numbers: Sequence[int],
    width: int,
    height: int,
    *,
    fov: float | None = None,
    split: Split = "fit",
) -> list[Camera]:
    """Return cameras of the sequence of `automatic_cameras` for a model that is analysed already.

    Args:
        scene: The analysis.
        numbers: Their numbers in the sequence, 0 or more.
        width: Width of the images, in pixels.
        height: Height of the images, in pixels.
        fov: Field of view along the longer side, degrees; by default that of the kind.
        split: Half of the sequence that they are taken from.
    """
    angle = np.radians(fov or (ORBIT_FOV if scene.kind == "orbit" else INSIDE_FOV))
    focal = max(width, height) / 2 / np.tan(angle / 2)
    tangents = np.array([width, height]) / 2 / focal  # tangents of half the fields of view
    members = 2 * np.array(numbers, np.int64) + (split == "test")
    return [
        Camera(
            width, height, focal, focal, width / 2, height / 2, pose @ scene.turn,
            f"{split}_{number:03}", near,
        )
        for number, (pose, near) in zip(numbers, _poses(scene, tangents, members), strict=True)
    ]  # fmt: skip


def _poses(scene: Survey, tangents: F64, numbers: I64) -> list[tuple[F64, float]]:
    if scene.kind == "orbit":
        return orbit.poses(scene.orbit, tangents, numbers, scene.band)
    return inside.poses(scene.sampled, scene.core, tangents, numbers)


def survey(
    model: Splats | Source,
    kind: Kind = "auto",
    up: Sequence[float] | F64 | None = None,
    *,
    habit: bool = True,
) -> Survey:
    """Analyse a model for `automatic_cameras`, whose arguments it takes.

    Raises:
        ModelError: No splat is visible.
        OptionError: An argument is out of range.
    """
    if kind not in ("auto", "orbit", "inside"):
        raise OptionError(f"The kind of views must be auto, orbit or inside, not {kind!r}.")
    refuse_no_model(model)
    given = None if up is None else unit_up(up)
    sampled = sample(model)
    if given is not None:
        camera_frame = frame_from_up(without_surroundings(sampled), given)
    elif habit:
        usual = stated_up(source_of(model).columns.comments)
        camera_frame = frame_from_up(
            without_surroundings(sampled), detect_up(sampled, find_core(sampled), usual)
        )
    else:
        camera_frame = frame_from_model(sampled, room=kind != "orbit")
    turn = np.eye(4)
    turn[:3, :3] = camera_frame.frame
    sampled = seen_from(sampled, camera_frame.frame)
    core = find_core(sampled)
    if kind == "auto":
        room = camera_frame.band == UPRIGHT and inside.is_room(sampled, core, UP)
        kind = "inside" if room else "orbit"
    return Survey(sampled, core, orbit.find_orbit(sampled, core), turn, kind, camera_frame.band)


def all_around(scene: Survey) -> Survey:
    """Return an analysis that places cameras around the model at all elevations.

    So they see a ground from below, and a room from outside.
    """
    return replace(scene, kind="orbit", band=ALL_AROUND)


def check_views(count: int, width: int, height: int, fov: float | None) -> None:
    """Refuse views that cannot be found, whatever the model.

    Raises:
        OptionError: The count or the size is no whole number, the field of view, degrees, is no
            number, or one of them is out of range.
    """
    whole = (is_number(value, whole=True) and value >= 1 for value in (count, width, height))
    if not all(whole):
        raise OptionError(
            "Cameras need a count and a size of 1 or more, in whole numbers, not"
            f" {count!r} of {width!r} x {height!r}."
        )
    if fov is not None and not (is_number(fov) and 1 <= fov <= 170):
        raise OptionError(f"The field of view must be 1 to 170 degrees, not {fov!r}.")


def unit_up(up: Sequence[float] | F64) -> F64:
    """Normalise a direction to (3,) float64 of length 1.

    Raises:
        OptionError: It is not three finite numbers, or all are zero.
    """
    try:
        given = np.array(up, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        given = np.empty(0)  # refused below
    if given.shape != (3,) or not np.isfinite(given).all() or not given.any():
        raise OptionError(f"Up must be three finite numbers, not all zero, not {up!r}.")
    given = np.ldexp(given, -np.frexp(np.abs(given).max())[1])  # squares stay in range
    unit: F64 = given / np.linalg.norm(given)
    return unit

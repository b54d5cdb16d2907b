"""Cameras for a model that came without any: around objects, inside rooms.

Everything is measured in the model's own extent and in its own frame, so moving, scaling or turning
a model does the same to its cameras, as long as which way is up turns too.
Directions come from one low-discrepancy sequence, whose even members are for fitting and whose odd
members are for testing: the two sets are disjoint, and the first n of a larger set are the smaller.
"""

from collections.abc import Sequence
from typing import Literal

import numpy as np

from nanogs._types import F64
from nanogs.errors import OptionError
from nanogs.render import inside, orbit
from nanogs.render.camera import Camera
from nanogs.render.heading import model_frame, seen_from
from nanogs.render.occupancy import find_core, sample
from nanogs.render.up import detect_up
from nanogs.splats import Splats

Kind = Literal["auto", "orbit", "inside"]
Split = Literal["fit", "test"]

UP = (0.0, 0.0, 1.0)  # in the model's own frame
ORBIT_FOV = 50.0  # degrees, of the longer side
INSIDE_FOV = 75.0


def automatic_cameras(
    splats: Splats,
    count: int = 8,
    *,
    width: int = 512,
    height: int = 512,
    kind: Kind = "auto",
    up: Sequence[float] | F64 | None = None,
    fov: float | None = None,
    split: Split = "fit",
) -> list[Camera]:
    """Choose cameras from the model alone; the same arguments give the same cameras.

    `auto` takes a model for a room, and looks from inside, where its area lies mostly in the six
    outer slabs of a box (turned about `up` as fits best), in four of them or more and in none
    alone, with some matter well inside; all else is looked at from around, from a range of
    distances: some views cut it off, some show it whole with what surrounds it (see `orbit`). Skies
    and splats that fly far away do not count (see `occupancy.find_core`). A view that something
    near the camera blocks is moved nearer and higher.

    Args:
        splats: The model, N splats.
        count: Number of cameras, 1 or more.
        width: Of the images, in pixels.
        height: Of the images, in pixels.
        kind: `orbit` or `inside` to choose, `auto` to let the model decide.
        up: (3,) direction in scene coordinates, of any length; by default away from the ground the
            model stands on where one is clear, else (0, -1, 0) (see `up.detect_up`).
        fov: Field of view along the longer side, in degrees; by default 50 around and 75 inside.
        split: `fit` and `test` give disjoint sets that cover the same ground.

    Returns:
        `count` cameras named `fit_000` and so on; `near` is set to the scale of the scene.

    Raises:
        ModelError: No splat is visible, so that every view would be empty.
        OptionError: An argument is out of range.
    """
    _check(count, width, height, kind, fov, split)
    given = None if up is None else _unit(up)
    matter = sample(splats)
    upward = detect_up(matter, find_core(matter)) if given is None else given
    turn = np.eye(4)
    turn[:3, :3] = model_frame(matter, upward)
    matter = seen_from(matter, turn[:3, :3])
    core = find_core(matter)
    if kind == "auto":
        kind = "inside" if inside.is_room(matter, core, np.array(UP)) else "orbit"
    angle = np.radians(fov or (ORBIT_FOV if kind == "orbit" else INSIDE_FOV))
    focal = max(width, height) / 2 / np.tan(angle / 2)
    lens = np.array([width, height]) / 2 / focal  # tangents of half the fields of view
    numbers = 2 * np.arange(count) + (split == "test")
    place = orbit.poses if kind == "orbit" else inside.poses
    return [
        Camera(width, height, focal, focal, width / 2, height / 2, pose @ turn, name, near)
        for name, (pose, near) in zip(
            (f"{split}_{i:03}" for i in range(count)),
            place(matter, core, np.array(UP), lens, numbers),
            strict=True,
        )
    ]


def _check(count: int, width: int, height: int, kind: str, fov: float | None, split: str) -> None:
    if count < 1 or width < 1 or height < 1:
        raise OptionError(
            f"Cameras need a count and a size of 1 or more, not {count} of {width} x {height}."
        )
    if kind not in ("auto", "orbit", "inside"):
        raise OptionError(f"The kind of views is auto, orbit or inside, not {kind!r}.")
    if split not in ("fit", "test"):
        raise OptionError(f"The split of views is fit or test, not {split!r}.")
    if fov is not None and not 1 <= fov <= 170:
        raise OptionError(f"The field of view must be 1 to 170 degrees, not {fov}.")


def _unit(up: Sequence[float] | F64) -> F64:
    given = np.array(up, dtype=np.float64)
    if given.shape != (3,) or not np.isfinite(given).all() or not given.any():
        raise OptionError(f"Up must be three finite numbers, not all zero, not {up}.")
    unit: F64 = given / np.linalg.norm(given)
    return unit

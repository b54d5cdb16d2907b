from dataclasses import replace

import numpy as np
import pytest

from conftest import scene_path
from nanogs.datasets.synthetic import make_scene
from nanogs.io import load
from nanogs.splats import Splats
from nanogs.views.automatic import automatic_cameras
from nanogs.views.occupancy import find_core, sample
from nanogs.views.up import detect_up

SCENE = make_scene(6_000)  # on a floor, up is (0, -1, 0)
# Rotations wxyz, and the direction that each turns (0, -1, 0) to.
HALF = 0.5**0.5
TURNS = {
    (1, 0, 0, 0): (0, -1, 0),
    (0, 1, 0, 0): (0, 1, 0),
    (HALF, -HALF, 0, 0): (0, 0, 1),
    (HALF, HALF, 0, 0): (0, 0, -1),
    (HALF, 0, 0, HALF): (1, 0, 0),
    (HALF, 0, 0, -HALF): (-1, 0, 0),
}


def matrix(quat) -> np.ndarray:
    w, x, y, z = quat
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def turned(splats: Splats, quat) -> Splats:
    """Return the model's geometry rotated; its colours do not matter here."""
    a, v = quat[0], np.array(quat[1:])
    b, w = splats.quats[:, :1], splats.quats[:, 1:]
    quats = np.hstack([a * b - w @ v[:, None], a * w + b * v + np.cross(v, w)])
    return replace(
        splats,
        means=(splats.means @ matrix(quat).T).astype(np.float32),
        quats=quats.astype(np.float32),
    )


def up_of(splats: Splats) -> np.ndarray:
    sampled = sample(splats)
    return detect_up(sampled, find_core(sampled))


@pytest.mark.parametrize(("quat", "up"), TURNS.items())
def test_up_is_found_for_a_scene_on_a_floor(quat, up):
    assert np.allclose(matrix(quat) @ (0, -1, 0), up)
    model = turned(SCENE, quat)
    assert (up_of(model) == up).all()
    for camera in automatic_cameras(model, 3):
        assert camera.world_to_camera[1, :3] @ np.array(up) < -0.8, "y of an image points down"


def test_up_does_not_depend_on_position_and_size():
    model = turned(SCENE, (HALF, -HALF, 0, 0))
    moved = replace(
        model,
        means=model.means * np.float32(1e-3) + np.float32(0.1),
        log_scales=model.log_scales + np.float32(np.log(1e-3)),
    )
    assert (up_of(moved) == (0, 0, 1)).all()


def test_without_a_ground_up_is_the_usual_direction():
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(4_000, 3)).astype(np.float32)
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    for points in (ball, ball * np.float32([1, 1, 3]), ball[:1], ball[:2]):
        part = SCENE.take(np.arange(len(points)))
        scales = np.full((len(points), 3), -4, np.float32)
        assert (up_of(replace(part, means=points, log_scales=scales)) == (0, -1, 0)).all()


def test_a_table_top_among_other_things_is_not_taken_for_the_ground():
    rng = np.random.default_rng(1)
    n = 2_000
    top = rng.uniform(-1, 1, (n, 3)) * (1, 1, 0.01)  # lies in z
    things = rng.uniform(-1, 1, (n, 3)) * (1, 1, 1)  # above and below
    model = replace(
        SCENE.take(np.arange(2 * n)),
        means=np.concatenate([top, things]).astype(np.float32),
        log_scales=np.tile(np.log(np.float32([0.05, 0.05, 0.001])), (2 * n, 1)),
        quats=np.tile(np.float32([1, 0, 0, 0]), (2 * n, 1)),
    )
    assert (up_of(model) == (0, -1, 0)).all()


def test_the_side_of_a_thick_hedge_is_not_taken_for_the_ground():
    """Leaves face z, most of them inside: no layer is thin, and the lowest is no ground either."""
    rng = np.random.default_rng(3)
    layers = [*range(240, 300, 6), *range(300, 0, -30)]  # leaves in each
    n = sum(layers)
    within = np.concatenate([np.linspace(0, 1, leaves) for leaves in layers])
    depths = (np.repeat(np.arange(len(layers)), layers) + within) / 10
    model = replace(
        SCENE.take(np.arange(n)),
        means=np.column_stack([rng.uniform(-1, 1, (n, 2)), depths]).astype(np.float32),
        log_scales=np.tile(np.log(np.float32([0.05, 0.05, 0.001])), (n, 1)),
        quats=np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
    )
    assert (up_of(model) == (0, -1, 0)).all()


def test_a_ceiling_of_more_area_than_the_floor_is_not_taken_for_it():
    """A plain ceiling has few large splats, a floor with a pattern many small ones."""
    rng = np.random.default_rng(2)
    n = 2_000
    heights = np.repeat([0.0, -2.8], n) + rng.normal(0, 0.005, 2 * n)  # y down: floor, ceiling
    means = np.stack([rng.uniform(-3, 3, 2 * n), heights, rng.uniform(-2, 2, 2 * n)], axis=1)
    things = rng.uniform((-3, -1, -2), (3, -0.1, 2), (n, 3))
    scales = np.log(np.repeat(np.float32([0.05, 0.058, 0.02]), n))
    model = replace(
        SCENE.take(np.arange(3 * n) % len(SCENE)),
        means=np.concatenate([means, things]).astype(np.float32),
        log_scales=np.stack([scales, scales, scales - 3], axis=1),
        quats=np.tile(np.float32([HALF, HALF, 0, 0]), (3 * n, 1)),
        opacity_logits=np.full(3 * n, 3, np.float32),
    )
    assert (up_of(model) == (0, -1, 0)).all()
    assert (up_of(turned(model.take(np.arange(n, 3 * n)), (0, 1, 0, 0))) == (0, -1, 0)).all()


@pytest.mark.parametrize(
    "name", ["biker.compressed.ply", "guitar.compressed.ply", "plant.splat", "seal.splat"]
)
def test_real_scenes_with_the_usual_up_keep_it(name):
    assert (up_of(load(scene_path(name))) == (0, -1, 0)).all()

"""Up and camera placement found from the model alone: they follow any rotation of the model."""

from dataclasses import replace

import numpy as np
import pytest

import reference_kernels as reference
from conftest import scene_path
from nanogs.datasets.synthetic import make_scene
from nanogs.io import load
from nanogs.views.automatic import automatic_cameras, survey
from nanogs.views.occupancy import sample
from nanogs.views.up_frame import ALL_AROUND, UPRIGHT, frame_from_model
from test_views import ball, cloud, product, room

SCENE = make_scene(6_000)  # on a floor, up is (0, -1, 0)
TURNS = [(1, 0, 0, 0), (0.5, -0.1, 0.7, 0.5), (0, 1, 0, 0), (-0.2, 0.9, -0.3, 0.1)]


def matrix(quat):
    return reference.rotation_matrix(np.array(quat) / np.linalg.norm(quat))


def turned(model, quat):
    """Return the model's geometry rotated, in double precision; its colours do not matter here."""
    quats = product(np.array(quat) / np.linalg.norm(quat), model.quats.astype(np.float64))
    return replace(model, means=model.means @ matrix(quat).T, quats=quats.astype(np.float32))


def land(seed=0):
    """A wide, uneven layer of round splats without a flat ground; its heights are along x."""
    rng = np.random.default_rng(seed)
    heights = rng.gamma(1.5, 0.15, 6_000)
    return cloud(np.stack([heights, *rng.uniform(-1, 1, (2, 6_000))], axis=1), 0.05)


def flat_room():
    """`room` with flat splats that lie in its walls; the splats of the table are round."""
    points = room()
    axis = np.argmax(np.abs(points) / (3.0, 1.5, 2.0), axis=1)
    thin = np.full((len(points), 3), 0.05)
    walls = np.abs(points / (3.0, 1.5, 2.0)).max(axis=1) > 0.999
    thin[walls, axis[walls]] = 0.005
    return replace(cloud(points), log_scales=np.log(thin).astype(np.float32))


def degrees(one, other):
    return np.degrees(np.arccos(np.clip(np.dot(one, other), -1, 1)))


@pytest.mark.parametrize("quat", TURNS)
@pytest.mark.parametrize(
    ("model", "up", "kind"),
    [
        (SCENE, (0, -1, 0), "orbit"),
        (land(), (1, 0, 0), "orbit"),
        (flat_room(), (0, -1, 0), "inside"),
    ],
    ids=["ground", "land", "room"],
)
def test_up_is_found_for_any_rotation_of_the_model(model, up, kind, quat):
    found = survey(turned(model, quat), habit=False)
    assert degrees(found.turn[2, :3], matrix(quat) @ up) < 6
    assert (found.kind, found.band) == (kind, UPRIGHT)


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 1, 3), (1, 2, 3)])
def test_cameras_surround_a_model_without_a_clear_up(shape):
    model = cloud(ball() * shape)
    assert frame_from_model(sample(model), room=True).band == ALL_AROUND
    positions = np.array([c.position for c in automatic_cameras(model, 24, habit=False)])
    directions = positions / np.linalg.norm(positions, axis=1, keepdims=True)
    aimed = np.random.default_rng(0).normal(size=(200, 3))
    aimed /= np.linalg.norm(aimed, axis=1, keepdims=True)
    nearest = (aimed @ directions.T).max(axis=1)
    assert np.degrees(np.arccos(nearest.min())) < 55, "no direction is far from a camera"


@pytest.mark.parametrize(
    ("model", "kind"),
    [
        (SCENE, "auto"),
        (SCENE, "inside"),
        (land(), "auto"),
        (cloud(ball() * (1, 2, 3)), "auto"),  # from inside, all its views are equally good
        (flat_room(), "auto"),
        (flat_room(), "orbit"),
    ],
    ids=["ground", "ground inside", "land", "ball", "room", "room orbit"],
)
def test_cameras_turn_with_the_model(model, kind):
    quat = TURNS[1]
    exact = replace(model, means=model.means.astype(np.float64))
    before = automatic_cameras(exact, 6, kind=kind, habit=False)
    after = automatic_cameras(turned(exact, quat), 6, kind=kind, habit=False)
    for one, other in zip(before, after, strict=True):
        assert np.allclose(matrix(quat) @ one.position, other.position, atol=1e-4)
        moved = one.world_to_camera[:3, :3] @ matrix(quat).T
        assert np.allclose(moved, other.world_to_camera[:3, :3], atol=1e-4)


REAL = {
    "seal.splat": (0, -1, 0),  # stands on a ground
    "biker.compressed.ply": None,  # objects cut out of their scenes
    "guitar.compressed.ply": None,
    "plant.splat": None,
    "chair.splat": None,
    "skull.sog": None,
    "kitchen.spz": (0, 1, 0),  # a room
}


@pytest.mark.parametrize("name", REAL)
def test_real_scenes_have_the_expected_up_or_none(name):
    found = survey(load(scene_path(name)), habit=False)
    if REAL[name] is None:
        assert found.band == ALL_AROUND
    else:
        assert found.band == UPRIGHT
        assert degrees(found.turn[2, :3], REAL[name]) < 6

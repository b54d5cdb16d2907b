"""Roaming cameras: free space, near and far, the same however the model is moved."""

from dataclasses import replace

import numpy as np
import pytest

from nanogs.errors import ModelError, OptionError
from nanogs.render.rasterize import prepare, render
from nanogs.render.roam import roaming_cameras
from test_views import SCENE, ball, cloud, product, room


@pytest.fixture(scope="module")
def found():
    return roaming_cameras(SCENE, 6, split="test")


def test_what_they_show_is_in_the_middle_and_nothing_hugs_the_lens(found):
    prepared = prepare(SCENE)
    for camera in found:
        view = render(prepared, camera.reduced(96), depth=True)
        assert view.alpha.mean() >= 0.33
        assert view.alpha[46:50, 46:50].mean() > 0.5
        assert np.isfinite(view.depth[46:50, 46:50]).any()


def test_they_are_named_rigid_and_of_the_size_asked_for():
    for i, camera in enumerate(roaming_cameras(SCENE, 2, width=320, height=200, fov=60)):
        turn = camera.world_to_camera[:3, :3]
        assert np.allclose(turn @ turn.T, np.eye(3), atol=1e-12)
        assert (camera.width, camera.height, camera.cx, camera.cy) == (320, 200, 160, 100)
        assert camera.fx == pytest.approx(160 / np.tan(np.radians(30)), rel=0.02)
        assert camera.name == f"fit_roam_{i:03}"


def test_the_size_of_the_pictures_moves_no_camera(found):
    small = roaming_cameras(SCENE, 3, width=64, height=64, split="test")
    for one, other in zip(found[:3], small, strict=True):
        assert (one.world_to_camera == other.world_to_camera).all()


def test_the_same_cameras_again_and_fewer_are_the_first(found):
    for one, other in zip(roaming_cameras(SCENE, 3, split="test"), found[:3], strict=True):
        assert one.world_to_camera.tobytes() == other.world_to_camera.tobytes()
        assert one.near == other.near


@pytest.mark.parametrize("split", ["fit", "decide"])
def test_nothing_is_drawn_that_judges(found, split):
    for camera in roaming_cameras(SCENE, 6, split=split):
        assert min(np.linalg.norm(camera.position - other.position) for other in found) > 1e-3


def test_distances_are_near_and_far():
    points = ball(6_000)
    distances = [
        np.linalg.norm(points - camera.position, axis=1).min()
        for camera in roaming_cameras(cloud(points, 0.04), 12)
    ]
    assert min(distances) < 0.3
    assert max(distances) > 0.8


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_moving_turning_and_scaling_the_scene_does_so_to_the_cameras(found, scale):
    w, x, y, z = quat = np.array([0.5, -0.1, 0.7, 0.5])
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn = np.eye(3) + 2 * (w * cross + cross @ cross) / (quat @ quat)
    shift = scale * np.array([3.0, -2.0, 1.0])
    moved = replace(
        SCENE,
        means=scale * SCENE.means.astype(np.float64) @ turn.T + shift,
        log_scales=(SCENE.log_scales + np.log(scale)).astype(np.float32),
        quats=product(quat, SCENE.quats).astype(np.float32),
    )
    for before, after in zip(found, roaming_cameras(moved, 6, split="test"), strict=True):
        expected = scale * turn @ before.position + shift
        assert np.allclose(after.position, expected, atol=1e-3 * scale)
        assert np.allclose(
            after.world_to_camera[:3, :3], before.world_to_camera[:3, :3] @ turn.T, atol=1e-3
        )
        assert after.near == pytest.approx(scale * before.near, rel=1e-3)


def test_the_hollow_inside_of_a_thing_is_not_looked_from():
    for camera in roaming_cameras(cloud(ball(6_000), 0.05), 12):
        assert np.linalg.norm(camera.position) > 1


def test_a_room_is_looked_at_from_inside():
    points = room(20_000)
    for camera in roaming_cameras(cloud(points, 0.06), 12):
        assert (np.abs(camera.position) < (3.0, 1.5, 2.0)).all()


def test_where_nothing_fills_a_picture_it_is_said():
    haze = cloud(ball(300), size=0.1, logit=-3.0)
    with pytest.raises(ModelError, match="No roaming view was found in 120 tries"):
        roaming_cameras(haze, 2)


@pytest.mark.parametrize("bad", [{"count": 0}, {"width": 0}, {"fov": 0.0}, {"fov": float("nan")}])
def test_bad_arguments_are_refused(bad):
    with pytest.raises(OptionError):
        roaming_cameras(SCENE, **bad)

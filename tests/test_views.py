from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from builders import random_splats
from conftest import scene_path
from nanogs.activations import rotation_about
from nanogs.datasets.synthetic import make_scene
from nanogs.errors import ModelError, OptionError
from nanogs.raster.rendering import render
from nanogs.splats import Splats
from nanogs.views import inside
from nanogs.views.automatic import automatic_cameras, unit_up
from nanogs.views.inside import is_room
from nanogs.views.occupancy import find_core, sample
from nanogs.views.poses import look_along, look_at, low_discrepancy

SCENE = make_scene(6_000)


def cloud(points: np.ndarray, size: float = 0.02, logit: float = 3.0) -> Splats:
    n = len(points)
    return Splats(
        means=points.astype(np.float32),
        log_scales=np.full((n, 3), np.log(size), np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
        opacity_logits=np.full(n, logit, np.float32),
        sh=np.zeros((n, 1, 3), np.float32),
    )


def ball(n: int = 4_000, radius: float = 1.0, seed: int = 0) -> np.ndarray:
    points = np.random.default_rng(seed).normal(size=(n, 3))
    return radius * points / np.linalg.norm(points, axis=1, keepdims=True)


def room(n: int = 12_000, seed: int = 0) -> np.ndarray:
    """Six walls of a room of 6 x 3 x 4 and a table in it."""
    rng = np.random.default_rng(seed)
    walls = rng.uniform(-1, 1, (n, 3))
    axis = rng.choice(3, n, p=[0.25, 0.4, 0.35])
    walls[np.arange(n), axis] = rng.choice([-1.0, 1.0], n)
    table = rng.uniform(-1, 1, (n // 10, 3)) * (0.2, 0.2, 0.2) + (0.2, 0.3, 0.0)
    return np.concatenate([walls, table]) * (3.0, 1.5, 2.0)


def pixels(camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    rotation, shift = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    x, y, z = (points @ rotation.T + shift).T
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    return np.stack([u, v], axis=1), z


def test_the_same_model_gives_the_same_cameras():
    first, second = automatic_cameras(SCENE, 4), automatic_cameras(SCENE, 4)
    for one, other in zip(first, second, strict=True):
        assert one.world_to_camera.tobytes() == other.world_to_camera.tobytes()
        assert one.near == other.near


@pytest.mark.parametrize("model", [SCENE, cloud(room())], ids=["orbit", "inside"])
@pytest.mark.parametrize("split", ["fit", "test"])
def test_cameras_are_valid_pinhole_cameras_with_names(model, split):
    for i, camera in enumerate(automatic_cameras(model, 5, width=320, height=200, split=split)):
        pose = camera.world_to_camera
        assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
        assert (pose[3] == (0, 0, 0, 1)).all()
        assert (camera.width, camera.height, camera.cx, camera.cy) == (320, 200, 160, 100)
        assert camera.fx == camera.fy > 0
        assert camera.name == f"{split}_{i:03}"
        assert camera.near > 0


@pytest.mark.parametrize("kind", ["orbit", "inside"])
def test_splits_are_disjoint_and_prefixes_stable(kind):
    fit = automatic_cameras(SCENE, 6, kind=kind)
    test = automatic_cameras(SCENE, 6, kind=kind, split="test")
    for camera in fit:
        assert min(np.linalg.norm(camera.position - other.position) for other in test) > 1e-3
    for short, long in zip(automatic_cameras(SCENE, 3, kind=kind), fit, strict=False):
        assert (short.world_to_camera == long.world_to_camera).all()


@pytest.mark.parametrize("size", [(512, 512), (640, 200), (200, 640)])
def test_an_object_is_seen_from_near_and_far_for_any_image_shape(size):
    points = ball() + (0, 7, 0)
    filled, cut = [], []
    for camera in automatic_cameras(cloud(points), 24, width=size[0], height=size[1]):
        uv, z = pixels(camera, points)
        assert (z > camera.near).all()
        cut.append(((uv < 0) | (uv > size)).any(axis=1).mean())
        filled.append((np.ptp(uv, axis=0) / min(size)).max())
    assert min(cut) == 0, "some show all of it"
    assert 0.05 < np.mean(cut) < 0.3
    assert min(filled) > 0.6, "none from so far that little is seen"
    assert max(filled) > 1.2, "some are near"


@pytest.mark.parametrize("kind", ["orbit", "inside"])
@pytest.mark.parametrize("size", [(240, 120), (120, 240), (240, 240)])
def test_the_field_of_view_is_that_along_the_longer_side(kind, size):
    width, height = size
    [camera] = automatic_cameras(SCENE, 1, kind=kind, fov=60, width=width, height=height)
    assert camera.fx == camera.fy == pytest.approx(120 / np.tan(np.radians(30)))


@pytest.mark.parametrize(("kind", "usual"), [("orbit", 50), ("inside", 75)])
def test_the_field_of_view_is_the_usual_one_of_its_kind_or_from_1_to_170(kind, usual):
    for fov, degrees in ((None, usual), (1, 1), (170, 170)):
        [camera] = automatic_cameras(SCENE, 1, kind=kind, fov=fov)
        assert np.degrees(2 * np.arctan(camera.width / 2 / camera.fx)) == pytest.approx(degrees)


def test_the_ground_around_an_object_is_seen_and_hardly_from_below():
    rng = np.random.default_rng(0)
    ground = rng.uniform(-1, 1, (6_000, 3)) * (3.0, 0.01, 3.0)
    thing = ball(4_000, 0.5, 1) + (0, -0.5, 0)
    scene = np.concatenate([ground, thing])
    visible_shares, beneath = [], 0
    for camera in automatic_cameras(cloud(scene), 24):
        uv, z = pixels(camera, ground)
        visible_shares.append(((z > camera.near) & ((uv > 0) & (uv < 512)).all(axis=1)).mean())
        flat = np.linalg.norm(camera.position[[0, 2]])
        beneath += camera.position[1] > flat * np.tan(np.radians(16))
    assert np.mean(visible_shares) > 0.5, "tightly framed, less than half of the ground is seen"
    assert beneath == 0


def test_orbit_directions_surround_the_object():
    cameras = automatic_cameras(cloud(ball()), 24)
    directions = np.array([camera.position for camera in cameras])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    headings = np.sort(np.arctan2(directions[:, 2], directions[:, 0]))
    assert np.diff(headings).max() < 1.0
    assert directions[:, 1].min() < np.sin(np.radians(-25)), "some look down from above, y-down"
    assert 0 < directions[:, 1].max() < np.sin(np.radians(16)), "and few a little upwards"


def test_cameras_stand_upright_for_the_given_up():
    for up in ([0, -1, 0], [0, 0, 2], [1, 1, 0]):
        unit = np.array(up) / np.linalg.norm(up)
        for camera in automatic_cameras(SCENE, 4, up=up):
            assert camera.world_to_camera[0, :3] @ unit == pytest.approx(0, abs=1e-9)
            assert camera.world_to_camera[1, :3] @ unit < 0


@settings(max_examples=12, deadline=None)
@given(
    st.floats(-3, 3),
    st.tuples(*[st.floats(-1, 1)] * 3),
    st.sampled_from(["orbit", "inside"]),
)
def test_moving_and_scaling_the_scene_moves_the_cameras(power, direction, kind):
    scale = 10.0**power
    shift = np.array(direction) * scale
    exact = replace(SCENE, means=SCENE.means.astype(np.float64))
    moved = replace(
        exact,
        means=exact.means * scale + shift,
        log_scales=(exact.log_scales + np.log(scale)).astype(np.float32),
    )
    pairs = zip(
        automatic_cameras(exact, 3, kind=kind), automatic_cameras(moved, 3, kind=kind), strict=True
    )
    for before, after in pairs:
        assert np.allclose(
            after.position, before.position * scale + shift, rtol=1e-3, atol=0.01 * scale
        )
        assert after.near == pytest.approx(before.near * scale, rel=1e-3)


def test_stray_splats_and_a_sky_do_not_move_the_cameras():
    points = ball()
    rng = np.random.default_rng(1)
    strays = np.concatenate([ball(400, 300.0, 2), rng.normal(size=(20, 3)) * 1e6])
    both = cloud(np.concatenate([points, strays]))
    both.log_scales[len(points) :] += 5
    for alone, among in zip(
        automatic_cameras(cloud(points), 6), automatic_cameras(both, 6), strict=True
    ):
        assert np.linalg.norm(alone.position - among.position) < 0.2


def test_rooms_are_seen_from_inside_and_objects_from_outside():
    for camera in automatic_cameras(cloud(room()), 8):
        assert (np.abs(camera.position) < (3.0, 1.5, 2.0)).all()
    for camera in automatic_cameras(cloud(ball()), 8):
        assert np.linalg.norm(camera.position) > 1.5
    for camera in automatic_cameras(cloud(room()), 4, kind="orbit"):
        assert (np.abs(camera.position) > (3.0, 1.5, 2.0)).any()


def test_an_empty_box_and_a_walled_yard_are_no_rooms():
    ground = np.random.default_rng(0).uniform(-1, 1, (15_000, 3)) * (3.0, 0, 2.0) + (0, 1.5, 0)
    yard = np.concatenate([room(), ground])
    askew = room() @ rotation_about(1, np.radians(35)).T
    cases = ((room(), True), (askew, True), (room()[:12_000], False), (yard, False))
    for points, expected in cases:
        sampled = sample(cloud(points))
        assert is_room(sampled, find_core(sampled), np.array([0.0, -1, 0])) == expected


def test_a_turned_room_is_still_a_room():
    turn = np.array([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]])
    for camera in automatic_cameras(cloud(room() @ turn.T), 4):
        assert (np.abs(camera.position @ turn) < (3.0, 1.5, 2.0)).all()


def test_cameras_inside_keep_a_distance_from_walls():
    points = room()
    for camera in automatic_cameras(cloud(points), 8):
        uv, z = pixels(camera, points)
        ahead = (z > 0) & ((uv > 0) & (uv < 512)).all(axis=1)
        distance = np.linalg.norm(points[ahead] - camera.position, axis=1)
        assert np.quantile(distance, 0.05) > 0.5


def test_cameras_inside_look_along_the_room_and_not_at_the_table_before_them():
    model = cloud(room(30_000), size=0.04)
    for camera in automatic_cameras(model, 6, width=64, height=64):
        assert np.median(render(model, camera, depth=True).depth) > 1.5


def test_cameras_inside_are_at_eye_level_and_look_a_little_down():
    box = inside.Box(np.eye(3), np.zeros(3), np.array([4.0, 4.0, 2.0]), np.zeros(6), 0.0)
    for draw, side, height, pitch in (
        (0, 0.12, 0.3, -25),
        (0.5, 0.5, 0.55, -7.5),
        (1, 0.88, 0.8, 10),
    ):
        pose = inside._candidate(box, np.full(5, float(draw)))
        assert -pose[:3, :3].T @ pose[:3, 3] == pytest.approx([4 * side, 4 * side, 2 * height])
        assert pose[2, 2] == pytest.approx(np.sin(np.radians(pitch)))


def test_views_inside_are_best_if_they_are_deep_and_open_and_nothing_is_very_near():
    far, near, beyond = 1.0, 0.1, np.inf
    hits = [[far] * 4, [0.5] * 4, [far, far, far, beyond], [far, far, beyond, beyond]]
    hits += [[near, far, far, far], [0.3, far, far, far]]
    scores = inside._scores(np.array(hits), 1.0)
    assert scores == pytest.approx([1.2, 0.95, 1.2, 1.0, -0.05, 0.95])


def test_a_wall_beside_the_object_does_not_block_the_view():
    side = np.linspace(-1, 1, 20)
    wall = np.stack([*np.meshgrid(side, side), np.full((20, 20), 0.95)], axis=2).reshape(-1, 3)
    both = cloud(np.concatenate([ball(40_000, 0.5), wall]))
    both.log_scales[-len(wall) :] = np.log(0.08)
    for camera in automatic_cameras(both, 24):
        x, y, z = camera.position
        crossing = np.abs([x, y]) * 0.95 / max(z, 0.95)
        assert z < 0.95 or crossing.max() > 0.8, "the wall stands between"


def test_tiny_models_have_cameras():
    for count in (1, 2, 3):
        for size in (1e-6, 1.0, 1e4):
            for camera in automatic_cameras(cloud(np.zeros((count, 3)), size), 2):
                assert np.isfinite(camera.world_to_camera).all()
                assert camera.near > 0
    for camera in automatic_cameras(make_scene(1), 2, kind="inside"):
        assert np.isfinite(camera.world_to_camera).all()


def test_points_without_an_extent_are_seen_from_some_distance():
    point = cloud(np.zeros((3, 3)))
    point.log_scales[:] = -np.inf
    far = cloud(np.full((3, 3), 1e7), 1e-9)  # coordinates are finer than 1e-9 times their size
    for model, least in ((point, 1.0), (far, 0.01)):
        for camera in automatic_cameras(model, 4, kind="orbit"):
            assert 1 < np.linalg.norm(camera.position - model.means[0]) / least < 4
            assert camera.near > 0
    walls = cloud(room(1000))
    walls.log_scales[:] = -np.inf
    for camera in automatic_cameras(walls, 2, kind="inside"):
        assert (np.abs(camera.position) < (3.0, 1.5, 2.0)).all()


def test_a_model_without_visible_splats_is_refused():
    nan = cloud(ball(10))
    nan.means[:] = np.nan
    for model in (cloud(ball(10), logit=-9.0), cloud(np.zeros((0, 3))), nan):
        with pytest.raises(ModelError, match="shows nothing"):
            automatic_cameras(model)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"count": 0}, "not 0 of 512 x 512"),
        ({"width": 0}, "of 0 x 512"),
        ({"kind": "around"}, "not 'around'"),
        ({"split": "train"}, "not 'train'"),
        ({"fov": 0.0}, r"field of view .* not 0\.0"),
        ({"fov": float("nan")}, "field of view .* not nan"),
        ({"count": 2.5}, r"whole numbers, not 2\.5 of 512 x 512"),
        ({"count": "8"}, "whole numbers, not '8' of 512 x 512"),
        ({"width": 64.0}, r"whole numbers, not 8 of 64\.0 x 512"),
        ({"height": None}, "whole numbers, not 8 of 512 x None"),
        ({"fov": "60"}, "field of view .* not '60'"),
        ({"up": [0, 0, 0]}, "Up must be"),
        ({"up": [0, 1]}, "Up must be"),
    ],
)
def test_bad_arguments_are_refused(arguments, message):
    with pytest.raises(OptionError, match=message):
        automatic_cameras(SCENE, **arguments)


@pytest.mark.parametrize("length", [1e-300, 1e-200, 1e200, 1.7e308])
def test_the_length_of_the_up_direction_does_not_matter(length):
    up = np.array([1.0, -2.0, 0.5])
    assert np.allclose(unit_up(up / 2 * length), unit_up(up), rtol=1e-15, atol=0)


def test_looking_straight_down_has_a_pose():
    pose = look_at(np.array([0.0, -5.0, 0.0]), np.zeros(3), np.array([0.0, -1.0, 0.0]))
    assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3))
    assert np.allclose(pose @ [0, 0, 0, 1], [0, 0, 5, 1])


@pytest.mark.filterwarnings("error")
def test_cameras_have_a_direction_however_far_away_they_are():
    up = np.array([0.0, 0.0, 1.0])
    for position in (np.zeros(3), np.full(3, 1e30)):
        pose = look_at(position, position, up)
        assert np.isfinite(pose).all()
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
        along = look_along(position, np.array([0.6, 0.8, 0.0]), up)
        np.testing.assert_allclose(along[2, :3], [0.6, 0.8, 0.0])


def test_the_low_discrepancy_sequence_is_even():
    values = low_discrepancy(np.arange(64), 2)
    counts, _, _ = np.histogram2d(*values.T, bins=4, range=[[0, 1], [0, 1]])
    assert counts.min() >= 2


@pytest.mark.parametrize("name", ["plant.splat", "chair.splat", "seal.splat"])
def test_real_objects_are_seen_from_around(name):
    rows = np.fromfile(
        scene_path(name), [("mean", "<f4", 3), ("scale", "<f4", 3), ("rest", "u1", 8)]
    )
    model = replace(cloud(rows["mean"]), log_scales=np.log(rows["scale"]))
    for camera in automatic_cameras(model, 4):
        uv, z = pixels(camera, rows["mean"].astype(np.float64))
        inside = (z > camera.near) & ((uv > 0) & (uv < 512)).all(axis=1)
        assert inside.mean() > 0.4


@pytest.mark.parametrize("kind", ["orbit", "inside"])
def test_turning_the_scene_and_up_turns_the_cameras(kind):
    exact = replace(SCENE, means=SCENE.means.astype(np.float64))
    w, x, y, z = quat = np.array([0.5, -0.1, 0.7, 0.5])
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn = np.eye(3) + 2 * (w * cross + cross @ cross) / (quat @ quat)
    quats = product(quat, exact.quats).astype(np.float32)
    turned = replace(exact, means=exact.means @ turn.T, quats=quats)
    up = np.array([0.1, -1.0, 0.0])
    before = automatic_cameras(exact, 6, kind=kind, up=up)
    after = automatic_cameras(turned, 6, kind=kind, up=turn @ up)
    for one, other in zip(before, after, strict=True):
        assert np.allclose(one.position @ turn.T, other.position, atol=1e-5)
        moved = one.world_to_camera[:3, :3] @ turn.T
        assert np.allclose(moved, other.world_to_camera[:3, :3], atol=1e-5)


def product(a, b):
    """Quaternion a times each row of b, wxyz."""
    v, w = a[1:], b[:, 1:]
    scalars = a[0] * b[:, :1] - w @ v[:, None]
    return np.hstack([scalars, a[0] * w + b[:, :1] * v + np.cross(np.broadcast_to(v, w.shape), w)])


@pytest.mark.parametrize("count", [5, 8, 10, 20])
def test_a_few_splats_are_not_taken_for_a_room(count):
    """A few splats may lie near the faces of a box by chance; views from inside show nothing."""
    for seed in range(8):
        rng = np.random.default_rng(seed)
        splats = random_splats(count, degree=0)
        splats.means[:] = rng.normal(size=(count, 3))
        for camera in automatic_cameras(splats, 8, width=32, height=32, split="test"):
            assert render(splats, camera).alpha.max() > 0

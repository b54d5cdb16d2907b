"""Roaming cameras: free space, near and far views, and how they follow the moved model."""

from dataclasses import replace

import numpy as np
import pytest

import nanogs
from conftest import CARD
from nanogs.card.device import engine_in_use, use_device
from nanogs.errors import ModelError, OptionError
from nanogs.raster.depths import light_by_depth
from nanogs.raster.rendering import prepare, render
from nanogs.splats import concatenate
from nanogs.views import roam
from nanogs.views.automatic import automatic_cameras
from nanogs.views.cameras import cameras_for
from nanogs.views.free_space import FreeSpace, middle
from nanogs.views.roam import roaming_cameras
from test_views import SCENE, ball, cloud, product, room


@pytest.fixture(scope="module")
def found():
    return roaming_cameras(SCENE, 6, split="test")


def test_roaming_views_have_opaque_content_in_their_centre(found):
    prepared = prepare(SCENE)
    for camera in found:
        view = render(prepared, camera.reduced(96), depth=True)
        assert view.alpha.mean() >= 0.33
        assert view.alpha[46:50, 46:50].mean() > 0.5
        assert np.isfinite(view.depth[46:50, 46:50]).any()


def test_cameras_have_names_rigid_poses_and_the_requested_size():
    for i, camera in enumerate(roaming_cameras(SCENE, 2, width=320, height=200, fov=60)):
        turn = camera.world_to_camera[:3, :3]
        assert np.allclose(turn @ turn.T, np.eye(3), atol=1e-12)
        assert (camera.width, camera.height, camera.cx, camera.cy) == (320, 200, 160, 100)
        assert camera.fx == pytest.approx(160 / np.tan(np.radians(30)), rel=0.02)
        assert camera.name == f"fit_roam_{i:03}"


def test_image_size_does_not_change_the_poses(found):
    small = roaming_cameras(SCENE, 3, width=64, height=64, split="test")
    for one, other in zip(found[:3], small, strict=True):
        assert (one.world_to_camera == other.world_to_camera).all()


def test_cameras_are_deterministic_and_fewer_are_the_first_ones(found):
    for one, other in zip(roaming_cameras(SCENE, 3, split="test"), found[:3], strict=True):
        assert one.world_to_camera.tobytes() == other.world_to_camera.tobytes()
        assert one.near == other.near


def test_cameras_of_different_splits_differ(found):
    """Test views are used for nothing else, and no view both for fitting and for deciding."""
    sets = [found, *(roaming_cameras(SCENE, 6, split=split) for split in ("fit", "decide"))]
    positions = np.array([camera.position for cameras in sets for camera in cameras])
    apart = np.linalg.norm(positions[:, None] - positions, axis=2) + 9 * np.eye(len(positions))
    assert apart.min() > 1e-3


def test_cameras_are_both_near_and_far():
    points = ball(6_000)
    distances = [
        np.linalg.norm(points - camera.position, axis=1).min()
        for camera in roaming_cameras(cloud(points, 0.04), 12)
    ]
    assert min(distances) < 0.3
    assert max(distances) > 0.8


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_cameras_follow_a_similarity_transform_of_the_scene(found, scale):
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


def test_no_camera_is_inside_a_hollow_object():
    for camera in roaming_cameras(cloud(ball(6_000), 0.05), 12):
        assert np.linalg.norm(camera.position) > 1


def test_nothing_is_near_the_lens_among_many_small_splats():
    snow = np.random.default_rng(2).uniform(-2, 2, (10_000, 3))
    scene = concatenate([cloud(ball(6_000), 0.05), cloud(snow, 0.03)])
    prepared = prepare(scene)
    for camera in roaming_cameras(scene, 12, split="test"):
        view = render(prepared, camera.reduced(96), depth=True)
        distance = camera.near / roam.NEAR
        assert (view.depth < roam.HUGGING * distance).mean() <= roam.HUGGED


def test_cameras_of_a_room_are_inside_it():
    points = room(20_000)
    for camera in roaming_cameras(cloud(points, 0.06), 12):
        assert (np.abs(camera.position) < (3.0, 1.5, 2.0)).all()


def wall(distance, width=3.0, beside=0.0):
    """A square of splats across the z axis."""
    side = np.linspace(-width, width, 40)
    x, y = (axis.ravel() for axis in np.meshgrid(side, side))
    return cloud(np.stack([x + beside, y, np.full(1600, distance)], axis=1), width / 20)


def view_is_accepted(*parts):
    """Return whether a view from the origin along z is accepted, if its target is at distance 1."""
    camera = replace(roam._small_camera(512, 512, 60), near=0.02)
    splats = prepare(concatenate(parts))
    return roam._shown(splats, roam.Candidate(camera, np.array([0.0, 0, 1]), 1.0)) is not None


def test_a_view_is_accepted_if_its_target_is_visible_and_large_enough():
    assert view_is_accepted(wall(1))
    assert not view_is_accepted(wall(1, 0.1)), "less than a third of the picture"
    assert not view_is_accepted(wall(1.3)), "something else in the middle"
    assert not view_is_accepted(wall(1), wall(0.5, 0.1)), "hidden"
    assert view_is_accepted(wall(1), wall(0.5, 0.03, 0.2)), "something stands beside it"
    assert not view_is_accepted(wall(1), wall(0.15, 0.03, 0.06)), "at the lens"


def test_light_by_depth_is_that_of_the_splats_in_each_range():
    prepared, [camera] = prepare(SCENE), automatic_cameras(SCENE, 1, width=50, height=33)
    middle = float(np.median((SCENE.means - camera.position) @ camera.world_to_camera[2, :3]))
    ranges = [(0.0, middle), (0.8 * middle, 1.2 * middle), (middle, np.inf)]
    light = light_by_depth(prepared, camera, ranges, contributions=True)
    assert (light.shares.max(axis=(0, 1)) > 0.1).all()
    np.testing.assert_allclose(light.shares[..., 0] + light.shares[..., 2], light.alpha, atol=1e-5)
    picture = render(prepared, camera, contributions=True)
    np.testing.assert_allclose(light.alpha, picture.alpha, atol=1e-5)
    np.testing.assert_allclose(light.contributions, picture.contributions, atol=1e-3)
    assert light_by_depth(prepared, camera, ranges).contributions is None


def test_targets_are_drawn_from_the_light_of_all_cameras_found_so_far():
    splats = concatenate([cloud(np.zeros((1, 3)), 0.1), cloud(np.full((1, 3), 0.2), 0.1)])
    scene = roam.SearchedModel(prepare(splats), np.zeros(3), 1.0, np.eye(3), np.ones(2, bool))
    camera = roam._small_camera(64, 64, 60)
    known = roam.SearchState(np.array([1.0, 0.0]), FreeSpace(scene.splats), [])
    candidates = roam._candidates(scene, known, camera, "fit", 50)
    assert (next(candidates).target == 0).all()
    known.weights = np.array([0.0, 1.0])
    known.cameras.append(camera)
    assert (next(candidates).target > 0).all()


def test_cameras_stay_near_the_model_and_no_target_is_out_of_reach():
    """The second splat stands for surroundings, the third for a sky, which takes no tries."""
    places = np.array([[0.0, 0, 0], [2.5, 0, 0], [9.0, 0, 0]])
    splats = prepare(cloud(places, 0.1))
    scene = roam.SearchedModel(splats, np.zeros(3), 1.0, np.eye(3), np.array([True, True, False]))
    known = roam.SearchState(np.array([1.0, 1.0, 98.0]), FreeSpace(splats), [])
    camera = roam._small_camera(64, 64, 60)
    found = [*roam._candidates(scene, known, camera, "fit", 300)]
    assert len(found) > 150
    assert {candidate.target[0] for candidate in found} == {0.0, 2.5}
    assert 2 < max(np.linalg.norm(each.camera.position) for each in found) <= roam.AWAY


def test_directions_are_uniform_over_the_sphere():
    draws = (np.indices((40, 40)).reshape(2, -1).T + 0.5) / 40
    directions = np.array([roam._direction(*draw) for draw in draws])
    assert np.allclose(np.linalg.norm(directions, axis=1), 1)
    assert np.allclose(directions.mean(axis=0), 0, atol=1e-9)
    assert np.allclose(directions.T @ directions / len(draws), np.eye(3) / 3, atol=1e-3)


def test_a_model_without_an_extent_has_a_radius():
    point = cloud(np.zeros((3, 3)))
    point.log_scales[:] = -np.inf
    assert roam._scene(point, None).radius == 1


def test_views_are_searched_on_the_cpu(monkeypatch):
    pytest.importorskip("warp", reason="pip install 'nanogs[cuda]'")
    used = set()

    def spy(*arguments, **options):
        used.add(engine_in_use() is None)
        return light_by_depth(*arguments, **options)

    monkeypatch.setattr(roam, "light_by_depth", spy)
    with use_device(CARD):
        cameras = roaming_cameras(SCENE, 2)
    assert len(cameras) == 2
    assert used == {True}


def is_free(scene, *positions):
    """Return whether a camera at the origin is in free space, given positions that are free."""
    space = FreeSpace(prepare(scene))
    for position in positions:
        space.add(np.array(position))
    return space.has(replace(roam._small_camera(512, 512, 60), near=0.02), np.array([0.0, 0, 1]))


@pytest.mark.parametrize("rows", [100, 1 << 15])
def test_a_position_is_free_if_a_free_one_sees_it_and_no_splat_covers_it(monkeypatch, rows):
    monkeypatch.setattr("nanogs.views.free_space.SLICE_STEPS", rows)
    assert is_free(wall(1), (0.5, 0.0, 0.5))
    assert is_free(wall(1), (0.0, 0.2, -2.0))
    between = concatenate([wall(1), wall(-1)])
    assert not is_free(between, (0.0, 0.2, -2.0))
    assert is_free(between, (0.0, 0.2, -0.5))
    assert not is_free(wall(1))
    assert not is_free(concatenate([wall(1), cloud(np.zeros((1, 3)), 0.3)]), (0.5, 0.0, 0.5))


def one_splat(place, scales, alpha):
    """A single splat along the axes, with alpha at its centre."""
    splat = cloud(np.array([place]), 1.0)
    logit = np.full_like(splat.opacity_logits, np.log(alpha / (1 - alpha)))
    sizes = np.log(np.array([scales], np.float32))
    return replace(splat, opacity_logits=logit, log_scales=sizes)


@pytest.mark.parametrize(("place", "inside"), [(0.9, True), (1.05, False)])
@pytest.mark.parametrize("scales", [(1.0, 1.0, 1.0), (1.0, 0.1, 0.1)])
def test_a_position_is_inside_a_splat_where_its_alpha_is_a_half(place, inside, scales):
    splat = one_splat((place, 0.0, 0.0), scales, 0.8)  # half at 0.97
    doubled = one_splat((2 * place, 0.0, 0.0), np.array(scales) * 2, 0.8)
    for each in (splat, doubled):
        assert is_free(each, (0.0, 0.0, 0.0)) is not inside


@pytest.mark.parametrize(("alpha", "free"), [(0.4, True), (0.6, False)])
def test_positions_see_each_other_through_what_lets_half_of_the_light_pass(alpha, free):
    pane = one_splat((0.0, 0.0, -1.0), (50.0, 50.0, 0.01), alpha)
    assert is_free(pane, (0.0, 0.0, -2.0)) is free
    assert is_free(pane, (0.0, 0.0, 1.0)), "at the target itself, with nothing between"


def test_a_position_is_tested_from_the_three_in_the_most_similar_direction():
    seen, hidden = (0.5, 0.0, 0.5), [(0.0, 0.0, -distance) for distance in (2.0, 3.0, 4.0)]
    assert is_free(wall(-1), *hidden[:2], seen)
    assert not is_free(wall(-1), *hidden, seen)


def test_the_middle_of_a_picture_is_its_centre_or_all_of_a_small_one():
    for shape in ((16, 16), (16, 4), (2, 3)):
        values = np.arange(shape[0] * shape[1], dtype=np.float32).reshape(*shape, 1)
        assert middle(values).tolist() == [values.mean()]
    corners = np.ones((16, 16, 1), np.float32)
    corners[6:10, 6:10] = 0
    assert middle(corners).tolist() == [0]


@pytest.mark.filterwarnings("error")
def test_free_positions_may_be_farther_away_than_float32_reaches():
    assert is_free(wall(1), (0.0, 0.0, -1e39))


def test_distant_splats_do_not_mislead_the_cameras():
    sky = cloud(ball(3_000, 40.0), 2.5)
    indoors = concatenate([cloud(0.3 * room(), 0.03), sky])
    for camera in roaming_cameras(indoors, 4):
        assert (np.abs(camera.position) < (0.9, 0.45, 0.6)).all()
    copy = replace(SCENE, means=SCENE.means + np.float32(1e5))
    cameras = roaming_cameras(concatenate([SCENE, copy]), 4)
    assert len(cameras) == 4
    for camera in cameras:  # all are within one of the two scenes, which reach 30 units
        assert min(np.abs(camera.position - shift).max() for shift in (0.0, 1e5)) < 30


def test_a_model_without_splats_is_refused():
    empty = SCENE.take(np.arange(0))
    for measured in (nanogs.render, nanogs.draw_cost):
        with pytest.raises(ModelError, match="nothing"):
            measured(empty, "roam")


def test_what_is_no_model_is_refused():
    with pytest.raises(ModelError, match="Splats, not InMemory"):
        roaming_cameras(nanogs.source.InMemory(SCENE), 2)
    for kind in ("auto", "roam"):
        with pytest.raises(ModelError, match=r"not the path 'a\.ply'"):
            cameras_for("a.ply", kind, count=2, width=8, height=8)


def test_a_scene_without_suitable_views_is_refused():
    haze = cloud(ball(300), size=0.1, logit=-3.0)
    with pytest.raises(ModelError, match="No roaming view was found in 120 tries"):
        roaming_cameras(haze, 2)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"count": 0}, "not 0 of 512 x 512"),
        ({"width": 0}, "of 0 x 512"),
        ({"fov": 0.0}, r"field of view .* not 0\.0"),
        ({"fov": float("nan")}, "field of view .* not nan"),
        ({"count": 2.5}, r"not 2\.5 of 512 x 512"),
        ({"fov": "60"}, "field of view .* not '60'"),
        ({"split": 1}, "split of views must be a name, not 1"),
    ],
)
def test_bad_arguments_are_refused(arguments, message):
    with pytest.raises(OptionError, match=message):
        roaming_cameras(SCENE, **arguments)

"""Cameras with lens distortion: as viewpoints, and with photographs that are undistorted."""

import json
import math
from functools import cache

import numpy as np
import pytest
from PIL import Image

from builders import random_splats
from dataset_files import colmap_camera, colmap_image, transforms, write_json, write_model
from launch import run
from nanogs import io
from nanogs.datasets.dataset import cameras_from_file, open_dataset
from nanogs.datasets.undistort import straightened
from nanogs.errors import FormatError
from nanogs.raster.camera import Camera
from nanogs.raster.lens import Lens, lens_notes
from nanogs.scoring.modes import ModelViews, render_findings
from nanogs.scoring.viewing import view_files
from viewer_bundle import require_bundle

SIZE = (160, 120)
WHITE = (1.0, 1.0, 1.0)


def distorted_points(model, params, x, y):
    """Distort points by the formulas of COLMAP's models.h."""
    r2 = x * x + y * y
    if model == "SIMPLE_RADIAL":
        return x * (1 + params[0] * r2), y * (1 + params[0] * r2)
    if model == "RADIAL":
        radial = params[0] * r2 + params[1] * r2**2
        return x * (1 + radial), y * (1 + radial)
    if model == "OPENCV":
        k1, k2, p1, p2 = params
        radial = k1 * r2 + k2 * r2**2
        return (
            x + x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y + y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y),
        )
    if model == "FULL_OPENCV":
        k1, k2, p1, p2, k3, k4, k5, k6 = params
        radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
        return (
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y),
        )
    r = np.maximum(np.sqrt(r2), 1e-300)
    theta = np.arctan(r)
    distorted = theta * (1 + sum(k * theta ** (2 * n + 2) for n, k in enumerate(params)))
    return x * distorted / r, y * distorted / r


# Focal lengths, principal point, and distortion parameters.
LENSES = {
    "SIMPLE_RADIAL": (120.0, 80.0, 60.0, -0.2),
    "RADIAL": (120.0, 81.0, 59.0, 0.15, 0.05),
    "OPENCV": (120.0, 121.0, 79.0, 61.0, -0.25, 0.08, 0.004, -0.003),
    "FULL_OPENCV": (120.0, 121.0, 79.0, 61.0, 0.1, 0.02, 0.001, 0.002, 0.01, 0.2, 0.03, 0.01),
    "OPENCV_FISHEYE": (90.0, 91.0, 79.0, 61.0, 0.05, -0.02, 0.003, -0.001),
    "SIMPLE_RADIAL_FISHEYE": (90.0, 80.0, 60.0, 0.03),
    "RADIAL_FISHEYE": (90.0, 80.0, 60.0, 0.03, -0.01),
}
NUMBERS = {"SIMPLE_RADIAL": 2, "RADIAL": 3, "OPENCV": 4, "OPENCV_FISHEYE": 5, "FULL_OPENCV": 6,
           "SIMPLE_RADIAL_FISHEYE": 8, "RADIAL_FISHEYE": 9}  # fmt: skip


def split_params(model):
    """Return (fx, fy, cx, cy) and the distortion parameters."""
    params = LENSES[model]
    if model in ("OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"):
        return params[:4], params[4:]
    return (params[0], params[0], *params[1:3]), params[3:]


def pattern(x, y):
    """A picture at distance 1, smooth, and different everywhere."""
    red = 0.5 + 0.4 * np.sin(5 * x + 1) * np.cos(4 * y)
    return np.stack([red, 0.5 + 0.4 * np.sin(3 * x * y + x), 0.5 + 0.3 * np.cos(6 * y)], axis=-1)


@cache
def distorted_photo(model):
    """Return the pattern as seen through that lens; the ray of each pixel is found by iteration."""
    (fx, fy, cx, cy), lens = split_params(model)
    u, v = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    expected = np.stack([(u - cx) / fx, (v - cy) / fy], axis=-1)
    ray = expected.copy()
    for _ in range(30):
        ray += expected - np.stack(distorted_points(model, lens, ray[..., 0], ray[..., 1]), axis=-1)
    return pattern(ray[..., 0], ray[..., 1])


@pytest.fixture(params=LENSES)
def capture(request, tmp_path):
    """A COLMAP capture of one lens, every photograph of the pattern."""
    model = request.param
    camera = colmap_camera(model=NUMBERS[model], size=SIZE, params=LENSES[model])
    images = [colmap_image(n + 1, f"{n}.png") for n in range(2)]
    write_model(tmp_path / "sparse" / "0", [camera], images)
    (tmp_path / "images").mkdir()
    photo = Image.fromarray(np.rint(distorted_photo(model) * 255).astype(np.uint8))
    for n in range(2):
        photo.save(tmp_path / "images" / f"{n}.png")
    return tmp_path, model


def test_photographs_are_undistorted(capture):
    folder, model = capture
    data = open_dataset(folder)
    (frame,) = data.split("test")
    camera = frame.camera
    assert camera.lens is None
    (fx, _, cx, cy), _ = split_params(model)
    assert 1 <= camera.fx / fx < 1.5
    assert (camera.cx, camera.cy) == (cx, cy)
    u, v = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    ideal = pattern((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy)
    error = np.abs(data.load_photo(frame, WHITE) - ideal)
    assert error.max() < 0.02
    assert error.mean() < 0.004  # rounding to bytes, and interpolation between pixels


def test_an_undistorted_photograph_stays_within_the_original(capture):
    """No pixel is made up: corners and edges come from inside the original."""
    folder, model = capture
    (frame,) = open_dataset(folder).split("test")
    camera, ((fx, fy, cx, cy), lens) = frame.camera, split_params(model)
    for u, v in [(0.5, 0.5), (159.5, 0.5), (0.5, 119.5), (159.5, 119.5), (80, 0.5), (0.5, 60)]:
        x, y = distorted_points(
            model, lens, (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
        )
        assert 0 <= x * fx + cx <= SIZE[0]
        assert 0 <= y * fy + cy <= SIZE[1]


def test_cameras_as_viewpoints_keep_intrinsics_and_lens(capture):
    folder, model = capture
    cameras = cameras_from_file(folder)
    (fx, fy, cx, cy), params = split_params(model)
    assert (cameras[0].fx, cameras[0].fy, cameras[0].cx, cameras[0].cy) == (fx, fy, cx, cy)
    assert cameras[0].lens.name == model
    x, y = cameras[0].lens.distorted(np.array([0.3, 0.0]), np.array([-0.2, 0.0]))
    assert (x[0], y[0]) == pytest.approx(distorted_points(model, params, 0.3, -0.2))
    assert (x[1], y[1]) == (0, 0)
    assert lens_notes(cameras) == [
        "The lens distortion of 2 cameras is ignored: views are rendered with pinhole cameras."
    ]


def test_pages_and_findings_say_that_the_distortion_is_ignored(tmp_path, capture):
    folder, _ = capture
    io.save(random_splats(200, seed=4), tmp_path / "a.ply")
    model, notes = tmp_path / "a.ply", tuple(lens_notes(cameras_from_file(folder)))
    assert render_findings(model, ModelViews(folder), costs=False).notes == notes
    require_bundle()
    pair = [("a", model), ("b", model)]
    assert notes[0] in view_files(pair, tmp_path / "a.html", cameras=str(folder)).notes


STATED = {
    "OPENCV": {"camera_model": "OPENCV", "k1": -0.25, "k2": 0.08, "p1": 0.004, "p2": -0.003},
    "OPENCV_FISHEYE": {"is_fisheye": True, "k1": 0.05, "k2": -0.02, "k3": 0.003, "k4": -0.001},
}


@pytest.mark.parametrize("model", STATED)
def test_lenses_in_transforms_files_are_the_same(tmp_path, model):
    (fx, fy, cx, cy), lens = split_params(model)
    intrinsics = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": SIZE[0], "h": SIZE[1]}
    Image.fromarray(np.rint(distorted_photo(model) * 255).astype(np.uint8)).save(
        tmp_path / "r_0.png"
    )
    frames = [{"file_path": "r_0", "transform_matrix": np.eye(4).tolist()}]
    write_json(tmp_path / "transforms_test.json", transforms(frames, **intrinsics, **STATED[model]))
    data = open_dataset(tmp_path)
    (frame,) = data.split("test")
    u, v = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    ideal = pattern((u - cx) / frame.camera.fx, (v - cy) / frame.camera.fy)
    assert np.abs(data.load_photo(frame, WHITE) - ideal).max() < 0.02
    (camera,) = cameras_from_file(tmp_path / "transforms_test.json")
    x, y = camera.lens.distorted(np.array([0.3]), np.array([-0.2]))
    assert (x[0], y[0]) == pytest.approx(distorted_points(model, lens, 0.3, -0.2))


@pytest.mark.parametrize(
    ("coefficients", "message"),
    [
        ({"k1": 0.1, "k4": 0.1}, "PINHOLE, cannot be removed from the photograph"),
        ({"is_fisheye": True, "k5": 0.1}, "OPENCV_FISHEYE, cannot be removed from the photograph"),
        ({"k1": -3.0}, "too strong to be removed from the photograph"),
    ],
)
def test_lenses_that_cannot_be_removed_are_refused_for_photographs(tmp_path, coefficients, message):
    Image.new("RGB", SIZE).save(tmp_path / "r_0.png")
    frames = [{"file_path": "r_0", "transform_matrix": np.eye(4).tolist()}]
    file = tmp_path / "transforms_test.json"
    write_json(file, transforms(frames, w=SIZE[0], h=SIZE[1], fl_x=20.0, **coefficients))
    with pytest.raises(FormatError, match=message) as caught:
        open_dataset(tmp_path).split("test")
    assert "image_undistorter" in str(caught.value)
    assert len(cameras_from_file(file)) == 1


def test_lenses_whose_distortion_turns_back_are_detected():
    assert Lens("a", above=(-0.3,)).turns_back(1.2)
    assert not Lens("a", above=(-0.3,)).turns_back(1.0)
    assert not Lens("a", fisheye=True).turns_back(50.0)


def test_no_place_of_a_photograph_is_shown_twice():
    """The lens turns back at a radius of 1.054; the corner pixels of the picture are at 1.2."""
    lens, corner = Lens("a", above=(-0.3,)), math.hypot(39.5, 39.5)
    camera = Camera(80, 80, corner / 1.2, corner / 1.2, 40, 40, np.eye(4), lens=lens)
    straight = straightened(camera, "a.png")
    assert 1.04 < corner / straight.fx < 1.056  # focal lengths are tried in steps of 1 %


def test_the_command_notes_that_distortion_is_ignored(tmp_path):
    io.save(random_splats(30), tmp_path / "a.ply")
    frames = [{"file_path": "v.png", "transform_matrix": np.eye(4).tolist()}]
    pose = {"fl_x": 60, "w": 64, "h": 48, "k1": -0.1, "camera_model": "OPENCV"}
    cameras = write_json(tmp_path / "transforms.json", transforms(frames, **pose))
    result = run("render", tmp_path / "a.ply", tmp_path / "out", "--cameras", cameras)
    assert result.returncode == 0, result.stderr
    assert "lens distortion of 1 camera is ignored" in result.stderr
    assert [file.name for file in (tmp_path / "out").iterdir()] == ["v.png"]
    looking = run("info", tmp_path / "a.ply", "--cameras", cameras)
    assert "note: The lens distortion of 1 camera is ignored" in looking.stderr
    result = run("compare", tmp_path / "a.ply", tmp_path / "a.ply", "--cameras", cameras, "--json")
    assert any(
        "lens distortion of 1 camera " in note for note in json.loads(result.stdout)["notes"]
    )

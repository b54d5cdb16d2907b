"""COLMAP models: both encodings, hand-computed cameras, and damage."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dataset_files import (
    MODEL_NUMBERS,
    QUARTER,
    cameras_bin,
    cameras_txt,
    colmap_camera,
    colmap_image,
    images_bin,
    images_txt,
    nine_images,
    write_model,
)
from nanogs.datasets.colmap import find_model, read_model, scaled
from nanogs.errors import FormatError

ENCODINGS = ("bin", "txt")
on_disk = settings(
    deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def test_a_camera_has_the_values_computed_by_hand(tmp_path):
    (camera,) = read_model(write_model(tmp_path, images=[colmap_image(7, "a.png", QUARTER)]))
    assert (camera.width, camera.height) == (80, 60)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (70, 71, 39, 31)
    assert camera.name == "a.png"
    turn = [[0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]
    np.testing.assert_allclose(camera.world_to_camera, turn, atol=1e-12)
    np.testing.assert_allclose(camera.position, [0, 0, -4], atol=1e-12)


def test_binary_and_text_models_are_read_alike(tmp_path):
    cameras = [colmap_camera(1), colmap_camera(2, "SIMPLE_PINHOLE", (8, 6), (7.1, 4.0, 3.0))]
    images = [*nine_images(), colmap_image(10, "sub dir/ü b.png", camera_id=2, points=0)]
    binary, text = (
        read_model(write_model(tmp_path / encoding, cameras, images, encoding))
        for encoding in ENCODINGS
    )
    assert len(binary) == len(text) == 10
    for a, b in zip(binary, text, strict=True):
        assert (a.name, a.width, a.height) == (b.name, b.width, b.height)
        assert (a.fx, a.fy, a.cx, a.cy) == (b.fx, b.fy, b.cx, b.cy)
        np.testing.assert_array_equal(a.world_to_camera, b.world_to_camera)


def test_cameras_are_sorted_by_name_not_by_id(tmp_path):
    names = [camera.name for camera in read_model(write_model(tmp_path))]
    assert names == [f"img_{k}.png" for k in range(9)]


def test_a_binary_model_is_preferred_to_a_text_model(tmp_path):
    write_model(tmp_path, images=[colmap_image(1, "old.png")], encoding="txt")
    write_model(tmp_path, images=[colmap_image(1, "new.png")], encoding="bin")
    assert [camera.name for camera in read_model(tmp_path)] == ["new.png"]


@pytest.mark.parametrize("subfolder", ["sparse/0", "sparse", "."])
def test_a_model_is_found_in_each_usual_folder(tmp_path, subfolder):
    folder = write_model(tmp_path / subfolder)
    assert find_model(tmp_path) == folder


def test_the_model_of_the_innermost_folder_is_preferred(tmp_path):
    for subfolder in ("sparse/0", "sparse", "."):
        write_model(tmp_path / subfolder)
    assert find_model(tmp_path) == tmp_path / "sparse" / "0"


def test_a_rotation_that_is_nearly_of_unit_length_is_normalised(tmp_path):
    image = colmap_image(1, "a.png", np.multiply(QUARTER, 1.0005))
    (camera,) = read_model(write_model(tmp_path, images=[image]))
    rotation = camera.world_to_camera[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


def test_an_incomplete_model_is_not_found(tmp_path):
    (write_model(tmp_path) / "images.bin").unlink()
    assert find_model(tmp_path) is None
    with pytest.raises(FormatError, match="lacks cameras and images"):
        read_model(tmp_path)


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize(
    ("model", "params", "focal"),
    [
        ("SIMPLE_RADIAL", (70.0, 40.0, 30.0, 0.0), (70, 70)),
        ("OPENCV", (70.0, 71.0, 40.0, 30.0, 0.0, 0.0, 0.0, -0.0), (70, 71)),
    ],
)
def test_camera_models_without_distortion_are_pinhole_cameras(
    tmp_path, encoding, model, params, focal
):
    cameras = [colmap_camera(model=model, params=params)]
    camera = read_model(write_model(tmp_path, cameras, encoding=encoding))[0]
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (*focal, 40, 30)


DISTORTED = [
    ("SIMPLE_RADIAL", 2, (70, 40, 30, 0.01)),
    ("RADIAL", 3, (70, 40, 30, 0, 0.01)),
    ("OPENCV", 4, (70, 71, 40, 30, 0, 0, 0, 1e-9)),
    ("FULL_OPENCV", 6, (70, 71, 40, 30, 0, 0, 0, 0, 0, 0, 0, 0.1)),
    ("FOV", 7, (70, 71, 40, 30, 0.9)),
    # Fisheye lenses bend lines even if all distortion parameters are zero.
    ("OPENCV_FISHEYE", 5, (70, 71, 40, 30, 0, 0, 0, 0)),
    ("SIMPLE_RADIAL_FISHEYE", 8, (70, 40, 30, 0)),
    ("RADIAL_FISHEYE", 9, (70, 40, 30, 0, 0)),
    ("THIN_PRISM_FISHEYE", 10, (70, 71, 40, 30, 0, 0, 0, 0, 0, 0, 0, 0)),
]


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize(("model", "number", "params"), DISTORTED)
def test_distorted_camera_models_keep_their_pose_and_get_a_lens(
    tmp_path, encoding, model, number, params
):
    given_model = number if encoding == "bin" else model
    cameras = [colmap_camera(model=given_model, params=params)]
    camera = read_model(write_model(tmp_path, cameras, encoding=encoding))[0]
    fy = 70 if len(params) < 8 and model != "FOV" else 71
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (70, fy, 40, 30)
    assert camera.lens.name == model
    assert camera.lens.known == (model not in ("FOV", "THIN_PRISM_FISHEYE"))


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_nan_lens_parameters_are_refused(tmp_path, encoding):
    params = (70, 71, 40, 30, 0, 0, 0, float("nan"))
    cameras = [colmap_camera(model="OPENCV", params=params)]
    with pytest.raises(FormatError, match=r"camera 1, lens: is nan where a finite number"):
        read_model(write_model(tmp_path, cameras, encoding=encoding))


@pytest.mark.parametrize(("encoding", "model"), [("bin", 11), ("bin", -1), ("txt", "MAGIC")])
def test_unknown_camera_models_are_refused(tmp_path, encoding, model):
    with pytest.raises(FormatError, match=rf"camera model '?{model}'? is not known.*undistort"):
        read_model(write_model(tmp_path, [colmap_camera(model=model)], encoding=encoding))


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize(
    ("images", "message"),
    [
        ([], "no registered image"),
        ([colmap_image(1, "a"), colmap_image(2, "a")], "image a twice"),
        ([colmap_image(1, "a"), colmap_image(1, "b")], "image id 1 twice"),
        ([colmap_image(1, "a", camera_id=5)], "camera 5, which is not in the model"),
        ([colmap_image(1, "a", q=(1, 1, 0, 0))], "quaternion of length 1.41421"),
        ([colmap_image(1, "a", q=(0, 0, 0, 0))], "quaternion of length 0"),
        ([colmap_image(1, "a", q=(float("nan"), 0, 0, 0))], "rotation: is nan"),
        ([colmap_image(1, "a", t=(0, float("inf"), 0))], "translation: is inf"),
    ],
)
def test_bad_images_are_refused(tmp_path, encoding, images, message):
    with pytest.raises(FormatError, match=message):
        read_model(write_model(tmp_path, images=images, encoding=encoding))


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize(
    ("camera", "message"),
    [
        (colmap_camera(params=(0.0, 71.0, 40.0, 30.0)), "focal length is 0"),
        (colmap_camera(params=(70.0, -71.0, 40.0, 30.0)), "focal length is -71"),
        (colmap_camera(params=(float("nan"), 71.0, 40.0, 30.0)), "focal length: is nan"),
        (colmap_camera(params=(70.0, 71.0, float("inf"), 30.0)), "principal point: is inf"),
        (colmap_camera(size=(0, 60)), "size: is 0"),
        (colmap_camera(size=(80, 2**40)), "size: is a huge|size: is 1099511627776"),
    ],
)
def test_bad_intrinsics_are_refused(tmp_path, encoding, camera, message):
    with pytest.raises(FormatError, match=message):
        read_model(write_model(tmp_path, [camera], encoding=encoding))


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_camera_listed_twice_is_refused(tmp_path, encoding):
    with pytest.raises(FormatError, match="camera 1 twice"):
        read_model(write_model(tmp_path, [colmap_camera(), colmap_camera()], encoding=encoding))


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin"])
def test_every_truncation_is_an_error(tmp_path, name):
    file = write_model(tmp_path, images=nine_images()[:2]) / name
    complete = file.read_bytes()
    for length in range(len(complete)):
        file.write_bytes(complete[:length])
        with pytest.raises(FormatError, match=r"is empty|ends before its last entry"):
            read_model(tmp_path)
    file.write_bytes(complete + b"\0")
    with pytest.raises(FormatError, match="has more data after its last entry"):
        read_model(tmp_path)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin"])
@pytest.mark.parametrize("count", [10, 2**31, 2**63, 2**64 - 1])
def test_huge_counts_are_refused_without_allocating_memory(tmp_path, name, count):
    file = write_model(tmp_path) / name
    file.write_bytes(count.to_bytes(8, "little") + file.read_bytes()[8:])
    tracemalloc.start()
    try:
        with pytest.raises(FormatError, match="ends before its last entry"):
            read_model(tmp_path)
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()


def test_an_image_name_that_is_not_utf8_is_refused(tmp_path):
    file = write_model(tmp_path) / "images.bin"
    file.write_bytes(file.read_bytes().replace(b"img_4", b"img_\xff"))
    with pytest.raises(FormatError, match="not UTF-8"):
        read_model(tmp_path)


def test_an_image_without_a_name_is_refused(tmp_path):
    with pytest.raises(FormatError, match="where a name is needed"):
        read_model(write_model(tmp_path, images=[colmap_image(1, "")]))


def test_text_without_observation_lines_is_refused(tmp_path):
    folder = write_model(tmp_path, encoding="txt")
    lines = images_txt(nine_images()).split("\n")
    (folder / "images.txt").write_text("\n".join(lines[:1] + lines[1::2]))
    with pytest.raises(FormatError, match=r"line 3: must be the list of observations of an image"):
        read_model(folder)


@pytest.mark.parametrize("ending", ["", "\n", "\n\n", "\r\n\r\n"])
def test_text_may_end_after_the_last_pose(tmp_path, ending):
    folder = write_model(tmp_path, encoding="txt")
    (folder / "images.txt").write_bytes(f"1 1 0 0 0 0 0 4 1 a b.png{ending}".encode())
    assert [camera.name for camera in read_model(folder)] == ["a b.png"]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("cameras.txt", "1 PINHOLE 80 60 70 71 40", "has 4 parameters, not 3"),
        ("cameras.txt", "1 PINHOLE 80 sixty 70 71 40 30", "line 1: is not a camera"),
        ("cameras.txt", "1", "line 1: is not a camera"),
        ("images.txt", "1 1 0 0 0 0 0 4 1", "line 1: is not an image"),
        ("images.txt", "1 1 0 0 0 0 0 z 1 a.png", "line 1: is not an image"),
        (
            "images.txt",
            "1 1 0 0 0 0 0 4 1 a.png\n1.0 x -1",
            "line 2: must be the list of observations of an image",
        ),
        # The second line is that of the next image, and the name is a number.
        (
            "images.txt",
            "1 1 0 0 0 0 0 4 1 6\n2 1 0 0 0 0 0 4 1 7",
            "line 2: must be the list of observations of an image",
        ),
    ],
)
def test_errors_in_text_models_name_the_line(tmp_path, name, content, message):
    folder = write_model(tmp_path, encoding="txt")
    (folder / name).write_text(content)
    with pytest.raises(FormatError, match=message):
        read_model(folder)


def test_text_that_is_not_utf8_is_refused(tmp_path):
    folder = write_model(tmp_path, encoding="txt")
    (folder / "images.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(FormatError, match="not UTF-8"):
        read_model(folder)


@pytest.mark.parametrize(
    "size", [(40, 30), (20, 15), (10, 8), (10, 7), (160, 120), (27, 20), (26, 20)]
)
def test_scaling_the_intrinsics_keeps_the_view(tmp_path, size):
    camera = read_model(write_model(tmp_path))[0]
    small = scaled(camera, size, "photo")
    assert (small.width, small.height) == size
    point = np.array([0.3, -0.2, 5.0])
    before = np.array([camera.fx, camera.fy]) * point[:2] / 5 + (camera.cx, camera.cy)
    after = np.array([small.fx, small.fy]) * point[:2] / 5 + (small.cx, small.cy)
    np.testing.assert_allclose(after / size, before / (80, 60), rtol=1e-12)
    np.testing.assert_array_equal(small.world_to_camera, camera.world_to_camera)


def test_the_sides_of_a_scaled_photograph_may_be_rounded_up_and_down(tmp_path):
    wide = colmap_camera(size=(1001, 667), params=(700.0, 700.0, 500.0, 333.0))
    camera = read_model(write_model(tmp_path, [wide]))[0]
    for size in ((500, 334), (501, 333)):
        assert (scaled(camera, size, "photo").width, scaled(camera, size, "photo").height) == size


def test_scaled_intrinsics_have_the_values_computed_by_hand(tmp_path):
    small = scaled(read_model(write_model(tmp_path))[0], (40, 30), "photo")
    assert (small.fx, small.fy, small.cx, small.cy) == (35, 35.5, 19.5, 15.5)


@pytest.mark.parametrize("size", [(60, 80), (80, 63), (40, 33), (37, 30), (20, 17), (83, 60)])
def test_photographs_of_another_aspect_ratio_are_refused(tmp_path, size):
    camera = read_model(write_model(tmp_path))[0]
    with pytest.raises(
        FormatError, match=rf"^photo: is {size[0]}x{size[1]} .* not a scaled version of the 80x60"
    ):
        scaled(camera, size, "photo")


finite = st.floats(-1e6, 1e6)
unit = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1)


@on_disk
@given(q=unit, t=st.tuples(finite, finite, finite), encoding=st.sampled_from(ENCODINGS))
def test_random_poses_are_read_exactly(tmp_path, q, t, encoding):
    q = np.array(q) / np.linalg.norm(q)
    image = colmap_image(1, "a.png", q.tolist(), t)
    folder = write_model(tmp_path / encoding, images=[image], encoding=encoding)
    pose = read_model(folder)[0].world_to_camera
    expected = Rotation.from_quat(np.roll(q, -1)).as_matrix()  # scipy's order is xyzw
    np.testing.assert_allclose(pose[:3, :3], expected, atol=1e-12)
    np.testing.assert_array_equal(pose[:3, 3], t)
    np.testing.assert_array_equal(pose[3], [0, 0, 0, 1])


mutations = st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), min_size=1, max_size=6)


@on_disk
@given(
    name=st.sampled_from(["cameras.bin", "images.bin", "cameras.txt", "images.txt"]),
    edits=mutations,
    keep=st.floats(0, 1) | st.just(1.0),
)
def test_damaged_models_give_cameras_or_a_format_error(tmp_path, outcomes, name, edits, keep):
    encoding = name[-3:]
    folder = write_model(tmp_path / encoding, images=nine_images()[:3], encoding=encoding)
    data = bytearray((folder / name).read_bytes())
    for where, value in edits:
        data[min(int(where * len(data)), len(data) - 1)] = value
    (folder / name).write_bytes(data[: int(keep * len(data))])
    try:
        cameras = read_model(folder)
    except FormatError:
        outcomes["refused"] += 1
        return
    outcomes["read"] += 1
    assert cameras
    assert all(np.isfinite(camera.world_to_camera).all() for camera in cameras)
    assert all(camera.fx > 0 and camera.fy > 0 for camera in cameras)


@on_disk
@given(content=st.binary(max_size=200), name=st.sampled_from(["cameras", "images"]))
def test_random_bytes_give_a_format_error(tmp_path, content, name):
    for encoding in ENCODINGS:
        folder = write_model(tmp_path / encoding, encoding=encoding)
        (folder / f"{name}.{encoding}").write_bytes(content)
        with pytest.raises(FormatError):
            read_model(folder)


def test_the_writers_of_these_tests_use_the_documented_layout():
    # Checks the helpers of these tests: record sizes are as in COLMAP's documentation.
    assert MODEL_NUMBERS["PINHOLE"] == 1
    assert len(cameras_bin([colmap_camera()])) == 8 + 24 + 4 * 8
    assert len(images_bin([colmap_image(1, "ab", points=3)])) == 8 + 64 + 3 + 8 + 3 * 24
    assert cameras_txt([colmap_camera()]).split("\n")[2].startswith("1 PINHOLE 80 60 70.0")

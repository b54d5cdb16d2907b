"""`transforms*.json` and `cameras.json`: cameras computed by hand, and refused files."""

import json
import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dataset_files import POSE, trained_camera, transforms, write_json, write_photo
from nanogs.datasets.blender import read_transforms
from nanogs.datasets.dataset import cameras_from_file
from nanogs.datasets.inria import read_cameras_json
from nanogs.errors import FormatError, NanogsError, NoViewsError

on_disk = settings(
    deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
NAN = float("nan")


def frame(name="./test/r_0", pose=POSE, **entries):
    return {"file_path": name, "transform_matrix": pose, **entries}


def moved(row, column, value):
    pose = [list(each) for each in POSE]
    pose[row][column] = value
    return pose


@pytest.fixture
def file(tmp_path):
    return tmp_path / "transforms_test.json"


def test_a_blender_camera_has_the_values_computed_by_hand(file):
    write_photo(file.parent / "test" / "r_0.png", (80, 60))
    (only,) = read_transforms(write_json(file, transforms()))
    camera = only.camera
    # tan(angle / 2) = 1/2, so the focal length is the width.
    assert (camera.fx, camera.fy) == (pytest.approx(80), pytest.approx(80))
    assert (camera.width, camera.height, camera.cx, camera.cy) == (80, 60, 40, 30)
    assert camera.name == "test/r_0"
    assert only.photo_path == file.parent / "test" / "r_0.png"
    np.testing.assert_allclose(camera.position, [1, 2, 3])
    # A point one ahead (world -z), one right and one up; camera axes: x right, y down, z forward.
    in_camera = camera.world_to_camera @ [2, 3, 2, 1]
    np.testing.assert_allclose(in_camera, [1, -1, 1, 1])


def test_stated_sizes_and_intrinsics_are_used(file):
    shared = {"w": 80, "h": 60.0, "fl_x": 90.0, "fl_y": 91.0, "cx": 38.0, "cy": 29.5}
    (only,) = read_transforms(write_json(file, transforms([frame("a.jpg")], **shared)))
    camera = only.camera
    assert (camera.width, camera.height) == (80, 60)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (90, 91, 38, 29.5)
    assert only.photo_path is None


def test_values_of_a_frame_override_shared_values(file):
    frames = [frame("a"), frame("b", fl_x=50.0, w=40, h=20, cx=1.0)]
    document = transforms(frames, w=80, h=60, fl_x=90.0)
    first, second = (each.camera for each in read_transforms(write_json(file, document)))
    assert (first.width, first.fx, first.fy, first.cx) == (80, 90, 90, 40)
    assert (second.width, second.height, second.fx, second.cx, second.cy) == (40, 20, 50, 1, 10)


def test_horizontal_and_vertical_angles_give_separate_focal_lengths(file):
    """With both angles pixels need not be square; with one angle they are taken as square."""
    two_angles = {
        "w": 80,
        "h": 60,
        "camera_angle_x": 2 * math.atan(0.5),
        "camera_angle_y": 2 * math.atan(1),
    }
    with_fl_x = {**two_angles, "fl_x": 50.0}
    (no_focal,), (one_focal,), (two_focals,) = (
        read_transforms(write_json(file, transforms(**shared)))
        for shared in (two_angles, with_fl_x, {**with_fl_x, "fl_y": 40.0})
    )
    assert (no_focal.camera.fx, no_focal.camera.fy) == pytest.approx((80, 30))
    assert (one_focal.camera.fx, one_focal.camera.fy) == pytest.approx((50, 30))
    assert (two_focals.camera.fx, two_focals.camera.fy) == (50, 40)


def test_an_unknown_image_size_is_an_error_with_a_remedy(file):
    with pytest.raises(FormatError, match=r"the image size is unknown.*; add 'w' and 'h'"):
        cameras_from_file(write_json(file, transforms()))


def test_a_photograph_of_another_size_than_stated_is_refused(file):
    write_photo(file.parent / "test" / "r_0.png", (40, 30))
    with pytest.raises(FormatError, match=r"r_0\.png: is \(40, 30\) .*states \(80, 60\)"):
        read_transforms(write_json(file, transforms(w=80, h=60)))


MIRRORED = [[-1.0, 0, 0, 1.0], *POSE[1:]]
BAD_FRAMES = [
    (frame(pose=moved(0, 0, 1.01)), "pose is not a rotation"),
    (frame(pose=moved(0, 1, 0.01)), "pose is not a rotation"),
    (frame(pose=MIRRORED), "pose is not a rotation"),
    (frame(pose=[[0.0] * 4] * 3 + [[0, 0, 0, 1]]), "pose is not a rotation"),
    (frame(pose=moved(0, 0, NAN)), "transform_matrix: is nan"),
    (frame(pose=moved(1, 3, math.inf)), "transform_matrix: is inf"),
    (frame(pose=moved(1, 3, 10**400)), "transform_matrix: is a huge integer"),
    (frame(pose=moved(1, 3, "1")), "transform_matrix: is '1'"),
    (frame(pose=moved(1, 3, True)), "transform_matrix: is True"),
    (frame(pose=moved(3, 3, 2.0)), "last row"),
    (frame(pose=[list(column) for column in zip(*POSE, strict=True)]), "last row"),
    (frame(pose=POSE[:3]), "not a 4x4 matrix"),
    (frame(pose=None), "not a 4x4 matrix"),
    (frame(name=None), "file_path: is None"),
    (frame(name=""), "file_path: is ''"),
    (frame(w=80), "h: is None"),
    (frame(w=80, h=60.5), "h: is 60.5"),
    (frame(w=0, h=60), "w: is 0"),
    (frame(w=10**6, h=60), "w: is 1000000"),
    (frame(fl_x=0.0), "focal length is 0"),
    (frame(fl_y=-1.0), "focal length is -1"),
    (frame(fl_x=NAN), "fl_x: is nan"),
    (frame(cx=NAN), "principal point: is nan"),
    (frame(camera_angle_x=0), "camera_angle_x is 0"),
    (frame(camera_angle_x=-1), "camera_angle_x is -1"),
    (frame(camera_angle_x=5e-324), "camera_angle_x is 4.9"),
    (frame(camera_angle_x=4), "camera_angle_x is 4"),
    (frame(camera_angle_x=None), "camera_angle_x: is None"),
    (frame(camera_angle_y=4), "camera_angle_y is 4"),
    (frame(camera_model="OPENCV", p2=NAN), "p2: is nan where a finite number"),
    (frame(k1="0.1"), "k1: is '0.1' where a finite number"),
    (frame(camera_model="EQUIRECTANGULAR"), "'EQUIRECTANGULAR' is not a pinhole camera"),
]


@pytest.mark.parametrize(("bad_frame", "message"), BAD_FRAMES)
def test_bad_frames_are_refused_with_file_and_reason(file, bad_frame, message):
    write_photo(file.parent / "test" / "r_0.png", (80, 60))
    write_json(file, transforms([bad_frame]))
    with pytest.raises(FormatError, match=message) as caught:
        read_transforms(file)
    assert str(file) in str(caught.value)


def test_an_opencv_model_without_distortion_is_a_pinhole_camera(file):
    zeros = {"camera_model": "OPENCV", "k1": 0.0, "k2": 0, "p1": 0.0, "p2": 0.0}
    assert read_transforms(write_json(file, transforms(w=8, h=6, **zeros)))


def test_small_rounding_errors_of_a_pose_are_not_corrected(file):
    pose = moved(0, 0, 1.0004)
    (only,) = read_transforms(write_json(file, transforms([frame(pose=pose)], w=8, h=6)))
    np.testing.assert_allclose(only.camera.world_to_camera[0, 0], 1 / 1.0004, rtol=1e-12)


@pytest.mark.parametrize("second_path", ["./test/r_0", "test/r_0", "test/../test/r_0"])
def test_an_image_listed_twice_is_refused(file, second_path):
    with pytest.raises(FormatError, match="image test/r_0 twice"):
        read_transforms(write_json(file, transforms([frame(), frame(second_path)], w=8, h=6)))


def test_a_photograph_listed_with_and_without_suffix_is_refused(file):
    write_photo(file.parent / "test" / "r_0.png", (8, 6))
    with pytest.raises(FormatError, match=r"photograph .*r_0\.png twice"):
        read_transforms(write_json(file, transforms([frame(), frame("test/r_0.png")])))


DOCUMENTS = [
    ("", "is not JSON"),
    ('{"frames": [', "is not JSON"),
    ("[" * 100_000, "is not JSON"),
    ('{"frames": ' + "9" * 5000 + "}", "is not JSON"),
    ("3", "holds 3 where a JSON object"),
    ("null", "holds None where"),
    ("{}", "frames: needs a list of at least one camera, not None"),
    ('{"frames": []}', "not a list of 0"),
    ('{"frames": {}}', "not a dict of 0"),
    ('{"frames": [3]}', "frames, entry 0: holds 3"),
    ("[]", "needs a list of at least one camera"),
    ("[[]]", "entry 0: holds a list of 0"),
]


@pytest.mark.parametrize(("document", "message"), DOCUMENTS)
def test_malformed_documents_are_refused(file, document, message):
    with pytest.raises(FormatError, match=message):
        cameras_from_file(write_json(file, document))


@pytest.mark.parametrize(
    ("document", "empty"),
    [('{"frames": []}', True), ("[]", True), ("{}", False), ('{"frames": {}}', False)],
)
def test_only_an_empty_list_means_that_there_are_no_views(file, document, empty):
    """`nanogs bench` goes on without views to learn from, but not with a damaged file."""
    with pytest.raises(FormatError) as error:
        cameras_from_file(write_json(file, document))
    assert isinstance(error.value, NoViewsError) == empty


def test_a_document_that_is_not_utf8_is_refused(file):
    file.write_bytes(b"\xff\xfe{}")
    with pytest.raises(FormatError, match="not UTF-8"):
        cameras_from_file(file)


def test_a_trained_camera_has_the_values_computed_by_hand(tmp_path):
    # Camera-to-world rotation by a quarter turn: camera x is world y, camera y is world -x.
    turn = [[0, -1.0, 0], [1.0, 0, 0], [0, 0, 1.0]]
    file = write_json(tmp_path / "cameras.json", [trained_camera(rotation=turn)])
    (camera,) = cameras_from_file(file)
    assert (camera.width, camera.height, camera.fx, camera.fy) == (80, 60, 70, 71)
    assert (camera.cx, camera.cy, camera.name) == (40, 30, "r_0")
    np.testing.assert_allclose(camera.position, [1, 2, 3])
    np.testing.assert_allclose(camera.world_to_camera @ [1, 3, 3, 1], [1, 0, 0, 1], atol=1e-12)


def test_trained_cameras_keep_their_order_and_get_unique_names(tmp_path):
    rows = [
        trained_camera(id=5, img_name="r_1"),
        trained_camera(id=3),
        trained_camera(id=4, img_name="r_1"),
    ]
    cameras = read_cameras_json(write_json(tmp_path / "c.json", rows))
    assert [camera.name for camera in cameras] == ["r_1-5", "r_0", "r_1-4"]


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([trained_camera(), trained_camera(img_name="r_1")], "id 0 twice"),
        ([trained_camera(id="x")], "id: is 'x'"),
        ([trained_camera(img_name=7)], "img_name: is 7"),
        ([trained_camera(fx=0)], "focal length is 0"),
        ([trained_camera(fy=NAN)], "fy: is nan"),
        ([trained_camera(width=8.5)], "width: is 8.5"),
        ([trained_camera(height=None)], "height: is None"),
        ([trained_camera(position=[1, 2])], "position: is not a 1x3 matrix"),
        ([trained_camera(position=[1, 2, NAN])], "position: is nan"),
        ([trained_camera(rotation=[[2, 0, 0], [0, 2, 0], [0, 0, 2]])], "pose is not a rotation"),
        ([trained_camera(rotation=[[1, 0, 0], [0, 1, 0], [0, 0, -1]])], "pose is not a rotation"),
        ([trained_camera(rotation="I")], "rotation: is not a 3x3 matrix"),
    ],
)
def test_bad_trained_cameras_are_refused(tmp_path, rows, message):
    file = write_json(tmp_path / "c.json", rows)
    with pytest.raises(FormatError, match=message):
        read_cameras_json(file)


quaternions = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1)
places = st.tuples(*[st.floats(-1e4, 1e4)] * 3)


@on_disk
@given(q=quaternions, centre=places)
def test_both_formats_agree_on_any_pose(tmp_path, q, centre):
    axes = Rotation.from_quat(q).as_matrix()  # columns: right, down, forward
    blender = np.eye(4)
    blender[:3, :3] = np.stack([axes[:, 0], -axes[:, 1], -axes[:, 2]], axis=1)
    blender[:3, 3] = centre
    document = transforms([frame(pose=blender.tolist())], w=8, h=6)
    (a,) = cameras_from_file(write_json(tmp_path / "a.json", document))
    trained = trained_camera(rotation=axes.tolist(), position=list(centre))
    (b,) = cameras_from_file(write_json(tmp_path / "b.json", [trained]))
    for camera in (a, b):
        np.testing.assert_allclose(camera.world_to_camera[:3, :3], axes.T, atol=1e-9)
        np.testing.assert_allclose(camera.position, centre, atol=1e-7)


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner),
    max_leaves=6,
)
possible_values = st.integers(1, 99) | st.floats(0.5, 99) | st.text("abc", min_size=1)


@on_disk
@given(key=st.sampled_from([*trained_camera()]), value=json_values | possible_values)
def test_any_value_in_a_trained_camera_gives_cameras_or_a_nanogs_error(
    tmp_path, outcomes, key, value
):
    file = write_json(tmp_path / "c.json", json.dumps([trained_camera(**{key: value})]))
    assert_cameras_or_a_nanogs_error(file, outcomes)


@on_disk
@given(
    key=st.sampled_from(
        [
            "file_path",
            "transform_matrix",
            "w",
            "h",
            "fl_x",
            "fl_y",
            "cx",
            "cy",
            "camera_angle_x",
            "k1",
            "camera_model",
            "frames",
        ]
    ),
    value=json_values,
    shared=st.booleans(),
)
def test_any_value_in_a_transforms_file_gives_cameras_or_a_nanogs_error(
    tmp_path, outcomes, key, value, shared
):
    document = transforms(w=8, h=6)
    (document if shared else document["frames"][0])[key] = value
    file = write_json(tmp_path / "t.json", json.dumps(document))
    assert_cameras_or_a_nanogs_error(file, outcomes)


def assert_cameras_or_a_nanogs_error(file, outcomes):
    try:
        cameras = cameras_from_file(file)
    except NanogsError:
        outcomes["refused"] += 1
        return
    outcomes["read"] += 1
    assert all(np.isfinite(camera.world_to_camera).all() for camera in cameras)
    assert all(camera.fx > 0 and math.isfinite(camera.fx + camera.cx) for camera in cameras)

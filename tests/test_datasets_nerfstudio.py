"""nerfstudio's data sets: cameras in the coordinates of its models, and its test photographs."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from builders import random_splats
from dataset_files import POSE, transforms, write_capture, write_json, write_model, write_photo
from nanogs import compare, save, simplify
from nanogs.datasets.dataset import cameras_from_file, open_dataset
from nanogs.errors import FormatError, NoViewsError
from nanogs.pipeline.options.views import camera_of, plain_camera
from nanogs.raster.camera import camera_notes
from nanogs.scoring.photos import photographs

# `ns-process-data` exchanges y and z of COLMAP's coordinates and negates the new z.
APPLIED = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]])
MOVED = (
    "Cameras were moved to the coordinates of nerfstudio's model, by dataparser_transforms.json."
)
INTRINSICS = {"w": 80, "h": 60, "fl_x": 70.0, "fl_y": 71.0}


def square(matrix):
    return np.vstack([matrix, [0, 0, 0, 1]])


class Training:
    """The changes that nerfstudio makes to a data set before training, in its own order."""

    def __init__(self, applied=APPLIED, applied_scale=1.0, seed=0):
        rng = np.random.default_rng(seed)
        turn = Rotation.random(random_state=seed).as_matrix()
        self.orientation = np.hstack([turn, rng.normal(size=(3, 1))])
        self.factor, self.applied, self.applied_scale = 0.3, applied, applied_scale

    def saved(self):
        """Return the content of `dataparser_transforms.json`."""
        whole = (
            self.orientation if self.applied is None else self.orientation @ square(self.applied)
        )
        return {"transform": whole.tolist(), "scale": self.factor * self.applied_scale}

    def trained(self, points):
        """Return points (n, 3) in coordinates of `transforms.json` as the model has them."""
        return self.factor * (points @ self.orientation[:, :3].T + self.orientation[:, 3])


def pixels(camera, points):
    x, y, z = (points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]).T
    return np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], axis=1), z


def random_poses(count, seed=3):
    """Camera-to-world matrices with OpenGL axes."""
    rng = np.random.default_rng(seed)
    turns = Rotation.random(count, random_state=seed).as_matrix()
    return [np.vstack([np.c_[turn, rng.normal(0, 3, 3)], [0, 0, 0, 1]]) for turn in turns]


def frames_of(poses):
    return [
        {"file_path": f"images/{k:03}.png", "transform_matrix": pose.tolist()}
        for k, pose in enumerate(poses)
    ]


@pytest.mark.parametrize("applied_scale", [None, 2.5])
@pytest.mark.parametrize("applied", [None, APPLIED])
def test_cameras_see_the_trained_model_as_they_saw_the_data_set(tmp_path, applied, applied_scale):
    training = Training(applied, applied_scale or 1.0)
    shared = {} if applied is None else {"applied_transform": applied.tolist()}
    shared |= {} if applied_scale is None else {"applied_scale": applied_scale}
    file = write_json(
        tmp_path / "transforms.json", transforms(frames_of(random_poses(4)), **INTRINSICS, **shared)
    )
    before = cameras_from_file(file)
    assert camera_notes(before) == []
    write_json(tmp_path / "dataparser_transforms.json", training.saved())
    after = cameras_from_file(tmp_path)
    points = np.random.default_rng(1).normal(0, 3, (50, 3))
    for old, new in zip(before, after, strict=True):
        expected, depths = pixels(old, points)
        found, trained_depths = pixels(new, training.trained(points))
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-6)
        np.testing.assert_allclose(trained_depths, training.factor * depths, atol=1e-9)
        assert new.near == pytest.approx(training.factor * old.near)
        assert (new.name, new.width, new.fx) == (old.name, old.width, old.fx)
    assert camera_notes(after) == [MOVED]
    assert camera_notes([camera_of(json.loads(json.dumps(plain_camera(after[0]))))]) == [MOVED]


def test_cameras_of_colmap_are_moved_from_the_original_coordinates(tmp_path):
    training = Training()
    folder = write_model(tmp_path / "sparse" / "0").parent.parent
    before = cameras_from_file(folder)
    write_json(folder / "dataparser_transforms.json", training.saved())
    points = np.random.default_rng(1).normal(0, 3, (50, 3))
    trained = training.trained(points @ APPLIED[:, :3].T)
    for old, new in zip(before, cameras_from_file(folder), strict=True):
        np.testing.assert_allclose(pixels(new, trained)[0], pixels(old, points)[0], atol=1e-6)


def test_photographs_have_the_moved_cameras_and_a_note(tmp_path):
    folder = write_capture(tmp_path)
    plain = open_dataset(folder).split("test")[0].camera
    write_json(folder / "dataparser_transforms.json", Training().saved())
    data = open_dataset(folder)
    assert not np.allclose(data.split("test")[0].camera.world_to_camera, plain.world_to_camera)
    assert folder / "dataparser_transforms.json" in data.camera_files
    assert photographs(folder, None, "test", None).notes == (MOVED,)


def test_reports_say_that_cameras_were_moved(tmp_path):
    model = random_splats(200, degree=0)
    save(model, tmp_path / "a.ply")
    turned = {"transform": np.eye(4)[:3].tolist(), "scale": 0.5}
    write_json(tmp_path / "dataparser_transforms.json", turned)
    pose = np.eye(4)
    pose[2, 3] = 20.0
    file = transforms(frames_of([pose]), **INTRINSICS)
    write_json(tmp_path / "transforms.json", file)
    report = compare(tmp_path / "a.ply", tmp_path / "a.ply", cameras=tmp_path)
    assert report.notes.count(MOVED) == 1


def test_cameras_in_another_frame_than_an_export_are_noted(tmp_path):
    model = replace(random_splats(200, degree=0), comments=("Generated by Nerstudio 1.1.5",))
    save(model, tmp_path / "a.ply")
    pose = np.eye(4)
    pose[2, 3] = 20.0
    frames = frames_of([pose])
    write_photo(tmp_path / "data" / frames[0]["file_path"], (80, 60))
    write_json(
        tmp_path / "data" / "transforms.json",
        transforms(frames, **INTRINSICS, test_filenames=[frames[0]["file_path"]]),
    )
    write_json(tmp_path / "path.json", camera_path(pose))
    paths = [tmp_path / "a.ply"] * 2
    data, note = tmp_path / "data", "copy the dataparser_transforms.json of the training run"

    def noted(report):
        return sum(note in line for line in report.notes)

    assert noted(compare(*paths, cameras=data)) == 1
    assert noted(compare(*paths, photos=data)) == 1
    assert noted(simplify(model, ratio=0.5, cameras=data, views=1, steps=0)[1]) == 1
    assert noted(compare(*paths, views=1, pixels=32)) == 0
    assert noted(compare(*paths, cameras=tmp_path / "path.json")) == 0
    save(random_splats(200, degree=0), tmp_path / "b.ply")
    assert noted(compare(tmp_path / "b.ply", tmp_path / "b.ply", cameras=data)) == 0
    turned = {"transform": np.eye(4)[:3].tolist(), "scale": 1.0}
    write_json(data / "dataparser_transforms.json", turned)
    assert noted(compare(*paths, cameras=data)) == noted(compare(*paths, photos=data)) == 0


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"scale": 1.0}, "transform: is not a 3x4 matrix"),
        ({"transform": [[1, 0, 0, 0]] * 3, "scale": 1.0}, "is not a rotation and a translation"),
        ({"transform": np.diag([1.0, 1, -1, 1])[:3].tolist(), "scale": 1.0}, "is not a rotation"),
        ({"transform": np.eye(4)[:3].tolist()}, "scale: is None"),
        ({"transform": np.eye(4)[:3].tolist(), "scale": 0}, "scale: is 0, but must be positive"),
        ({"transform": np.eye(4)[:3].tolist(), "scale": -1}, "must be positive"),
        ([], "where a JSON object is needed"),
    ],
)
def test_damaged_changes_are_refused_by_name(tmp_path, entries, message):
    write_json(tmp_path / "transforms.json", transforms(frames_of([np.array(POSE)]), **INTRINSICS))
    write_json(tmp_path / "dataparser_transforms.json", entries)
    with pytest.raises(FormatError, match=message) as caught:
        cameras_from_file(tmp_path)
    assert "dataparser_transforms.json" in str(caught.value)


@pytest.mark.parametrize(
    "applied", [{"applied_transform": [[2.0, 0, 0, 0]] * 3}, {"applied_scale": 0}]
)
def test_a_damaged_change_in_the_data_set_is_refused(tmp_path, applied):
    document = transforms(frames_of([np.array(POSE)]), **INTRINSICS, **applied)
    write_json(tmp_path / "transforms.json", document)
    assert len(cameras_from_file(tmp_path)) == 1  # not needed without the other file
    write_json(tmp_path / "dataparser_transforms.json", Training().saved())
    with pytest.raises(FormatError, match=r"transforms\.json, applied"):
        cameras_from_file(tmp_path)


def camera_path(pose, **changes):
    row = {"camera_to_world": pose.ravel().tolist(), "fov": 90.0, "aspect": 1.5}
    return {
        "camera_type": "perspective",
        "render_height": 60,
        "render_width": 90,
        "camera_path": [row | changes.pop("row", {})],
        "fps": 24,
        "seconds": 1.0,
        **changes,
    }


def test_a_camera_path_is_in_coordinates_of_the_model(tmp_path):
    write_json(tmp_path / "dataparser_transforms.json", Training().saved())  # has no effect
    (camera,) = cameras_from_file(
        write_json(tmp_path / "camera_path.json", camera_path(np.array(POSE)))
    )
    # tan(90 degrees / 2) = 1, so the focal length is half of the height.
    assert (camera.width, camera.height, camera.cx, camera.cy) == (90, 60, 45, 30)
    assert (camera.fx, camera.fy) == (pytest.approx(30), pytest.approx(30))
    np.testing.assert_allclose(camera.position, [1, 2, 3])
    # A point one ahead (world -z), one right and one up.
    np.testing.assert_allclose(camera.world_to_camera @ [2, 3, 2, 1], [1, -1, 1, 1])
    assert (camera.name, camera.near, camera_notes([camera])) == ("path_000", 0.01, [])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"camera_type": "equirectangular"}, "save the path for a perspective camera"),
        ({"render_width": None}, "render_width"),
        ({"camera_path": []}, "a list of at least one camera"),
        ({"row": {"fov": 0}}, "camera 0, fov: is 0, but must be between 0 and 180"),
        ({"row": {"fov": None}}, "camera 0, fov"),
        ({"row": {"camera_to_world": [1.0] * 15}}, "camera 0, camera_to_world"),
        ({"row": {"camera_to_world": [1.0] * 16}}, "camera 0: its pose is not a rotation"),
    ],
)
def test_damaged_camera_paths_are_refused(tmp_path, changes, message):
    file = write_json(tmp_path / "path.json", camera_path(np.array(POSE), **changes))
    with pytest.raises(FormatError, match=message):
        cameras_from_file(file)


@pytest.mark.parametrize(
    ("document", "message"),
    [
        (Training().saved(), "a change of coordinates, but no cameras"),
        ([{"file_path": "a.png", "transform": POSE[:3]}], "poses without focal lengths"),
    ],
)
def test_files_with_a_part_of_the_cameras_say_what_is_needed(tmp_path, document, message):
    file = write_json(tmp_path / "given.json", document)
    with pytest.raises(FormatError, match=rf"{message}; give the transforms\.json"):
        cameras_from_file(file)


def photographed(folder, count, **shared):
    """Write a data set of `count` photographs, whose frames are not sorted by name."""
    frames = frames_of(random_poses(count))
    for frame in frames:
        write_photo(folder / frame["file_path"], (80, 60))
    document = transforms(frames[::-1], **INTRINSICS, **shared)
    write_json(folder / "transforms.json", document)
    return open_dataset(folder)


def names(frames):
    return sorted(frame.camera.name for frame in frames)


# nerfstudio: linspace(0, count - 1, ceil(0.9 count)), rounded down, are trained on.
@pytest.mark.parametrize(("count", "tested"), [(10, [8]), (11, [9]), (20, [9, 18]), (25, [11, 23])])
def test_a_tenth_of_the_photographs_is_held_out_as_nerfstudio_does(tmp_path, count, tested):
    data = photographed(tmp_path, count)
    expected = [f"images/{k:03}.png" for k in tested]
    assert names(data.split("test")) == expected
    held = {*expected}
    assert names(data.split("train")) == [
        name for k in range(count) if (name := f"images/{k:03}.png") not in held
    ]


def test_listed_photographs_are_held_out(tmp_path):
    listed = ["images/001.png", "./images/003.png"]
    data = photographed(tmp_path, 5, test_filenames=listed, train_filenames=["images/000.png"])
    assert names(data.split("test")) == ["images/001.png", "images/003.png"]
    assert names(data.split("train")) == ["images/000.png", "images/002.png", "images/004.png"]
    data = photographed(tmp_path, 3, train_filenames=["images/000.png", "images/002.png"])
    assert names(data.split("test")) == ["images/001.png"]


@pytest.mark.parametrize("listed", ["images/001.png", [1], ["images/7.png"]])
def test_bad_lists_are_refused(tmp_path, listed):
    data = photographed(tmp_path, 5, test_filenames=listed)
    with pytest.raises(FormatError, match="test_filenames"):
        data.split("test")


def test_an_empty_list_holds_out_no_photograph(tmp_path):
    data = photographed(tmp_path, 20, test_filenames=[])
    assert len(data.split("train")) == 20
    with pytest.raises(NoViewsError):
        data.split("test")


def test_too_few_photographs_leave_none_to_test_on(tmp_path):
    with pytest.raises(NoViewsError, match="use a larger set"):
        photographed(tmp_path, 5).split("test")
    write_json(
        tmp_path / "transforms_train.json", transforms(frames_of(random_poses(2)), **INTRINSICS)
    )
    with pytest.raises(NoViewsError, match=r"put its cameras into transforms_test\.json"):
        open_dataset(tmp_path).split("test")

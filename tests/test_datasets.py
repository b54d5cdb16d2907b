"""Data sets as a whole: layouts, splits, photographs, and the shared chair."""

import os
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from dataset_files import (
    POSE,
    colmap_image,
    trained_camera,
    transforms,
    write_capture,
    write_json,
    write_model,
    write_photo,
)
from nanogs.datasets.dataset import cameras_from_file, open_dataset
from nanogs.datasets.photos import photo_size
from nanogs.errors import FormatError, NanogsError, OptionError

WHITE = (1.0, 1.0, 1.0)
BLACK = np.zeros(3)
WHITE_8 = (255, 255, 255)


@pytest.fixture
def chair():
    default = Path(__file__).resolve().parents[2] / "shared" / "scenes"
    folder = Path(os.environ.get("NANOGS_SCENES", default)) / "chair_photos"
    if not folder.is_dir():
        pytest.skip(f"no shared scene {folder}; set NANOGS_SCENES to the scenes folder")
    return folder


@pytest.fixture
def blender(tmp_path):
    frames = [{"file_path": f"./test/r_{k}", "transform_matrix": POSE} for k in (0, 2, 10)]
    write_json(tmp_path / "transforms_test.json", transforms(frames))
    for k in (0, 2, 10):
        write_photo(tmp_path / "test" / f"r_{k}.png", (8, 6), (0, 0, k), "RGB")
    return tmp_path


def names(frames):
    return [frame.camera.name for frame in frames]


@pytest.mark.parametrize("encoding", ["bin", "txt"])
def test_colmap_holds_out_one_in_eight(tmp_path, encoding):
    data = open_dataset(write_capture(tmp_path, encoding))
    assert data.kind == "colmap"
    assert names(data.split("test")) == ["img_0.png", "img_8.png"]
    assert names(data.split("train")) == [f"img_{k}.png" for k in range(1, 8)]


def test_each_photograph_is_matched_to_its_camera(tmp_path):
    data = open_dataset(str(write_capture(tmp_path)))
    for frame in data.split("train"):
        k = int(frame.camera.name[4])
        assert frame.camera.world_to_camera[0, 3] == k
        assert data.load_photo(frame, BLACK)[0, 0, 0] == pytest.approx(k / 255)


def test_intrinsics_are_scaled_to_the_chosen_photographs(tmp_path):
    write_capture(tmp_path)
    write_capture(tmp_path, folder="images_4", size=(20, 15))
    small = open_dataset(tmp_path, images="images_4").split("test")[0]
    assert small.photo_path == tmp_path / "images_4" / "img_0.png"
    camera = small.camera
    assert (camera.width, camera.height) == (20, 15)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (17.5, 17.75, 9.75, 7.75)
    large = open_dataset(tmp_path).split("test")[0].camera
    assert (large.width, large.fx) == (80, 70)


def test_downscaled_photographs_may_have_another_file_format(tmp_path):
    write_model(tmp_path / "sparse" / "0", images=[colmap_image(1, "sub/IMG.JPG")])
    write_photo(tmp_path / "images_2" / "sub" / "IMG.png", (40, 30))
    (frame,) = open_dataset(tmp_path, images="images_2").split("test")
    assert frame.photo_path == tmp_path / "images_2" / "sub" / "IMG.png"


def test_cropped_photographs_are_refused(tmp_path):
    write_capture(tmp_path, size=(80, 56))
    with pytest.raises(
        FormatError,
        match=r"img_0\.png: is 80x56 pixels, which is not a scaled version of the 80x60",
    ):
        open_dataset(tmp_path).split("test")


def test_a_missing_photograph_is_an_error(tmp_path):
    (write_capture(tmp_path) / "images" / "img_8.png").unlink()
    data = open_dataset(tmp_path)
    with pytest.raises(FormatError, match=r"no photograph img_8\.png"):
        data.split("test")
    assert len(data.split("train")) == 7


def test_a_missing_image_folder_is_an_error(tmp_path):
    write_capture(tmp_path, folder="images_4")
    with pytest.raises(
        FormatError,
        match=r"is no folder .* choose `images=.images_4.`, or rename that folder to images",
    ):
        open_dataset(tmp_path)
    with pytest.raises(OptionError, match="images_8: is no folder"):
        open_dataset(tmp_path, images="images_8")


def test_a_colmap_model_without_photographs_only_has_cameras(tmp_path):
    write_model(tmp_path / "sparse" / "0")
    with pytest.raises(FormatError, match="copy the photographs there"):
        open_dataset(tmp_path)
    assert len(cameras_from_file(tmp_path)) == 9


def test_a_single_image_leaves_no_train_split(tmp_path):
    write_model(tmp_path / "sparse" / "0", images=[colmap_image(1, "img_0.png")])
    write_photo(tmp_path / "images" / "img_0.png")
    with pytest.raises(FormatError, match="leave none for the train split"):
        open_dataset(tmp_path).split("train")


def test_colmap_is_preferred_to_transforms_files(tmp_path):
    write_json(write_capture(tmp_path) / "transforms_test.json", transforms())
    assert open_dataset(tmp_path).kind == "colmap"


def test_blender_frames_keep_the_order_of_the_file(blender):
    data = open_dataset(blender)
    assert data.kind == "blender"
    assert names(data.split("test")) == ["test/r_0", "test/r_2", "test/r_10"]


def test_a_missing_blender_split_is_an_error(blender):
    with pytest.raises(FormatError, match="no train split"):
        open_dataset(blender).split("train")
    (blender / "transforms_test.json").rename(blender / "transforms_train.json")
    assert len(open_dataset(blender).split("train")) == 3
    with pytest.raises(FormatError, match=r"no test split; .*transforms_test\.json"):
        open_dataset(blender).split("test")


def test_a_missing_blender_photograph_is_an_error(blender):
    write_json(blender / "transforms_test.json", transforms(w=8, h=6))
    assert open_dataset(blender).split("test")
    (blender / "test" / "r_0.png").unlink()
    with pytest.raises(FormatError, match="no photograph test/r_0; restore"):
        open_dataset(blender).split("test")


def test_impossible_options_are_refused(blender):
    with pytest.raises(OptionError, match="leave `images` out"):
        open_dataset(blender, images="images_2")
    with pytest.raises(OptionError, match="choose 'test' or 'train'"):
        open_dataset(blender).split("val")


def test_cameras_without_photographs_are_not_a_data_set(tmp_path):
    file = write_json(tmp_path / "cameras.json", [trained_camera()])
    with pytest.raises(FormatError, match="the photographs are needed besides the cameras"):
        open_dataset(file)
    with pytest.raises(FormatError, match=r"neither transforms_test\.json nor sparse/0"):
        open_dataset(tmp_path)
    with pytest.raises(FormatError, match="neither"):
        open_dataset(write_model(tmp_path / "bare"))
    with pytest.raises(FormatError, match="does not exist"):
        open_dataset(tmp_path / "nowhere")


def test_cameras_are_read_from_each_layout(tmp_path, blender):
    model = write_model(tmp_path / "capture" / "sparse" / "0")
    for path in (model, model.parent.parent, model.parent.parent / "sparse" / "0"):
        assert len(cameras_from_file(path)) == 9
    assert len(cameras_from_file(blender)) == 3
    assert len(cameras_from_file(str(blender / "transforms_test.json"))) == 3
    run = write_json(tmp_path / "run" / "cameras.json", [trained_camera()]).parent
    assert len(cameras_from_file(run)) == len(cameras_from_file(run / "cameras.json")) == 1


def test_cameras_in_a_file_with_a_byte_order_mark_are_read(tmp_path):
    """Programs on Windows write it."""
    path = write_json(tmp_path / "cameras.json", [trained_camera()])
    plain = cameras_from_file(path)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert str(cameras_from_file(path)) == str(plain)


def test_cameras_of_all_transforms_files_are_listed(blender):
    train = [{"file_path": "./train/r_0", "transform_matrix": POSE}]
    write_json(blender / "transforms_train.json", transforms(train, w=8, h=6))
    listed = [camera.name for camera in cameras_from_file(blender)]
    assert listed == ["train/r_0", "test/r_0", "test/r_2", "test/r_10"]


def test_cameras_that_are_in_several_transforms_files_are_listed_once(tmp_path):
    frames = [{"file_path": f"images/{name}.png", "transform_matrix": POSE} for name in "abc"]
    moved = {**frames[0], "transform_matrix": [[1.0, 0, 0, 9.0], *POSE[1:]]}
    for name, listed_frames in (
        ("", frames),
        ("_train", frames[:2]),
        ("_test", [frames[2], moved]),
    ):
        write_json(tmp_path / f"transforms{name}.json", transforms(listed_frames, w=8, h=6))
    listed = [camera.name for camera in cameras_from_file(tmp_path)]
    assert listed == [f"images/{name}.png" for name in "abca"]


def test_sources_without_cameras_are_refused(tmp_path):
    with pytest.raises(FormatError, match="holds no cameras"):
        cameras_from_file(tmp_path)
    with pytest.raises(FormatError, match="cannot be read"):
        cameras_from_file(tmp_path / "nowhere.json")


@pytest.mark.parametrize("encoding", ["bin", "txt"])
@pytest.mark.parametrize("name", ["cameras", "images"])
def test_a_file_of_a_colmap_model_is_answered_with_its_folder(tmp_path, encoding, name):
    file = write_model(tmp_path, encoding=encoding) / f"{name}.{encoding}"
    with pytest.raises(FormatError, match="is one file of a COLMAP model; give its folder"):
        cameras_from_file(file)


def frame_with(blender, image):
    data = open_dataset(blender)
    frame = data.split("test")[0]
    image.save(frame.photo_path)
    return data, frame


def test_straight_alpha_is_composited_over_the_background(blender):
    data, frame = frame_with(blender, Image.new("RGBA", (8, 6), (255, 102, 0, 51)))
    photo = data.load_photo(frame, (0.0, 0.5, 1.0))
    assert photo.shape == (6, 8, 3)
    assert photo.dtype == np.float32
    # alpha 0.2: 0.2 * (1, 0.4, 0) + 0.8 * (0, 0.5, 1)
    np.testing.assert_allclose(photo[3, 4], [0.2, 0.48, 0.8], atol=1e-6)


def test_opaque_photographs_ignore_the_background(blender):
    data, frame = frame_with(blender, Image.new("RGB", (8, 6), (255, 102, 0)))
    np.testing.assert_array_equal(data.load_photo(frame, WHITE), data.load_photo(frame, BLACK))
    np.testing.assert_allclose(data.load_photo(frame, WHITE)[0, 0], [1, 0.4, 0], atol=1e-7)


def test_rows_of_a_photograph_start_at_the_top(blender):
    image = Image.new("RGB", (8, 6))
    image.putpixel((5, 1), (255, 255, 255))
    data, frame = frame_with(blender, image)
    assert np.argwhere(data.load_photo(frame, BLACK)[..., 0]).tolist() == [[1, 5]]


@pytest.mark.parametrize("mode", ["L", "LA", "P", "1"])
def test_other_image_modes_are_converted_to_rgb(blender, mode):
    data, frame = frame_with(blender, Image.new("RGB", (8, 6), WHITE_8).convert(mode))
    np.testing.assert_allclose(data.load_photo(frame, BLACK), 1)


def test_a_transparent_palette_entry_shows_the_background(blender):
    image = Image.new("P", (8, 6), 0)
    image.putpalette([255, 0, 0, 0, 255, 0])
    image.info["transparency"] = 0
    data, frame = frame_with(blender, image)
    np.testing.assert_allclose(data.load_photo(frame, (0, 0, 1)), np.full((6, 8, 3), (0, 0, 1)))


def test_sixteen_bit_photographs_are_refused(blender):
    data, frame = frame_with(blender, Image.new("I;16", (8, 6), 40_000))
    with pytest.raises(FormatError, match=r"convert it to 8 bits a channel"):
        data.load_photo(frame, BLACK)


@pytest.mark.parametrize("bits", [8, 16])
def test_of_colours_of_sixteen_bits_the_upper_eight_are_used(blender, bits):
    data, frame = frame_with(blender, Image.new("RGB", (8, 6)))
    colour = b"".join(bytes([value, 255][: bits // 8]) for value in (10, 20, 30))
    header = struct.pack(">2I5B", 8, 6, bits, 2, 0, 0, 0)
    chunks = {b"IHDR": header, b"IDAT": zlib.compress((b"\0" + 8 * colour) * 6), b"IEND": b""}
    frame.photo_path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + b"".join(
            struct.pack(">I", len(content)) + kind + content
            + struct.pack(">I", zlib.crc32(kind + content))
            for kind, content in chunks.items()
        )
    )  # fmt: skip
    found = data.load_photo(frame, BLACK)[0, 0]
    np.testing.assert_array_equal(found, np.float32([10, 20, 30]) / np.float32(255))


@pytest.mark.parametrize("most", [10, 30])  # Pillow refuses, or warns
def test_large_photographs_are_read_without_a_warning(tmp_path, monkeypatch, most):
    write_json(tmp_path / "transforms_test.json", transforms())
    for suffix in ("png", "jpg", *["webp"] * (most > 24)):  # its plugin refuses them too
        file = write_photo(tmp_path / "test" / f"r_0.{suffix}", (8, 6), (1, 2, 3))
        monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", most)
        data = open_dataset(tmp_path)
        (frame,) = data.split("test")
        assert frame.photo_path == file
        assert data.load_photo(frame, BLACK).shape == (6, 8, 3)
        file.unlink()
    other = write_photo(tmp_path / "a.bmp", (8, 6))
    with pytest.raises(FormatError, match=r"a\.bmp: has too many pixels; use smaller"):
        photo_size(other)


def test_a_photograph_whose_size_changed_is_refused(blender):
    data, frame = frame_with(blender, Image.new("RGB", (9, 6)))
    with pytest.raises(FormatError, match="is 9x6 pixels, but its camera is 8x6"):
        data.load_photo(frame, BLACK)


def test_loading_a_frame_without_photograph_is_an_error(blender):
    data = open_dataset(blender)
    frame = replace(data.split("test")[0], photo_path=None)
    with pytest.raises(FormatError, match="no photograph test/r_0"):
        data.load_photo(frame, BLACK)


@pytest.mark.parametrize(
    "background", [(1, 1), (0, 0, 1.1), (0, -0.1, 0), (0, 0, float("nan")), "white", 1.0]
)
def test_invalid_backgrounds_are_refused(blender, background):
    data = open_dataset(blender)
    with pytest.raises(OptionError, match="three numbers from 0 to 1"):
        data.load_photo(data.split("test")[0], background)


@settings(
    deadline=None, max_examples=80, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(where=st.floats(0, 1), value=st.integers(0, 255), keep=st.floats(0.2, 1))
def test_damaged_photographs_give_pixels_or_a_nanogs_error(blender, outcomes, where, value, keep):
    file = write_photo(blender / "test" / "r_0.png", (8, 6), (1, 2, 3))
    data = bytearray(file.read_bytes())
    data[min(int(where * len(data)), len(data) - 1)] = value
    file.write_bytes(data[: int(keep * len(data))])
    opened = open_dataset(blender)
    try:
        photo = opened.load_photo(opened.split("test")[0], WHITE)
    except NanogsError:
        outcomes["refused"] += 1
        return
    outcomes["read"] += 1
    assert np.isfinite(photo).all()


def test_the_shared_chair_has_the_expected_cameras(chair):
    data = open_dataset(chair)
    frames = data.split("test")
    assert data.kind == "blender"
    assert len(frames) == 20
    for frame in frames:
        camera = frame.camera
        assert (camera.width, camera.height, camera.cx, camera.cy) == (800, 800, 400, 400)
        assert camera.fx == camera.fy == pytest.approx(1111.111, abs=1e-3)
        # All cameras are on a sphere around the chair and look at its centre.
        assert np.linalg.norm(camera.position) == pytest.approx(4.031, abs=1e-3)
        np.testing.assert_allclose(
            camera.world_to_camera @ [0, 0, 0, 1], [0, 0, 4.031, 1], atol=2e-3
        )
        # Blender's up, z, is up in the image: down the camera's y axis.
        assert camera.world_to_camera[1, 2] < 0


def test_the_shared_chair_has_the_expected_photographs(chair):
    data = open_dataset(chair)
    frame = data.split("test")[0]
    white, black = data.load_photo(frame, WHITE), data.load_photo(frame, BLACK)
    assert white.shape == (800, 800, 3)
    np.testing.assert_array_equal(white[0, 0], 1)
    np.testing.assert_array_equal(black[0, 0], 0)
    assert 0 < black.mean() < white.mean() < 1

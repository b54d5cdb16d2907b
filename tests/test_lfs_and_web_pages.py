"""Git LFS pointers and web pages in the place of a model are recognised for every format."""

import pytest

from builders import random_splats
from nanogs import io
from nanogs.datasets.colmap_binary import read_cameras_binary
from nanogs.datasets.dataset import cameras_from_file
from nanogs.datasets.photos import photo_size
from nanogs.errors import FormatError
from nanogs.io.registry import formats

POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a21\nsize 12345\n"
PAGES = (
    b"<!DOCTYPE html><html>",
    b"\xef\xbb\xbf\n  <html lang='en'>",
    b"<?xml version='1.0'?><Error>",
)
READABLE = [known.suffix for known in formats() if known.readable]


@pytest.mark.parametrize("read", [io.load, io.inspect])
@pytest.mark.parametrize("suffix", READABLE)
def test_a_git_lfs_pointer_says_how_to_get_the_file(tmp_path, suffix, read):
    path = tmp_path / (suffix if suffix.endswith("json") else f"a{suffix}")
    path.write_bytes(POINTER)
    with pytest.raises(FormatError, match="is a Git LFS pointer, not the file itself: run git lfs"):
        read(path)


@pytest.mark.parametrize("page", PAGES)
@pytest.mark.parametrize("suffix", READABLE)
def test_a_web_page_in_place_of_a_model_is_refused(tmp_path, suffix, page):
    path = tmp_path / (suffix if suffix.endswith("json") else f"a{suffix}")
    path.write_bytes(page)
    with pytest.raises(FormatError, match="is a web page, not a model"):
        io.load(path)


@pytest.mark.parametrize("name", ["transforms.json", "cameras.json"])
def test_a_pointer_in_place_of_a_camera_file_is_recognised(tmp_path, name):
    (tmp_path / name).write_bytes(POINTER)
    with pytest.raises(FormatError, match="Git LFS pointer"):
        cameras_from_file(tmp_path / name)


def test_a_pointer_in_place_of_a_file_of_a_folder_is_recognised(tmp_path):
    """A scene that was cloned without Git LFS has its text, but not its pictures."""
    io.save(random_splats(9), tmp_path / "scene" / "meta.json")
    (tmp_path / "scene" / "sh0.webp").write_bytes(POINTER)
    with pytest.raises(FormatError, match=r"sh0\.webp is a Git LFS pointer"):
        io.load(tmp_path / "scene" / "meta.json")


@pytest.mark.parametrize(
    ("read", "name", "wanted"),
    [
        (photo_size, "r_0.png", "a photograph"),
        (read_cameras_binary, "cameras.bin", "a file of cameras"),
        (cameras_from_file, "cameras.json", "a file of cameras"),
    ],
)
def test_stand_ins_of_the_files_of_a_data_set_are_recognised(tmp_path, read, name, wanted):
    """A data set that was cloned without Git LFS has its folders, but not its pictures."""
    path = tmp_path / name
    path.write_bytes(POINTER)
    with pytest.raises(FormatError, match="is a Git LFS pointer, not the file itself: run git lfs"):
        read(path)
    path.write_bytes(PAGES[0])
    with pytest.raises(FormatError, match=f"is a web page, not {wanted};"):
        read(path)

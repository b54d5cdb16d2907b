"""Files whose suffix is that of another format: they are named for what they are."""

import gzip
import io
import re
import shutil
from pathlib import Path

import pytest

import nanogs
from builders import random_splats
from nanogs.errors import FormatError
from nanogs.io import registry

MISNAMED = {
    ".ply": (".splat", ".spz", ".glb", ".rad"),
    ".spz": (".ply", ".splat", ".sog", ".usda"),
    ".sog": (".spz", ".splat", ".ply"),
    ".glb": (".ply", ".spz"),
    ".rad": (".spz",),
}


@pytest.mark.parametrize("name", ["a", "a.data"])
def test_a_file_without_a_known_suffix_is_named_for_what_it_is(tmp_path, name):
    nanogs.save(random_splats(64), tmp_path / name, format=".spz")
    with pytest.raises(FormatError, match=r"a \.spz file; give it the suffix \.spz\.$"):
        nanogs.load(tmp_path / name)
    (tmp_path / name).write_bytes(gzip.compress(b"notes"))  # begins as a .spz does
    with pytest.raises(FormatError, match="unknown suffix"):
        nanogs.load(tmp_path / name)


@pytest.mark.parametrize("real", MISNAMED)
def test_a_file_of_another_format_is_named_by_it(tmp_path, real):
    nanogs.save(random_splats(64), tmp_path / f"a{real}")
    for named in MISNAMED[real]:
        wrong = tmp_path / f"wrong{named}"
        shutil.copy(tmp_path / f"a{real}", wrong)
        expected = f"like a {real} file, so it is no {named} file; give it the suffix {real}."
        with pytest.raises(FormatError, match=re.escape(expected)):
            nanogs.load(wrong)


def test_a_wrong_format_beside_the_name_is_named(tmp_path):
    nanogs.save(random_splats(64), tmp_path / "a.spz")
    stream = io.BytesIO((tmp_path / "a.spz").read_bytes())
    for model, called in ((tmp_path / "a.spz", tmp_path / "a.spz"), (stream, "The open file")):
        expected = f"{called} begins like a .spz file, so it is no .ply file; name the format .spz."
        with pytest.raises(FormatError, match=f"^{re.escape(expected)}$"):
            nanogs.load(model, format="ply")


def test_an_open_file_with_the_name_of_another_format_is_read_once_its_format_is_named(tmp_path):
    nanogs.save(random_splats(64), tmp_path / "a.splat", format=".spz")
    expected = "The open file begins like a .spz file, so it is no .splat file; name the format"
    with (tmp_path / "a.splat").open("rb") as file:
        with pytest.raises(FormatError, match=f"^{re.escape(expected)} \\.spz\\.$"):
            nanogs.load(file)
        file.seek(0)
        assert len(nanogs.load(file, format=".spz")) == 64


def test_a_ply_of_whole_rows_is_not_read_as_splat(tmp_path):
    """A `.splat` has no header: of any file whose length suits, rows could be read."""
    nanogs.save(random_splats(64), tmp_path / "a.ply")
    head, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n")
    fill = -len(head + b"comment \nend_header\n" + body) % 32
    whole = head + b"comment " + b"x" * fill + b"\nend_header\n" + body
    assert len(whole) % 32 == 0
    (tmp_path / "b.splat").write_bytes(whole)
    with pytest.raises(FormatError, match=r"begins like a \.ply file"):
        nanogs.load(tmp_path / "b.splat")


def test_other_gzip_files_are_not_taken_for_spz(tmp_path):
    nanogs.save(random_splats(64), tmp_path / "a.ply")
    for name in ("b.ply", "b.splat"):
        (tmp_path / name).write_bytes(gzip.compress((tmp_path / "a.ply").read_bytes()))
        with pytest.raises(FormatError, match="give it the suffix of its real format"):
            nanogs.load(tmp_path / name)


def test_a_damaged_compressed_ply_is_not_called_a_ply(tmp_path):
    nanogs.save(random_splats(64), tmp_path / "a.compressed.ply")
    data = (tmp_path / "a.compressed.ply").read_bytes()
    (tmp_path / "a.compressed.ply").write_bytes(data[:-9])
    with pytest.raises(FormatError, match="cut short"):
        nanogs.load(tmp_path / "a.compressed.ply")


def test_a_format_is_found_by_a_text_as_by_a_path():
    for name in ("a/B.Compressed.PLY", "https://host/a.compressed.ply?key=1"):
        assert registry.find(name).suffix == ".compressed.ply"
    assert registry.find("a.txt") is registry.find(Path("a.txt")) is None

"""Bad input: one sentence that names file, place and remedy, and never another exception."""

import re

import numpy as np
import pytest

from nanogs import io
from nanogs.errors import FormatError, OptionError
from nanogs.io.ply import read as reader
from nanogs.io.ply import rows as ply_rows
from plyfiles import BASE, ENCODINGS, ply, vertex

GOOD = ply(("vertex", vertex()))
ASCII = ply(("vertex", vertex()), encoding="ascii")
FACE = b"element face 1\nproperty list uchar int vertex_indices\nend_header"
MESH = ply(("vertex", vertex(3, ["x", "y", "z"]))).replace(b"end_header", FACE)


def assert_refused(path, words):
    with pytest.raises(FormatError, match=re.escape(words)) as caught:
        io.load(path)
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    return message


def without(*names):
    return ply(("vertex", vertex(3, [name for name in BASE if name not in names])))


def rest(*indices):
    return ply(("vertex", vertex(3, [*BASE, *(f"f_rest_{i}" for i in indices)])))


@pytest.mark.parametrize("line", [b"element e%d 0\n", b"property uchar e%d\n"])
def test_a_second_name_is_found_among_many_at_once(line, tmp_path):
    """A search through all names before it would take a minute for a header of a megabyte."""
    many = b"".join(line % number for number in [*range(40_000), 0])
    (tmp_path / "a.ply").write_bytes(GOOD.replace(b"end_header", many + b"end_header"))
    assert_refused(tmp_path / "a.ply", "a second")


def test_a_header_that_goes_on_beyond_a_megabyte_is_not_read_to_its_end(tmp_path):
    comments = b"comment as long as a usual one\n" * 40_000
    (tmp_path / "a.ply").write_bytes(GOOD.replace(b"end_header", comments + b"end_header"))
    assert_refused(tmp_path / "a.ply", "no 'end_header' line within the first 1048576 bytes")


def test_a_missing_file_is_refused(tmp_path):
    assert_refused(tmp_path / "none.ply", "no such file")


def test_a_folder_is_refused(tmp_path):
    (tmp_path / "d.ply").mkdir()
    assert_refused(tmp_path / "d.ply", "is a folder")


def test_unknown_suffix_lists_the_known_ones(tmp_path):
    assert_refused(tmp_path / "a.obj", ".compressed.ply, .ply, .splat")


@pytest.mark.parametrize("name", ["a.obj", "a.ksplat"])
def test_saving_in_formats_that_are_not_written_is_refused(tmp_path, name):
    (tmp_path / "a.ply").write_bytes(GOOD)
    with pytest.raises(OptionError, match=r"it writes .*\.ply"):
        io.save(io.load(tmp_path / "a.ply"), tmp_path / name)
    with pytest.raises(OptionError, match=r"it writes .*\.ply"):
        io.check_writable(tmp_path / name)


@pytest.mark.parametrize("name", ["small", "new/"])
def test_an_output_without_a_suffix_gets_an_example(tmp_path, name):
    with pytest.raises(OptionError) as caught:
        io.check_writable(f"{tmp_path}/{name}")
    path = tmp_path / name
    assert str(caught.value).endswith(f"such as {path}.ply or {path / 'scene.ply'}.")


def test_check_writable_uses_a_given_format(tmp_path):
    io.check_writable(tmp_path / "a.obj", format="ply")
    io.check_writable(tmp_path / "a", format=".spz", format_options={"spz_version": 2})
    for name, options in (("a.ply", {"format": "ksplat"}), ("a.ply", {"format": "obj"})):
        with pytest.raises(OptionError, match=r"\.ply"):
            io.check_writable(tmp_path / name, **options)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "is empty (0 bytes)"),
        (b"\x89PNG\r\n", "not a PLY file"),
        (GOOD[:60], "ends inside its header (line 4"),
        (GOOD[: GOOD.index(b"end_header")], "ends inside its header"),
        (b"ply\n" + b"comment x\n" * 200_000, "no 'end_header' line within"),
        (b"ply\n" + b"x" * 2_000_000, "no 'end_header' line within"),
        (GOOD.replace(b"vertex", b"points"), "no element 'vertex' (its elements: 'points')"),
        (GOOD.replace(b"vertex 3", b"vertex 0"), "'vertex' has no rows"),
        (GOOD.replace(b"vertex 3", b"vertex -3"), "line 3: element 'vertex' has the impossible"),
        (GOOD.replace(b"vertex 3", b"vertex 3.0"), "impossible count '3.0'"),
        (GOOD.replace(b"vertex 3", b"vertex 9" + b"9" * 5000), "impossible count"),
        (GOOD.replace(b"vertex 3", b"vertex 999999999999999999"), "cut short"),
        (ASCII.replace(b"vertex 3", b"vertex 999999999999999999"), "cut short"),
        (GOOD.replace(b"vertex 3", b"vertex"), "needs a name and a count"),
        (GOOD.replace(b"float x", b"flot x"), "line 4: unknown type 'flot' of property 'x'"),
        (GOOD.replace(b"end_header", FACE.replace(b"uchar", b"byte")), "unknown type 'byte'"),
        (GOOD.replace(b"end_header", FACE.replace(b" int", b" in")), "unknown type 'in'"),
        (GOOD.replace(b"float x", b"float y"), "line 5: a second property 'y'"),
        (GOOD.replace(b"float x", b"float"), "needs a type and a name"),
        (GOOD.replace(b"end_header", b"element vertex 1\nend_header"), "second element 'vertex'"),
        (GOOD.replace(b"end_header", FACE), "element 'face' has the list property"),
        (GOOD.replace(b"float x", b"list uchar float x"), "'vertex' has the list property 'x'"),
        (GOOD.replace(b"end_header", b"element e 4\nend_header"), "has 4 rows but no properties"),
        (GOOD.replace(b"element", b"property float q\nelement"), "a property before any element"),
        (GOOD.replace(b"element", b"banana 1\nelement"), "unknown keyword 'banana'"),
        (GOOD.replace(b"element", b"format ascii 1.0\nelement"), "a second 'format' line"),
        (GOOD.replace(b" 1.0", b" 2.0"), "version 1.0"),
        (GOOD.replace(b"little", b"middle"), "the format must be one of"),
        (GOOD.replace(b"format binary_little_endian 1.0\n", b""), "has no 'format' line"),
        (without("scale_1"), "lacks scale_1: it is damaged"),
        (without("scale_2", "opacity"), "lacks opacity, scale_2"),
        (without("rot_1", "opacity"), "lacks opacity, rot_1"),
        (ply(("vertex", vertex(3, ["x", "y", "z"]))), "a point cloud or mesh"),
        (MESH, "rot_3: it is a point cloud or mesh, not a 3D Gaussian splatting model"),
        (rest(*range(10)), "has 10 f_rest properties"),
        (rest(0), "has 1 f_rest property, but"),
        (rest(*range(1, 10)), "f_rest_0 is missing"),
        (GOOD[:-1], "should have 3 rows of 56 bytes, but only 2 (167 bytes)"),
        (GOOD + b"\0", "1 byte follows the last row"),
        (ASCII + b"1 2 3\n", "text follows the last row"),
        (ASCII[: ASCII.rindex(b"3.0 6.0")], "row 3 of 3 of element 'vertex' has 0 values"),
        (ASCII.replace(b"2.0 4.0 6.0", b"2.0 4.0"), "row 2 of 3 of element 'vertex' has 13 values"),
        (ASCII.replace(b"2.0 4.0", b"2.0 4_0"), "row 2 of 3 of element 'vertex': '4_0'"),
        (ASCII.replace(b"2.0 4.0", b"2.0 0x4"), "row 2 of 3 of element 'vertex': '0x4'"),
    ],
)
def test_damaged_files_are_refused_in_one_sentence(tmp_path, data, message):
    path = tmp_path / "bad.ply"
    path.write_bytes(data)
    assert_refused(path, message)


@pytest.mark.parametrize("value", [300, -1, 1.5, float("nan"), float("inf")])
def test_text_outside_the_range_of_an_integer_type_is_refused(tmp_path, value):
    columns = vertex(1)
    data = ply(("vertex", [*columns, ("label", "uchar", np.array([7]))]), encoding="ascii")
    path = tmp_path / "a.ply"
    path.write_bytes(data[:-2] + str(value).encode() + b"\n")
    assert_refused(path, "is no value of type u1 for 'label'")


@pytest.mark.parametrize(
    ("kind", "value", "held"),
    [
        ("float", "1e39", False), ("float", "-3.5e38", False), ("double", "1e999", False),
        ("float", "3.4e38", True), ("float", "-inf", True), ("float", "Infinity", True),
        ("float", "nan", True), ("double", "1e300", True), ("float", "1e-400", True),
    ],
)  # fmt: skip
def test_text_beyond_the_range_of_a_float_type_is_refused(tmp_path, kind, value, held):
    """It would become infinite, which is only what it says if the file says so."""
    columns = [*vertex(1), ("label", kind, np.array([7.0]))]
    data = ply(("vertex", columns), encoding="ascii")
    path = tmp_path / "a.ply"
    path.write_bytes(data[: data.rindex(b"7.0")] + value.encode() + b"\n")
    if held:
        assert io.load(path).extras["label"].astype(str) == str(float(value))
    else:
        assert_refused(path, f"is no value of type {'f4' if kind == 'float' else 'f8'} for 'label'")


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_every_truncation_is_refused(tmp_path, encoding):
    data = ply(("vertex", vertex(2)), encoding=encoding)
    path = tmp_path / "cut.ply"
    for end in range(0, len(data) - 4, 3):
        path.write_bytes(data[:end])
        with pytest.raises(FormatError):
            io.load(path)


def test_a_file_that_becomes_shorter_while_it_is_read_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "shrinking.ply"
    path.write_bytes(ply(("vertex", vertex(9))))
    check = ply_rows.check_body

    def check_and_cut(header):
        check(header)
        with path.open("r+b") as file:
            file.truncate(path.stat().st_size - 5)

    monkeypatch.setattr(reader, "check_body", check_and_cut)
    assert_refused(path, "became shorter while it was read")

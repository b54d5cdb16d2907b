"""Reading and writing `.ply`: what must be kept, and how."""

import os
import subprocess
import sys
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from nanogs import io
from nanogs.activations import smooth
from nanogs.errors import FormatError, OutputError
from nanogs.splats import ExtraElement, RenderMode
from part_reading import in_parts
from plyfiles import BASE, ENCODINGS, ply, vertex
from strategies import assert_same


@pytest.fixture
def load(tmp_path):
    def load(data, name="in.ply"):
        (tmp_path / name).write_bytes(data)
        return io.load(tmp_path / name)

    return load


@pytest.fixture
def resave(tmp_path):
    def resave(model):
        io.save(model, tmp_path / "out.ply", overwrite=True)
        return (tmp_path / "out.ply").read_bytes()

    return resave


def rest(count):
    return [f"f_rest_{i}" for i in range(count)]


def test_columns_are_assigned_by_name(load):
    model = load(ply(("vertex", vertex())))
    assert model.means[0].tolist() == [1, 2, 3]
    assert model.sh[0, 0].tolist() == [4, 5, 6]
    assert model.opacity_logits[0] == 7
    assert model.log_scales[0].tolist() == [8, 9, 10]
    assert model.quats[0].tolist() == [11, 12, 13, 14]
    assert model.means[2].tolist() == [3, 6, 9]
    assert model.notes == ()


def test_column_order_does_not_matter(load):
    columns = vertex()
    assert_same(
        load(ply(("vertex", columns))), load(ply(("vertex", [*columns[7:], *columns[6::-1]])))
    )


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_all_encodings_give_the_same_model(load, encoding):
    columns = vertex(5, [*BASE, *rest(9), "label"], {"label": "short"})
    columns[6][2][0] = -5
    assert_same(load(ply(("vertex", columns))), load(ply(("vertex", columns), encoding=encoding)))


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_models_longer_than_a_block_are_read(load, monkeypatch, encoding):
    whole = load(ply(("vertex", vertex(100))))
    monkeypatch.setattr("nanogs.io.ply.rows.BLOCK_ROWS", 7)
    assert_same(whole, load(ply(("vertex", vertex(100)), encoding=encoding)))


def test_models_longer_than_a_block_are_written(load, resave, monkeypatch):
    model = load(ply(("vertex", vertex(100))))
    whole = resave(model)
    monkeypatch.setattr("nanogs.io.ply.write.BLOCK_ROWS", 7)
    assert resave(model) == whole


@pytest.mark.parametrize("spans", [3, 64], ids=["several blocks each", "a block each"])
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_parts_read_by_threads_join_to_the_whole(load, monkeypatch, encoding, spans):
    """With columns of an array in its own order, in another one, of another type, and extras."""
    names = [*BASE[:2], "label", *BASE[2:], *rest(24)]
    columns = vertex(100, names, {"label": "uchar", "scale_1": "double", "f_rest_3": "int"})
    columns[-3] = (columns[-3][0], "double", np.where(np.arange(100) % 9, 0.5, 1e300))
    columns[5] = (columns[5][0], "double", np.where(np.arange(100) % 7, 0.5, 1e300))
    data = ply(("vertex", columns), ("more", [("f", "float", np.arange(40.0))]), encoding=encoding)
    whole = load(data)
    monkeypatch.setattr("nanogs.io.ply.read._PART_ROWS", 11)
    monkeypatch.setattr("nanogs.io.ply.read._SPANS", spans)
    parts = load(data)
    assert_same(whole, parts)
    assert whole.notes == parts.notes
    assert any("15 values of" in str(note) for note in parts.notes)
    assert any("12 values of" in str(note) for note in parts.notes)


@pytest.mark.parametrize(("count", "degree"), [(0, 0), (9, 1), (24, 2), (45, 3), (72, 4)])
def test_f_rest_is_channel_major(load, count, degree):
    columns = vertex(2, BASE) + [(n, "float", np.full(2, i)) for i, n in enumerate(rest(count))]
    model = load(ply(("vertex", columns)))
    assert model.sh_degree == degree
    assert model.sh[0, 1:].T.ravel().tolist() == list(range(count))


@pytest.mark.parametrize("alias", ["float32", "float"])
def test_type_aliases_are_read(load, alias):
    data = ply(("vertex", vertex(3, [*BASE, "a"], {"a": "uchar"})))
    data = data.replace(b"property float ", f"property {alias} ".encode())
    model = load(data.replace(b"uchar", b"uint8"))
    assert model.extras["a"].dtype == np.uint8
    assert model.means.dtype == np.float32


def test_double_centres_stay_double(load, resave):
    model = load(ply(("vertex", vertex(3, BASE, dict.fromkeys("xyz", "double")))))
    assert model.means.dtype == np.float64
    assert model.notes == ()
    assert b"property double x\n" in resave(model)


@pytest.mark.parametrize("kind", ["int", "uint"])
def test_centres_of_whole_numbers_stay_exact(load, kind):
    columns = vertex(3, BASE, {"y": kind})
    columns[1] = ("y", kind, [2**24 + 1, 2**31 - 1, 7])
    model = load(ply(("vertex", columns)))
    assert model.means[:, 1].tolist() == [2**24 + 1, 2**31 - 1, 7]
    assert model.notes == ()


def test_other_doubles_become_float_with_a_note(load):
    model = load(ply(("vertex", vertex(3, BASE, {"opacity": "double"}))))
    assert model.opacity_logits.tolist() == [7, 14, 21]
    assert model.notes == ("1 double column became float: opacity.",)


def test_double_beyond_float_is_reported(load):
    columns = vertex(3, BASE, {"opacity": "double"})
    columns[6] = ("opacity", "double", np.array([1.0, 1e300, np.inf]))
    model = load(ply(("vertex", columns)))
    assert "1 value of 'opacity' became infinite when converted to float32." in model.notes


def test_doubles_beyond_float_in_adjacent_columns_are_reported(load):
    columns = vertex(3, BASE, dict.fromkeys(BASE[3:6], "double"))
    columns[4] = (BASE[4], "double", np.array([-1e300, 2.0, 1e300]))
    model = load(ply(("vertex", columns)))
    assert model.sh[:, 0, 1].tolist() == [-np.inf, 2, np.inf]
    assert "2 values of 'f_dc_1' became infinite when converted to float32." in model.notes


def test_integer_colours_become_float_with_a_note(load):
    model = load(ply(("vertex", vertex(3, BASE, {"f_dc_0": "int"}))))
    assert model.sh[:, 0, 0].tolist() == [4, 8, 12]
    assert model.notes == ("1 int column became float: f_dc_0.",)


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize(
    "comments", [(), ("SplatRenderMode: 2dgs",), ("SplatRenderMode: default",)]
)
def test_two_scales_are_those_of_flat_splats(load, resave, tmp_path, encoding, comments):
    names = [name for name in BASE if name != "scale_2"]
    columns = vertex(5, names)
    model = load(ply(("vertex", columns), encoding=encoding, comments=comments))
    values = {name: column for name, _, column in columns}
    assert np.array_equal(model.log_scales[:, 0], values["scale_0"])
    assert np.array_equal(model.log_scales[:, 1], values["scale_1"])
    assert (model.log_scales[:, 2] == -np.inf).all()
    assert np.array_equal(model.quats[:, 0], values["rot_0"])
    assert model.render_mode is RenderMode.SURFEL
    assert [note for note in model.notes if "two scales" in note]
    info = io.inspect(tmp_path / "in.ply")
    assert (info.render_mode, info.render_tag) == ("2dgs", "its two scales per splat")
    with in_parts(tmp_path / "in.ply") as read:
        assert_same(read(2, 4), model.take(slice(2, 4)))
    data = resave(model)
    assert b"comment SplatRenderMode: 2dgs\n" in data
    assert b"property float scale_2\n" in data
    assert_same(replace(load(data), comments=()), replace(model, comments=()))


SMOOTHED = (
    "The smoothing filter of Mip-Splatting (filter_3D) was applied to scales and opacities, as"
    " viewers need it."
)


def smoothing_columns():
    """Four splats: unfiltered, filtered, nearly opaque and filtered much, and with a NaN width."""
    widths, opacities = np.array([0, 0.3, 2.0, np.nan]), np.array([1.5, -0.7, 16.0, 0.0])
    scales = np.log(np.array([[0.1, 0.2, 0.3], [0.5, 0.01, 0.3], [1e-3, 1e-2, 3.0], [1, 1, 1]]))
    columns = [
        [name, kind, values] for name, kind, values in vertex(4, [*BASE, "filter_3D", "label"])
    ]
    for column in columns:
        if column[0].startswith("scale_"):
            column[2] = scales[:, int(column[0][-1])]
        elif column[0] in ("opacity", "filter_3D"):
            column[2] = opacities if column[0] == "opacity" else widths
    return columns, scales, opacities, widths


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_the_smoothing_filter_is_applied(load, resave, tmp_path, encoding):
    columns, scales, opacities, widths = smoothing_columns()
    model = load(ply(("vertex", columns), encoding=encoding))
    assert SMOOTHED in model.notes
    assert list(model.extras) == ["label"]
    assert io.inspect(tmp_path / "in.ply").extras == ("label",)
    # As Mip-Splatting's `save_fused_ply` computes it, in double precision.
    before, after = np.exp(2 * scales), np.exp(2 * scales) + widths[:, None] ** 2
    alpha = np.sqrt(before.prod(axis=1) / after.prod(axis=1)) / (1 + np.exp(-opacities))
    np.testing.assert_allclose(model.log_scales, 0.5 * np.log(after), rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(model.opacity_logits, np.log(alpha / (1 - alpha)), rtol=2e-6)
    assert np.array_equal(model.log_scales[0], scales[0].astype(np.float32))
    assert model.opacity_logits[0] == np.float32(1.5)
    with in_parts(tmp_path / "in.ply") as read:
        assert_same(read(1, 3), model.take(slice(1, 3)))
    again = load(resave(model))
    assert SMOOTHED not in again.notes, "applied only once"
    assert_same(replace(again, notes=()), replace(model, notes=()))


def test_smoothing_keeps_the_integral_of_every_gaussian():
    rng = np.random.default_rng(0)
    scales, logits = rng.normal(-3, 2, (500, 3)), rng.normal(0, 8, 500)
    smoothed, faded = scales.astype(np.float32), logits.astype(np.float32)
    smooth(smoothed, faded, np.exp(rng.normal(-3, 2, 500)).astype(np.float32))
    before = scales.sum(axis=1) - np.logaddexp(0, -logits)
    after = smoothed.astype(np.float64).sum(axis=1) - np.logaddexp(0, -faded.astype(np.float64))
    np.testing.assert_allclose(after, before, atol=2e-5)
    assert (smoothed >= scales.astype(np.float32)).all()


def test_a_filter_of_flat_splats_stays_a_column(load):
    names = [name for name in BASE if name != "scale_2"]
    model = load(ply(("vertex", vertex(3, [*names, "filter_3D"]))))
    assert list(model.extras) == ["filter_3D"]


def test_extras_keep_dtype_values_and_order(load, resave):
    names = ["label", *BASE, "nx", "id"]
    model = load(ply(("vertex", vertex(3, names, {"label": "uchar", "id": "int"}))))
    assert {n: c.dtype.str[1:] for n, c in model.extras.items()} == {
        "label": "u1",
        "nx": "f4",
        "id": "i4",
    }
    data = resave(model)
    written = [line.split()[-1].decode() for line in data.split(b"\n") if b"property" in line]
    assert written == ["x", "y", "z", "nx", *BASE[3:], "label", "id"]
    assert load(data).extras["label"].tolist() == model.extras["label"].tolist()


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_elements_before_and_after_vertex_are_kept(load, resave, encoding):
    before = ("camera", [("f", "float", np.array([0.5, 2.5]))])
    after = ("tag", [("id", "uint", np.array([7, 4294967295])), ("k", "uchar", np.array([1, 2]))])
    model = load(ply(before, ("vertex", vertex()), after, encoding=encoding))
    assert [e.name for e in model.elements] == ["camera", "tag"]
    assert model.elements[1].rows["id"].tolist() == [7, 4294967295]
    assert model.means[0].tolist() == [1, 2, 3]
    assert_same(model, load(resave(model)))


def test_empty_face_element_is_left_out_with_a_note(load):
    data = ply(("vertex", vertex()))
    face = b"element face 0\nproperty list uchar int vertex_indices\nend_header"
    model = load(data.replace(b"end_header", face))
    assert model.elements == ()
    assert model.notes == ("The empty element 'face' was left out.",)


@pytest.mark.parametrize(
    ("comments", "mode"),
    [
        ([], RenderMode.DEFAULT),
        (["SplatRenderMode: mip"], RenderMode.MIP),
        (["splatrendermode: 2DGS"], RenderMode.SURFEL),
        (["antialiased 1"], RenderMode.MIP),
        (["antialiased 0"], RenderMode.DEFAULT),
        (["SplatRenderMode: banana"], RenderMode.DEFAULT),
        (["antialiased 1", "SplatRenderMode: 2dgs"], RenderMode.SURFEL),
    ],
)
def test_render_mode_is_read_and_survives(load, resave, comments, mode):
    model = load(ply(("vertex", vertex()), comments=comments))
    assert model.render_mode is mode
    assert load(resave(model)).render_mode is mode


def test_render_tag_is_not_duplicated(load, resave):
    model = load(ply(("vertex", vertex()), comments=["made by hand", "antialiased 1"]))
    assert load(resave(model)).comments == ("made by hand", "antialiased 1")


def test_changed_render_mode_replaces_the_tag(load, resave):
    model = load(ply(("vertex", vertex()), comments=["antialiased 1", "me"]))
    surfel = load(resave(replace(model, render_mode=RenderMode.SURFEL)))
    assert surfel.comments == ("me", "SplatRenderMode: 2dgs")
    assert load(resave(replace(model, render_mode=RenderMode.DEFAULT))).comments == ("me",)


def test_contradicting_tags_are_noted(load):
    model = load(ply(("vertex", vertex()), comments=["antialiased 1", "SplatRenderMode: 2dgs"]))
    assert model.notes == ("The comments state 2 render modes; the last one (2dgs) was taken.",)


def test_comment_bytes_survive_in_any_encoding(load, resave, tmp_path):
    raw = b"comment caf\xe9  \xc3\xa9 \n"
    model = load(ply(("vertex", vertex())).replace(b"element", raw + b"element"))
    assert raw in resave(model)
    assert io.inspect(tmp_path / "out.ply").comments[0].startswith("café")


def test_obj_info_becomes_a_comment_with_a_note(load):
    model = load(ply(("vertex", vertex())).replace(b"element", b"obj_info num 3\nelement"))
    assert model.comments == ("num 3",)
    assert model.notes == ("1 obj_info line was kept as a comment.",)
    model = load(ply(("vertex", vertex())).replace(b"element", b"obj_info a\nobj_info b\nelement"))
    assert model.notes == ("2 obj_info lines were kept as comments.",)


def test_a_source_has_the_comments_of_the_model(tmp_path, load):
    """Byte for byte, with those of `obj_info`, because results made in blocks copy them."""
    lines = b"comment caf\xe9\nobj_info num 3\nelement"
    model = load(ply(("vertex", vertex())).replace(b"element", lines, 1))
    path = tmp_path / "b.ply"
    io.save(model, path)
    path.write_bytes(path.read_bytes().replace(b"comment num", b"obj_info num"))
    with io.open(path) as source:
        assert source.columns.comments == source.load().comments == ("caf\udce9", "num 3")


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_carriage_returns_in_the_header_are_accepted(load, encoding):
    data = ply(("vertex", vertex()), encoding=encoding, eol="\r\n", comments=["hi"])
    model = load(data)
    assert model.means[0].tolist() == [1, 2, 3]
    assert model.comments == ("hi",)


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("value", [np.inf, -np.inf, np.nan])
def test_infinities_and_nan_are_read_as_they_are(load, encoding, value):
    columns = vertex()
    columns[6] = ("opacity", "float", np.array([1.5, value, 0]))
    model = load(ply(("vertex", columns), encoding=encoding))
    assert np.array_equal(model.opacity_logits, np.float32([1.5, value, 0]), equal_nan=True)


def test_arrays_do_not_depend_on_the_file(load, tmp_path):
    model = load(ply(("vertex", vertex())))
    path = tmp_path / "in.ply"
    path.write_bytes(bytes(path.stat().st_size))
    io.save(model, path, overwrite=True)
    assert io.load(path).means[0].tolist() == model.means[0].tolist() == [1, 2, 3]
    assert type(model.means) is np.ndarray


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"extras": {"a": np.zeros(3, np.int64)}}, "int64"),
        ({"extras": {"a b": np.zeros(3, np.float32)}}, "space"),
        ({"extras": {"": np.zeros(3, np.float32)}}, "empty"),
        ({"extras": {"opacity": np.zeros(3, np.float32)}}, "own name"),
        ({"extras": {"f_rest_0": np.zeros(3, np.float32)}}, "own name"),
        ({"comments": ["a\nend_header"]}, "line break"),
        ({"comments": ["\ud800"]}, "encoded"),
        ({"comments": ["x" * (1 << 20)]}, "header"),
        ({"elements": [ExtraElement("vertex", np.zeros(1, [("a", "f4")]))]}, "Two elements"),
        ({"elements": [ExtraElement("e", np.zeros(1, [("a", "i8")]))]}, "int64"),
        ({"elements": [ExtraElement("e", np.zeros(1, [("a", "f4", 3)]))]}, "dimensions"),
    ],
)
def test_models_that_ply_cannot_hold_are_refused_and_leave_no_file(load, tmp_path, change, message):
    model = replace(load(ply(("vertex", vertex()))), **change)
    with pytest.raises(OutputError, match=message):
        io.save(model, tmp_path / "out.ply")
    assert [p.name for p in tmp_path.iterdir()] == ["in.ply"]


def test_inspect_describes_the_columns_and_elements(tmp_path):
    columns = vertex(4, [*BASE, *rest(9), "label"], {"label": "uchar", "x": "double"})
    extra = ("camera", [("f", "float", np.array([0.5]))])
    data = ply(("vertex", columns), extra, encoding="binary_big_endian", comments=["antialiased 1"])
    path = tmp_path / "a.PLY"
    path.write_bytes(data)
    info = io.inspect(path)
    assert (info.format, info.encoding) == ("ply", "binary_big_endian")
    assert (info.splats, info.sh_degree, info.file_bytes) == (4, 1, len(data))
    assert info.double_means
    assert info.properties[0] == ("x", "double")
    assert info.extras == ("label",)
    assert info.elements == (("camera", 1),)
    assert info.render_mode is RenderMode.MIP


def test_inspect_does_not_read_the_rows_of_text(load, tmp_path):
    data = ply(("vertex", vertex()), encoding="ascii")
    header, end, body = data.partition(b"end_header\n")
    with pytest.raises(FormatError, match="no value of type"):
        load(header + end + body.replace(b"1", b"x"))
    assert io.inspect(tmp_path / "in.ply").splats == 3


def test_inspect_does_not_read_binary_rows(tmp_path):
    """Measured by its memory: the file, most of which is a hole, has 224 MB."""
    header = ply(("vertex", vertex(0))).replace(b"vertex 0\n", b"vertex 4000000\n")
    path = tmp_path / "large.ply"
    path.write_bytes(header)
    os.truncate(path, len(header) + 4_000_000 * 4 * len(BASE))
    tracemalloc.start()
    try:
        info = io.inspect(path)
        used = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert info.splats == 4_000_000
    assert used < 1e6


def test_io_does_not_import_numba():
    code = "import sys, nanogs.io; sys.exit('numba' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0

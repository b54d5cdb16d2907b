"""glTF as text, with a buffer in another file, packed as SPZ, and with colours in linear light."""

import base64
import json
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from builders import random_splats
from nanogs import io
from nanogs.errors import FormatError
from nanogs.io.gltf import packed_write as gltf_spz
from nanogs.io.parts import Whole
from nanogs.sh import basis
from nanogs.splats import ExtraElement, RenderMode
from strategies import assert_same
from test_gltf import PREFIX, columns, document, glb

NO_TURN = [{"mesh": 0, "rotation": [0, 0, 1, 0]}]


def as_text(content, body, uri=None):
    """Return the text of a `.gltf` file, with its buffer as a `data:` URI unless one is given."""
    data = "data:application/octet-stream;base64," + base64.b64encode(body).decode()
    content = json.loads(json.dumps(content))
    content["buffers"][0]["uri"] = uri or data
    return json.dumps(content, indent=1)


@pytest.fixture
def content_and_buffer():
    return document(columns(random_splats(300, degree=2, seed=3)), nodes=NO_TURN)


@pytest.fixture
def expected(content_and_buffer, tmp_path):
    (tmp_path / "whole.glb").write_bytes(glb(*content_and_buffer))
    return io.load(tmp_path / "whole.glb")


def test_a_text_file_with_a_data_uri_is_the_same_model(content_and_buffer, expected, tmp_path):
    (tmp_path / "a.gltf").write_text(as_text(*content_and_buffer))
    assert_same(io.load(tmp_path / "a.gltf"), expected)
    info = io.inspect(tmp_path / "a.gltf")
    assert (info.format, info.splats, info.sh_degree) == ("gltf", 300, 2)
    assert info.file_bytes == (tmp_path / "a.gltf").stat().st_size


def test_a_comment_that_looks_like_a_data_uri_is_kept(tmp_path):
    comments = ["data:" + "x" * 400, '"uri":"data:' + "y" * 400]
    model = replace(random_splats(5), comments=comments)
    io.save(model, tmp_path / "a.gltf")
    assert io.load(tmp_path / "a.gltf").comments == tuple(comments)


def test_a_text_file_may_escape_its_slashes(content_and_buffer, expected, tmp_path):
    (tmp_path / "a.gltf").write_text(as_text(*content_and_buffer).replace("/", "\\/"))
    assert_same(io.load(tmp_path / "a.gltf"), expected)


@pytest.mark.parametrize("piece_size", [1, 2, 5, 6, 7, 100, 257, 1000])
def test_a_text_file_is_read_in_pieces_of_any_size(
    content_and_buffer, expected, tmp_path, monkeypatch, piece_size
):
    content, body = content_and_buffer
    content["extras"] = ["data:", '"data:a', 'x"data:', "data:" + "y" * 250, "data:" + "z" * 300]
    (tmp_path / "a.gltf").write_text(as_text(content, body))
    monkeypatch.setattr("nanogs.io.gltf.glb._PIECE", piece_size)
    assert_same(io.load(tmp_path / "a.gltf"), expected)
    with io.open(tmp_path / "a.gltf") as source:
        assert np.array_equal(source.read(7, 200).sh, expected.sh[7:200])


def test_only_the_requested_part_of_a_data_uri_is_decoded(tmp_path):
    model = random_splats(40_000, degree=3)
    io.save(model, tmp_path / "a.gltf")
    size = (tmp_path / "a.gltf").stat().st_size
    assert size > 10_000_000
    tracemalloc.start()
    with io.open(tmp_path / "a.gltf") as source:
        part = source.read(20_000, 20_100)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert np.array_equal(part.means, model.means[20_000:20_100])
    assert peak < 6_000_000


@pytest.mark.parametrize("character", ["!", "=", "é"])
def test_a_damaged_data_uri_is_refused(content_and_buffer, tmp_path, character):
    text = as_text(*content_and_buffer)
    index = text.index("base64,") + 4001
    (tmp_path / "a.gltf").write_text(text[:index] + character + text[index + 1 :], encoding="utf-8")
    with pytest.raises(FormatError, match="damaged"):
        io.load(tmp_path / "a.gltf")


@pytest.mark.parametrize("uri", ["b.bin", "./sub/b%20c.bin", "b.bin?v=1"])
def test_a_text_file_may_have_its_buffer_in_another_file(
    content_and_buffer, expected, tmp_path, uri
):
    name = uri.replace("%20", " ").partition("?")[0]
    (tmp_path / "sub").mkdir()
    (tmp_path / name).write_bytes(content_and_buffer[1])
    (tmp_path / "a.gltf").write_text(as_text(*content_and_buffer, uri))
    assert_same(io.load(tmp_path / "a.gltf"), expected)
    assert io.inspect(tmp_path / "a.gltf").file_bytes == sum(
        (tmp_path / each).stat().st_size for each in ("a.gltf", name)
    )
    assert io.open(tmp_path / "a.gltf").files == (tmp_path / "a.gltf", tmp_path / name)
    part = io.open(tmp_path / "a.gltf").read(7, 200)
    assert np.array_equal(part.sh, expected.sh[7:200])


def test_text_and_binary_files_are_recognised_by_their_first_bytes(
    content_and_buffer, expected, tmp_path
):
    (tmp_path / "a.gltf").write_bytes(glb(*content_and_buffer))
    (tmp_path / "a.glb").write_text(as_text(*content_and_buffer))
    assert_same(io.load(tmp_path / "a.gltf"), expected)
    assert_same(io.load(tmp_path / "a.glb"), expected)


def test_a_buffer_file_that_is_too_short_is_refused(content_and_buffer, tmp_path):
    (tmp_path / "b.bin").write_bytes(content_and_buffer[1][:-1])
    (tmp_path / "a.gltf").write_text(as_text(*content_and_buffer, "b.bin"))
    with pytest.raises(FormatError, match="does not fit into its buffer"):
        io.load(tmp_path / "a.gltf")


def test_many_small_data_uris_take_little_memory(tmp_path):
    (tmp_path / "a.gltf").write_bytes(b'{"a":[' + b'"data:",' * 600_000 + b"1]}")
    tracemalloc.start()
    with pytest.raises(FormatError, match="reads up to 4194304"):
        io.load(tmp_path / "a.gltf")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 5 * 4_800_000


def test_required_material_extensions_are_ignored(content_and_buffer, expected, tmp_path):
    content, body = content_and_buffer
    content["extensionsRequired"] = ["KHR_gaussian_splatting", "KHR_materials_unlit"]
    (tmp_path / "a.glb").write_bytes(glb(content, body))
    assert_same(io.load(tmp_path / "a.glb"), expected)


# Packed as SPZ


def packed(path, model):
    with path.open("wb") as file:
        gltf_spz.write(model, file)
    return path


@pytest.mark.parametrize("degree", [0, 3])
def test_packed_splats_are_those_of_an_spz_file(tmp_path, degree):
    model = replace(random_splats(500, degree=degree, seed=4), render_mode=RenderMode.MIP)
    path = packed(tmp_path / "a.glb", model)
    io.save(model, tmp_path / "a.spz")
    loaded = io.load(path)
    assert_same(loaded, io.load(tmp_path / "a.spz"))
    info = io.inspect(path)
    assert (info.splats, info.sh_degree, info.format) == (500, degree, "glb")
    assert (info.encoding, info.render_mode) == ("gzip", RenderMode.MIP)
    assert dict(info.properties)["positions"] == "int24"
    assert isinstance(io.open(path), Whole)  # unpacked as a whole
    assert sum(map(len, io.open(path).blocks())) == 500


def test_bounds_of_packed_splats_are_single_precision_as_their_type_says(tmp_path):
    model = random_splats(40)
    model = replace(model, means=model.means.astype(np.float64) + 1e-9)
    data = packed(tmp_path / "a.glb", model).read_bytes()
    position = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])["accessors"][0]
    bounds = np.array([position["min"], position["max"]])
    np.testing.assert_array_equal(bounds, bounds.astype(np.float32))
    np.testing.assert_array_equal(bounds[0], model.means.min(axis=0).astype(np.float32))


def test_losses_of_packed_splats_name_the_file_that_is_written():
    model = replace(random_splats(5, degree=4, extras={"a": np.ones(5)}), comments=["one"])
    assert gltf_spz.losses(model)[:3] == (
        "Spherical harmonics above degree 3 are left out, .glb holds no more.",
        "Extra columns are left out, .glb has no room for them: a.",
        "1 comment line is left out, .glb has no room for it.",
    )


def test_the_extension_name_of_the_earlier_draft_is_accepted(tmp_path):
    data = packed(tmp_path / "a.glb", random_splats(40, degree=1)).read_bytes()
    length = int.from_bytes(data[12:16], "little")
    text = data[20 : 20 + length].replace(b"compression_spz_2", b"compression_spz")
    (tmp_path / "b.glb").write_bytes(glb(json.loads(text), data[28 + length :]))
    assert_same(io.load(tmp_path / "b.glb"), io.load(tmp_path / "a.glb"))


def test_extension_records_of_packed_splats_are_left_out_with_a_note(tmp_path):
    """nanogs packs version 3 for all models; other programs may pack version 4."""
    rows = np.frombuffer(b"hello", [("byte", "u1")])
    element = ExtraElement("spz_record_12340001", rows)
    model = replace(random_splats(40, degree=1), elements=[element])
    data = packed(tmp_path / "a.glb", model).read_bytes()
    assert io.inspect(tmp_path / "a.glb").encoding == "gzip"
    assert "spz_record_12340001" in " ".join(gltf_spz.losses(model))
    io.save(model, tmp_path / "a.spz")
    length = int.from_bytes(data[12:16], "little")
    content, body = json.loads(data[20 : 20 + length]), (tmp_path / "a.spz").read_bytes()
    content["bufferViews"][0]["byteLength"] = content["buffers"][0]["byteLength"] = len(body)
    (tmp_path / "b.glb").write_bytes(glb(content, body + bytes(-len(body) % 4)))
    loaded = io.load(tmp_path / "b.glb")
    assert loaded.notes == (
        "Extension records of the packed splats were left out: spz_record_12340001.",
    )
    assert loaded.elements == ()
    assert np.array_equal(loaded.sh, io.load(tmp_path / "a.spz").sh)


def test_node_transforms_apply_to_packed_splats(tmp_path):
    model = random_splats(40, degree=2, seed=5)
    data = packed(tmp_path / "a.glb", model).read_bytes()
    length = int.from_bytes(data[12:16], "little")
    content, body = json.loads(data[20 : 20 + length]), data[28 + length :]
    original = io.load(tmp_path / "a.glb")
    content["nodes"] = [{"mesh": 0, "rotation": [0, 0, 1, 0], "translation": [1, 2, 3]}]
    content["nodes"].append({"children": [0], "scale": [2, 2, 2]})
    content["scenes"] = [{"nodes": [1]}]
    (tmp_path / "b.glb").write_bytes(glb(content, body))
    transformed = io.load(tmp_path / "b.glb")
    assert transformed.means == pytest.approx(2 * original.means + [-2, -4, 6], abs=1e-5)
    assert transformed.log_scales == pytest.approx(original.log_scales + np.log(2), abs=1e-6)
    assert np.array_equal(transformed.sh, original.sh)


def test_many_nodes_cannot_multiply_packed_splats_without_limit(tmp_path):
    model = random_splats(1).take(np.zeros(100_000, np.int64))
    data = packed(tmp_path / "a.glb", model).read_bytes()
    length = int.from_bytes(data[12:16], "little")
    content, body = json.loads(data[20 : 20 + length]), data[28 + length :]
    content["nodes"] = content["nodes"] * 1000
    content["scenes"] = [{"nodes": list(range(1000))}]
    (tmp_path / "b.glb").write_bytes(glb(content, body))
    tracemalloc.start()
    with pytest.raises(FormatError, match="far more than splats can be compressed"):
        io.load(tmp_path / "b.glb")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 10_000_000


# Colours in linear light


def linear(model):
    """Return a file whose colours are in linear light."""
    extension = {"colorSpace": "lin_rec709_display"}
    content, body = document(columns(model), nodes=NO_TURN)
    content["meshes"][0]["primitives"][0]["extensions"] = {PREFIX[:-1]: extension}
    return glb(content, body)


def encode(light):
    light = np.maximum(light, 0)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def test_linear_base_colours_are_converted_to_srgb(tmp_path):
    model = random_splats(50, degree=0, seed=6)
    (tmp_path / "a.glb").write_bytes(linear(model))
    loaded = io.load(tmp_path / "a.glb")
    c0 = 0.5 / np.pi**0.5
    target = encode(model.sh[:, 0].astype(np.float64) * c0 + 0.5)
    assert loaded.sh[:, 0] * c0 + 0.5 == pytest.approx(target, abs=1e-6)
    assert any("lin_rec709_display" in note for note in loaded.notes)


def test_linear_harmonics_are_converted_to_srgb_as_rendered(tmp_path):
    """The conversion of weak harmonics is nearly linear."""
    model = random_splats(50, degree=2, seed=7)
    model.sh[:, 0] = np.clip(model.sh[:, 0], -0.8, 0.8)
    model.sh[:, 1:] *= 0.05 / np.abs(model.sh[:, 1:]).max()
    (tmp_path / "a.glb").write_bytes(linear(model))
    loaded = io.load(tmp_path / "a.glb")
    directions = np.random.default_rng(0).normal(size=(200, 3))
    values = basis(directions / np.linalg.norm(directions, axis=1, keepdims=True), 2)
    encoded = encode(np.einsum("dk,nkc->ndc", values, model.sh.astype(np.float64)) + 0.5)
    found = np.einsum("dk,nkc->ndc", values, loaded.sh.astype(np.float64)) + 0.5
    assert np.abs(found - encoded).max() < 0.002

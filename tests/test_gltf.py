"""glTF with Gaussian splats: round trips, the specification, transforms, damage and attacks."""

import dataclasses
import io as streams
import json
import struct
import tracemalloc

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import nanogs
from builders import linear_scales, random_splats
from damage import outcome
from launch import run
from nanogs import io
from nanogs.errors import FormatError, OutputError
from nanogs.io.gltf import write as gltf_write
from nanogs.sh import basis
from nanogs.splats import ExtraElement, RenderMode
from npm_packages import node, package
from strategies import assert_same, splats

FILES = settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow], deadline=None
)
PREFIX = "KHR_gaussian_splatting:"
COMPONENTS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "f4": 5126}
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def glb(document, body=b"", *, version=2, length=None):
    text = document if isinstance(document, bytes) else json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(body), b"BIN\0") + body
    size = 12 + len(chunks) if length is None else length
    return b"glTF" + struct.pack("<II", version, size) + chunks


def parsed(data):
    """Return the JSON and the buffer of a file."""
    (length,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def columns(model):
    """Return the float32 attributes of a model by name, activated as the specification requires."""
    out = {
        "POSITION": model.means,
        PREFIX + "ROTATION": model.unit_quats()[:, [1, 2, 3, 0]],
        PREFIX + "SCALE": linear_scales(model),
        PREFIX + "OPACITY": model.opacities()[:, None],
    }
    index = 0
    for degree in range(model.sh_degree + 1):
        for n in range(2 * degree + 1):
            out[f"{PREFIX}SH_DEGREE_{degree}_COEF_{n}"] = model.sh[:, index]
            index += 1
    return {name: values.astype("f4") for name, values in out.items()}


def document(*tables, nodes=None, normalized=True, **primitive):
    """Return (JSON, buffer) of one mesh with a primitive for each table of columns."""
    accessors, views, primitives, body = [], [], [], b""
    for table in tables:
        attributes = {}
        for name, values in table.items():
            attributes[name] = len(accessors)
            kind = values.dtype.str[1:]
            accessors.append({
                "bufferView": len(views), "componentType": COMPONENTS[kind],
                "count": len(values), "type": TYPES[values.shape[1]],
                "normalized": normalized and kind != "f4",
            })  # fmt: skip
            data = values.tobytes()
            views.append({"buffer": 0, "byteOffset": len(body), "byteLength": len(data)})
            body += data + b"\0" * (-len(data) % 4)
        extension = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
        primitives.append({
            "mode": 0, "attributes": attributes,
            "extensions": {"KHR_gaussian_splatting": extension}, **primitive,
        })  # fmt: skip
    nodes = nodes or [{"mesh": 0}]
    roots = sorted(set(range(len(nodes))) - {c for node in nodes for c in node.get("children", ())})
    return {
        "asset": {"version": "2.0"}, "extensionsUsed": ["KHR_gaussian_splatting"], "scene": 0,
        "scenes": [{"nodes": roots}], "nodes": nodes, "meshes": [{"primitives": primitives}],
        "accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": len(body)}],
    }, body  # fmt: skip


@pytest.fixture
def load(tmp_path):
    def load(data):
        (tmp_path / "a.glb").write_bytes(data if isinstance(data, bytes) else glb(*data))
        return io.load(tmp_path / "a.glb")

    return load


def covariances(model):
    w, x, y, z = model.unit_quats().astype(np.float64).T
    rotation = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]).transpose(2, 0, 1)  # fmt: skip
    axes = rotation * model.scales().astype(np.float64)[:, None]
    return axes @ axes.transpose(0, 2, 1)


def assert_same_splats(model, loaded):
    """Compare bit by bit what is stored unchanged, and within float32 what is stored activated."""
    assert np.array_equal(loaded.means, model.means.astype(np.float32))
    assert np.array_equal(loaded.sh, model.sh[:, : (min(model.sh_degree, 3) + 1) ** 2])
    zero = np.isneginf(model.log_scales)
    assert np.array_equal(np.isneginf(loaded.log_scales), zero)
    assert loaded.log_scales[~zero] == pytest.approx(model.log_scales[~zero], abs=2e-6)
    assert loaded.opacities() == pytest.approx(model.opacities(), abs=1e-7)
    assert np.abs(loaded.quats - model.unit_quats()).max() < 1e-6


# Writing


@FILES
@given(model=splats())
def test_a_written_file_reads_back_as_the_same_model(tmp_path, model):
    io.save(model, tmp_path / "a.glb", overwrite=True)
    loaded = io.load(tmp_path / "a.glb")
    assert_same_splats(model, loaded)
    assert loaded.render_mode is model.render_mode
    assert loaded.comments == model.comments
    assert loaded.notes == ()
    io.save(loaded, tmp_path / "b.glb", overwrite=True)
    assert_same_splats(loaded, io.load(tmp_path / "b.glb"))


@FILES
@given(model=splats())
def test_a_gltf_text_file_holds_the_same_model_as_a_glb(tmp_path, model):
    """The file contains its buffer, and a comment that looks like one is not taken for it."""
    comments = ["data:application/octet-stream;base64,", '"'] + list(model.comments)
    model = dataclasses.replace(model, comments=comments)
    for name in ("a.glb", "a.gltf"):
        io.save(model, tmp_path / name, overwrite=True)
    loaded = io.load(tmp_path / "a.gltf")
    assert_same(loaded, io.load(tmp_path / "a.glb"))
    assert loaded.comments == tuple(comments)
    content = json.loads((tmp_path / "a.gltf").read_bytes())
    assert len(content["buffers"]) == 1
    assert content["extensionsUsed"] == ["KHR_gaussian_splatting"]


def test_a_gltf_file_appears_complete_or_not_at_all(tmp_path):
    model = random_splats(500, degree=1)
    io.save(model, tmp_path / "a.ply")
    completed = run("convert", tmp_path / "a.ply", tmp_path / "a.gltf")
    assert completed.returncode == 0, completed.stderr
    before = (tmp_path / "a.gltf").read_bytes()
    model.means[7] = np.nan
    io.save(model, tmp_path / "b.ply")
    for options in ((), ("-w",)):
        refused = run("convert", tmp_path / "b.ply", tmp_path / "a.gltf", *options)
        assert refused.returncode == 2
        assert ("row 7" in refused.stderr) == bool(options)
    assert (tmp_path / "a.gltf").read_bytes() == before
    assert {path.name for path in tmp_path.iterdir()} == {"a.ply", "b.ply", "a.gltf"}
    result = nanogs.convert(tmp_path / "a.gltf", tmp_path / "c.gltf")
    assert (result.format, result.splats, result.notes, result.losses) == ("gltf", 500, (), ())


@pytest.mark.parametrize(
    ("write", "size"),
    [(gltf_write.write, gltf_write.file_bytes), (gltf_write.write_text, gltf_write.text_bytes)],
)
@FILES
@given(model=splats(), count=st.integers(1, 3000))
def test_the_predicted_file_size_is_exact(write, size, model, count):
    repeated = model.take(np.arange(count) % len(model))
    stream = streams.BytesIO()
    write(repeated, stream)
    assert size(model, count) == len(stream.getvalue()) < size(model, count + 1)


def test_the_document_follows_the_specification(tmp_path):
    model = random_splats(300, degree=1)
    io.save(model, tmp_path / "a.glb")
    data = (tmp_path / "a.glb").read_bytes()
    content, body = parsed(data)
    assert len(data) % 4 == 0
    assert struct.unpack("<4sII", data[:12]) == (b"glTF", 2, len(data))
    assert content["extensionsUsed"] == ["KHR_gaussian_splatting"]
    assert content["nodes"] == [{"mesh": 0, "rotation": [0, 0, 1, 0]}]
    (primitive,) = content["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    assert primitive["extensions"]["KHR_gaussian_splatting"] == {
        "kernel": "ellipse", "colorSpace": "srgb_rec709_display", "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }  # fmt: skip
    assert "extras" not in primitive
    attributes = primitive["attributes"]
    assert set(attributes) == {*columns(model), "COLOR_0"}
    position = content["accessors"][attributes["POSITION"]]
    assert position["min"] == model.means.min(axis=0).tolist()
    assert position["max"] == model.means.max(axis=0).tolist()
    for name, values in columns(model).items():
        view = content["bufferViews"][content["accessors"][attributes[name]]["bufferView"]]
        start = view["byteOffset"]
        stored = np.frombuffer(body[start : start + view["byteLength"]], "<f4")
        assert np.array_equal(stored.reshape(values.shape), values), name


def test_the_fallback_colour_is_linear(tmp_path):
    model = random_splats(2, degree=0)
    model.sh[:, 0] = (np.array([[0.5, 0, 2], [1, 0.2, -1]]) - 0.5) / 0.28209479177387814
    model.opacity_logits[:] = [np.inf, 0]
    io.save(model, tmp_path / "a.glb")
    content, body = parsed((tmp_path / "a.glb").read_bytes())
    index = content["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]
    start = content["bufferViews"][index]["byteOffset"]
    expected = [55, 0, 255, 255, 255, 8, 0, 128]  # 0.5 of sRGB is 0.214, 0.2 is 0.033
    assert list(body[start : start + 8]) == expected
    assert content["accessors"][index]["normalized"] is True


def test_writing_in_smaller_blocks_gives_the_same_bytes(tmp_path, monkeypatch):
    model = random_splats(100, degree=2)
    io.save(model, tmp_path / "a.glb")
    monkeypatch.setattr("nanogs.source.base.BLOCK_ROWS", 7)
    monkeypatch.setattr("nanogs.io.gltf.primitives.BLOCK_ROWS", 11)
    io.save(model, tmp_path / "b.glb")
    assert (tmp_path / "a.glb").read_bytes() == (tmp_path / "b.glb").read_bytes()
    assert_same_splats(model, io.load(tmp_path / "b.glb"))


@pytest.mark.parametrize("field", ["means", "log_scales", "quats", "opacity_logits", "sh"])
def test_nan_values_are_refused_before_anything_is_written(tmp_path, field):
    model = random_splats(3)
    getattr(model, field)[2] = np.nan
    with pytest.raises(OutputError, match="the first in row 2"):
        io.save(model, tmp_path / "a.glb")
    assert list(tmp_path.iterdir()) == []


def test_files_of_more_than_four_gigabytes_are_refused():
    model = random_splats(1, degree=3)
    assert gltf_write.file_bytes(model, 17_000_000) < 1 << 32
    with pytest.raises(OutputError, match="cannot have more than 4294967295"):
        gltf_write.file_bytes(model, 18_000_000)
    with pytest.raises(OutputError, match=r"or a \.glb"):
        gltf_write.text_bytes(model, 17_000_000)


def test_comments_too_long_to_be_read_back_are_refused():
    model = dataclasses.replace(random_splats(1), comments=["x" * (5 << 20)])
    with pytest.raises(OutputError, match="shorten the comments"):
        gltf_write.file_bytes(model, 1)


@pytest.mark.parametrize("line", ["two\nlines", "one\r"])
@pytest.mark.parametrize("name", ["a.glb", "a.rad"])
def test_a_comment_that_would_not_be_read_back_is_refused(tmp_path, name, line):
    model = dataclasses.replace(random_splats(1), comments=["", line])
    with pytest.raises(OutputError, match="holds a line break; split it in two"):
        io.save(model, tmp_path / name)


def test_losses_are_reported():
    model = random_splats(2, degree=4, extras={"label": np.zeros(2)})
    tag = ExtraElement("tag", np.zeros(1, [("id", "i4")]))
    model = dataclasses.replace(model, elements=[tag], means=model.means + np.float64(1e-12))
    for loss, word in zip(
        io.losses(model, "a.glb"), ("label", "tag", "degree 3", "double precision"), strict=True
    ):
        assert word in loss
    plain = random_splats(2, degree=3)
    for means in (plain.means, plain.means.astype(np.float64)):
        assert io.losses(dataclasses.replace(plain, means=means), "a.glb") == ()


@pytest.mark.parametrize("name", ["a.glb", "a.gltf"])
def test_the_khronos_validator_finds_no_errors(tmp_path, name):
    """It does not know the extension yet, and therefore not the names of its attributes either."""
    package("gltf-validator")
    model = dataclasses.replace(
        random_splats(300, degree=3), render_mode=RenderMode.MIP, comments=["é"]
    )
    io.save(model, tmp_path / name)
    script = (
        "const fs = require('fs'), v = require('gltf-validator');"
        "v.validateBytes(new Uint8Array(fs.readFileSync(process.argv[1])), {maxIssues: 0})"
        ".then(r => console.log(JSON.stringify(r.issues.messages)))"
    )
    issues = [
        (issue["code"], issue["pointer"])
        for issue in json.loads(node(script, tmp_path / name))
        if not issue["pointer"].split("/")[-1].startswith(PREFIX)
    ]
    assert issues in ([], [("UNSUPPORTED_EXTENSION", "/extensionsUsed/0")])


# Reading


def test_a_file_without_node_transforms_is_read_as_y_up(load, tmp_path):
    """Without a node transform the scene is y-up: only x and y change sign."""
    model = random_splats(20, degree=3, seed=1)
    loaded = load(document(columns(model)))
    assert np.array_equal(loaded.means, model.means * np.float32([-1, -1, 1]))
    turn = np.diag([-1.0, -1, 1])
    assert np.allclose(covariances(loaded), turn @ covariances(model) @ turn, rtol=1e-5)
    orders = np.concatenate([np.arange(-degree, degree + 1) for degree in range(4)])
    signs = np.where(orders % 2, -1, 1).astype(np.float32)
    assert np.array_equal(loaded.sh, model.sh * signs[:, None])
    info = io.inspect(tmp_path / "a.glb")
    assert (info.splats, info.sh_degree, info.format) == (20, 3, "glb")


def unit(vector):
    return np.array(vector) / np.linalg.norm(vector)


def test_node_transforms_are_composed_and_rotate_the_colours(load):
    """From a direction that turns with the model, every colour is unchanged."""
    model = random_splats(20, degree=3, seed=2)
    x, y, z, w = rotation = unit([0.3, -0.2, 0.5, 0.7]).tolist()
    nodes = [
        {"children": [1], "translation": [1, 2, 3], "scale": [2, 2, 2]},
        {"mesh": 0, "rotation": rotation},
    ]
    loaded = load(document(columns(model), nodes=nodes))
    rotation_matrix = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip
    flip = np.diag([-1.0, -1, 1])
    assert np.allclose(
        loaded.means, (2 * model.means @ rotation_matrix.T + [1, 2, 3]) @ flip, atol=1e-5
    )
    total = flip @ rotation_matrix
    assert np.allclose(covariances(loaded), 4 * total @ covariances(model) @ total.T, rtol=1e-4)
    directions = np.random.default_rng(0).normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before = np.einsum("dk,nkc->ndc", basis(directions, 3), model.sh)
    after = np.einsum("dk,nkc->ndc", basis(directions @ total.T, 3), loaded.sh)
    assert np.allclose(before, after, atol=1e-5)


def test_node_scales_may_differ_between_axes(load):
    """The specification's covariance is M C C^T M^T; only the rotation turns the colours."""
    model = random_splats(20, degree=1, seed=2)
    model.log_scales[3, 1] = -np.inf
    stretch, (x, y, z, w) = np.array([2.0, 0.5, 3.0]), unit([0.3, -0.2, 0.5, 0.7])
    node = {"mesh": 0, "scale": stretch.tolist(), "translation": [1, 2, 3]}
    unscaled = load(document(columns(model), nodes=[{"mesh": 0, "rotation": [x, y, z, w]}]))
    scaled = load(document(columns(model), nodes=[node | {"rotation": [x, y, z, w]}]))
    rotation_matrix = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip
    total = np.diag([-1.0, -1, 1]) @ rotation_matrix @ np.diag(stretch)
    assert np.allclose(scaled.means, model.means @ total.T + [-1, -2, 3], atol=1e-5)
    expected = total @ covariances(model) @ total.T
    assert np.allclose(covariances(scaled), expected, rtol=1e-4, atol=1e-5 * np.abs(expected).max())
    assert np.isneginf(scaled.log_scales[3]).sum() == 1
    assert np.array_equal(scaled.sh, unscaled.sh)
    assert np.allclose(np.linalg.norm(scaled.quats, axis=1), 1, atol=1e-6)


@pytest.mark.parametrize("scale", [[1, 1, 1], [2, 0.5, 3]])
def test_a_zero_quaternion_is_the_identity_under_every_transform(load, scale):
    table = columns(random_splats(5, degree=1))
    table[PREFIX + "ROTATION"][:] = [0, 0, 0, 1]
    node = {"mesh": 0, "scale": scale, "rotation": unit([0.3, -0.2, 0.5, 0.7]).tolist()}
    expected = load(document(table, nodes=[node]))
    table[PREFIX + "ROTATION"][:] = 0
    assert_same(load(document(table, nodes=[node])), expected)


@pytest.mark.parametrize("colour_space", ["BT.709-sRGB", "BT.709-linear", None])
def test_colour_space_names_of_drafts_are_accepted(load, colour_space):
    model = random_splats(4, seed=7)
    content, body = document(columns(model), nodes=[{"mesh": 0, "rotation": [0, 0, 1, 0]}])
    extension = {"kernel": "ellipse"} | ({"colorSpace": colour_space} if colour_space else {})
    content["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"] = extension
    loaded = load((content, body))
    assert np.array_equal(loaded.sh, model.sh) == (colour_space != "BT.709-linear")
    assert any("BT.709-linear" in note for note in loaded.notes) == (
        colour_space == "BT.709-linear"
    )
    assert len(loaded.notes) == (colour_space == "BT.709-linear")


def test_a_node_transform_may_be_a_matrix(load):
    model = random_splats(5, seed=3)
    matrix = np.diag([-1.0, -1, 1, 1])
    matrix[:3, 3] = [1, 2, 3]
    nodes = [{"mesh": 0, "matrix": matrix.T.ravel().tolist()}]
    loaded = load(document(columns(model), nodes=nodes))
    assert np.allclose(loaded.means, model.means + np.float32([-1, -2, 3]))
    assert np.array_equal(loaded.sh, model.sh)


def test_primitives_are_concatenated_with_the_highest_sh_degree(load):
    parts = [random_splats(n, degree=degree, seed=n) for n, degree in ((9, 0), (4, 2))]
    half_turn = [{"mesh": 0, "rotation": [0, 0, 1, 0]}]
    loaded = load(document(*map(columns, parts), nodes=half_turn))
    assert (len(loaded), loaded.sh_degree) == (13, 2)
    assert np.array_equal(loaded.means[9:], parts[1].means)
    assert np.array_equal(loaded.sh[9:], parts[1].sh)
    assert not loaded.sh[:9, 1:].any()


def test_normalized_integers_and_strided_buffers_are_read(load):
    model = random_splats(8, degree=0, seed=5)
    table = columns(model)
    table[PREFIX + "ROTATION"] = np.rint(table[PREFIX + "ROTATION"] * 32767).astype("i2")
    table[PREFIX + "OPACITY"] = np.rint(table[PREFIX + "OPACITY"] * 255).astype("u1")
    wide = np.zeros((8, 5), "f4")
    wide[:, 1:4] = model.scales()
    content, body = document(table, nodes=[{"mesh": 0, "rotation": [0, 0, 1, 0]}])
    content["bufferViews"][2] = {
        "buffer": 0, "byteOffset": len(body), "byteLength": 160, "byteStride": 20,
    }  # fmt: skip
    content["accessors"][2]["byteOffset"] = 4
    content["buffers"][0]["byteLength"] = len(body) + 160
    loaded = load((content, body + wide.tobytes()))
    assert loaded.log_scales == pytest.approx(model.log_scales, abs=1e-6)
    assert np.abs(loaded.quats - model.unit_quats()).max() < 1e-4
    assert loaded.opacities() == pytest.approx(model.opacities(), abs=0.51 / 255)


def test_scales_of_early_drafts_are_logarithms(load):
    model = random_splats(8, seed=6)
    table = columns(model) | {PREFIX + "SCALE": model.log_scales}
    loaded = load(document(table))
    assert np.array_equal(loaded.log_scales, model.log_scales)
    assert "logarithms" in loaded.notes[0]


def test_unsupported_content_is_noted(load):
    model = random_splats(4, seed=7)
    table = columns(model) | {name: np.zeros((4, 1), "f4") for name in ("_LABEL", "_AGE")}
    content, body = document(table, extras={"SplatRenderMode": "new", "comments": ["a", 3, "b\n"]})
    content["meshes"][0]["primitives"].append({"attributes": {"POSITION": 0}})
    content["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"] = {
        "kernel": "box", "colorSpace": "lin_rec709_display", "projection": "fish",
        "sortingMethod": "zDepth", "extensions": {"EXT_box": {}},
    }  # fmt: skip
    loaded = load((content, body))
    text = " ".join(loaded.notes)
    for word in (
        "'_LABEL'",
        "'_AGE'",
        "Comments that are not one line of text were left out.",
        "'new'",
        "'box'",
        "'fish'",
        "'zDepth'",
        "'EXT_box'",
        "lin_rec709_display",
        "1 primitive of a mesh was left out.",
    ):
        assert word in text
    assert loaded.comments == ("a",)
    assert loaded.render_mode is RenderMode.DEFAULT


def test_extensions_of_the_nodes_of_splats_are_noted_once(load):
    """One of them repeats the mesh, so that copies of the splats are missing."""
    nodes = [{"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {}}}] * 2
    loaded = load(document(columns(random_splats(4, seed=7)), nodes=nodes))
    assert loaded.notes == ("The extension 'EXT_mesh_gpu_instancing' of a node was left out.",)


def test_the_format_is_that_of_the_content_not_of_the_name(tmp_path):
    path = tmp_path / "scene.gltf"
    path.write_bytes(glb(*document(columns(random_splats(4, seed=7)))))
    assert nanogs.info(path).file.format == "glb"
    path = tmp_path / "model.bin"
    nanogs.save(random_splats(4, seed=7), tmp_path / "model.glb")
    (tmp_path / "model.glb").rename(path)
    assert nanogs.open(path, format="glb").info.format == "glb"


@pytest.mark.parametrize(
    ("count", "note"),
    [
        (1, "1 primitive of a mesh was left out."),
        (2, "2 primitives of meshes were left out."),
    ],
)
def test_mesh_primitives_that_are_left_out_are_counted(load, count, note):
    content, body = document(columns(random_splats(4, seed=7)))
    content["meshes"][0]["primitives"] += [{"attributes": {"POSITION": 0}}] * count
    assert load((content, body)).notes == (note,)


def test_opacities_out_of_range_are_noted(load):
    table = columns(random_splats(4, seed=7))
    table[PREFIX + "OPACITY"][1] = 1.5
    assert load(document(table)).notes == ("1 opacity is not from 0 to 1 and became NaN.",)


def test_a_single_row_may_state_any_stride(tmp_path):
    content, body = document(columns(random_splats(1, degree=1)))
    (tmp_path / "a.glb").write_bytes(glb(content, body))
    expected = io.load(tmp_path / "a.glb")
    for view in content["bufferViews"]:
        view["byteStride"] = 10**30
    (tmp_path / "a.glb").write_bytes(glb(content, body))
    assert_same(io.load(tmp_path / "a.glb"), expected)


def broken(path, value):
    """Return a function that makes a small file with a JSON entry replaced, or removed if None."""

    def make():
        content, body = document(columns(random_splats(3, degree=1)))
        entry = content
        for key in path[:-1]:
            entry = entry[key]
        if value is None:
            del entry[path[-1]]
        else:
            entry[path[-1]] = value
        return glb(content, body)

    return make


def without_uri():
    """Return a small file whose first view is in a second buffer: only the first needs no URI."""
    content, body = document(columns(random_splats(3, degree=1)))
    content["buffers"] *= 2
    content["bufferViews"][0]["buffer"] = 1
    return glb(content, body)


PRIMITIVE = ("meshes", 0, "primitives", 0)
ATTRIBUTES = (*PRIMITIVE, "attributes")
EXTENSION = (*PRIMITIVE, "extensions", "KHR_gaussian_splatting")
SPZ = {"KHR_gaussian_splatting_compression_spz_2": {"bufferView": 0}}
REFUSED = {
    "not glb": (lambda: b"PK\3\4" + bytes(99), "does not begin with 'glTF', nor is it JSON"),
    "short": (lambda: b"glTF\2\0", "ends inside its header"),
    "version": (lambda: glb({}, version=1), "reads glTF 2.0, not 1"),
    "length": (lambda: glb({}, length=99), "says 99 bytes"),
    "no json": (lambda: glb(b"{"), "JSON cannot be read"),
    "list": (lambda: glb([1]), "JSON is no object"),
    "deep": (lambda: glb(b"[" * 100_000), "JSON cannot be read"),
    "nan": (lambda: glb(b'{"a": NaN}'), "JSON cannot be read"),
    "long": (lambda: glb(b" " * (5 << 20)), "reads up to 4194304; export the splats alone"),
    "no scene": (broken(("scenes",), None), "has no scene"),
    "scene": (broken(("scene",), 7), "no object 7 in 'scenes'"),
    "node": (broken(("scenes", 0, "nodes"), [3]), "no object 3 in 'nodes'"),
    "node type": (broken(("scenes", 0, "nodes"), [True]), r"scenes\[0\].nodes must be an integer"),
    "cycle": (broken(("nodes", 0, "children"), [0]), "nodes must form a tree"),
    "twice": (broken(("scenes", 0, "nodes"), [0, 0]), "nodes must form a tree"),
    "mesh": (broken(("nodes", 0, "mesh"), -1), r"nodes\[0\].mesh must be an integer from 0 on"),
    "shear": (
        broken(("nodes", 0, "matrix"), [1, 0, 0, 0, 1, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]),
        "shears its splats",
    ),
    "by rows": (
        broken(("nodes", 0, "matrix"), [1, 0, 0, 5, 0, 1, 0, 6, 0, 0, 1, 7, 0, 0, 0, 1]),
        "last row is not 0, 0, 0, 1",
    ),
    "mirror": (broken(("nodes", 0, "scale"), [-1, 1, 1]), "mirrors"),
    "flat": (broken(("nodes", 0, "scale"), [0, 0, 0]), "flattens"),
    "huge scale": (
        broken(("nodes", 0, "scale"), [1e200, 1e200, 1e200]),
        "must hold finite numbers",
    ),
    "rotation": (broken(("nodes", 0, "rotation"), [0, 0, 1]), "rotation must be a list of 4"),
    "big number": (broken(("nodes", 0, "translation"), [10**400, 0, 0]), "finite numbers"),
    "triangles": (broken((*PRIMITIVE, "mode"), 4), "must have mode 0"),
    "no splats": (broken(EXTENSION, None), "mesh or point cloud"),
    "no spz": (broken((*EXTENSION, "extensions"), SPZ), "it is no .spz file"),
    "packed": (
        broken((*EXTENSION, "extensions"), {"KHR_compression_9": {}}),
        "packed with 'KHR_compression_9', which nanogs does not",
    ),
    "old spz": (broken(("extensionsRequired",), ["KHR_spz"]), "requires the extension 'KHR_spz'"),
    "new spz": (
        broken(("extensionsRequired",), ["KHR_gaussian_splatting_compression_spz_9"]),
        "_spz_9', which nanogs does not read; export it without",
    ),
    "scale missing": (broken((*ATTRIBUTES, PREFIX + "SCALE"), None), "lacks .*SCALE"),
    "band": (broken((*ATTRIBUTES, PREFIX + "SH_DEGREE_1_COEF_1"), None), "lacks .*COEF_1"),
    "higher": (broken((*ATTRIBUTES, PREFIX + "SH_DEGREE_3_COEF_0"), 0), "lacks .*DEGREE_2_COEF_0"),
    "accessor": (broken((*ATTRIBUTES, "POSITION"), 99), "no object 99 in 'accessors'"),
    "counts": (broken(("accessors", 1, "count"), 2), "have different counts"),
    "count": (broken(("accessors", 0, "count"), 4), "does not fit into its buffer view"),
    "none": (broken(("accessors", 0, "count"), 0), "does not fit"),
    "huge count": (broken(("accessors", 0, "count"), 10**30), "does not fit"),
    "type": (broken(("accessors", 0, "type"), "VEC2"), "needs 3 components"),
    "component": (broken(("accessors", 0, "componentType"), 5125), "needs 3 components"),
    "sparse": (broken(("accessors", 0, "sparse"), {}), "sparse or without a buffer view"),
    "no view": (broken(("accessors", 0, "bufferView"), None), "sparse or without a buffer view"),
    "stride": (broken(("bufferViews", 0, "byteStride"), 4), "does not fit"),
    "view": (broken(("bufferViews", 0, "byteLength"), 10**9), "does not fit into its buffer"),
    "beyond": (broken(("buffers", 0, "byteLength"), 4), "does not fit into its buffer"),
    "outside": (broken(("buffers", 0, "uri"), "/etc/passwd"), "in the same folder or below it"),
    "above": (broken(("buffers", 0, "uri"), "../a.bin"), "in the same folder or below it"),
    "hidden": (broken(("buffers", 0, "uri"), "%2e%2e/a.bin"), "in the same folder or below it"),
    "web": (broken(("buffers", 0, "uri"), "http://a/b.bin"), "in the same folder or below it"),
    "drive": (broken(("buffers", 0, "uri"), "C:\\a.bin"), "in the same folder or below it"),
    "absent": (broken(("buffers", 0, "uri"), "b.bin"), "b.bin: no such file"),
    "data": (broken(("buffers", 0, "uri"), "data:,abc"), "that is not in base64"),
    "base64": (broken(("buffers", 0, "uri"), "data:;base64,a"), "data: URI that is damaged"),
    "second buffer": (broken(("bufferViews", 0, "buffer"), 1), "no object 1 in 'buffers'"),
    "no uri": (without_uri, "buffers\\[1\\] has no URI"),
    "meshopt": (
        broken(("bufferViews", 0, "extensions"), {"EXT_meshopt_compression": {}}),
        "packed with EXT_meshopt_compression",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_invalid_files_are_refused_with_a_reason_and_a_remedy(load, name):
    make, words = REFUSED[name]
    with pytest.raises(FormatError, match=words) as caught:
        load(make())
    assert "; " in str(caught.value)


def test_small_files_that_share_data_cannot_expand_without_limit(load):
    """All attributes may refer to the same bytes, and all nodes to the same mesh."""
    content, body = document(columns(random_splats(200, degree=1)))
    content["nodes"] = [{"mesh": 0} for _ in range(30)]
    content["scenes"][0]["nodes"] = list(range(30))
    with pytest.raises(FormatError, match="more than four times"):
        load((content, body))
    small = document(columns(random_splats(1)), nodes=[{"mesh": 0}] * 5000)
    small[0]["extras"] = " " * 1_000_000
    with pytest.raises(FormatError, match="one of too many"):
        load(small)


def test_a_file_without_a_binary_chunk_is_refused(load):
    data = glb(document(columns(random_splats(3)))[0])
    cut = data[:-8]
    with pytest.raises(FormatError, match="does not fit into its buffer"):
        load(cut[:8] + struct.pack("<I", len(cut)) + cut[12:])


@pytest.mark.parametrize("seed", range(2))
def test_damaged_files_give_a_format_error_or_a_model(tmp_path, seed):
    rng, path = np.random.default_rng(seed), tmp_path / "fuzz.glb"
    io.save(random_splats(3, degree=seed), path)
    data = path.read_bytes()
    content, body = parsed(data)
    text = json.dumps(content, separators=(",", ":")).encode()
    outcomes = {"model": 0, "refused": 0}
    tracemalloc.start()
    for _ in range(400):
        changed, changed_body = bytearray(text), bytearray(body)
        for _ in range(rng.integers(1, 4)):
            index = int(rng.integers(len(changed)))
            if rng.random() < 0.2:
                changed_body[rng.integers(len(changed_body))] = rng.integers(256)
            elif rng.random() < 0.5:
                changed[index : index + 1] = rng.choice(
                    [b"9", b"-", b"0", b"]", b"null", b"\xff", b'"a"']
                )
            else:
                digits = [i for i, byte in enumerate(changed) if chr(byte).isdigit()]
                changed[rng.choice(digits)] = rng.choice(list(b"0123456789"))
        out = glb(bytes(changed), bytes(changed_body))
        path.write_bytes(out[: None if rng.random() < 0.9 else rng.integers(1, len(out))])
        outcomes[outcome(path)] += 1
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert min(outcomes.values()) > 0
    assert peak < 20_000_000


def test_a_draft_with_splats_of_its_own_is_named_with_the_extension_to_use(tmp_path):
    io.save(random_splats(3, degree=0), tmp_path / "a.gltf")
    text = (tmp_path / "a.gltf").read_text()
    content = json.loads(
        text.replace("KHR_gaussian_splatting", "KHR_spz_gaussian_splats_compression")
    )
    content["extensionsRequired"] = content["extensionsUsed"]
    (tmp_path / "a.gltf").write_text(json.dumps(content))
    with pytest.raises(FormatError, match="export it with KHR_gaussian_splatting instead"):
        io.load(tmp_path / "a.gltf")

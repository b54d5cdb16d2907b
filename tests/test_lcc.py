"""Reading `.lcc`, against the tiny writer of `lccfiles` and against splat-transform."""

import json
import math
import struct
import tracemalloc

import numpy as np
import pytest

import lccfiles
from builders import model_bytes
from launch import run
from nanogs import io
from nanogs.errors import FormatError, OptionError
from npm_packages import splat_transform
from strategies import assert_same
from test_gltf import covariances


def write_files(folder, files):
    """Write the files of a model into a folder and return the path of its .lcc file."""
    folder.mkdir(exist_ok=True)
    for name, data in files.items():
        (folder / name).write_bytes(data)
    return folder / "scene.lcc"


@pytest.fixture(params=[False, True], ids=["plain", "harmonics"])
def quality(request):
    return request.param


@pytest.fixture
def typical_model(tmp_path, quality):
    files = lccfiles.typical_model(np.random.default_rng(3), quality=quality, environment=5)
    return write_files(tmp_path / "scan", files)


def interpolated(edges, channel, share):
    return (1 - share) * edges[0][channel] + share * edges[1][channel]


def test_a_splat_made_by_hand_is_read_in_another_frame(tmp_path):
    """In the file z is up; x, y and z become x, -z and y."""
    codes = [(2047 * (i % 2), 1023 * (i % 3 == 0), i) for i in range(15)]
    cell = (0, 0, [([lccfiles.row()], [lccfiles.harmonics(codes)])])
    path = write_files(tmp_path, lccfiles.model([cell], depth=1, quality=True))
    model = io.load(path)
    assert model.means.tolist() == [[1.5, -0.0625, -2.25]]
    assert model.opacity_logits[0] == pytest.approx(math.log(0.25))
    c0 = 0.5 / np.pi**0.5
    assert model.sh[0, 0] == pytest.approx([0.5 / c0, -0.5 / c0, (128 / 255 - 0.5) / c0])
    low, high = lccfiles.SCALES
    scales = [low[0], high[1], interpolated((low, high), 2, 777 / 65535)]
    assert sorted(model.scales()[0]) == pytest.approx(sorted(scales))
    # The first coefficient is that of -y, which becomes -z; that of z is the second.
    shares = [code / max_code for code, max_code in zip(codes[0], (2047, 1023, 2047), strict=True)]
    first = [interpolated(lccfiles.SH, channel, share) for channel, share in enumerate(shares)]
    assert -model.sh[0, 2] == pytest.approx(first, abs=1e-6)
    assert model.notes == ()


def test_a_rotation_is_decoded_from_ten_bits_a_component(tmp_path):
    """The largest component, the third here, is left out; its index counts x, y, z and w."""
    codes = (700, 300, 900)
    row = bytearray(lccfiles.row(scale=(0, 65535, 777)))
    row[22:26] = struct.pack("<I", 2 << 30 | codes[2] << 20 | codes[1] << 10 | codes[0])
    x, y, w = ((code / 1023 * 2 - 1) * 0.5**0.5 for code in codes)
    z = (1 - x * x - y * y - w * w) ** 0.5
    model = io.load(write_files(tmp_path, lccfiles.model([(0, 0, [([row], [])])], depth=1)))
    ranges, steps = lccfiles.SCALES, (0, 65535, 777)
    scales = [interpolated(ranges, i, step / 65535) for i, step in enumerate(steps)]
    axes = turned_by(w, x, y, z) * scales
    flip = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    expected = flip @ axes @ axes.T @ flip.T
    assert covariances(model)[0] == pytest.approx(expected, rel=1e-5, abs=1e-6)


def turned_by(w, x, y, z):
    """Return the rotation matrix of a unit quaternion."""
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def test_cells_may_be_stored_in_another_order(typical_model):
    """The rows follow the index, not the data."""
    whole, index = io.load(typical_model), typical_model.with_name("index.bin")
    data = index.read_bytes()
    index.write_bytes(data[72:] + data[:72])
    again = io.load(typical_model)
    assert model_bytes(again[:9]) == model_bytes(whole[20:29])
    assert model_bytes(again[9:29]) == model_bytes(whole[:20])


def test_an_empty_environment_is_none(typical_model):
    whole = io.load(typical_model)
    typical_model.with_name("environment.bin").write_bytes(b"")
    assert model_bytes(io.load(typical_model)) == model_bytes(whole[:29])


def test_levels_and_the_environment_are_read(typical_model, quality):
    """The finest level is the model; the environment is part of each."""
    info = io.inspect(typical_model)
    assert (info.format, info.splats, info.sh_degree) == ("lcc", 34, 3 * quality)
    assert info.file_bytes == sum(path.stat().st_size for path in typical_model.parent.iterdir())
    with io.open(typical_model) as source:
        assert (source.levels, source.environment) == ((34, 16), 5)
        assert {path.name for path in source.files} == {
            p.name for p in typical_model.parent.iterdir()
        }
    fine, coarse = io.load(typical_model), io.load(typical_model, level=1)
    assert model_bytes(fine[29:]) == model_bytes(coarse[11:])
    low, high = np.array(lccfiles.ENV_SCALES)
    assert (fine.scales()[29:] >= low.min()).all()
    assert (fine.scales()[29:] <= high.max() * 1.001).all()
    if quality:
        low, high = np.array(lccfiles.ENV_SH)
        assert np.abs(fine.sh[29:, 1:]).max() < 3 * high.max()
    with pytest.raises(OptionError, match="levels 0 to 1; level 2"):
        io.load(typical_model, level=2)


def test_rows_read_in_parts_equal_those_of_the_whole(typical_model, monkeypatch):
    whole = io.load(typical_model)
    monkeypatch.setattr("nanogs.io.parts.BLOCK_ROWS", 3)
    with io.open(typical_model) as source:
        for start in range(0, 35, 4):
            for stop in range(start, 35):
                assert model_bytes(source.read(start, stop)) == model_bytes(whole[start:stop])
        assert_same(source.load(), whole)


@pytest.mark.parametrize("level", [0, 1])
def test_splat_transform_reads_the_same(typical_model, tmp_path, level):
    """Except for the environment, which it leaves out of a .ply."""
    out = tmp_path / "out.ply"
    splat_transform("-L", level, typical_model, out)
    theirs, ours = io.load(out), io.load(typical_model, level=level)
    assert len(ours) == len(theirs) + 5
    ours = ours[: len(theirs)]
    assert np.array_equal(ours.means, theirs.means)
    assert ours.opacity_logits == pytest.approx(theirs.opacity_logits, abs=1e-6)
    assert np.abs(ours.sh - theirs.sh).max() < 1e-5
    expected = covariances(theirs)
    assert np.allclose(covariances(ours), expected, rtol=1e-4, atol=1e-5 * np.abs(expected).max())


def test_commands_read_lcc(typical_model, tmp_path):
    shown = run("info", typical_model.parent)
    assert shown.returncode == 0, shown.stderr
    assert "0: 34, 1: 16 splats" in shown.stdout
    result = run("convert", typical_model, tmp_path / "a.ply", "--level", "1")
    assert result.returncode == 0, result.stderr
    assert len(io.load(tmp_path / "a.ply")) == 16
    result = run("simplify", typical_model, tmp_path / "b.spz", "-r", "0.5", "--preset", "fast")
    assert result.returncode == 0, result.stderr
    assert len(io.load(tmp_path / "b.spz")) == 17
    refused = run("convert", typical_model, tmp_path / "b.lcc")
    assert refused.returncode == 2
    assert "does not write this format" in refused.stderr


def test_normals_are_left_out_with_a_note(tmp_path):
    rows = [lccfiles.row(), lccfiles.row(normal=(1, 0, 0)), lccfiles.row()]
    cells = [(0, 0, [(rows, [])]), (1, 0, [(rows[1:], [])])]
    path = write_files(tmp_path, lccfiles.model(cells, depth=1))
    assert io.load(path).notes == (
        "The normals of 2 splats were left out, because their encoding is not known.",
    )


def test_extreme_alphas_and_zero_scales_become_infinite(tmp_path):
    rows = [lccfiles.row(rgba=(0, 0, 0, alpha), scale=(0, 0, 0)) for alpha in (0, 255)]
    attributes = [{"name": "scale", "min": [0, 0, 0], "max": [1, 1, 1]}]
    files = lccfiles.model([(0, 0, [(rows, [])])], depth=1, changes={"attributes": attributes})
    model = io.load(write_files(tmp_path, files))
    assert model.opacity_logits.tolist() == [-math.inf, math.inf]
    assert np.isneginf(model.log_scales).all()


def test_older_files_have_harmonics_if_they_state_their_range(tmp_path):
    rng = np.random.default_rng(1)
    rows, sh = lccfiles.random_rows(rng, 4)
    files = lccfiles.model(
        [(0, 0, [(rows, sh)])], depth=1, quality=True, changes={"fileType": None}
    )
    assert io.load(write_files(tmp_path, files)).sh_degree == 3


def changed(name, data):
    """Return the usual files with one of them replaced or removed."""
    files = lccfiles.typical_model(np.random.default_rng(3), quality=True, environment=5)
    files = {key: value for key, value in files.items() if key != name or data is not None}
    return files | ({name: data(files[name])} if data else {})


def with_description(**changes):
    def data(text):
        found = json.loads(text) | changes
        return json.dumps({key: value for key, value in found.items() if value is not None})

    return changed("scene.lcc", lambda text: data(text).encode())


def attributes(name, **changes):
    def data(text):
        found = json.loads(text)
        for each in found["attributes"]:
            each.update(changes if each["name"] == name else {})
        return json.dumps(found).encode()

    return changed("scene.lcc", data)


def replaced_at(offset, value):
    return lambda data: data[:offset] + value + data[offset + len(value) :]


REFUSED = {
    "no json": (lambda: changed("scene.lcc", lambda _: b"{"), "is no JSON"),
    "levels": (
        lambda: with_description(totalLevel=65),
        "totalLevel must be an integer from 1 to 64",
    ),
    "counts": (lambda: with_description(splats=[29]), "splats must be a list of 2"),
    "count": (lambda: with_description(splats=[28, 11]), "the .lcc says 28"),
    "below 0": (lambda: with_description(splats=[-1, 11]), "must be an integer from 0 on"),
    "kind": (lambda: with_description(fileType="Best"), 'must be "Portable" or "Quality"'),
    "no attributes": (lambda: with_description(attributes=None), "attributes must be a list"),
    "no scale": (lambda: with_description(attributes=[]), "attributes, scale is missing"),
    "scale": (lambda: attributes("scale", min=[0, -1, 0]), "scales below 0"),
    "range": (lambda: attributes("shcoef", max=[1, 2]), "max must be a list of 3"),
    "no index": (lambda: changed("index.bin", None), "index.bin: no such file"),
    "no data": (lambda: changed("data.bin", None), "data.bin: no such file"),
    "no harmonics": (lambda: changed("shcoef.bin", None), "shcoef.bin: no such file"),
    "short index": (
        lambda: changed("index.bin", lambda data: data[:-1]),
        "not a whole number of cells of 2 levels",
    ),
    "short data": (lambda: changed("data.bin", lambda data: data[:-1]), "do not fit into data.bin"),
    "short harmonics": (lambda: changed("shcoef.bin", lambda data: data[:-2]), "do not fit"),
    "offset": (
        lambda: changed("index.bin", replaced_at(8, b"\xff" * 8)),
        "offsets that are negative or too large",
    ),
    "far": (
        lambda: changed("index.bin", replaced_at(8, b"\xff" * 7 + b"\x7f")),
        "offsets that are negative or too large",
    ),
    "negative": (
        lambda: changed("index.bin", replaced_at(4, b"\xff" * 4)),
        "counts or offsets that are negative",
    ),
    "shared": (
        lambda: changed("index.bin", replaced_at(80, (19 * 32).to_bytes(8, "little"))),
        "cells of level 0 share splats",
    ),
    "sky": (lambda: changed("environment.bin", lambda data: data[:-1]), "no whole number of"),
    "empty": (
        lambda: lccfiles.model([(0, 0, [([], []), ([lccfiles.row()], [])])], depth=2),
        "holds no splats of level 0",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_damaged_files_are_refused(tmp_path, name):
    make, words = REFUSED[name]
    with pytest.raises(FormatError, match=words) as caught:
        io.load(write_files(tmp_path, make()))
    assert "; " in str(caught.value)


def test_an_index_that_is_too_large_is_refused(typical_model, monkeypatch):
    monkeypatch.setattr("nanogs.io.lcc.header._MAX_INDEX", 107)  # three cells take 108 bytes
    with pytest.raises(FormatError, match="or too many; export"):
        io.load(typical_model)


def test_cells_cannot_share_their_splats(tmp_path):
    """Otherwise a small file could describe a model of any size."""
    rows = [lccfiles.row()] * 10
    files = lccfiles.model([(0, 0, [(rows, [])])], depth=1)
    files["index.bin"] *= 50
    text = json.loads(files["scene.lcc"]) | {"splats": [500]}
    files["scene.lcc"] = json.dumps(text).encode()
    with pytest.raises(FormatError, match="do not fit"):
        io.load(write_files(tmp_path, files))


def test_memory_for_reading_is_that_of_the_model_and_some_rows(tmp_path, monkeypatch):
    monkeypatch.setattr("nanogs.io.parts.BLOCK_ROWS", 1000)
    rows, sh = lccfiles.random_rows(np.random.default_rng(1), 100)
    files = lccfiles.model([(0, 0, [(rows * 100, sh * 100)])], depth=1, quality=True)
    path = write_files(tmp_path, files)
    model = io.load(path)
    tracemalloc.start()
    io.load(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2 * len(model_bytes(model))

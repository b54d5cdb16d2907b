"""Spark's `.rad`: each encoding by hand, round trips, trees, palettes, and what is refused."""

import json
import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given

import radfiles
from builders import random_splats
from launch import run
from nanogs import io
from nanogs.activations import SH_C0, rotations
from nanogs.errors import FormatError, OutputError
from nanogs.findings import join_findings
from nanogs.io.rad import values, write
from nanogs.splats import RenderMode
from radfiles import by_component, chunk, column, rad, small_tree, typical_columns, with_palette
from strategies import splats

C0 = SH_C0


def read(folder, data, name="a.rad"):
    path = folder / name
    path.write_bytes(data)
    return io.load(path)


def replaced(count, *columns, seed=0):
    """Return the usual columns with some of them replaced."""
    column_of_property = {
        entry["property"]: (entry, data) for entry, data in typical_columns(count, seed)[0]
    }
    return list(
        (
            column_of_property | {entry["property"]: (entry, data) for entry, data in columns}
        ).values()
    )


def covariances(model):
    rotated = rotations(model.unit_quats().astype(np.float64))
    axes = rotated * np.exp(model.log_scales.astype(np.float64))[:, None]
    return axes @ axes.transpose(0, 2, 1)


# ---- encodings, by hand


def test_float_columns_are_read(tmp_path):
    columns, expected = typical_columns(7)
    model = read(tmp_path, rad([chunk(columns, 7)], 7))
    np.testing.assert_array_equal(model.means, expected["center"])
    np.testing.assert_allclose(model.opacities(), expected["alpha"][:, 0], rtol=1e-5)
    np.testing.assert_allclose(model.sh[:, 0] * C0 + 0.5, expected["rgb"], atol=1e-6)
    np.testing.assert_allclose(model.scales(), expected["scales"], rtol=1e-5)
    np.testing.assert_allclose(model.quats[:, 1:], expected["orientation"])
    np.testing.assert_allclose(np.linalg.norm(model.quats, axis=1), 1, rtol=1e-6)


@pytest.mark.parametrize("kind", ["f32", "f16"])
def test_floats_split_into_byte_planes_are_read(tmp_path, kind):
    numbers = np.array([[1.5, -2.25, 3e3], [0.125, 7, -0.0]])
    dtype = np.dtype({"f32": "<f4", "f16": "<f2"}[kind])
    plain = np.ascontiguousarray(numbers.astype(dtype).T)
    planes = b"".join(plain.tobytes()[b :: plain.itemsize] for b in range(plain.itemsize))
    columns = replaced(2, column("center", f"{kind}_lebytes", planes))
    np.testing.assert_array_equal(read(tmp_path, rad([chunk(columns, 2)], 2)).means, numbers)


def test_bytes_scaled_to_a_range_are_read(tmp_path):
    steps = np.array([[0, 128, 255], [255, 1, 2]], np.uint8)
    delta = np.array([[0, 128, 255], [255, 129, 3]], np.uint8)  # differences of successive rows
    value_range = {"min": -0.5, "max": 2.0}
    plain = column("rgb", "r8", by_component(steps, "u1"), **value_range)
    packed = column("rgb", "r8_delta", by_component(delta, "u1"), **value_range)
    expected = steps / 255 * 2.5 - 0.5
    for one in (plain, packed):
        model = read(tmp_path, rad([chunk(replaced(2, one), 2)], 2))
        np.testing.assert_allclose(model.sh[:, 0] * C0 + 0.5, expected, atol=1e-6)


def test_logarithmic_scales_are_read(tmp_path):
    steps = np.array([[0, 1, 255]], np.uint8)
    one = column("scales", "ln_0r8", by_component(steps, "u1"), min=-9, max=3)
    model = read(tmp_path, rad([chunk(replaced(1, one), 1)], 1))
    np.testing.assert_allclose(model.log_scales, [[-np.inf, -9, 3]])
    halves = column("scales", "ln_f16", by_component([[-np.inf, -2.5, 1]], "<f2"))
    model = read(tmp_path, rad([chunk(replaced(1, halves), 1)], 1))
    np.testing.assert_array_equal(model.log_scales, [[-np.inf, -2.5, 1]])


def test_octahedral_rotations_are_read(tmp_path):
    """Half a turn about x, no rotation, and nearly a third of a turn about the diagonal."""
    stored = bytes([255, 128, 255, 9, 9, 0, 170, 170, 170])
    one = column("orientation", "oct88r8", stored)
    model = read(tmp_path, rad([chunk(replaced(3, one), 3)], 3))
    expected = [[0, 1, 0, 0], [1, 0, 0, 0], [0.5, 0.5, 0.5, 0.5]]
    np.testing.assert_allclose(model.quats, expected, atol=0.01)


@pytest.mark.parametrize("encoding", ["f32", "f16", "r8", "r8_delta", "s8", "s8_delta"])
def test_bands_of_harmonics_are_read(tmp_path, encoding):
    """Bands 1 and 2: the coefficients in order, each as RGB."""
    rng = np.random.default_rng(3)
    columns, expected = list(typical_columns(4)[0]), []
    for name, width in (("sh1", 9), ("sh2", 15)):
        if encoding.startswith("f"):
            stored = rng.integers(-64, 64, (4, width)) / 32
            data = by_component(stored, "<f4" if encoding == "f32" else "<f2")
            columns.append(column(name, encoding, data))
            expected.append(stored)
            continue
        steps = rng.integers(0, 256, (4, width)).astype(np.uint8)
        deltas = np.diff(steps, axis=0, prepend=np.zeros((1, width), np.uint8))
        stored = deltas if encoding.endswith("delta") else steps
        columns.append(column(name, encoding, by_component(stored, "u1"), min=-2, max=1.5))
        signed = steps.view(np.int8) / 127 * 1.5
        expected.append(signed if encoding.startswith("s8") else steps / 255 * 3.5 - 2)
    model = read(tmp_path, rad([chunk(columns, 4)], 4, maxSh=2))
    assert model.sh_degree == 2
    found = model.sh[:, 1:].reshape(4, -1)
    np.testing.assert_allclose(found, np.concatenate(expected, axis=1), atol=1e-6)


def test_palettes_of_harmonics_are_read(tmp_path):
    data, labels, entries = with_palette()
    np.testing.assert_array_equal(read(tmp_path, data).sh[:, 1:], entries[labels])


def test_the_palette_in_the_first_chunk_is_that_of_all_chunks(tmp_path):
    entries = np.random.default_rng(0).normal(size=(3, 9)).astype(np.float32)
    palette, labels = column("sh1_code", "f32", by_component(entries)), [[2, 0], [1, 2, 2]]
    labelled = [
        [*typical_columns(len(own))[0], column("sh_label", "u16", by_component(own, "<u2"))]
        for own in labels
    ]
    parts = [chunk([*labelled[0], palette], 2), chunk(labelled[1], 3, base=2)]
    model = read(tmp_path, rad(parts, 5, maxSh=1, shCodeCount=3))
    np.testing.assert_array_equal(model.sh[:, 1:].reshape(5, 9), entries[[2, 0, 1, 2, 2]])
    parts[1] = chunk([*labelled[1], palette], 3, base=2)
    with pytest.raises(FormatError, match="sh1_code must not be in this chunk"):
        read(tmp_path, rad(parts, 5, maxSh=1, shCodeCount=3))


def test_uncompressed_columns_and_gaps_between_chunks_are_read(tmp_path):
    first, _ = typical_columns(3, seed=1)
    second, expected = typical_columns(2, seed=2)
    plain = [(entry | {"compression": None}, data) for entry, data in second]
    parts = [chunk(first, 3), b"\0" * 16, chunk(plain, 2, base=3)]
    sizes = [len(part) for part in parts]
    entries = [{"offset": 0, "bytes": sizes[0]},
               {"offset": sizes[0] + 16, "bytes": sizes[2]}]  # fmt: skip
    model = read(tmp_path, rad(parts, 5, chunks=entries))
    np.testing.assert_array_equal(model.means[3:], expected["center"])


def test_chunks_in_separate_files_are_read(tmp_path):
    parts, expected, leaves = small_tree()
    names = []
    for number, part in enumerate(parts):
        names.append(f"a-{number}.radc")
        (tmp_path / names[-1]).write_bytes(part)
    entries = [{"offset": 0, "bytes": 1, "filename": name} for name in names]
    model = read(tmp_path, rad([], 8, chunks=entries, lodTree=True))
    np.testing.assert_array_equal(model.means, expected["center"][leaves])
    files = io.open(tmp_path / "a.rad").files
    assert [path.name for path in files] == ["a.rad", *names]
    assert io.inspect(tmp_path / "a.rad").file_bytes == sum(path.stat().st_size for path in files)
    with pytest.raises(FormatError, match=r"names a-0\.radc twice"):
        read(tmp_path, rad([], 8, chunks=[entries[0]] * 2, lodTree=True), "b.rad")
    (tmp_path / names[1]).unlink()
    with pytest.raises(FormatError, match=r"a-1\.radc: no such file"):
        io.load(tmp_path / "a.rad")
    with pytest.raises(FormatError, match="one chunk of a"):
        read(tmp_path, parts[0], "b.rad")


def test_a_model_may_be_large_for_the_file_that_names_its_chunks(tmp_path, monkeypatch):
    monkeypatch.setattr("nanogs.io.files._SMALL_MODEL", 0)
    columns, expected = typical_columns(2000)
    (tmp_path / "a-0.radc").write_bytes(chunk(columns, 2000))
    entries = [{"offset": 0, "bytes": 1, "filename": "a-0.radc"}]
    model = read(tmp_path, rad([], 2000, chunks=entries))
    np.testing.assert_array_equal(model.means, expected["center"])


# ---- trees


def test_a_tree_is_read_as_its_leaves(tmp_path):
    parts, expected, leaves = small_tree()
    model = read(tmp_path, rad(parts, 8, lodTree=True))
    np.testing.assert_array_equal(model.means, expected["center"][leaves])
    info = io.inspect(tmp_path / "a.rad")
    assert (info.splats, info.format, info.encoding) == (5, "rad", "deflate")
    source = io.open(tmp_path / "a.rad")
    assert source.files == (tmp_path / "a.rad",)
    np.testing.assert_array_equal(source.read(1, 4).means, model.means[1:4])


def test_alphas_above_1_are_opaque_and_larger(tmp_path):
    """As Spark draws them with `lodInflate`; an alpha rounded to just above 1 is only opaque."""
    alphas = by_component([[0.5], [1.0039], [1.5], [2], [9]])
    model = read(tmp_path, rad([chunk(replaced(5, column("alpha", "f32", alphas)), 5)], 5))
    plain = typical_columns(5)[1]["scales"]
    large, largest = (np.exp((a**2 - 1) / np.e) ** (1 / 3) for a in (3, 5))
    factors = np.array([[1], [1], [large], [largest], [largest]])
    np.testing.assert_allclose(model.scales() / plain, factors * np.ones(3), rtol=1e-5)
    assert model.opacity_logits.tolist() == [0, *[np.inf] * 4]
    assert "3 splats have an alpha above 1" in " ".join(model.notes)


def test_negative_scales_become_nan_and_are_counted(tmp_path):
    scales = by_component([[1, 1, 1], [1, -1, 1], [-1, -1, -1]])
    model = read(tmp_path, rad([chunk(replaced(3, column("scales", "f32", scales)), 3)], 3))
    assert np.isnan(model.log_scales).sum(axis=1).tolist() == [0, 1, 3]
    assert model.notes == ("2 splats have a negative scale, which became NaN.",)


def test_notes_on_a_chunk_are_counted_once(tmp_path):
    """Blocks of rows may begin within a chunk."""
    alphas = column("alpha", "f32", by_component([[0.5], [1.5], [1.5]]))
    parts = [chunk(replaced(3, alphas), 3, base=base) for base in (0, 3)]
    model = read(tmp_path, rad(parts, 6))
    assert "4 splats have an alpha above 1" in " ".join(model.notes)
    with io.open(tmp_path / "a.rad") as source:
        for step in (1, 2, 4, 5):
            assert join_findings(part.notes for part in source.blocks(step)) == model.notes
        assert tuple(source.read(0, 0).notes) == ()


# ---- round trips


def test_long_comments_beyond_ascii_are_read_back(tmp_path):
    lines = [300 * "ä"] * 1000
    io.save(replace(random_splats(3), comments=lines), tmp_path / "a.rad")
    assert list(io.load(tmp_path / "a.rad").comments) == lines


def test_lines_of_a_comment_may_end_as_on_windows(tmp_path):
    data = rad([chunk(typical_columns(3)[0], 3)], 3, comment="one\r\ntwo")
    assert read(tmp_path, data).comments == ("one", "two")


def test_comments_that_could_not_be_read_back_are_refused_before_any_work(tmp_path, monkeypatch):
    monkeypatch.setattr(write, "_chunks", None)
    with pytest.raises(OutputError, match="no more than 1048576 can be read back; shorten the com"):
        io.save(replace(random_splats(3), comments=["a" * (1 << 20)]), tmp_path / "a.rad")
    assert not [*tmp_path.iterdir()]


@given(splats())
def test_models_survive_a_round_trip(tmp_path_factory, model):
    path = tmp_path_factory.mktemp("rad") / "a.rad"
    with path.open("wb") as file:
        write.write(model, file)
    back = io.load(path)
    assert back.sh_degree == min(model.sh_degree, 3)
    assert back.render_mode == model.render_mode
    assert {*model.comments} - {*back.comments} == set()
    np.testing.assert_array_equal(back.means, model.means.astype(np.float32))
    np.testing.assert_allclose(back.opacities(), model.opacities(), atol=0.5 / 255 + 1e-6)
    width = (back.sh_degree + 1) ** 2
    colours = model.sh[:, :1] * np.float32(C0)
    np.testing.assert_allclose(back.sh[:, :1] * np.float32(C0), colours, atol=0.0038)
    most = np.abs(model.sh[:, 1:width]).max(initial=0)
    np.testing.assert_allclose(back.sh[:, 1:], model.sh[:, 1:width], atol=max(most, 2) / 127)
    own, found = covariances(model), covariances(back)
    size = np.linalg.norm(own, axis=(1, 2))
    assert (np.linalg.norm(own - found, axis=(1, 2)) <= 0.03 * size).all()
    with path.with_name("b.rad").open("wb") as file:
        write.write(model, file)
    assert path.read_bytes() == path.with_name("b.rad").read_bytes()


def test_values_that_bytes_would_hold_badly_are_stored_as_floats(tmp_path):
    model = random_splats(50, degree=1)
    model.sh[3, 0] = 30.0
    model.sh[4, 1] = (9.0, 0, 0)
    model.sh[5, 2] = (0, 1e5, 0)
    io.save(model, tmp_path / "a.rad")
    loaded = io.load(tmp_path / "a.rad")
    np.testing.assert_allclose(loaded.sh, model.sh, atol=0.004, rtol=0.001)
    head, [(header, _)] = radfiles.parse_rad((tmp_path / "a.rad").read_bytes())
    encodings = {entry["property"]: entry["encoding"] for entry in header["properties"]}
    assert (encodings["rgb"], encodings["sh1"]) == ("f16", "f32")
    assert head["maxSh"] == 1


def test_the_ranges_for_a_viewer_leave_out_only_the_ends(tmp_path):
    model = random_splats(4000, degree=3)
    model.sh[:, 0] *= 3
    for values_of_all in (model.sh, model.log_scales):
        values_of_all[0] *= 9
    io.save(model, tmp_path / "a.rad")
    head, [(header, _)] = radfiles.parse_rad((tmp_path / "a.rad").read_bytes())
    ranges = head["splatEncoding"]
    assert ranges == header["splatEncoding"]
    assert ranges["lodOpacity"] is False
    colours = np.percentile(model.sh[:, 0] * C0 + 0.5, (0.5, 99.5))
    assert [ranges["rgbMin"], ranges["rgbMax"]] == pytest.approx(colours, abs=0.02)
    logs = np.percentile(model.log_scales, (0.5, 99.5))
    assert [ranges["lnScaleMin"], ranges["lnScaleMax"]] == pytest.approx(logs, abs=0.01)
    for band in (1, 2, 3):
        most = np.percentile(np.abs(model.sh[:, band**2 : (band + 1) ** 2]), 99.5)
        assert ranges[f"sh{band}Max"] == pytest.approx(most, abs=0.05)


def test_models_of_several_chunks_are_read_and_written_in_parts(tmp_path):
    model = random_splats(140_000, degree=1, seed=4)
    io.save(model, tmp_path / "a.ply")
    io.save(model, tmp_path / "a.rad")
    result = run("convert", tmp_path / "a.ply", tmp_path / "b.rad", "--json")
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "a.rad").read_bytes() == (tmp_path / "b.rad").read_bytes()
    _, chunks = radfiles.parse_rad((tmp_path / "a.rad").read_bytes())
    assert [header["count"] for header, _ in chunks] == [65_536, 65_536, 8_928]
    assert [header["base"] for header, _ in chunks] == [0, 65_536, 131_072]
    loaded = io.load(tmp_path / "a.rad")
    np.testing.assert_array_equal(loaded.means, model.means)
    source = io.open(tmp_path / "a.rad")
    np.testing.assert_array_equal(source.read(65_000, 66_000).sh, loaded.sh[65_000:66_000])
    rows = np.array([139_999, 3, 70_000])
    np.testing.assert_array_equal(source.take(rows).quats, loaded.quats[rows])


def test_info_and_losses_are_reported(tmp_path):
    model = replace(
        random_splats(9, degree=4, extras={"label": np.arange(9)}), render_mode=RenderMode.MIP,
        comments=["made by hand"],
    )  # fmt: skip
    io.save(model, tmp_path / "a.rad")
    info = json.loads(run("info", tmp_path / "a.rad", "--json").stdout)
    assert (info["splats"], info["sh_degree"], info["render_mode"]) == (9, 3, "mip")
    assert info["comments"] == ["made by hand", "SplatRenderMode: mip"]
    losses = " ".join(io.losses(model, "a.rad"))
    assert "label" in losses
    assert "degree 3" in losses
    assert "double" not in losses


def test_nan_positions_are_refused(tmp_path):
    model = random_splats(9)
    model.means[4, 1] = np.nan
    with pytest.raises(OutputError, match="row 4"):
        io.save(model, tmp_path / "a.rad")
    assert not (tmp_path / "a.rad").exists()


def test_octahedral_points_of_axes_give_the_axes_back():
    rng = np.random.default_rng(0)
    axes = rng.normal(size=(1000, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    points = values.octahedral_points(axes)
    assert np.abs(points).max() <= 1
    np.testing.assert_allclose(values.octahedral_axes(points), axes, atol=1e-12)
    for rounded in (1e-9, -1e-9):  # where two points of the rim stand for one axis
        points = values.octahedral_points(np.array([[0.5, rounded, -0.5], [rounded, -0.25, -0.75]]))
        np.testing.assert_allclose(points, [[1, 0.5], [0.75, -1]], atol=1e-8)


@pytest.mark.parametrize("largest", [1.0, 4.001, 5.0])
def test_a_file_that_is_read_and_written_again_keeps_its_bytes(tmp_path, largest):
    """Coefficients up to 4 are stored as bytes, and 4.001 would be 4 as float16."""
    model = random_splats(500, degree=2)
    model.sh[0, 1] = largest
    io.save(model, tmp_path / "a.rad")
    io.save(io.load(tmp_path / "a.rad"), tmp_path / "b.rad")
    assert (tmp_path / "a.rad").read_bytes() == (tmp_path / "b.rad").read_bytes()


# ---- what is refused


def broken(change, count=4):
    """Return a file after `change` has edited its header, its chunk's header or its columns."""
    columns, _ = typical_columns(count)
    head, part = {}, {"count": count}
    change(head, part, columns)
    return rad([chunk(columns, **part)], count, **head)


REFUSED = {
    "no RAD0": (lambda h, p, c: None, "does not start with RAD0"),
    "version": (lambda h, p, c: h.update(version=2), "version"),
    "type": (lambda h, p, c: h.update(type="mesh"), "gsplat"),
    "degree": (lambda h, p, c: h.update(maxSh=4), "maxSh"),
    "promised bands": (lambda h, p, c: h.update(maxSh=1), "lacks sh1"),
    "promised tree": (lambda h, p, c: h.update(lodTree=True), "lacks child_count"),
    "count": (lambda h, p, c: h.update(count=5), "hold 4 of 5 rows"),
    "beyond the file": (
        lambda h, p, c: h.update(chunks=[{"offset": 8, "bytes": 900}]), "outside of the file",
    ),
    "chunks in one place": (
        lambda h, p, c: h.update(chunks=[{"offset": 0, "bytes": 99}] * 2), "or in another chunk",
    ),
    "columns in one place": (lambda h, p, c: c[1][0].update(offset=0), "or in another property"),
    "palette": (lambda h, p, c: h.update(maxSh=1, shCodeCount=5), "shCodeCount"),
    "the chunk's rows": (lambda h, p, c: p.update(count=3), "hold 3 of 4 rows"),
    "the chunk's place": (lambda h, p, c: p.update(base=1), "begin with row 0"),
    "payload": (lambda h, p, c: p.update(payloadBytes=8), "two sizes"),
    "unknown property": (lambda h, p, c: c.append(column("depth", "f32", b"")), "'depth'"),
    "twice": (lambda h, p, c: c.append(c[0]), "must not be in this chunk"),
    "unpromised": (
        lambda h, p, c: c.append(column("sh1", "f32", bytes(144))),
        "which the file's header does not mention",
    ),
    "missing": (lambda h, p, c: c.pop(), "lacks orientation"),
    "encoding": (lambda h, p, c: c[0][0].update(encoding="u16"), "encoded as 'u16'"),
    "compression": (lambda h, p, c: c[0][0].update(compression="zstd"), "packed as 'zstd'"),
    "no range": (
        lambda h, p, c: c[1][0].update(encoding="r8", min=0), "finite numbers",
    ),
    "comment": (lambda h, p, c: h.update(comment="\ud800"), "comment must be text"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_contradicting_headers_are_refused(tmp_path, name):
    change, words = REFUSED[name]
    data = broken(change)
    data = b"RAD1" + data[4:] if name == "no RAD0" else data
    with pytest.raises(FormatError, match=words):
        read(tmp_path, data)


def test_a_decompression_bomb_is_refused_before_it_is_unpacked(tmp_path):
    columns = [
        column(entry["property"], "f32", bytes(4 * 3_000_000 * len(data) // 16))
        for entry, data in typical_columns(4)[0]
    ]
    with pytest.raises(FormatError, match="far more than splats can be compressed"):
        read(tmp_path, rad([chunk(columns, 3_000_000)], 3_000_000))


def test_columns_longer_than_their_rows_are_refused(tmp_path):
    columns, _ = typical_columns(4)
    columns[0] = columns[0][0], columns[0][1] + bytes(1 << 24)
    with pytest.raises(FormatError, match="does not hold the 48 bytes"):
        read(tmp_path, rad([chunk(columns, 4)], 4))


def test_labels_beyond_the_palette_are_refused(tmp_path):
    columns = [*typical_columns(2)[0], column("sh1_code", "f32", by_component(np.zeros((2, 9)))),
               column("sh_label", "u16", struct.pack("<2H", 1, 2))]  # fmt: skip
    with pytest.raises(FormatError, match="beyond the palette's 2"):
        read(tmp_path, rad([chunk(columns, 2)], 2, maxSh=1, shCodeCount=2))


def test_a_tree_without_leaves_is_refused(tmp_path):
    columns = [*typical_columns(1)[0], *radfiles.tree_columns([1], [0])]
    with pytest.raises(FormatError, match="no leaf"):
        read(tmp_path, rad([chunk(columns, 1)], 1, lodTree=True))

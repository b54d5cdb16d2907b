"""PlayCanvas' compressed PLY: decoding against a plain twin and by hand, and writing."""

import dataclasses
import io as streams
import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from builders import random_splats
from conftest import scene_path
from nanogs import io
from nanogs.errors import FormatError, OutputError
from nanogs.io.ply import compressed_read
from nanogs.io.ply import compressed_write as compressed_ply_write
from nanogs.io.ply.compressed_write import morton_order
from nanogs.io.ply.header import read_header
from nanogs.io.ply.rows import iter_blocks
from nanogs.splats import ExtraElement, RenderMode
from plyfiles import ply, vertex
from strategies import splats

BOUNDS = [f"{e}_{s}{a}" for s in ("", "scale_") for e in ("min", "max") for a in "xyz"]
COLOURS = [f"{e}_{c}" for e in ("min", "max") for c in "rgb"]
PACKED = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
C0 = 0.28209479177387814


def chunk(count=1, colours=True):
    names = BOUNDS + (COLOURS if colours else [])
    return [(n, "float", np.full(count, -1.0 if n[:3] == "min" else 3.0)) for n in names]


def packed(**words):
    return [(n, "uint", np.atleast_1d(words.get(n[7:], [0])).astype(np.uint32)) for n in PACKED]


@pytest.fixture
def load(tmp_path):
    def load(*elements, name="a.compressed.ply"):
        (tmp_path / name).write_bytes(ply(*elements))
        return io.load(tmp_path / name)

    return load


def test_bits_of_position_and_scale(load):
    word = (2047 << 21) | (0 << 11) | 2047
    model = load(("chunk", chunk()), ("vertex", packed(position=word, scale=word)))
    assert model.means.tolist() == [[3, -1, 3]]
    assert model.log_scales.tolist() == [[3, -1, 3]]


@pytest.mark.parametrize("name", ["a.ply", "a.compressed.ply"])
def test_layout_is_recognised_under_either_name(load, name):
    assert len(load(("chunk", chunk()), ("vertex", packed()), name=name)) == 1


def test_plain_ply_under_the_compressed_name(load):
    assert load(("vertex", vertex())).means[0].tolist() == [1, 2, 3]


@pytest.mark.parametrize("largest", range(4))
def test_largest_part_of_the_rotation_is_put_back(load, largest):
    word = (largest << 30) | (512 << 20) | (1023 << 10) | 512
    quat = load(("chunk", chunk()), ("vertex", packed(rotation=word))).quats[0]
    assert np.linalg.norm(quat) == pytest.approx(1)
    others = np.delete(quat, largest)
    assert others == pytest.approx([0, math.sqrt(0.5), 0], abs=1e-3)


def test_colour_bounds_and_opacity(load):
    word = (255 << 24) | (0 << 16) | (255 << 8) | 51
    model = load(("chunk", chunk()), ("vertex", packed(color=word)))
    assert model.sh[0, 0] == pytest.approx([2.5 / C0, -1.5 / C0, 2.5 / C0])
    assert model.opacity_logits[0] == pytest.approx(math.log(0.2 / 0.8))


def test_older_files_without_colour_bounds(load):
    word = (255 << 24) | 128
    model = load(("chunk", chunk(colours=False)), ("vertex", packed(color=word)))
    assert model.sh[0, 0] == pytest.approx([0.5 / C0, -0.5 / C0, -0.5 / C0])


def test_alpha_0_and_255_are_infinite(load):
    model = load(("chunk", chunk()), ("vertex", packed(**{n[7:]: [0, 255] for n in PACKED})))
    assert model.opacity_logits.tolist() == [-math.inf, math.inf]


def test_sh_bytes_are_channel_major_and_exact_at_the_ends(load):
    values = [0, 255, 128, 1, 2, 3, 4, 5, 6]
    sh = [(f"f_rest_{i}", "uchar", np.array([v])) for i, v in enumerate(values)]
    model = load(("chunk", chunk()), ("vertex", packed()), ("sh", sh))
    assert model.sh[0, 1:, 0].tolist() == [-4, 4, 0.015625]
    assert model.sh[0, 1, 1] == (1.5 / 256 - 0.5) * 8


def test_chunk_of_256_rows_and_unusual_order(load):
    bounds = [(n, k, np.array([v[0], v[0] + 10])) for n, k, v in chunk(1)]
    words = packed(**{n[7:]: np.zeros(257) for n in PACKED})
    model = load(("vertex", words), ("chunk", bounds))
    assert model.means[255:, 0].tolist() == [-1, 9]


def test_extra_columns_and_elements_are_kept(load):
    extra = [*packed(), ("label", "uchar", np.array([9]))]
    model = load(("chunk", chunk()), ("vertex", extra), ("tag", [("id", "int", np.array([4]))]))
    assert model.extras["label"].tolist() == [9]
    assert model.elements[0].rows["id"].tolist() == [4]


def test_further_elements_are_read_without_the_splats(load, tmp_path, monkeypatch):
    extra = ("tag", [("id", "int", np.array([4, 5]))])
    load(("chunk", chunk()), ("vertex", packed()), extra)
    monkeypatch.setattr(compressed_read, "_decoded", None)
    with io.open(tmp_path / "a.compressed.ply") as source:
        [tag] = source.read_elements()
    assert (tag.name, tag.rows["id"].tolist()) == ("tag", [4, 5])


@pytest.mark.parametrize(
    ("elements", "words"),
    [
        ([("chunk", chunk(2)), ("vertex", packed())], "1 splat needs 1 chunk, not 2"),
        ([("chunk", chunk()[1:]), ("vertex", packed())], "min_x of type float"),
        ([("chunk", chunk()[:-1]), ("vertex", packed())], "max_b of type float"),
        ([("chunk", chunk()), ("vertex", packed()[:3])], "packed_color of type uint"),
        (
            [
                ("chunk", chunk()),
                ("vertex", packed()),
                ("sh", [(f"f_rest_{i}", "uchar", np.zeros(2)) for i in range(9)]),
            ],
            "2 rows for 1 splat",
        ),
        (
            [
                ("chunk", chunk()),
                ("vertex", packed()),
                ("sh", [(f"f_rest_{i}", "float", np.zeros(1)) for i in range(9)]),
            ],
            "of type uchar",
        ),
    ],
)
def test_inconsistent_layout_is_refused(load, elements, words):
    with pytest.raises(FormatError, match=words):
        load(*elements)


@pytest.mark.parametrize(
    ("name", "count", "opaque"),
    [("biker.compressed.ply", 152_746, 198), ("guitar.compressed.ply", 90_854, 667)],
)
def test_real_scene(name, count, opaque):
    path = scene_path(name)
    model, info = io.load(path), io.inspect(path)
    assert len(model) == info.splats == count
    assert np.isinf(model.opacity_logits).sum() == opaque
    assert model.finite().all()
    assert info.format == "compressed.ply"
    for row in (0, 255, 256, count - 1):
        assert model.means[row] == pytest.approx(_twin(path, row), rel=1e-6)


def _twin(path, row):
    """Centre of one splat, decoded without arrays."""
    header = read_header(path)
    rows = {e.name: np.empty(e.count, e.dtype()) for e in header.elements}
    for block in iter_blocks(header):
        rows[block.element.name][block.rows] = block.values
    bounds, word = rows["chunk"][row // 256], int(rows["vertex"]["packed_position"][row])
    units = (word >> 21) / 2047, ((word >> 11) & 1023) / 1023, (word & 2047) / 2047
    return [
        float(bounds[f"min_{a}"]) * (1 - t) + float(bounds[f"max_{a}"]) * t
        for a, t in zip("xyz", units, strict=True)
    ]


# Writing

FILES = settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow], deadline=None
)


def rewritten(model, folder):
    """The model as read back, and the rows of the original in the file's order."""
    io.save(model, folder / "a.compressed.ply", overwrite=True)
    rows = morton_order(model.means.astype(np.float32))
    return io.load(folder / "a.compressed.ply"), rows


def steps(values, levels):
    """Half the quantisation step of each row and axis: that of its chunk's own extent."""
    half = np.empty(values.shape)
    for start in range(0, len(values), 256):
        part = values[start : start + 256]
        half[start : start + 256] = (part.max(axis=0) - part.min(axis=0)) / levels / 2
    return half + 1e-6 * np.abs(values) + 1e-30


def assert_close(model, again, rows):
    """Every value is within half a step of the one it stands for, +5 % for rounding."""
    means, scales = model.means[rows].astype(np.float64), model.log_scales[rows].clip(-20, 20)
    levels = np.array([2047, 1023, 2047])
    assert (np.abs(again.means - means) <= 1.05 * steps(means, levels)).all()
    assert (np.abs(again.log_scales - scales) <= 1.05 * steps(scales, levels) + 1e-5).all()
    assert (np.abs(again.opacities() - model.opacities()[rows]) <= 0.5 / 255 + 1e-6).all()
    colour = model.sh[rows, 0].astype(np.float64)
    assert (np.abs(again.sh[:, 0] - colour) <= 1.05 * steps(colour, 255) + 1e-5).all()
    kept = again.sh.shape[1]
    rest = model.sh[rows, 1:kept].clip(-4, 4)
    assert (np.abs(again.sh[:, 1:] - rest) <= 1 / 32 + 1e-6).all()  # the end steps are whole
    dots = (again.unit_quats().astype(np.float64) * model.unit_quats()[rows]).sum(axis=1)
    assert (1 - np.abs(dots) <= 1e-5).all()


@FILES
@given(model=splats())
def test_what_is_written_is_read_within_half_a_step(tmp_path, model):
    again, rows = rewritten(model, tmp_path)
    assert_close(model, again, rows)
    assert again.render_mode is model.render_mode
    assert again.comments == model.comments
    assert again.sh_degree == min(model.sh_degree, 3)


def test_many_chunks_and_blocks(tmp_path, monkeypatch):
    model = random_splats(3000, degree=3, seed=4)
    again, rows = rewritten(model, tmp_path)
    assert_close(model, again, rows)
    before = (tmp_path / "a.compressed.ply").read_bytes()
    monkeypatch.setattr(compressed_ply_write, "BLOCK_ROWS", 300)  # one chunk at a time
    rewritten(model, tmp_path)
    assert (tmp_path / "a.compressed.ply").read_bytes() == before


@FILES
@given(model=splats(), count=st.integers(1, 3000))
def test_size_is_known_beforehand(model, count):
    many = model.take(np.arange(count) % len(model))
    stream = streams.BytesIO()
    compressed_ply_write.write(many, stream)
    size = compressed_ply_write.file_bytes
    assert size(model, count) == len(stream.getvalue()) < size(model, count + 1)


def test_infinite_opacities_and_zero_scales_survive_as_far_as_the_format_goes(tmp_path):
    model = random_splats(3)
    model.opacity_logits[:] = [-np.inf, np.inf, 0]
    model.log_scales[0, 0] = -np.inf
    again, rows = rewritten(model, tmp_path)
    assert sorted(again.opacities()[np.argsort(rows)].round(2)) == [0, 0.5, 1]
    assert again.log_scales[np.argsort(rows)][0, 0] == -20
    assert "1 splat has a log-scale beyond ±20" in io.losses(model, "a.compressed.ply")[0]


@pytest.mark.parametrize("field", ["means", "log_scales", "quats", "opacity_logits", "sh"])
def test_what_is_no_number_is_refused_before_a_byte_is_written(tmp_path, field):
    model = random_splats(3)
    getattr(model, field)[1] = np.nan
    words = "1 splat holds NaN or infinite values, the first in row 1"
    with pytest.raises(OutputError, match=words):
        io.save(model, tmp_path / "a.compressed.ply")
    assert list(tmp_path.iterdir()) == []


def test_centres_beyond_float_are_refused(tmp_path):
    model = random_splats(3)
    model = dataclasses.replace(model, means=model.means.astype(np.float64) * 1e39)
    with pytest.raises(OutputError, match="cannot store"):
        io.save(model, tmp_path / "a.compressed.ply")


def test_losses_are_stated():
    model = random_splats(2, degree=4, extras={"label": np.zeros(2)})
    tag = ExtraElement("tag", np.zeros(1, [("id", "i4")]))
    model.sh[0, 1] = 5
    model = dataclasses.replace(model, elements=[tag], means=model.means.astype(np.float64))
    extra, element, degree, double, range_ = io.losses(model, "a.compressed.ply")
    assert "label" in extra
    assert "tag" in element
    assert "above degree 3" in degree
    assert "double precision" in double
    assert "3 SH coefficients are beyond ±4" in range_
    assert io.losses(random_splats(2, degree=3), "a.compressed.ply") == ()


@pytest.mark.parametrize("mode", RenderMode)
def test_the_render_mode_is_tagged(tmp_path, mode):
    model = dataclasses.replace(random_splats(2), render_mode=mode)
    assert rewritten(model, tmp_path)[0].render_mode is mode


def test_the_order_is_that_of_interleaved_bits():
    corners = [(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)]
    assert morton_order(np.array(corners, np.float32)).tolist() == list(range(8))
    assert morton_order(np.array(corners[::-1], np.float32)).tolist() == list(range(8))[::-1]


def test_a_crowd_far_from_one_splat_is_ordered_all_the_same():
    rng = np.random.default_rng(0)
    means = np.concatenate([rng.permutation(2000)[:, None] * (1e-4, 0, 0), [[1e6, 0, 0]]])
    means = means.astype(np.float32)
    assert (np.diff(means[morton_order(means), 0]) >= -2.1e-4).all()  # a cell holds two of them


def test_coincident_centres_keep_their_order():
    assert morton_order(np.zeros((600, 3), np.float32)).tolist() == list(range(600))


def test_a_real_scene_survives_being_packed_again(tmp_path):
    path = scene_path("guitar.compressed.ply")
    model = io.load(path)
    again, rows = rewritten(model, tmp_path)
    assert_close(model, again, rows)

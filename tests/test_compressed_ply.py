"""PlayCanvas' compressed PLY: decoding compared with a reference and by hand, and writing."""

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


def test_position_and_scale_are_unpacked_from_11_10_and_11_bits(load):
    word = (2047 << 21) | (0 << 11) | 2047
    model = load(("chunk", chunk()), ("vertex", packed(position=word, scale=word)))
    assert model.means.tolist() == [[3, -1, 3]]
    assert model.log_scales.tolist() == [[3, -1, 3]]


@pytest.mark.parametrize("name", ["a.ply", "a.compressed.ply"])
def test_the_layout_is_recognised_for_both_suffixes(load, name):
    assert len(load(("chunk", chunk()), ("vertex", packed()), name=name)) == 1


def test_a_plain_ply_with_the_compressed_suffix_is_read(load):
    assert load(("vertex", vertex())).means[0].tolist() == [1, 2, 3]


@pytest.mark.parametrize("largest", range(4))
def test_the_largest_component_of_the_rotation_is_restored(load, largest):
    word = (largest << 30) | (512 << 20) | (1023 << 10) | 512
    quat = load(("chunk", chunk()), ("vertex", packed(rotation=word))).quats[0]
    assert np.linalg.norm(quat) == pytest.approx(1)
    others = np.delete(quat, largest)
    assert others == pytest.approx([0, math.sqrt(0.5), 0], abs=1e-3)


def test_colours_use_the_bounds_of_their_chunk(load):
    word = (255 << 24) | (0 << 16) | (255 << 8) | 51
    model = load(("chunk", chunk()), ("vertex", packed(color=word)))
    assert model.sh[0, 0] == pytest.approx([2.5 / C0, -1.5 / C0, 2.5 / C0])
    assert model.opacity_logits[0] == pytest.approx(math.log(0.2 / 0.8))


def test_older_files_without_colour_bounds_are_read(load):
    word = (255 << 24) | 128
    model = load(("chunk", chunk(colours=False)), ("vertex", packed(color=word)))
    assert model.sh[0, 0] == pytest.approx([0.5 / C0, -0.5 / C0, -0.5 / C0])


def test_alphas_of_0_and_255_give_infinite_logits(load):
    model = load(("chunk", chunk()), ("vertex", packed(**{n[7:]: [0, 255] for n in PACKED})))
    assert model.opacity_logits.tolist() == [-math.inf, math.inf]


def test_sh_bytes_are_channel_major_and_exact_at_the_ends(load):
    values = [0, 255, 128, 1, 2, 3, 4, 5, 6]
    sh = [(f"f_rest_{i}", "uchar", np.array([v])) for i, v in enumerate(values)]
    model = load(("chunk", chunk()), ("vertex", packed()), ("sh", sh))
    assert model.sh[0, 1:, 0].tolist() == [-4, 4, 0.015625]
    assert model.sh[0, 1, 1] == (1.5 / 256 - 0.5) * 8


def test_chunks_have_256_rows_and_may_follow_the_vertices(load):
    bounds = [(n, k, np.array([v[0], v[0] + 10])) for n, k, v in chunk(1)]
    words = packed(**{n[7:]: np.zeros(257) for n in PACKED})
    model = load(("vertex", words), ("chunk", bounds))
    assert model.means[255:, 0].tolist() == [-1, 9]


def test_extra_columns_and_elements_are_kept(load):
    extra = [*packed(), ("label", "uchar", np.array([9]))]
    model = load(("chunk", chunk()), ("vertex", extra), ("tag", [("id", "int", np.array([4]))]))
    assert model.extras["label"].tolist() == [9]
    assert model.elements[0].rows["id"].tolist() == [4]


def test_extra_elements_are_read_without_decoding_the_splats(load, tmp_path, monkeypatch):
    extra = ("tag", [("id", "int", np.array([4, 5]))])
    load(("chunk", chunk()), ("vertex", packed()), extra)
    monkeypatch.setattr(compressed_read, "decoded", None)
    with io.open(tmp_path / "a.compressed.ply") as source:
        [tag] = source.read_elements()
    assert (tag.name, tag.rows["id"].tolist()) == ("tag", [4, 5])


@pytest.mark.parametrize(
    ("elements", "message"),
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
        (
            [
                ("chunk", chunk()),
                ("vertex", packed()),
                ("sh", [(n, "uchar", [0]) for n in (*[f"f_rest_{i}" for i in range(9)], "label")]),
            ],
            "properties other than f_rest",
        ),
    ],
)
def test_inconsistent_layouts_are_refused(load, elements, message):
    with pytest.raises(FormatError, match=message):
        load(*elements)


@pytest.mark.parametrize(
    ("name", "count", "opaque"),
    [("biker.compressed.ply", 152_746, 198), ("guitar.compressed.ply", 90_854, 667)],
)
def test_real_scenes_are_read_as_by_the_reference(name, count, opaque):
    path = scene_path(name)
    model, info = io.load(path), io.inspect(path)
    assert len(model) == info.splats == count
    assert np.isinf(model.opacity_logits).sum() == opaque
    assert model.finite().all()
    assert info.format == "compressed.ply"
    for row in (0, 255, 256, count - 1):
        assert model.means[row] == pytest.approx(_reference_centre(path, row), rel=1e-6)


def _reference_centre(path, row):
    """Return the centre of one splat, decoded with plain arithmetic."""
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
    """Write and read a model; return it with the original row of each row of the file."""
    io.save(model, folder / "a.compressed.ply", overwrite=True)
    rows = morton_order(model.means.astype(np.float32))
    return io.load(folder / "a.compressed.ply"), rows


def steps(values, levels):
    """Return half the quantisation step of each row and axis, from the extent of its chunk."""
    half = np.empty(values.shape)
    for start in range(0, len(values), 256):
        part = values[start : start + 256]
        half[start : start + 256] = (part.max(axis=0) - part.min(axis=0)) / levels / 2
    return half + 1e-6 * np.abs(values) + 1e-30


def assert_close(model, loaded, rows):
    """Check that each value is within half a step of the original, plus 5 % for rounding."""
    means, scales = model.means[rows].astype(np.float64), model.log_scales[rows].clip(-20, 20)
    levels = np.array([2047, 1023, 2047])
    assert (np.abs(loaded.means - means) <= 1.05 * steps(means, levels)).all()
    assert (np.abs(loaded.log_scales - scales) <= 1.05 * steps(scales, levels) + 1e-5).all()
    assert (np.abs(loaded.opacities() - model.opacities()[rows]) <= 0.5 / 255 + 1e-6).all()
    colour = model.sh[rows, 0].astype(np.float64)
    assert (np.abs(loaded.sh[:, 0] - colour) <= 1.05 * steps(colour, 255) + 1e-5).all()
    bands = loaded.sh.shape[1]
    rest = model.sh[rows, 1:bands].clip(-4, 4)
    assert (np.abs(loaded.sh[:, 1:] - rest) <= 1 / 32 + 1e-6).all()  # a whole step at either end
    dots = (loaded.unit_quats().astype(np.float64) * model.unit_quats()[rows]).sum(axis=1)
    assert (1 - np.abs(dots) <= 1e-5).all()


def test_rotations_that_were_read_are_written_with_the_same_bytes(tmp_path):
    """Though rounding can make another component the largest, or as large."""
    rng = np.random.default_rng(0)
    quats = rng.choice([-1, 0, 0.3, 1], (4000, 4)) + rng.normal(0, 2e-3, (4000, 4))
    model = dataclasses.replace(random_splats(4000, degree=0), quats=quats.astype(np.float32))
    again, _ = rewritten(model, tmp_path)
    io.save(again, tmp_path / "b.compressed.ply")
    first, second = ((tmp_path / f"{name}.compressed.ply").read_bytes() for name in "ab")
    assert first == second


@FILES
@given(model=splats())
def test_written_values_are_read_back_within_half_a_quantisation_step(tmp_path, model):
    loaded, rows = rewritten(model, tmp_path)
    assert_close(model, loaded, rows)
    assert loaded.render_mode is model.render_mode
    assert loaded.comments == model.comments
    assert loaded.sh_degree == min(model.sh_degree, 3)


def test_writing_in_smaller_blocks_gives_the_same_bytes(tmp_path, monkeypatch):
    model = random_splats(3000, degree=3, seed=4)
    loaded, rows = rewritten(model, tmp_path)
    assert_close(model, loaded, rows)
    before = (tmp_path / "a.compressed.ply").read_bytes()
    monkeypatch.setattr(compressed_ply_write, "_ROWS", 256)  # one chunk at a time
    rewritten(model, tmp_path)
    assert (tmp_path / "a.compressed.ply").read_bytes() == before


@FILES
@given(model=splats(), count=st.integers(1, 3000))
def test_the_predicted_file_size_is_exact(model, count):
    repeated = model.take(np.arange(count) % len(model))
    stream = streams.BytesIO()
    compressed_ply_write.write(repeated, stream)
    size = compressed_ply_write.file_bytes
    assert size(model, count) == len(stream.getvalue()) < size(model, count + 1)


def test_infinite_opacities_are_kept_and_zero_scales_are_clipped(tmp_path):
    model = random_splats(3)
    model.opacity_logits[:] = [-np.inf, np.inf, 0]
    model.log_scales[0, 0] = -np.inf
    loaded, rows = rewritten(model, tmp_path)
    assert sorted(loaded.opacities()[np.argsort(rows)].round(2)) == [0, 0.5, 1]
    assert loaded.log_scales[np.argsort(rows)][0, 0] == -20
    assert "1 splat has a log-scale beyond ±20" in io.losses(model, "a.compressed.ply")[0]


@pytest.mark.parametrize("field", ["means", "log_scales", "quats", "opacity_logits", "sh"])
def test_nan_values_are_refused_before_anything_is_written(tmp_path, field):
    model = random_splats(3)
    getattr(model, field)[1] = np.nan
    words = "1 splat holds NaN or infinite values, the first in row 1"
    with pytest.raises(OutputError, match=words):
        io.save(model, tmp_path / "a.compressed.ply")
    assert list(tmp_path.iterdir()) == []


def test_centres_beyond_the_float32_range_are_refused(tmp_path):
    model = random_splats(3)
    model = dataclasses.replace(model, means=model.means.astype(np.float64) * 1e39)
    with pytest.raises(OutputError, match="cannot store"):
        io.save(model, tmp_path / "a.compressed.ply")


def test_losses_are_reported():
    model = random_splats(2, degree=4, extras={"label": np.zeros(2)})
    tag = ExtraElement("tag", np.zeros(1, [("id", "i4")]))
    model.sh[0, 1] = 5
    model = dataclasses.replace(model, elements=[tag], means=model.means + np.float64(1e-12))
    extra, element, degree, precision, range_ = io.losses(model, "a.compressed.ply")
    assert "label" in extra
    assert "tag" in element
    assert "above degree 3" in degree
    assert "double precision" in precision
    assert "3 SH coefficients are beyond ±4" in range_
    assert io.losses(random_splats(2, degree=3), "a.compressed.ply") == ()


@pytest.mark.parametrize("mode", RenderMode)
def test_the_render_mode_is_stored(tmp_path, mode):
    model = dataclasses.replace(random_splats(2), render_mode=mode)
    assert rewritten(model, tmp_path)[0].render_mode is mode


def test_splats_are_ordered_by_interleaved_bits_of_their_cells():
    corners = [(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)]
    assert morton_order(np.array(corners, np.float32)).tolist() == list(range(8))
    assert morton_order(np.array(corners[::-1], np.float32)).tolist() == list(range(8))[::-1]


def test_a_dense_group_far_from_an_outlier_is_still_ordered():
    rng = np.random.default_rng(0)
    means = np.concatenate([rng.permutation(2000)[:, None] * (1e-4, 0, 0), [[1e6, 0, 0]]])
    means = means.astype(np.float32)
    assert (
        np.diff(means[morton_order(means), 0]) >= -2.1e-4
    ).all()  # a cell may contain two of them


def test_coincident_centres_keep_their_order():
    assert morton_order(np.zeros((600, 3), np.float32)).tolist() == list(range(600))


def test_a_real_scene_is_written_again_within_half_a_step(tmp_path):
    path = scene_path("guitar.compressed.ply")
    model = io.load(path)
    loaded, rows = rewritten(model, tmp_path)
    assert_close(model, loaded, rows)


def test_rotations_whose_components_become_rivals_by_rounding_are_written_again_unchanged(tmp_path):
    # Two components that are too far apart before rounding to be confused, but not after it.
    quats = np.array([[0.31868118, 0.64054149, -0.64386433, -0.27127033]] * 2, np.float32)
    model = dataclasses.replace(random_splats(2), quats=quats)
    first, second = tmp_path / "a.compressed.ply", tmp_path / "b.compressed.ply"
    io.save(model, first)
    io.save(io.load(first), second)
    assert first.read_bytes() == second.read_bytes()


@pytest.mark.parametrize("bits", [0x7F80_0001, 0x7F7F_FFFF], ids=["signalling NaN", "huge"])
def test_damaged_bounds_of_a_chunk_give_no_warnings(load, bits):
    damaged = np.full(1, bits, np.uint32).view(np.float32)
    bounds = [(name, "float", damaged) for name in BOUNDS + COLOURS]
    assert not load(("chunk", bounds), ("vertex", packed())).finite().any()

"""Decoding PlayCanvas' compressed PLY, against a plain twin and by hand."""

import math

import numpy as np
import pytest

from conftest import scene_path
from nanogs import io
from nanogs.errors import FormatError
from nanogs.io.ply_header import read_header
from nanogs.io.ply_rows import iter_blocks
from plyfiles import ply, vertex

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


@pytest.mark.parametrize(
    ("elements", "words"),
    [
        ([("chunk", chunk(2)), ("vertex", packed())], "1 splats need 1 chunks, not 2"),
        ([("chunk", chunk()[1:]), ("vertex", packed())], "min_x of type float"),
        ([("chunk", chunk()[:-1]), ("vertex", packed())], "max_b of type float"),
        ([("chunk", chunk()), ("vertex", packed()[:3])], "packed_color of type uint"),
        (
            [
                ("chunk", chunk()),
                ("vertex", packed()),
                ("sh", [(f"f_rest_{i}", "uchar", np.zeros(2)) for i in range(9)]),
            ],
            "2 rows for 1 splats",
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

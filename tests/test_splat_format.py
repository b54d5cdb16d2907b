"""Decoding `.splat`."""

import math
import struct

import numpy as np
import pytest

from conftest import scene_path
from nanogs import io
from nanogs.errors import FormatError

C0 = 0.28209479177387814


def row(mean=(1, 2, 3), scale=(1, 0.5, 2), rgba=(255, 0, 51, 51), quat=(255, 128, 0, 129)):
    return struct.pack("<6f8B", *mean, *scale, *rgba, *quat)


@pytest.fixture
def load(tmp_path):
    def load(data):
        (tmp_path / "a.splat").write_bytes(data)
        return io.load(tmp_path / "a.splat")

    return load


def test_one_row(load):
    model = load(row())
    assert model.means.tolist() == [[1, 2, 3]]
    assert model.log_scales[0] == pytest.approx([0, -math.log(2), math.log(2)])
    assert model.sh[0, 0] == pytest.approx([0.5 / C0, -0.5 / C0, -0.3 / C0])
    assert model.opacity_logits[0] == pytest.approx(math.log(0.25))
    assert model.quats.tolist() == [[127 / 128, 0, -1, 1 / 128]]


def test_zero_scale_and_extreme_alpha_are_infinite(load):
    model = load(row(scale=(0, 1, 1), rgba=(0, 0, 0, 0)) + row(rgba=(0, 0, 0, 255)))
    assert model.log_scales[0, 0] == -math.inf
    assert model.opacity_logits.tolist() == [-math.inf, math.inf]
    assert model.finite().all()
    assert model.notes == ()


def test_negative_scale_is_noted(load):
    model = load(row(scale=(-1, 1, 1)))
    assert math.isnan(model.log_scales[0, 0])
    assert model.notes == ("1 splats have a negative scale, which became NaN.",)


def test_blocks_agree(load, monkeypatch):
    data = b"".join(row(mean=(i, 0, 0)) for i in range(20))
    monkeypatch.setattr("nanogs.io.splat.BLOCK_ROWS", 3)
    assert load(data).means[:, 0].tolist() == list(range(20))


@pytest.mark.parametrize("size", [1, 31, 33, 63])
def test_partial_row_is_refused(load, size):
    with pytest.raises(FormatError, match="of 32 bytes each"):
        load((row() * 2)[:size])


def test_empty_file_is_refused(load):
    with pytest.raises(FormatError, match="is empty"):
        load(b"")


def test_real_scene():
    path = scene_path("plant.splat")
    model, info = io.load(path), io.inspect(path)
    assert len(model) == info.splats == 113_648
    assert np.isneginf(model.opacity_logits).sum() == 199
    assert model.finite().all()

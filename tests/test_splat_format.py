"""Reading and writing `.splat`."""

import math
import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from builders import random_splats
from conftest import scene_path
from nanogs import io
from nanogs.errors import FormatError, OutputError
from nanogs.io import registry
from nanogs.splats import RenderMode
from strategies import splats

C0 = 0.28209479177387814


def row(mean=(1, 2, 3), scale=(1, 0.5, 2), rgba=(255, 0, 51, 51), quat=(255, 128, 0, 129)):
    return struct.pack("<6f8B", *mean, *scale, *rgba, *quat)


@pytest.fixture
def load(tmp_path):
    def load(data):
        (tmp_path / "a.splat").write_bytes(data)
        return io.load(tmp_path / "a.splat")

    return load


def test_one_row_is_decoded(load):
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
    assert model.notes == ("1 splat has a negative scale, which became NaN.",)


def test_negative_scales_of_all_blocks_are_counted(load, monkeypatch):
    monkeypatch.setattr("nanogs.io.parts.BLOCK_ROWS", 3)
    data = row(scale=(1, -1, -1)) * 4 + row() * 4
    assert load(data).notes == ("4 splats have a negative scale, which became NaN.",)


def test_a_coordinate_may_begin_like_a_gzip_file(load):
    """Only the flags of gzip, of which the upper three bits are zero, tell the two apart."""
    [x] = struct.unpack("<f", b"\x1f\x8b\x08\x3f")
    assert load(row(mean=(x, 0, 0))).means[0, 0] == np.float32(x)
    with pytest.raises(FormatError, match="begins like a file of another format"):
        load(row(mean=struct.unpack("<3f", b"\x1f\x8b\x08\x00" + b"\0" * 8)))


def test_a_file_read_in_blocks_gives_the_same_model(load, monkeypatch):
    data = b"".join(row(mean=(i, 0, 0)) for i in range(20))
    monkeypatch.setattr("nanogs.io.parts.BLOCK_ROWS", 3)
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


# --- writing


@pytest.fixture
def saved(tmp_path):
    def saved(model):
        io.save(model, tmp_path / "b.splat", overwrite=True)
        return (tmp_path / "b.splat").read_bytes()

    return saved


def test_one_row_is_written_back(load, saved):
    unit = (255, 128, 128, 130)
    data = row(quat=unit) + row(scale=(0, 1, 2), rgba=(0, 1, 2, 255), quat=unit)
    assert saved(load(data)) == data


@pytest.mark.parametrize("length", [0.97, 0.98828125, 0.99, 1.01, 1.0117, 1.03])
def test_nearly_unit_quaternions_are_written_the_same_again(load, saved, length):
    """Rounding moved a length away from 1, so that the second writing normalised it."""
    model = random_splats(20, degree=0)
    model.quats[:] = (length, 0, 0, 0)
    once = saved(model)
    assert saved(load(once)) == once


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(quats=hnp.arrays(np.float32, (20, 4), elements=st.floats(-4, 4, width=32)))
def test_unit_quaternions_keep_their_bytes(load, saved, tmp_path, quats):
    """Other quaternions are normalised when they are first written."""
    model = replace(random_splats(20, degree=0), quats=quats)
    once = saved(model)
    assert saved(load(once)) == once
    again = io.load(tmp_path / "b.splat")
    dots = (again.unit_quats() * model.unit_quats().astype(np.float64)).sum(axis=1)
    assert np.abs(dots).min() > 0.999


@pytest.mark.parametrize("length", [0.3, 1.5, 100])
def test_the_length_of_a_quaternion_does_not_matter(saved, length):
    """Nor where bytes that are cut off at 1 would make it nearly a unit one."""
    model = random_splats(40, degree=0)
    model.quats[:] = model.unit_quats()
    model.quats[:20, 1:] *= 0.05
    model.quats[:] = model.unit_quats()
    assert saved(replace(model, quats=length * model.quats)) == saved(model)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(model=splats(max_degree=0, extras=False))
def test_round_trip_within_half_a_step(tmp_path, model):
    io.save(model, tmp_path / "a.splat", overwrite=True)
    again = io.load(tmp_path / "a.splat")
    assert np.array_equal(again.means, model.means.astype(np.float32))
    assert np.allclose(again.log_scales, model.log_scales, rtol=3e-7)
    assert np.abs(again.opacities() - model.opacities()).max() <= 0.5 / 255 + 1e-7
    inside = np.clip(model.sh[:, 0], -0.5 / C0, 0.5 / C0)
    assert np.abs(again.sh[:, 0] - inside).max() <= 0.5 / 255 / C0 + 1e-6
    size = registry.sizer(tmp_path / "a.splat")(model, len(model))
    assert (tmp_path / "a.splat").stat().st_size == size == 32 * len(model)


def test_order_is_kept_across_blocks(saved, load, monkeypatch):
    model = random_splats(20, degree=0)
    whole = saved(model)
    monkeypatch.setattr("nanogs.source.base.BLOCK_ROWS", 3)
    assert saved(model) == whole
    assert np.array_equal(load(whole).means, model.means)


def test_losses_are_reported(tmp_path):
    model = random_splats(3, degree=2, extras={"label": np.arange(3)})
    model.sh[:, 0] = 0
    model.sh[1, 0, 2] = 2
    model = replace(model, means=model.means.astype(np.float64) + 1e-12, render_mode=RenderMode.MIP)
    mode = "The render mode mip is left out, .splat has no tag for it"
    assert io.losses(model, tmp_path / "a.splat") == (
        "Extra columns are left out, .splat has no room for them: label.",
        "Spherical harmonics above degree 0 are left out, .splat holds no more.",
        f"{mode}: viewers will render the model as ordinary splats.",
        "1 splat has base colours outside 0 to 1, the range of .splat; they are clamped to it.",
        "Centres in double precision are rounded, .splat holds single.",
    )
    plain = random_splats(3, degree=0)
    plain.sh[:] = [[[-1.003 / 2 / C0, 0, 1.003 / 2 / C0]]]  # rounded to bytes 0 and 255
    assert io.losses(plain, tmp_path / "a.splat") == ()


def test_unstorable_models_are_refused(saved, tmp_path):
    model = random_splats(3, degree=0)
    model.sh[1] = np.nan
    with pytest.raises(OutputError, match="1 splat holds NaN"):
        saved(model)
    with pytest.raises(OutputError, match="no splats"):
        saved(model.take(np.zeros(0, np.int64)))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["plant", "seal", "chair"])
def test_real_files_are_written_back_byte_for_byte(saved, name):
    path = scene_path(f"{name}.splat")
    assert saved(io.load(path)) == path.read_bytes()


def test_gaussforge_reads_the_same_values(saved, tmp_path):
    forge = pytest.importorskip("gaussforge").GaussForge()
    model = random_splats(500, degree=0)
    (tmp_path / "a.ply").write_bytes(forge.convert(saved(model), "splat", "ply")["data"])
    ours, theirs = io.load(tmp_path / "b.splat"), io.load(tmp_path / "a.ply")
    assert np.array_equal(theirs.means, ours.means)
    assert np.allclose(theirs.log_scales, ours.log_scales, atol=1e-5)
    assert np.abs(theirs.opacities() - ours.opacities()).max() < 1e-4
    assert np.allclose(theirs.sh, ours.sh, atol=1e-5)
    dots = (theirs.unit_quats() * ours.unit_quats().astype(np.float64)).sum(axis=1)
    assert np.abs(dots).min() > 1 - 1e-5


def test_normals_of_zero_are_no_loss(tmp_path):
    zeros, ones = np.zeros(4, np.float32), np.ones(4, np.float32)
    model = replace(random_splats(4, degree=0), comments=())
    path = tmp_path / "model.splat"
    assert io.losses(replace(model, extras={"nx": zeros, "ny": zeros}), path) == ()
    assert "ny" in io.losses(replace(model, extras={"nx": zeros, "ny": ones}), path)[0]
    assert "label" in io.losses(replace(model, extras={"label": zeros}), path)[0]

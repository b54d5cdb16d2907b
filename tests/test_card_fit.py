"""Fits and runs with the kernels for a card, on one or else on Warp's CPU device, and the CPU's."""

import dataclasses
import json

import numpy as np
import pytest

import nanogs
from builders import cloud_pair, model_bytes
from conftest import CARD, made_on_the_device
from launch import run
from nanogs.card.device import use_device
from nanogs.fit.on_card import CardDescent, descent_for
from nanogs.fit.parameters import RefitParameters
from nanogs.fit.shared import SharedHarmonics
from nanogs.fit.state import MeanState
from nanogs.fit.targets import Fitting, errors_of_splats, make_target, squared_error
from nanogs.kernels.blocks import ALL_BLOCKS, FIELDS
from nanogs.raster.rendering import prepare
from nanogs.splats import RenderMode
from nanogs.views.automatic import automatic_cameras

pytest.importorskip("warp", reason="pip install 'nanogs[cuda]'")

STEPS, CLOSE = 6, 0.02  # CLOSE: dB between results of the two devices
QUICK = RefitParameters(views=6, validation=2, size=64, rounds=2, steps=12)
COLUMNS = ("means", "log_scales", "quats", "logits", "sh")


def scene(degree=1, mode=RenderMode.DEFAULT):
    """Return the original, a small model to fit, and four views of the original as targets."""
    original, small = cloud_pair(degree=degree)
    small = dataclasses.replace(small, render_mode=mode)
    cameras = automatic_cameras(original, 4, width=64, height=48)
    cameras[-1] = cameras[-1].sharpened(0.5)
    return original, small, [make_target(prepare(original), camera) for camera in cameras]


def check_steps(small, views, parameters=QUICK, shared=None):
    """Make the same steps on both devices and compare the resulting states."""
    cpu_descent = descent_for(small, views, parameters, shared)
    with use_device(CARD):
        card_descent = descent_for(small, views, parameters, shared)
        assert isinstance(card_descent, CardDescent)
        assert not isinstance(cpu_descent, CardDescent)
        for number in range(STEPS):
            share = number / STEPS
            on_card = card_descent.step(1.0, share)
            with use_device("cpu"):
                assert on_card == pytest.approx(cpu_descent.step(1.0, share), rel=1e-4)
        found, expected = card_descent.curvatures(), cpu_descent.curvatures()
    for each in dataclasses.fields(expected):
        values = getattr(expected, each.name)
        least = 1e-3 * float(values.max())
        assert getattr(found, each.name) == pytest.approx(values, rel=0.01, abs=least)
    on_card, on_cpu = card_descent.state, cpu_descent.state
    assert (on_card.touched == on_cpu.touched).all()
    assert on_cpu.touched.any()
    start = descent_for(small, views, parameters).state
    for name in COLUMNS:
        card_column, cpu_column = getattr(on_card, name), getattr(on_cpu, name)
        distance = np.abs(cpu_column - getattr(start, name)).max()
        assert distance > 0.01, name
        assert np.abs(card_column - cpu_column).max() < 1e-3 * distance, name
    return on_card, on_cpu


@pytest.mark.parametrize("degree", range(4))
def test_steps_agree_for_every_sh_degree(degree):
    _, small, targets = scene(degree)
    check_steps(small, Fitting(targets))


def test_steps_agree_in_mip_mode_with_half_of_the_pixels_and_double_means():
    _, small, targets = scene(mode=RenderMode.MIP)
    small = dataclasses.replace(small, means=small.means.astype(np.float64))
    check_steps(small, Fitting(targets), dataclasses.replace(QUICK, halves=True))


def test_steps_agree_with_surroundings_and_lazily_rendered_views():
    original, small, targets = scene()
    part = np.flatnonzero(small.means[:, 0] < 0)
    rest = prepare(small.take(np.flatnonzero(small.means[:, 0] >= 0)))
    more = [target.camera for target in targets[2:]]
    views = Fitting(targets[:2], prepare(original), more, surroundings=rest)
    state, _ = check_steps(small.take(part), views)
    assert len(state.means) == len(part)


def test_steps_agree_where_splats_share_their_harmonics():
    _, small, targets = scene(2)
    labels = (np.arange(len(small)) % 7).astype(np.int32)
    sh = small.sh.copy()
    sh[:, 1:] = sh[:7][labels, 1:]
    shared = SharedHarmonics.of(labels, 7, np.ones(len(small)))
    state, _ = check_steps(dataclasses.replace(small, sh=sh), Fitting(targets), shared=shared)
    assert len(np.unique(state.sh[:, 1:].reshape(len(small), -1), axis=0)) == 7


def test_a_restarted_descent_knows_how_well_splats_were_determined():
    _, small, targets = scene()
    with use_device(CARD):
        descent = descent_for(small, Fitting(targets), QUICK)
        for number in range(3):
            descent.step(1.0, number / 3)
        known = descent._moving.determined().copy()
        descent.begin(descent.state)
        np.testing.assert_array_equal(descent._moving.determined(), known)
    assert known.max() > 0.5


def test_means_of_states_agree():
    _, small, targets = scene(2)
    views = Fitting(targets)
    with use_device(CARD):
        card = descent_for(small, views, QUICK)
        plain = MeanState()
        for _ in range(4):
            card.step(1.0, 0.0)
            card.add_to_mean()
            plain.add(card.state)
        on_card, on_cpu, last = card.mean(), plain.state(), card.state
    for name in COLUMNS:
        card_column, cpu_column = getattr(on_card, name), getattr(on_cpu, name)
        np.testing.assert_allclose(card_column, cpu_column, rtol=1e-6, atol=1e-6)
        assert np.abs(getattr(last, name) - cpu_column).max() > 1e-3, name
    assert (on_card.touched == on_cpu.touched).all()


def test_errors_of_views_agree():
    _, small, targets = scene()
    model = prepare(small)
    for target in targets:
        with use_device(CARD):
            error = squared_error(model, target)
        assert error == pytest.approx(squared_error(model, target), rel=1e-6)


@pytest.mark.parametrize("blocks", [ALL_BLOCKS, FIELDS[0]])
@pytest.mark.parametrize("halved", [False, True])
def test_errors_of_splats_agree(blocks, halved):
    original, small, targets = scene()
    prepared = prepare(small)
    for target in targets[:2]:
        camera = target.camera.cropped(0, 0, 63, 47)  # odd: the last row and column do not count
        part = make_target(prepare(original), camera, depth=False, wanted=blocks)
        on_cpu = errors_of_splats(prepared, part, halved=halved)
        with use_device(CARD):
            on_card = errors_of_splats(prepared, part, halved=halved)
        assert on_cpu.max(axis=0).min() > 0
        np.testing.assert_allclose(on_card, on_cpu, rtol=1e-3, atol=1e-4 * on_cpu.max())


def test_a_refit_is_as_good_and_its_bytes_are_reproducible():
    original, small, _ = scene()
    _, cpu = nanogs.refit(original, small, parameters=QUICK)
    fitted, card = nanogs.refit(original, small, parameters=QUICK, device=CARD)
    assert card.psnr_after == pytest.approx(cpu.psnr_after, abs=CLOSE)
    assert card.improved
    assert made_on_the_device(card.notes)
    assert cpu.notes == ()
    again, _ = nanogs.refit(original, small, parameters=QUICK, device=CARD)
    assert model_bytes(again) == model_bytes(fitted)


@pytest.mark.parametrize("preset", ["default", "best"])
def test_presets_are_as_good_on_a_card(small_views, preset):
    original, _, _ = scene(2)
    scores = []
    for device in ("cpu", CARD):
        small, report = nanogs.simplify(original, ratio=0.2, preset=preset, device=device)
        assert len(small) == report.achieved_count == 80
        scores.append(nanogs.compare(original, small, views=4, pixels=64).models[0].psnr)
    assert scores[0] == pytest.approx(scores[1], abs=CLOSE)
    assert made_on_the_device(report.notes)


def test_levels_equal_those_of_simplify_and_note_the_device(small_views, tmp_path):
    original, _, _ = scene()
    [(level, report)] = nanogs.levels(original, [0.2], device=CARD)
    small, _ = nanogs.simplify(original, ratio=0.2, finer=1, device=CARD)
    assert model_bytes(level) == model_bytes(small)
    assert made_on_the_device(report.notes)
    manifest, _ = nanogs.write_levels(original, tmp_path / "out", [0.2], device=CARD)
    assert any(CARD in note for note in manifest.notes)
    written = nanogs.load(tmp_path / "out/level_0.ply")
    assert np.array_equal(written.sh, small.sh)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("models") / "a.ply"
    nanogs.save(cloud_pair()[0], path)
    return path


def test_the_command_fits_on_the_device_and_reports_it(file, tmp_path):
    quick = ("--views", 4, "--view-size", 32, "--steps", 4, "--no-measure", "--json")
    result = run("simplify", file, tmp_path / "b.ply", "-r", "0.25", *quick, "--device", CARD)
    assert result.returncode == 0, result.stderr
    assert made_on_the_device(json.loads(result.stdout)["notes"])
    quick = ("--views", 4, "--pixels", 32, "--rounds", 1, "--json")
    result = run("refit", file, tmp_path / "b.ply", tmp_path / "c.ply", *quick, "--device", CARD)
    assert result.returncode == 0, result.stderr
    assert made_on_the_device(json.loads(result.stdout)["notes"])


@pytest.mark.parametrize("command", ["simplify", "lod"])
@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--preset", "fast"), "preset fast, which renders nothing"),
        (("--job", "work"), "--device cpu"),
    ],
)
def test_the_command_refuses_a_card_where_it_cannot_be_used(
    file, tmp_path, command, options, message
):
    out = tmp_path / ("b.ply" if command == "simplify" else "b")
    target = ("-r", "0.25") if command == "simplify" else ("--levels", "0.25")
    result = run(command, file, out, *target, *options, "--device", CARD, cwd=tmp_path)
    assert result.returncode == 2
    assert message in result.stderr.splitlines()[-1]
    assert not out.exists()
    assert not (tmp_path / "work").exists()

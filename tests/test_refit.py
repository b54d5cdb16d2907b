"""Refit: its kernels against reference versions in float64, and its promises on small scenes."""

import dataclasses
import itertools
import json
import math

import numpy as np
import pytest
from numba.core import config

import reference_refit
from builders import cloud_pair, model_bytes
from conftest import peer_path, scene_path
from nanogs import RefitParameters, refit
from nanogs.errors import ModelError, OptionError, OutputError
from nanogs.fit import groups, rounds
from nanogs.fit.descent import Descent, _bands
from nanogs.fit.groups import EXACT, ViewGroup, grouped, hold_out, split
from nanogs.fit.report import RefitStop
from nanogs.fit.rounds import SHARES, Validator, _line_search, _round
from nanogs.fit.shared import SharedHarmonics, fit_shared
from nanogs.fit.stages import refit_stages
from nanogs.fit.state import (
    LOWEST_LOG_SCALE,
    MeanState,
    activate,
    displacements_of,
    range_notes,
    start,
    store,
)
from nanogs.fit.targets import (
    ALPHA,
    WHITE,
    Fitting,
    Target,
    compute_gradients,
    make_target,
    squared_error,
    sum_gradients,
)
from nanogs.fit.views import choose_cameras, view_targets
from nanogs.io import load
from nanogs.kernels import backward, damped
from nanogs.kernels.advance import MOST_DETERMINED
from nanogs.kernels.blocks import ALL_BLOCKS, FIELDS
from nanogs.kernels.chain import ELSEWHERE, SHAPE, resolved_share, unoccluded_share
from nanogs.kernels.damped import LANES
from nanogs.progress import ignore_progress
from nanogs.raster.camera import NEAR, Camera
from nanogs.raster.rendering import prepare, project, render
from nanogs.scoring.scores import reference_views, score
from nanogs.splats import RenderMode, Splats
from nanogs.views.automatic import automatic_cameras
from nanogs.views.roam import roaming_cameras
from reference_refit import (
    ReferenceFit,
    blend_reference,
    gradient_reference,
    perturbed,
    pixel_weights,
    shape_terms,
)

QUICK = RefitParameters(views=6, validation=2, size=64, rounds=2, steps=12)


def make_camera(width=37, height=21, focal=30.0):
    return Camera(width, height, focal, focal, width / 2, height / 2, np.eye(4))


def make_splats(n=12, seed=0, degree=0, size=-1.2, mode=RenderMode.DEFAULT):
    """Splats around (0, 0, 4), large on screen, so that few pixels are at an alpha threshold."""
    rng = np.random.default_rng(seed)
    arrays = {
        "means": rng.normal((0, 0, 4), (1, 0.6, 0.8), (n, 3)),
        "log_scales": rng.normal(size, 0.4, (n, 3)),
        "quats": rng.normal(size=(n, 4)),
        "opacity_logits": rng.normal(0, 1, n),
        "sh": rng.normal(0, 0.5, (n, (degree + 1) ** 2, 3)),
    }
    arrays = {name: array.astype(np.float32) for name, array in arrays.items()}
    return Splats(**arrays, render_mode=mode)


def gradient_sums(splats, camera, residual, precision, blocks=ALL_BLOCKS):
    """Return the features that the kernels are given, and the gradient sums that they compute."""
    view = project(prepare(splats), camera)
    features = np.zeros_like(view.features)
    features[view.order, :3] = view.features[view.order, :3] - np.float32(0.5)
    features[:, 3] = 0.7
    image = blend_reference(splats, camera, features).astype(np.float32)
    totals = sum_gradients(view, features, image, residual, precision, blocks)
    return features.astype(np.float64), totals


def random_pixels(camera, seed=5):
    rng = np.random.default_rng(seed)
    residual = rng.normal(size=(camera.height, camera.width, 4)).astype(np.float32)
    return residual, rng.uniform(0, 1, residual.shape[:2]).astype(np.float32)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("size", [(37, 21), (16, 16), (50, 7)])
def test_gradients_match_their_reference(seed, size):
    splats, camera = make_splats(20, seed), make_camera(*size)
    residual, precision = random_pixels(camera)
    features, totals = gradient_sums(splats, camera, residual, precision)
    expected = gradient_reference(splats, camera, features, residual, precision)
    scale = np.abs(expected).max(axis=0)
    assert (np.abs(totals - expected).max(axis=0) < 1e-3 * scale).all()


@pytest.mark.parametrize("entries", [1, 7, 40, 1000])
def test_gradients_are_the_same_however_many_entries_are_held_at_a_time(entries, monkeypatch):
    splats, camera = make_splats(30, size=-2.0), make_camera(200, 120, focal=150.0)
    residual, precision = random_pixels(camera)
    _, whole = gradient_sums(splats, camera, residual, precision)
    monkeypatch.setattr("nanogs.fit.targets.ENTRIES", entries)
    held, gather = [], backward.gather_entries
    monkeypatch.setattr(
        backward, "gather_entries", lambda *args: (held.append(len(args[1])), gather(*args))
    )
    _, found = gradient_sums(splats, camera, residual, precision)
    assert np.array_equal(found, whole)
    assert np.abs(whole).max() > 0
    counts = np.diff(project(prepare(splats), camera).starts)
    assert sum(held) == counts.sum() > 100
    assert max(held) <= max(entries, counts.max())


def test_pixel_errors_are_the_mean_over_black_and_white_backgrounds():
    rng = np.random.default_rng(7)
    target, image = rng.uniform(0, 1, (2, 9, 11, 4))
    image[..., :3] *= 1.4  # some colours are above 1
    image[0, 0, :3], target[0, 0, :3] = 1.3, 1.0
    shifted = image.copy()
    shifted[..., :3] -= WHITE * image[..., 3:]
    shifted[..., 3] *= ALPHA
    residual, precision = np.empty((9, 11, 4), np.float32), np.empty((9, 11), np.float32)
    errors = np.empty((9, 2))
    target = np.rint(target * 255) / 255
    fixed = np.rint(target * 255).astype(np.uint8)
    backward.weigh_pixels(
        shifted.astype(np.float32), fixed, WHITE, ALPHA, ALL_BLOCKS, residual, precision, errors
    )
    assert (errors[:, 1] == 11).all()
    errors = errors[:, 0]
    change = target - np.minimum(image, 1)
    over_black = (change[..., :3] ** 2).sum()
    over_white = ((change[..., :3] - change[..., 3:]) ** 2).sum()
    assert errors.sum() == pytest.approx((over_black + over_white) / 2, rel=1e-4)
    assert (residual.astype(np.float64) ** 2).sum() == pytest.approx(errors.sum(), rel=1e-4)
    np.testing.assert_allclose(precision, image[..., 3], rtol=1e-5)
    expected = -WHITE * change[0, 0, 3]  # a clipped colour has no residual of its own
    np.testing.assert_allclose(residual[0, 0, :3], expected, atol=1e-4)


def test_gradients_of_the_two_checkerboard_halves_add_up_to_the_whole():
    splats, camera = make_splats(20, 3), make_camera()
    residual, precision = random_pixels(camera)
    _, whole = gradient_sums(splats, camera, residual, precision)
    parts = [gradient_sums(splats, camera, residual, precision, blocks)[1] for blocks in FIELDS]
    assert all(np.abs(part[:, 3]).sum() > 0.2 * whole[:, 3].sum() for part in parts)
    scale = np.abs(whole).max(axis=0)
    assert (np.abs(parts[0] + parts[1] - whole).max(axis=0) < 1e-5 * scale).all()


@pytest.mark.filterwarnings("error")
def test_extreme_values_are_fitted_without_warnings():
    """Colours without a value are black, and depths may be near the limit of float32."""
    splats, camera = make_splats(20, 4, degree=2), make_camera()
    splats.sh[:] = np.float32(3e38) * np.sign(splats.sh)
    splats.log_scales[3], splats.quats[3] = 1e38, (1, 0, 0, 0)
    assert np.isnan(render(prepare(splats), camera).color).any()
    target = make_target(prepare(splats), camera)
    assert target.image[..., 3].max() > 0
    assert squared_error(prepare(splats), target) < EXACT
    far = make_splats(20, 4)
    far.means[:] *= np.float32(5e37)
    far.log_scales[:] += np.float32(np.log(5e37))
    assert 1e36 < make_target(prepare(far), camera).footprint < math.inf
    splats.quats[5] = np.inf
    state = start(splats)
    assert np.isnan(state.quats[5]).any()
    state.means[7] = 1e39  # steps may move a centre this far
    assert not activate(state, splats, splats.finite()).model.keep[3]


def test_the_error_of_a_checkerboard_half_is_that_of_its_pixels():
    splats, camera = make_splats(20, 3), make_camera()
    target = make_target(prepare(make_splats(20, 4)), camera)
    whole = compute_gradients(prepare(splats), target)
    halves = [compute_gradients(prepare(splats), target, blocks) for blocks in FIELDS]
    rows, columns = np.indices((camera.height, camera.width)) // 4
    shares = [((rows + columns) % 2 == field).mean() for field in (0, 1)]
    mean = sum(share * half.error for share, half in zip(shares, halves, strict=True))
    assert mean == pytest.approx(whole.error, rel=1e-6)


def test_a_view_uses_its_other_checkerboard_half_at_its_next_turn():
    original, small = cloud_pair()
    cameras = automatic_cameras(original, 3, width=32, height=32)
    targets = [make_target(prepare(original), camera) for camera in cameras]
    descent = Descent(small, Fitting(targets), dataclasses.replace(QUICK, halves=True))
    turns = [[descent._next() for _ in range(3)] for _ in range(2)]
    first, second = (dict(turn) for turn in turns)
    assert first.keys() == second.keys()
    assert all({first[view], second[view]} == set(FIELDS) for view in first)


def test_a_view_rendered_in_one_half_is_fitted_on_that_half():
    original, small = cloud_pair()
    prepared, [camera] = prepare(original), automatic_cameras(original, 1, width=40, height=40)
    whole = make_target(prepared, camera)
    rows, columns = np.indices((40, 40)) // 4
    for number, field in enumerate(FIELDS):
        half = make_target(prepared, camera, wanted=field)
        rendered = (rows + columns) % 2 == number
        assert np.array_equal(half.image[rendered], whole.image[rendered])
        assert not half.image[~rendered].any()
        descent = Descent(small, Fitting([half]), dataclasses.replace(QUICK, halves=True))
        assert [descent._next()[1] for _ in range(3)] == [field] * 3
        target = Fitting([], prepared, [camera]).take(0, field)
        assert np.array_equal(target.image, half.image)


def test_colour_gradients_are_the_adjoint_of_blending():
    splats, camera = make_splats(20, 3), make_camera()
    residual, precision = random_pixels(camera)
    _, totals = gradient_sums(splats, camera, residual, precision)
    colours = np.random.default_rng(6).normal(size=(20, 3))
    forward = (blend_reference(splats, camera, colours) * residual[..., :3]).sum()
    assert (colours * totals[:, :3]).sum() == pytest.approx(forward, rel=1e-4)


def random_features(splats, seed=9):
    return np.random.default_rng(seed).normal(0, 0.5, (len(splats), 4))


def shape_sums(splats, camera, residual, precision):
    """Gradients and Hessian blocks of shape parameters, from sums without an alpha threshold."""
    view = project(prepare(splats), camera)
    features = random_features(splats)
    totals = gradient_reference(splats, camera, features, residual, precision, cutoff=0.0)
    active = activate(start(splats), splats, splats.finite())
    gradients, blocks = np.zeros((len(splats), 10)), np.zeros((len(splats), 55))
    model = active.model
    for i in view.order:
        gradients[i], blocks[i] = shape_terms(
            view.geometry[i], totals[i], model.means[i] - camera.position, active.axes[i],
            active.scales[i], model.opacities[i], camera, splats.render_mode,
        )  # fmt: skip
    return view.order, gradients, blocks


@pytest.mark.parametrize("mode", [RenderMode.DEFAULT, RenderMode.MIP])
@pytest.mark.parametrize("parameter", range(10))
def test_shape_gradients_match_finite_differences(mode, parameter):
    splats, camera = make_splats(8, 2, size=-1.5, mode=mode), make_camera()
    residual, precision = random_pixels(camera)
    visible, gradients, _ = shape_sums(splats, camera, residual, precision)
    features, step = random_features(splats), 1e-4
    for i in visible:
        ends = [
            blend_reference(
                perturbed(splats, i, parameter, sign * step), camera, features, cutoff=0.0
            )
            for sign in (-1, 1)
        ]
        slope = ((ends[1] - ends[0]) * residual).sum() / (2 * step)
        assert gradients[i, parameter] == pytest.approx(slope, rel=1e-3, abs=1e-3)


def test_hessian_blocks_bound_the_curvature_from_above():
    """Moving all splats changes the pixels, squared, by no more than the sum over the blocks."""
    splats, camera = make_splats(8, 4), make_camera()
    _, weights, after = pixel_weights(splats, camera, 0.0)
    precision = 1 - after[-1]
    visible, _, blocks = shape_sums(splats, camera, np.zeros((21, 37, 4)), precision)
    assert len(weights) == len(visible)
    rng, features, step = np.random.default_rng(0), random_features(splats), 1e-4
    for _ in range(3):
        direction = np.zeros((8, 10))
        direction[visible] = rng.normal(size=(len(visible), 10))
        bound = sum(d @ block @ d for d, block in zip(direction, unpack(blocks), strict=True))
        change = 0.0
        for i, parameter in itertools.product(visible, range(10)):
            ends = [
                blend_reference(
                    perturbed(splats, i, parameter, sign * step), camera, features, cutoff=0.0
                )
                for sign in (-1, 1)
            ]
            change = change + direction[i, parameter] * (ends[1] - ends[0]) / (2 * step)
        assert (change**2).sum() <= bound


def unpack(blocks):
    full = np.zeros((len(blocks), 10, 10))
    for a, b in itertools.product(range(10), range(10)):
        low, high = max(a, b), min(a, b)
        full[:, a, b] = blocks[:, low * (low + 1) // 2 + high]
    return full


def packed(full):
    return np.array([[m[a, b] for a in range(10) for b in range(a + 1)] for m in full])


def solved(gradients, blocks, damping, floor, limits, lanes):
    """Return the steps (N, 10) of N <= `lanes` splats, and whether each splat moves."""
    steps, curvatures, moves = damped.new_lanes(SHAPE, lanes)
    steps[:, : len(gradients)], curvatures[:, : len(gradients)] = (
        np.transpose(gradients),
        np.transpose(blocks),
    )
    damped.damped_steps(steps, curvatures, damping, floor, limits, np.empty(lanes), moves)
    return steps.T[: len(gradients)], moves[: len(gradients)]


def test_damped_steps_solve_each_block():
    rng = np.random.default_rng(8)
    factors = rng.normal(size=(30, 10, 12))
    full, gradients = factors @ factors.transpose(0, 2, 1), rng.normal(size=(30, 10))
    steps, moves = solved(gradients, packed(full), 0.1, 0.01, np.full(10, 1e9), 32)
    assert moves.all()
    diagonals = np.diagonal(full, axis1=1, axis2=2)
    lifts = 0.1 * diagonals + 0.01 * diagonals.max(axis=1, keepdims=True)
    damped_blocks = full + lifts[:, :, None] * np.eye(10)
    np.testing.assert_allclose(np.einsum("nab,nb->na", damped_blocks, steps), gradients, atol=1e-9)


def test_damped_steps_keep_limits():
    block, step = np.zeros(55), np.full(10, 5.0)
    block[[a * (a + 3) // 2 for a in range(10)]] = 1.0
    blocks = [0 * block, block, np.nan * block, block]  # the first has no curvature
    gradients = [step, step, step, np.nan * step]
    steps, moves = solved(gradients, blocks, 0.0, 0.01, np.linspace(0.5, 1.4, 10), 8)
    np.testing.assert_array_equal(moves, [False, True, False, False])
    np.testing.assert_allclose(steps[1], 0.5)  # shortened as a whole, to its smallest limit


@pytest.mark.skipif(
    bool(config.BOUNDSCHECK), reason="checks between operations keep some from being fused"
)
def test_a_damped_step_does_not_depend_on_the_other_lanes():
    rng = np.random.default_rng(9)
    factors = rng.normal(size=(LANES, 10, 12))
    blocks, gradients = packed(factors @ factors.transpose(0, 2, 1)), rng.normal(size=(LANES, 10))
    limits = np.full(10, 0.3)
    whole, _ = solved(gradients, blocks, 0.1, 0.01, limits, LANES)
    for first, last in ((0, 3), (5, LANES), (17, 18), (LANES - 1, LANES)):
        part, _ = solved(gradients[first:last], blocks[first:last], 0.1, 0.01, limits, LANES)
        np.testing.assert_array_equal(part, whole[first:last])


@pytest.mark.parametrize("mode", [RenderMode.DEFAULT, RenderMode.MIP])
def test_a_descent_step_matches_its_reference(mode):
    """Two views in turn, so that the second step uses curvatures kept from the first."""
    splats = make_splats(12, 5, size=-1.5, mode=mode, degree=2)
    original = make_splats(12, 6, size=-1.5, mode=mode, degree=2)
    near = dataclasses.replace(make_camera(), fx=60.0, fy=60.0).sharpened(0.5)
    targets = [make_target(prepare(original), camera) for camera in (make_camera(), near)]
    descent = Descent(splats, Fitting(targets), RefitParameters())
    reference = ReferenceFit(splats, RefitParameters(), len(targets))
    for target, rate in zip(targets, (0.3, 0.7), strict=True):
        model = activate(descent.state, splats, descent.finite).model
        reference.step(compute_gradients(model, target), target.camera, rate)
        descent._follow_target(target, ALL_BLOCKS, rate)
    state = descent.state
    assert state.touched.any()
    for name in ("means", "log_scales", "quats", "logits", "sh"):
        np.testing.assert_allclose(getattr(state, name), getattr(reference, name), atol=2e-5)
    np.testing.assert_array_equal(state.touched, reference.seen > 0)
    # The model that the kernel leaves for the next view equals one activated from the state.
    fresh, kept = activate(state, splats, descent.finite).model, descent._active.model
    np.testing.assert_allclose(kept.factors, fresh.factors, atol=1e-6)
    np.testing.assert_allclose(kept.opacities, fresh.opacities, atol=1e-6)
    np.testing.assert_allclose(kept.reaches, fresh.reaches, atol=1e-4)
    np.testing.assert_array_equal(kept.keep, fresh.keep)


@pytest.mark.parametrize("dilation", [0.3, 0.05])
@pytest.mark.parametrize("scale", [0.02, 0.3, 1.0, 4.0, 50.0])
def test_splats_smaller_than_a_pixel_have_a_low_resolved_share(scale, dilation):
    """For a ball of `scale` pixels, the square of variance / (variance + dilation)."""
    variance = scale**2 + dilation
    ball = np.array([0.0, 0.0, 1 / math.sqrt(variance), 0.0, 1 / variance])
    assert resolved_share(ball, dilation) == pytest.approx((scale**2 / variance) ** 2)
    assert resolved_share(ball, dilation) == pytest.approx(
        reference_refit.resolved_share(ball, dilation)
    )


def test_the_resolved_share_of_a_needle_is_that_of_its_long_axis():
    needle = np.array([0.0, 0.0, 1 / math.sqrt(1e-6 + 0.3), 0.0, 1 / (20.0**2 + 0.3)])
    assert resolved_share(needle, 0.3) == pytest.approx(0.5, abs=1e-3)
    leaning = np.array([0.0, 0.0, 0.4, -1.3, 0.9])
    assert resolved_share(leaning, 0.3) == pytest.approx(
        reference_refit.resolved_share(leaning, 0.3)
    )


def ball_behind_sheets(*alphas):
    """Return a ball of ten pixels and, in front of it, sheets that fill the view."""
    splats = make_splats(1 + len(alphas), 5)
    splats.means[:], splats.means[0] = (0, 0, 2), (0, 0, 4)
    splats.log_scales[:], splats.log_scales[0] = 5.0, -0.7
    splats.opacity_logits[:] = [1.0, *(math.log(alpha / (1 - alpha)) for alpha in alphas)]
    return splats


@pytest.mark.parametrize("alpha", [0.9, 0.95, 0.98])
def test_the_unoccluded_share_follows_the_light_that_passes(alpha):
    model = prepare(ball_behind_sheets(alpha))
    view = compute_gradients(model, make_target(model, make_camera()))
    row, weight = view.view.geometry[0], float(view.totals[0, 3])
    share = unoccluded_share(row, weight)
    assert share == pytest.approx(reference_refit.unoccluded_share(row, weight))
    # With A nearly 1, the weight is the light that passes: 2 pi opacity times both deviations.
    passes = min(4 * (1 - alpha) / row[6], 1)
    assert share == pytest.approx((1 + ELSEWHERE) * passes / (passes + ELSEWHERE), rel=0.05)


@pytest.mark.parametrize("wanted", [ALL_BLOCKS, *FIELDS])
@pytest.mark.parametrize("logit", [-3.0, 0.0, 6.0])
def test_splats_in_full_sight_have_an_unoccluded_share_of_one(wanted, logit):
    ball = make_splats(1, 5)
    ball.means[:], ball.log_scales[:], ball.opacity_logits[:] = (0, 0, 4), -0.7, logit
    model = prepare(ball)
    view = compute_gradients(model, make_target(model, make_camera()), wanted)
    assert unoccluded_share(view.view.geometry[0], float(view.totals[0, 3])) > 0.98


def test_many_steps_hardly_move_a_hidden_splat():
    moved = []
    for alphas in ((0.5,), (0.9, 0.98)):
        splats = ball_behind_sheets(*alphas)
        shift = np.zeros_like(splats.means)
        shift[0, 0] = 0.3
        other = dataclasses.replace(splats, means=splats.means + shift)
        descent = Descent(
            splats, Fitting([make_target(prepare(other), make_camera())]), RefitParameters()
        )
        for _ in range(100):
            descent.step(1.0, 0.0)
        moved.append(descent.state.means[0, 0])
    assert moved[0] > 0.25
    assert abs(moved[1]) < 0.05


def test_a_step_on_a_view_from_far_away_hardly_changes_scales():
    splats = make_splats(40, 5, size=-1.5)
    original = prepare(make_splats(40, 6, size=-1.5))
    moved = []
    for width in (37, 3):  # the same view on so few pixels that splats are points
        target = make_target(original, make_camera().reduced(width))
        descent = Descent(splats, Fitting([target]), RefitParameters())
        descent._follow_target(target, ALL_BLOCKS, 1.0)
        moved.append(np.abs(descent.state.log_scales - splats.log_scales).max())
    assert 0 < moved[1] < 0.1 * moved[0]


def test_many_steps_on_a_view_from_far_away_converge():
    """Each step also undoes a part of the whole displacement, until both are in balance."""
    splats = make_splats(40, 5, size=-1.5)
    target = make_target(prepare(make_splats(40, 6, size=-1.5)), make_camera().reduced(3))
    descent = Descent(splats, Fitting([target]), RefitParameters())
    far = []
    for number in range(1, 801):
        descent._follow_target(target, ALL_BLOCKS, 1.0)
        if number in (200, 400, 800):
            far.append(np.abs(descent.state.log_scales - splats.log_scales).max())
    assert 0 < far[2] < 1.1 * far[1] < 1.2 * far[0]


def test_a_restarted_descent_keeps_its_displacements_from_the_start():
    splats = make_splats(12, 5, size=-1.5, degree=1)
    target = make_target(prepare(make_splats(12, 6, size=-1.5, degree=1)), make_camera())
    descent = Descent(splats, Fitting([target]), RefitParameters())
    for _ in range(5):
        descent._follow_target(target, ALL_BLOCKS, 1.0)
    known = descent._displacements.copy()
    assert np.abs(known[:, :-1]).max() > 0.05
    assert known[:, MOST_DETERMINED].max() > 0.5
    descent.begin(descent.state)
    np.testing.assert_allclose(descent._displacements, known, atol=1e-6)
    descent.begin(start(splats))
    assert not descent._displacements[:, :-1].any()
    assert np.array_equal(descent._displacements[:, MOST_DETERMINED], known[:, MOST_DETERMINED])


def test_refit_raises_the_psnr_and_keeps_other_data():
    original, small = cloud_pair()
    fitted, report = refit(original, small, parameters=QUICK)
    assert report.improved
    assert report.psnr_after > report.psnr_before + 1
    assert len(fitted) == len(small) == report.count
    assert fitted.sh_degree == small.sh_degree
    np.testing.assert_array_equal(fitted.extras["label"], small.extras["label"])
    assert len(report.fit_views) == 6
    assert len(report.validation_views) == 2
    assert not set(report.fit_views) & set(report.validation_views)
    assert all(name.startswith("fit") for name in report.fit_views + report.validation_views)
    assert list(report.seconds) == [stage.name for stage in refit_stages(QUICK, 1, 1)]
    json.dumps(report.to_dict())


def test_a_perfect_model_is_returned_unchanged():
    original, _ = cloud_pair()
    fitted, report = refit(original, original, parameters=dataclasses.replace(QUICK, rounds=4))
    assert fitted is original
    assert [entry.share for entry in report.rounds] == [0, 0, 0], "steps were shortened first"
    assert (report.improved, report.stop) == (False, RefitStop.OPTIMUM)
    assert report.psnr_after == report.psnr_before > 56  # the error of 8 bits per channel
    assert report.notes


def test_no_group_of_views_may_become_worse_than_with_the_input():
    """Even if the others gain more than it loses; it may become worse than at its best."""
    _, small = cloud_pair()

    class Measured:
        def __init__(self, *psnrs):
            self.psnrs = iter(psnrs)

        def psnr(self, _model):
            return next(self.psnrs)

    groups = [Measured(30.0, 40.0, 31.0, 35.0, 36.0), Measured(30.0, 29.9, 32.0, 30.0, 29.0)]
    guard = Validator(small, groups)
    state = start(small)
    assert [guard.accepts(state) for _ in range(4)] == [False, True, True, False]
    assert (guard.before, guard.best) == ([30, 30], [35, 30])


def test_a_round_is_searched_from_its_end_to_the_best_state_so_far():
    _, small = cloud_pair()
    best, end = start(small), start(small)
    best.means[:] += 1
    end.means[:] += 5
    seen = []

    class Guard:
        def accepts(self, state):
            seen.append(float((state.means - small.means).mean()))
            return len(seen) == 3

    found, share = _line_search(Guard(), best, small, end)
    assert share == 0.25
    assert seen == pytest.approx([5, 3, 2])
    assert found.means == pytest.approx(small.means + 2)


class Steps:
    """A descent that moves all centres by 1 in a step; it notes its steps and restarts."""

    def __init__(self, small, parameters):
        self.parameters, self.state = parameters, start(small)
        self.state.touched[:] = True
        self.state.means[0] = 1e39
        self.taken, self.begun = [], []

    def step(self, *rate_and_share):
        self.state.means[1:] += 1
        self.taken.append(rate_and_share)
        return 0.1 if len(self.taken) % 2 else 0.3

    def begin(self, state):
        self.begun.append(state.copy())
        self.state = state.copy()

    def curvatures(self):
        return len(self.taken)

    def release(self):
        pass


def rounds_with(monkeypatch, kept, **parameters):
    """Fit in rounds of two steps, of which the guard keeps the given shares."""

    class Guard:
        def __init__(self, *_given):
            self.before = self.best = [20.0]
            self.tries = iter([each == share for share in kept for each in SHARES if each >= share])

        def accepts(self, _state):
            better = next(self.tries)
            self.best = [self.best[0] + better]
            return better

        def delivered(self, state):
            return state

        def reports(self):
            return ()

    _, small = cloud_pair()
    chosen = RefitParameters(rounds=len(kept), steps=2, **parameters)
    steps = Steps(small, chosen)
    monkeypatch.setattr(rounds, "AVERAGED", 0.0)
    monkeypatch.setattr(rounds, "Validator", Guard)
    monkeypatch.setattr(rounds, "descent_for", lambda *_given: steps)
    best, curvatures, outcome = rounds.fit(small, Fitting([]), [], chosen, ignore_progress)
    assert curvatures == len(steps.taken)
    return steps, best, outcome


def test_rounds_continue_from_what_was_kept_of_them_at_a_lower_rate(monkeypatch):
    kept = [1, 0.5, 0, 0.25, 1]
    steps, best, outcome = rounds_with(monkeypatch, kept, rate=2.0)
    assert [each.share for each in outcome.rounds] == kept
    rates = [2, 2, 1.4, 0.35, 0.245]
    assert [each.rate for each in outcome.rounds] == pytest.approx(rates)
    taken = [(rates[number // 2], number / 10) for number in range(10)]
    assert np.array(steps.taken) == pytest.approx(np.array(taken))
    moved = [(state.means - steps.begun[0].means)[1:].mean() for state in (*steps.begun, best)]
    assert moved == pytest.approx([0, 0, 0.5, 2.5])
    assert [(each.psnr_before, each.psnr_after) for each in outcome.rounds] == [
        (20, 21), (21, 22), (22, 22), (22, 23), (23, 24)
    ]  # fmt: skip
    assert outcome.rounds[0].fit_psnr == pytest.approx(-10 * math.log10(0.2))
    assert (outcome.stop, len(outcome.notes)) == (RefitStop.ROUNDS, 1)
    assert "left the range of float32" in outcome.notes[0]


@pytest.mark.parametrize("rate", [1.0, 8.0])
def test_rounds_end_if_nothing_was_kept_at_a_twentieth_of_the_first_rate(monkeypatch, rate):
    kept = [0, 0, 0.5, 0.5, 0, 1]
    _, _, outcome = rounds_with(monkeypatch, kept, rate=rate)
    assert [each.share for each in outcome.rounds] == kept[:5]
    assert outcome.stop == RefitStop.OPTIMUM


@pytest.mark.parametrize(("rounds", "steps", "averaged"), [(10, 10, 10), (2, 10, 4), (1, 4, 0)])
def test_the_last_fifth_of_all_steps_is_averaged_but_no_more_than_a_round(rounds, steps, averaged):
    added = []

    class Steps:
        parameters = RefitParameters(rounds=rounds, steps=steps)
        state = "last"

        def step(self, _rate, _share):
            return 0.0

        def add_to_mean(self):
            added.append(None)

        def mean(self):
            return "mean"

    reached = [_round(Steps(), 1.0, number, ignore_progress)[0] for number in range(rounds)]
    assert len(added) == averaged
    assert reached == ["last"] * (rounds - 1) + ["mean" if averaged else "last"]


def test_the_first_steps_of_a_descent_are_shorter():
    descent, rates = object.__new__(Descent), []
    descent._count, descent.shared = 0, None
    descent._next = lambda: (0, ALL_BLOCKS)
    descent._follow_view = lambda _index, _wanted, rate: rates.append(rate) or 0.0
    for _ in range(6):
        descent.step(2.0, 0.0)
    assert rates == pytest.approx([0.5, 1, 1.5, 2, 2, 2])
    descent.step(2.0, 1.0)
    assert rates[-1] == pytest.approx(0.6)


@pytest.mark.parametrize("degree", range(5))
def test_the_bands_share_a_change_of_colour(degree):
    """The base colour gets half of it, the other bands equal parts of the rest."""
    curvature, ridge = _bands(degree, RefitParameters(ridge=3.0, band_ridge=7.0)).T
    sizes = np.repeat(2 * np.arange(degree + 1) + 1, 2 * np.arange(degree + 1) + 1)
    shares = sizes / (4 * math.pi) / curvature
    expected = [0.5, *([0.5 / degree] * ((degree + 1) ** 2 - 1))] if degree else [1]
    assert shares == pytest.approx(expected)
    assert (ridge * 4 * math.pi).tolist() == pytest.approx([3, *[7] * ((degree + 1) ** 2 - 1)])


def test_steps_that_make_the_model_worse_are_undone():
    original, small = cloud_pair()
    # With this learning rate, colours overshoot by far in every round.
    wild = dataclasses.replace(QUICK, rate=60.0, rounds=3)
    fitted, report = refit(original, small, parameters=wild)
    assert report.psnr_after >= report.psnr_before
    assert report.rounds[0].share < 1
    assert report.improved is (fitted is not small)


def test_threads_change_no_byte():
    original, small = cloud_pair()
    results = [refit(original, small, parameters=QUICK, threads=t)[0] for t in (1, 2)]
    assert model_bytes(results[0]) == model_bytes(results[1])


def test_unit_of_length_does_not_matter():
    gains = []
    for scale in (1.0, 1e3, 1e25, 1e-25):
        _, report = refit(*cloud_pair(scale=scale), parameters=QUICK)
        gains.append((report.psnr_before, report.psnr_after))
    np.testing.assert_allclose(gains[1:], gains[:1] * 3, atol=0.05)


def test_nonfinite_and_transparent_rows_keep_their_bytes():
    original, small = cloud_pair()
    means, logits, quats = small.means.copy(), small.opacity_logits.copy(), small.quats.copy()
    means[0] = np.nan
    logits[1] = -np.inf
    quats[1] *= 3
    dirty = dataclasses.replace(small, means=means, opacity_logits=logits, quats=quats)
    means = original.means.copy()
    means[:2] = np.inf
    original = dataclasses.replace(original, means=means)
    fitted, report = refit(original, dirty, parameters=QUICK)
    assert report.improved
    assert report.notes == (
        "Of the original model, 2 splats with a NaN or infinite value were not drawn.",
        "Of the small model, 1 splat with a NaN or infinite value was not drawn.",
    )
    first = np.arange(2)
    assert model_bytes(fitted.take(first)) == model_bytes(dirty.take(first))
    assert fitted.take(np.arange(2, len(small))).finite().all()


@pytest.mark.parametrize("log_scale", [20.0, 40.0, 80.0, 88.7])
def test_extremely_long_splats_stay_finite(log_scale):
    """A splat whose step overflows is not drawn any more, which must not count as a gain."""
    original, small = cloud_pair()
    small.log_scales[::3, 0] = log_scale
    fitted, _ = refit(original, small, parameters=QUICK)
    assert fitted.finite().all()


def test_splats_whose_parameters_overflow_keep_their_bytes():
    _, small = cloud_pair()
    state = start(small)
    state.touched[:] = True
    state.means[:] += 1
    state.sh[0, 0, 1], state.means[1, 2] = np.nan, 1e39
    assert range_notes(start(small)) == ()
    assert range_notes(state) == (
        "2 splats keep their values of before the fit, which would have left the range of float32.",
    )
    stored, two = store(state, small), np.arange(2)
    assert model_bytes(stored.take(two)) == model_bytes(small.take(two))
    np.testing.assert_allclose(stored.means[2:], small.means[2:] + 1, atol=1e-6)


def test_a_splat_whose_scale_overflows_keeps_its_bytes():
    """The log-scale alone could be stored, but the splat would not be drawn."""
    _, small = cloud_pair()
    state = start(small)
    state.touched[0] = True
    state.log_scales[0, 1] = 89
    assert len(range_notes(state)) == 1
    stored = store(state, small)
    assert model_bytes(stored) == model_bytes(small)


def test_the_model_with_a_palette_is_validated_as_it_is_delivered():
    """Splats that no fitted view shows get the fitted entry of their palette too."""
    original, small = cloud_pair(degree=2)
    small.sh[:, 1:] += np.random.default_rng(0).normal(0, 0.1, small.sh[:, 1:].shape)
    cameras = automatic_cameras(original, 4, width=64, height=64)
    prepared = prepare(original).with_buffers()
    part = make_target(prepared, cameras[0].cropped(0, 0, 32, 32))
    deciding = [ViewGroup("all", tuple(make_target(prepared, camera) for camera in cameras[1:]))]
    fitted, _, outcome = fit_shared(small, 3, Fitting((part,)), deciding, QUICK, ignore_progress)
    assert outcome.improved
    assert outcome.psnr_after == deciding[0].psnr(prepare(fitted))
    assert len(np.unique(fitted.sh[:, 1:].reshape(len(fitted), -1), axis=0)) == 3


def test_splats_that_no_step_moved_get_the_fitted_harmonics_of_their_entry():
    begun = make_splats(4, degree=1)
    begun.sh[:, 1:] = [[[0.0] * 3] * 3, [[1.0] * 3] * 3] * 2
    fitted = dataclasses.replace(begun, sh=begun.sh.copy())
    fitted.sh[0, 1:] = 7
    shared = SharedHarmonics.of(np.array([0, 1, 0, 1], np.int32), 2, np.ones(4))
    assert shared.spread(fitted, begun).sh[:, 1, 0].tolist() == [7, 1, 7, 1]


def noisy_pair(n=400):
    """Return `cloud_pair` of degree 2; each splat of the small model has harmonics of its own."""
    original, small = cloud_pair(n, degree=2)
    small.sh[:, 1:] += np.random.default_rng(0).normal(0, 0.1, small.sh[:, 1:].shape)
    return original, small


def sets_of_harmonics(splats):
    return len(np.unique(splats.sh[:, 1:].reshape(len(splats), -1), axis=0))


def test_a_refit_for_a_file_with_a_palette_shares_harmonics():
    pair = noisy_pair()
    alone, _ = refit(*pair, parameters=QUICK)
    asked = {"format": ".sog", "format_options": {"palette": 3}}
    shared, report = refit(*pair, parameters=QUICK, **asked)
    assert report.psnr_after > report.psnr_before
    assert sets_of_harmonics(alone) == 100
    assert sets_of_harmonics(shared) == 3
    usual, _ = refit(*pair, parameters=QUICK, format="sog")  # small files need no sharing
    assert model_bytes(usual) == model_bytes(alone)


def test_values_that_cannot_be_shared_are_refused_before_a_refit():
    original, small = noisy_pair()
    flat = small.with_sh_degree(0)
    small.sh[7, 4, 1] = flat.sh[7, 0, 1] = np.nan
    for model in (small, flat):
        with pytest.raises(
            OutputError, match=r"1 splat holds NaN .* row 7, which \.sog cannot store"
        ):
            refit(original, model, parameters=QUICK, format=".sog")
    with pytest.raises(OptionError, match="no option 'palete' \\(did you mean"):
        refit(original, small, parameters=QUICK, format_options={"palete": 3})
    fitted, _ = refit(original, small, parameters=QUICK)
    assert np.isnan(fitted.sh[7, 4, 1])


@pytest.mark.parametrize("mode", [RenderMode.MIP, RenderMode.SURFEL])
def test_other_render_modes_are_fitted_too(mode):
    pair = [dataclasses.replace(model, render_mode=mode) for model in cloud_pair()]
    fitted, report = refit(*pair, parameters=QUICK)
    assert report.psnr_after > report.psnr_before + 1
    assert fitted.render_mode is mode


def test_sh_degrees_of_the_two_models_may_differ():
    original, _ = cloud_pair(degree=1)
    _, small = cloud_pair(degree=0)
    fitted, report = refit(original, small, parameters=QUICK)
    assert report.improved
    assert fitted.sh_degree == 0


def test_infinite_opacity_logits_can_become_finite():
    original, small = cloud_pair()
    opaque = dataclasses.replace(small, opacity_logits=np.full(len(small), np.inf, np.float32))
    fitted, report = refit(original, opaque, parameters=QUICK)
    assert report.improved
    assert np.isfinite(fitted.opacity_logits).mean() > 0.9


def test_splats_with_a_scale_of_zero_are_fitted_like_the_thinnest_ones():
    original, small = cloud_pair()
    models = []
    for least in (-np.inf, LOWEST_LOG_SCALE):
        flat = dataclasses.replace(small, log_scales=small.log_scales.copy())
        flat.log_scales[:, 2] = least
        state = start(flat)
        state.touched[:] = True
        assert not displacements_of(state, flat).any()
        fitted, report = refit(original, flat, parameters=QUICK)
        assert report.improved
        assert report.notes == ()
        models.append(fitted)
    assert model_bytes(models[0]) == model_bytes(models[1])


def test_opacity_is_fitted_for_black_splats_on_black():
    """Colours are equal whatever the opacity; only the alpha image shows it."""
    original, small = cloud_pair(degree=0)
    black = np.full((1, 1, 3), -0.5 / 0.28209479177387814, np.float32)
    original = dataclasses.replace(original, sh=np.broadcast_to(black, original.sh.shape).copy())
    small = dataclasses.replace(
        small,
        sh=np.broadcast_to(black, small.sh.shape).copy(),
        opacity_logits=small.opacity_logits - 3,
    )
    _, report = refit(original, small, parameters=QUICK)
    assert report.psnr_after > report.psnr_before + 2


def test_given_cameras_are_reduced_and_split_for_validation():
    original, small = cloud_pair()
    cameras = automatic_cameras(original, 5, width=200, height=100)
    _, report = refit(original, small, cameras=cameras, parameters=QUICK)
    assert [group.pixels for group in report.groups] == [str(min(200, QUICK.size))]
    assert len(report.fit_views) == 4
    assert len(report.validation_views) == 1
    assert report.notes == ()


def test_swapped_models_are_noted():
    original, small = cloud_pair()
    _, report = refit(small, original, parameters=QUICK)
    assert report.notes[0].startswith(
        f"The original has {len(small)} splats, fewer than the {len(original)} of the model that"
    )
    _, report = refit(small, small, parameters=QUICK)
    assert not any("fewer than" in note for note in report.notes)


def test_options_without_effect_and_frames_that_may_differ_are_noted():
    original, small = cloud_pair(degree=0)
    original = dataclasses.replace(original, comments=("Generated by Nerfstudio",))
    cameras = automatic_cameras(original, 4, width=32, height=32)
    cameras = [dataclasses.replace(camera, near=NEAR) for camera in cameras]
    given = {"format": ".sog", "format_options": {"palette": 3}}
    _, report = refit(original, small, cameras=cameras, parameters=QUICK, **given)
    frame, palette = report.notes
    assert "nerfstudio" in frame
    assert palette.startswith("`palette` had no effect, because")


def test_the_expected_seconds_of_a_fit_follow_its_steps():
    def seconds(**changes):
        chosen = dataclasses.replace(RefitParameters(rounds=2, steps=10, views=6), **changes)
        return refit_stages(chosen, 10**6, 10**5)[-1].weight

    assert seconds(rounds=4) == pytest.approx(2 * seconds())
    assert seconds(views=84) == seconds(views=320) > seconds(views=64), "a view for each step"


def test_views_that_see_no_splats_are_left_out_and_noted():
    original, small = cloud_pair()
    cameras = automatic_cameras(original, 5, width=64, height=64)
    turned_away = np.diag([-1.0, 1, -1, 1]) @ cameras[2].world_to_camera
    cameras[2] = dataclasses.replace(cameras[2], world_to_camera=turned_away)
    _, report = refit(original, small, cameras=cameras, parameters=QUICK)
    assert cameras[2].name not in report.fit_views + report.validation_views
    [note] = report.notes
    assert note.startswith(
        "The original is not visible in 1 of 5 views, so the fit leaves them out"
    )


def test_only_given_cameras_are_said_to_be_in_another_frame():
    original, small = cloud_pair()
    cameras = automatic_cameras(original, 4, width=32, height=32)
    away = np.diag([-1.0, 1, -1, 1])
    turned = [
        dataclasses.replace(each, world_to_camera=away @ each.world_to_camera) for each in cameras
    ]
    with pytest.raises(ModelError, match=r"another frame than the model: give other cameras, or"):
        refit(original, small, cameras=turned, parameters=QUICK)
    few = dataclasses.replace(QUICK, views=100, rounds=1, steps=1)
    _, report = refit(original, small, cameras=[*cameras, *turned] * 10, parameters=few)
    assert any("views looked at, so the fit leaves them out" in note for note in report.notes)
    dots = dataclasses.replace(original, log_scales=original.log_scales - 12, render_mode="mip")
    with pytest.raises(ModelError, match=r"too faint to be seen: give cameras nearer to it"):
        refit(dots, small, parameters=QUICK)


def test_views_are_grouped_by_size_and_distance():
    original, _ = cloud_pair()
    far = automatic_cameras(original, 10, width=40, height=40)
    near = [dolly(camera, 0.15) for camera in far]
    large = automatic_cameras(original, 4, width=100, height=50)
    prepared = prepare(original)
    targets = [make_target(prepared, camera) for camera in (*far, *near, *large)]
    groups = grouped(targets)
    assert [(group.name, len(group.targets)) for group in groups] == [
        ("40 px, near", 10), ("40 px, far", 10), ("100 px", 4)
    ]  # fmt: skip
    assert set(groups[0].targets) == set(targets[10:20])
    assert [len(group.targets) for group in hold_out(groups, 6)] == [2, 2, 1]
    assert [group.name for group in grouped(targets[:3] + targets[20:])] == ["40 to 100 px"]


def blank(size, footprint=math.inf):
    return Target(make_camera(size, size // 2), np.zeros((1, 1, 4), np.uint8), footprint)


def test_groups_of_views_need_four_views_of_known_distance():
    known = [blank(64, footprint) for footprint in (9, 1, 8, 2, 7, 1, 8, 2)]
    assert [len(group.targets) for group in grouped(known)] == [4, 4]
    assert [len(group.targets) for group in grouped(known[1:])] == [7]
    assert [group.name for group in grouped([blank(64)] * 8)] == ["64 px"]
    alike = [blank(size) for size in (128, 96, 112, 128) * 2]
    assert [group.name for group in grouped(alike)] == ["96 to 128 px"]
    assert len(grouped([blank(size) for size in (128, 64) * 4])) == 2


def test_about_as_many_validation_views_are_held_out_as_asked():
    one, two = ([ViewGroup("", (blank(64),) * 12)] * groups for groups in (1, 2))
    assert [len(group.targets) for group in hold_out(one, 9)] == [3], "a quarter at most"
    assert [len(group.targets) for group in hold_out(two, 2)] == [2, 2], "two of each"
    assert [RefitParameters(views=views).held for views in (2, 6, 40)] == [1, 2, 6]


def test_the_psnr_of_a_group_is_the_mean_over_its_views(monkeypatch):
    errors = iter([1e-2, 1e-4, 0.0])
    monkeypatch.setattr(groups, "squared_error", lambda _model, _target: next(errors))
    found = ViewGroup("", (blank(64),) * 3).psnr(None)
    assert found == pytest.approx((20 + 40 - 10 * math.log10(EXACT)) / 3)


def test_the_footprint_is_that_of_a_pixel_where_most_is_visible():
    """A faint veil far behind an opaque splat does not count."""
    splats = make_splats(2)
    splats.means[:] = [[0, 0, 4], [0, 0, 40]]
    splats.log_scales[:] = [[-1] * 3, [3] * 3]
    splats.opacity_logits[:] = 5, -4
    camera = dataclasses.replace(make_camera(), fy=60.0)
    assert make_target(prepare(splats), camera).footprint == pytest.approx(4 / 60, rel=0.1)


def test_given_cameras_are_used_evenly():
    cameras = [dataclasses.replace(make_camera(), name=str(number)) for number in range(21)]
    kept, further = choose_cameras(cameras, 3, 2, 64, 0.7)
    assert (len(kept), len(further)) == (3, 2)
    assert {camera.name for camera in kept + further} == {"2", "6", "10", "14", "18"}


def test_each_view_is_used_either_for_validation_or_for_fitting():
    original, _ = cloud_pair()
    prepared = prepare(original)
    cameras = automatic_cameras(original, 12, width=40, height=40)
    targets = [make_target(prepared, camera) for camera in cameras]
    fitting, deciding = split(targets, 2)
    validation_views = [target for group in deciding for target in group.targets]
    assert len(validation_views) == 2
    assert list(fitting) == [target for target in targets if target not in validation_views], (
        "in their order"
    )
    assert len(fitting) == 10
    alone, deciding = split(targets[:1], 1)
    assert (alone, deciding[0].targets) == ((), tuple(targets[:1]))


def test_views_rendered_on_demand_give_the_same_steps_as_kept_ones():
    original, small = cloud_pair()
    prepared = prepare(original)
    cameras = automatic_cameras(original, 6, width=40, height=40)
    kept = [make_target(prepared, camera) for camera in cameras]
    drawn = Fitting(kept[:2], prepared, cameras[2:])
    assert (len(drawn), drawn.names) == (6, Fitting(kept).names)
    for index, target in enumerate(kept):
        assert np.array_equal(drawn.take(index).image, target.image)
    descents = [Descent(small, views, QUICK) for views in (Fitting(kept), drawn)]
    errors = [[descent.step(0.5, 0.0) for _ in range(8)] for descent in descents]
    assert errors[0] == errors[1]
    assert np.array_equal(descents[0].state.means, descents[1].state.means)


def test_the_original_is_held_only_for_views_that_are_rendered_later(monkeypatch):
    original, small = cloud_pair()
    cameras = automatic_cameras(original, 5, width=32, height=32)

    def views(**given):
        parameters = RefitParameters(size=32, **given)
        return view_targets(original, small, cameras, parameters, ignore_progress)[0]

    assert views().original is None
    monkeypatch.setattr("nanogs.fit.parameters.KEPT", 2)
    some = views(views=4, validation=1)
    assert len(some.further) == 2
    assert some.original is not None


def dolly(camera, distance):
    """Multiply the distance of a camera from the origin; it looks the same way."""
    matrix = camera.world_to_camera.copy()
    matrix[:3, 3] *= distance
    return dataclasses.replace(camera, world_to_camera=matrix)


def test_every_group_of_views_gains():
    """Near and far views of several sizes; the report has the gain of each group."""
    original, small = cloud_pair()
    cameras = [
        *automatic_cameras(original, 12, width=64, height=64),
        *automatic_cameras(original, 4, width=128, height=128),
        *roaming_cameras(original, 12, width=64, height=64),
    ]
    parameters = dataclasses.replace(QUICK, views=26, size=128)
    _, report = refit(original, small, cameras=cameras, parameters=parameters)
    assert len(report.groups) > 1
    assert all(group.psnr_after > group.psnr_before + 0.5 for group in report.groups)
    assert report.psnr_after == pytest.approx(
        np.mean([group.psnr_after for group in report.groups])
    )
    reported = [name for group in report.groups for name in group.views]
    assert reported == list(report.validation_views)
    assert len(reported) + len(report.fit_views) == len(cameras)


def test_a_rare_view_does_not_overshoot_its_own_optimum():
    """Only one view of 16 shows the model: each step on it lowers its error."""
    original, small = cloud_pair()
    prepared = prepare(original)
    shown = automatic_cameras(original, 1, width=64, height=64)[0]
    turned = np.diag([-1.0, 1, -1, 1]) @ shown.world_to_camera
    away = dataclasses.replace(shown, world_to_camera=turned)
    targets = [make_target(prepared, camera) for camera in [shown] + [away] * 15]
    descent = Descent(small, Fitting(targets), QUICK)
    errors = [descent.step(1.0, 0.0) for _ in range(64)]
    view_errors = [error for error in errors if error > 0]
    assert len(view_errors) == 4
    assert view_errors == sorted(view_errors, reverse=True)


def test_mean_state_is_the_mean_of_each_parameter():
    states = []
    for seed in range(3):
        splats = make_splats(6, seed, degree=1)
        splats.opacity_logits[0] = -np.inf  # is not drawn, and so does not move
        states.append(start(splats))
        states[-1].quats[:] = states[0].quats
        states[-1].touched[seed] = True
    mean = MeanState()
    for state in states:
        mean.add(state)
    found = mean.state()
    for name in ("means", "log_scales", "logits", "sh", "quats"):
        each = [getattr(state, name) for state in states]
        np.testing.assert_allclose(getattr(found, name), np.mean(each, axis=0), rtol=1e-6)
    assert found.touched.tolist() == [True] * 3 + [False] * 3
    assert not states[0].touched[1]  # the first state was copied, not changed
    assert states[0].towards(states[1], 0.5).logits[0] == -np.inf


def test_states_are_interpolated_linearly():
    _, small = cloud_pair()
    begin, end = start(small), start(small)
    end.means[:], end.quats[:] = begin.means + 1, -begin.quats  # the same rotations
    between = begin.towards(end, 0.25)
    np.testing.assert_allclose(between.means, begin.means + 0.25)
    np.testing.assert_allclose(between.quats, begin.quats)
    np.testing.assert_allclose(begin.towards(end, 0.5).quats, begin.quats)
    assert not between.touched.any()
    end.touched[3] = True
    assert np.array_equal(begin.towards(end, 0.25).touched, end.touched)


def test_displacements_are_measured_from_where_the_fit_began():
    splats = make_splats(3)
    splats.log_scales[0, 1] = -np.inf  # begins at the least scale
    splats.opacity_logits[:2] = np.inf, -np.inf  # the first begins at the highest logit
    state = start(splats)
    state.touched[:] = True
    state.means[:, 2] += 1
    state.log_scales[0] += 2
    state.logits[0] -= 3
    expected = np.zeros((3, 11))
    expected[:, 2], expected[0, 3:6], expected[0, 10] = 1, 2, -3
    np.testing.assert_allclose(displacements_of(state, splats)[:, :11], expected, atol=1e-5)


def test_a_small_step_lowers_the_error():
    """On the view that it was computed from."""
    original, small = cloud_pair()
    camera = automatic_cameras(original, 1, width=64, height=64)[0]
    target = make_target(prepare(original), camera)
    descent = Descent(small, Fitting([target]), QUICK)
    before = descent.step(0.2, 0.0)
    after = squared_error(activate(descent.state, small, small.finite()).model, target)
    assert after < before


@pytest.mark.parametrize(
    "change",
    [
        {"views": 0},
        {"size": 3},
        {"rate": math.nan},
        {"rate": 0.0},
        {"floor": 0.0},
        {"damping": -1},
        {"seed": -1},
    ],
)
def test_invalid_parameters_are_refused(change):
    with pytest.raises(OptionError, match=next(iter(change))):
        refit(*cloud_pair(), parameters=RefitParameters(**change))


def test_unusable_models_are_refused():
    original, small = cloud_pair()
    empty = small.take(np.zeros(0, np.int64))
    broken = dataclasses.replace(small, means=np.full_like(small.means, np.nan))
    for bad in (empty, broken):
        with pytest.raises(ModelError, match="small model holds no usable splat"):
            refit(original, bad, parameters=QUICK)
        with pytest.raises(ModelError, match="original model holds no usable splat"):
            refit(bad, small, parameters=QUICK)
    elsewhere = dataclasses.replace(small, means=small.means + np.float32(500))
    with pytest.raises(ModelError, match="same scene"):
        refit(original, elsewhere, parameters=QUICK)
    with pytest.raises(OptionError, match="two cameras"):
        refit(original, small, cameras=[make_camera()], parameters=QUICK)


@pytest.mark.parametrize(
    ("alpha", "aside", "is_refused"), [(0.01, 0, True), (0.04, 0, False), (0.99, 2, True)]
)
def test_a_small_model_has_to_cover_a_fiftieth_of_the_original(alpha, aside, is_refused):
    original = make_splats(1).take(np.zeros(1, np.int64))
    original.means[:] = -1, 0, 4
    original.log_scales[:] = -2
    original.opacity_logits[:] = 5
    small = dataclasses.replace(
        original,
        means=original.means + np.float32([aside, 0, 0]),
        opacity_logits=np.full(1, np.log(alpha / (1 - alpha)), np.float32),
    )
    cameras = [dataclasses.replace(make_camera(), name=name) for name in "ab"]

    def targets():
        return view_targets(original, small, cameras, QUICK, ignore_progress)

    if is_refused:
        with pytest.raises(ModelError, match="same scene"):
            targets()
    else:
        assert len(targets()[1]) == 1


def test_a_real_scene_gains_on_held_out_views():
    original, small = load(scene_path("plant.splat")), load(peer_path("plant_0.01_st-uniform.ply"))
    fitted, _ = refit(
        original, small, parameters=RefitParameters(views=16, size=192, rounds=2, steps=16)
    )
    cameras = automatic_cameras(original, 3, width=256, height=256, split="test")
    views, _ = reference_views(prepare(original), cameras, (0.0, 0.0, 0.0))
    before, after = (score("", prepare(model), views, (0.0, 0.0, 0.0)) for model in (small, fitted))
    assert after.psnr > before.psnr + 1.5
    assert after.ssim > before.ssim + 0.02

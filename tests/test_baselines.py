"""Baselines: exact counts, reproducible bytes, and comparisons with plain reimplementations."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from builders import gaussians_of, model_bytes, random_splats
from nanogs.bench import significance as significance_module
from nanogs.bench.baselines import BASELINES, MethodContext, highest
from nanogs.bench.significance import BETA, normalised_volumes, significance, view_contributions
from nanogs.bench.voxel import merge_groups, merge_voxels, voxel_labels
from nanogs.errors import ModelError, OptionError
from nanogs.raster.camera import Camera
from nanogs.raster.rendering import render


def camera_along_z(size=32, distance=4.0, name="a"):
    pose = np.eye(4)
    pose[2, 3] = distance
    return Camera(size, size, size, size, size / 2, size / 2, pose, name)


CONTEXT = MethodContext((camera_along_z(),), seed=3)
every_method = pytest.mark.parametrize("method", BASELINES.values(), ids=BASELINES)


# All of them


@every_method
@pytest.mark.parametrize("count", [1, 2, 7, 60, 199, 200])
def test_the_count_is_exact(method, count):
    assert len(method(random_splats(200), count, CONTEXT)) == count


@given(st.integers(1, 60), st.data())
def test_the_count_is_exact_for_any_count_and_scene(n, data):
    count = data.draw(st.integers(1, n))
    splats = random_splats(n, seed=n)
    for name in ("random", "opacity", "voxel"):
        assert len(BASELINES[name](splats, count, CONTEXT)) == count


@every_method
def test_results_are_reproducible_and_the_input_is_unchanged(method):
    splats = random_splats(200, extras={"label": np.arange(200)})
    before = model_bytes(splats)
    assert model_bytes(method(splats, 20, CONTEXT)) == model_bytes(method(splats, 20, CONTEXT))
    assert model_bytes(splats) == before


@every_method
def test_rows_that_are_not_finite_are_never_chosen(method):
    splats = random_splats(60)
    splats.means[::3] = np.nan
    splats.log_scales[1, 0] = np.inf
    splats.opacity_logits[:] = 9.0
    splats.opacity_logits[2] = np.nan
    finite = int(splats.finite().sum())
    small = method(splats, finite, CONTEXT)
    assert len(small) == finite
    assert small.finite().all()
    with pytest.raises(ModelError, match="Only 38 splats are finite"):
        method(splats, finite + 1, CONTEXT)


@every_method
def test_the_whole_count_returns_the_same_bytes(method):
    splats = random_splats(50, degree=2)
    assert model_bytes(method(splats, 50, CONTEXT)) == model_bytes(splats)


@every_method
def test_a_count_below_one_is_refused(method):
    with pytest.raises(OptionError, match="at least 1"):
        method(random_splats(5), 0, CONTEXT)


# Random choice and opacity


def test_random_depends_on_the_seed_and_keeps_the_order_of_rows():
    splats = random_splats(500, extras={"row": np.arange(500)})
    first = BASELINES["random"](splats, 50, MethodContext(seed=0)).extras["row"]
    second = BASELINES["random"](splats, 50, MethodContext(seed=1)).extras["row"]
    assert not np.array_equal(first, second)
    assert (np.diff(first) > 0).all()


def test_opacity_keeps_the_most_opaque_splats_and_breaks_ties_by_row():
    splats = random_splats(6, extras={"row": np.arange(6)})
    splats.opacity_logits[:] = [0, np.inf, 0, 5, 0, -np.inf]
    assert BASELINES["opacity"](splats, 4, CONTEXT).extras["row"].tolist() == [0, 1, 2, 3]


def test_highest_breaks_ties_by_row():
    assert highest(np.array([1.0, 2.0, 1.0, 1.0]), np.array([4, 5, 7, 9]), 3).tolist() == [4, 5, 7]


# Significance


def test_significance_is_contribution_times_opacity_times_volume_to_the_beta():
    splats = random_splats(40, seed=2)
    cameras = [camera_along_z(), camera_along_z(48, 3.0)]
    volumes = np.exp(splats.log_scales.astype(float)).prod(axis=1)
    percentile = np.sort(volumes)[int(np.ceil(0.9 * 39))]
    expected = np.zeros(40)
    for row in range(40):
        contribution = sum(
            render(splats, camera, contributions=True).contributions[row] for camera in cameras
        )
        alpha = 1 / (1 + np.exp(-float(splats.opacity_logits[row])))
        expected[row] = contribution * alpha * min(max(volumes[row] / percentile, 0), 1) ** 0.1
    assert BETA == 0.1
    np.testing.assert_allclose(significance(splats, cameras), expected, rtol=1e-5)


def test_splats_that_no_view_shows_are_dropped_first():
    splats = random_splats(30, spread=0.3, extras={"row": np.arange(30)})
    splats.means[:10, 2] = -50  # behind the camera
    splats.opacity_logits[:] = 3
    assert BASELINES["significance"](splats, 20, CONTEXT).extras["row"].min() == 10


def test_volumes_are_capped_at_the_90th_percentile_without_overflow():
    splats = random_splats(11)
    splats.log_scales[:] = np.linspace(-80, 80, 11, dtype=np.float32)[:, None]
    splats.log_scales[0] = -np.inf
    volumes = normalised_volumes(splats, np.ones(11, dtype=bool))
    assert volumes[0] == 0
    assert volumes[9] == volumes[10] == 1
    assert (volumes[1:9] < 1).all()


def test_flat_splats_have_no_volume():
    splats = random_splats(11)
    splats.log_scales[:, 2] = -np.inf
    assert normalised_volumes(splats, np.ones(11, dtype=bool)).tolist() == [0] * 11


def test_significance_needs_a_view():
    with pytest.raises(OptionError, match="at least one camera"):
        view_contributions(random_splats(3), ())


def test_all_views_are_rendered_in_one_call(monkeypatch):
    calls = []
    real = significance_module.view_contributions
    monkeypatch.setattr(
        significance_module,
        "view_contributions",
        lambda splats, cameras: calls.append(len(cameras)) or real(splats, cameras),
    )
    significance(random_splats(10), [camera_along_z()] * 2)
    assert calls == [2]


# Voxels


def reference_moments(gaussians, rows):
    """Compute the mass-weighted mean, covariance, opacity and coefficients in plain numpy."""
    masses = gaussians.opacities[rows] * gaussians.scales[rows].astype(float).prod(axis=1)
    shares = masses / masses.sum()
    mean = sum(share * gaussians.means[row] for share, row in zip(shares, rows, strict=True))
    covariance = np.zeros((3, 3))
    for share, row in zip(shares, rows, strict=True):
        w, x, y, z = gaussians.quats[row].astype(float)
        rotation = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        offset = gaussians.means[row] - mean
        covariance_of_row = (
            rotation @ np.diag(gaussians.scales[row].astype(float) ** 2) @ rotation.T
        )
        covariance += share * (covariance_of_row + np.outer(offset, offset))
    return mean, covariance, shares @ gaussians.opacities[rows], shares @ gaussians.features[rows]


def covariance_of(gaussians, row):
    return reference_moments(gaussians, np.array([row]))[1]


def test_a_merged_splat_has_the_moments_of_its_members():
    gaussians = gaussians_of(random_splats(60, seed=5))
    labels = np.random.default_rng(1).permutation(np.arange(60) % 7)
    merged = merge_groups(gaussians, labels)
    assert len(merged) == 7
    for group in range(7):
        rows = np.flatnonzero(labels == group)
        mean, covariance, opacity, features = reference_moments(gaussians, rows)
        np.testing.assert_allclose(merged.means[group], mean, atol=1e-12)
        np.testing.assert_allclose(covariance_of(merged, group), covariance, rtol=1e-4, atol=1e-6)
        assert merged.opacities[group] == pytest.approx(opacity)
        np.testing.assert_allclose(merged.features[group], features, rtol=1e-5, atol=1e-6)
        masses = gaussians.opacities[rows] * gaussians.scales[rows].prod(axis=1)
        assert merged.sources[group] == rows[np.argmax(masses)]


def test_two_equal_splats_merge_into_one_stretched_along_their_line():
    splats = random_splats(2)
    splats.means[:] = [[0, 0, 0], [1, 1, 0]]
    splats.log_scales[:] = np.log(0.1)
    splats.opacity_logits[:] = 1
    merged = merge_groups(gaussians_of(splats), np.zeros(2, dtype=np.int64))
    stretched = np.sqrt(0.5 + 0.01)
    np.testing.assert_allclose(np.sort(merged.scales[0]), [0.1, 0.1, stretched], rtol=1e-5)


def test_members_without_mass_have_equal_weights():
    splats = random_splats(4)
    splats.opacity_logits[:2] = -np.inf
    gaussians = gaussians_of(splats)
    merged = merge_groups(gaussians, np.array([0, 0, 1, 1]))
    np.testing.assert_allclose(merged.means[0], gaussians.means[:2].mean(axis=0))
    assert merged.opacities[0] == 0
    assert np.isfinite(merged.scales).all()


@pytest.mark.parametrize("scale", [1e-20, 1.0, 1e8])
def test_voxel_labels_do_not_depend_on_the_unit_of_length(scale):
    labels = voxel_labels(gaussians_of(random_splats(300)).means, 40)
    scaled = voxel_labels(gaussians_of(random_splats(300)).means * scale, 40)
    assert np.array_equal(labels, scaled)


@pytest.mark.parametrize("count", [1, 2, 3, 9, 10])
def test_coincident_centres_are_split_into_the_requested_groups(count):
    labels = voxel_labels(np.ones((10, 3)), count)
    assert sorted(set(labels.tolist())) == list(range(count))
    assert np.ptp(np.bincount(labels)) <= 5


def test_splats_in_one_cell_of_a_grid_are_in_one_group():
    axis = np.arange(4) + 0.5
    means = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    near = np.concatenate([means, means + 0.01])
    labels = voxel_labels(near, 64)
    assert np.array_equal(labels[:64], labels[64:])


def test_the_count_is_exact_with_an_outlier_far_away():
    splats = random_splats(300)
    splats.means[0] = 1e6
    assert len(merge_voxels(splats, np.arange(300), 50)) == 50

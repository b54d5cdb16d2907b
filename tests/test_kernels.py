"""Each kernel against its plain float64 twin."""

import math
import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import twins
from builders import gaussians_of, random_splats, row
from nanogs.kernels.mass import mass_fraction
from nanogs.kernels.pairs import cost_keys, count_pairs, fill_pairs, radix_sort
from nanogs.kernels.quaternion import rotation_matrix, unit_quaternion
from nanogs.kernels.symmetric3 import covariance, eigen, log_det, mix
from nanogs.simplify.cost import JITTER, log_masses, pair_costs
from nanogs.simplify.graph import neighbour_pairs
from nanogs.simplify.match import MergePlan, match
from nanogs.simplify.merge import merge
from nanogs.simplify.neighbours import coincident_groups, nearest_neighbours
from nanogs.simplify.order import morton_codes
from nanogs.simplify.presets import PaperParameters


def unpack(six):
    xx, xy, xz, yy, yz, zz = six
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def random_quats(count, seed=0):
    quats = np.random.default_rng(seed).normal(size=(count, 4))
    return (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32)


def test_rotation_matrix_turns_as_the_quaternion_product_does():
    for quat in random_quats(50):
        # float32 quaternions are unit to 1e-7 only, and both formulas notice differently.
        assert np.allclose(rotation_matrix(quat), twins.rotation_matrix(quat), atol=1e-6)


@pytest.mark.parametrize("quat", [*np.eye(4), *random_quats(50, seed=1)])
def test_unit_quaternion_inverts_rotation_matrix_on_every_branch(quat):
    quat = np.asarray(quat, dtype=np.float64)
    back = np.array(unit_quaternion(rotation_matrix(quat)))
    assert np.linalg.norm(back) == pytest.approx(1)
    assert back[0] >= 0
    assert abs(back @ quat) == pytest.approx(1, abs=1e-6)


def test_covariance_and_mix_are_the_second_moment():
    g = gaussians_of(random_splats(2, seed=3))
    a, b = row(g, 0), row(g, 1)
    sigmas = [
        covariance(rotation_matrix(p["quat"]), *(p["scales"].astype(np.float64) ** 2))
        for p in (a, b)
    ]
    share = twins.fraction(a, b)
    mixed = mix(share, sigmas[0], 1 - share, sigmas[1], share * (1 - share), a["mean"] - b["mean"])
    assert np.allclose(unpack(mixed), twins.moments(a, b)[1], rtol=1e-6)


@pytest.mark.parametrize("ratio", [1.0, 1e-2, 1e-4, 1e-6])
def test_eigen_takes_thin_splats_apart(ratio):
    for quat in random_quats(20, seed=4):
        sigma = covariance(rotation_matrix(quat), 1.0, 0.5, ratio**2)
        values, axes = eigen(sigma)
        axes = np.array(axes)
        assert np.allclose(axes @ np.diag(values) @ axes.T, unpack(sigma), atol=1e-14)
        assert np.allclose(axes.T @ axes, np.eye(3), atol=1e-14)
        assert np.linalg.det(axes) == pytest.approx(1)
        assert np.allclose(np.sort(values), np.linalg.eigvalsh(unpack(sigma)), atol=1e-15)


@given(st.lists(st.floats(-1e3, 1e3), min_size=6, max_size=6), st.sampled_from([1e-30, 1, 1e30]))
def test_eigen_holds_for_any_symmetric_matrix_in_any_unit(entries, unit):
    sigma = tuple(entry * unit for entry in entries)
    values, axes = eigen(sigma)
    axes = np.array(axes)
    largest = max(map(abs, sigma))
    assert np.allclose(axes @ np.diag(values) @ axes.T, unpack(sigma), atol=1e-13 * largest)


def test_eigen_of_equal_diagonals_turns_by_45_degrees():
    """An eigen-solver in which sign(0) = 0 leaves this matrix as it is."""
    values, _ = eigen((0.26, 0.25, 0.0, 0.26, 0.0, 0.01))
    assert np.sort(values) == pytest.approx([0.01, 0.01, 0.51])


def test_log_det_equals_the_determinant():
    for quat in random_quats(20, seed=5):
        sigma = covariance(rotation_matrix(quat), 1.0, 0.01, 1e-4)
        assert log_det(sigma, 1e-8) == pytest.approx(np.linalg.slogdet(unpack(sigma))[1], abs=1e-9)


def test_log_det_of_a_singular_matrix_stops_at_its_floor():
    assert log_det((1.0, 1.0, 0.0, 1.0, 0.0, 1.0), 1e-8) == pytest.approx(math.log(1e-8))
    assert log_det((1.0, 0.0, 1.0, 1.0, 0.0, 1.0), 1e-8) == pytest.approx(math.log(1e-8))
    assert log_det((0.0,) * 6, 1e-8) == pytest.approx(3 * math.log(1e-8))


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        (0.0, 0.0, 0.5),
        (math.log(3), 0.0, 0.75),
        (-math.inf, 0.0, 0.0),
        (0.0, -math.inf, 1.0),
        (-math.inf, -math.inf, 0.5),
        (0.0, 800.0, 0.0),
        (800.0, 0.0, 1.0),
    ],
)
def test_mass_fraction(first, second, expected):
    assert mass_fraction(first, second) == pytest.approx(expected)


@pytest.mark.parametrize("samples", [1, 4])
@pytest.mark.parametrize("degree", [0, 3])
def test_costs_equal_the_twin(samples, degree):
    g = gaussians_of(random_splats(40, degree=degree, seed=6))
    pairs = neighbour_pairs(g.means, 5, threads=1)
    parameters = PaperParameters(samples=samples, seed=7, lambda_geo=0.7, lambda_app=1.3)
    costs = pair_costs(g, pairs, log_masses(g), parameters)
    normals = np.random.default_rng(7).standard_normal((samples, 3))
    expected = [twins.cost(row(g, i), row(g, j), normals, JITTER, 0.7, 1.3) for i, j in pairs]
    assert np.allclose(costs, expected, rtol=1e-5, atol=1e-5)


def test_cost_of_equal_splats_is_near_zero_and_of_colours_is_their_distance():
    g = gaussians_of(random_splats(1, degree=0, seed=8).take(np.array([0, 0])))
    g.features[1, 0] += 2
    pairs = np.array([[0, 1]], dtype=np.int32)
    normals = np.random.default_rng(0).standard_normal((1, 3))
    alone = pair_costs(g, pairs, log_masses(g), PaperParameters(lambda_app=0))
    both = pair_costs(g, pairs, log_masses(g), PaperParameters())
    # KL of equal normals is 0; its estimate is the draw's own deviation from the entropy.
    assert alone[0] == pytest.approx(1.5 - 0.5 * np.sum(normals**2), abs=1e-4)
    assert both[0] - alone[0] == pytest.approx(4, rel=1e-5)


def test_costs_of_splats_without_volume_or_opacity_are_finite():
    splats = random_splats(30, seed=9)
    splats.log_scales[:10] = -np.inf
    splats.log_scales[10:15, 0] = -np.inf
    splats.opacity_logits[12:20] = -np.inf
    splats.opacity_logits[20:25] = np.inf
    g = gaussians_of(splats)
    pairs = neighbour_pairs(g.means, 29, threads=1)
    assert np.isfinite(pair_costs(g, pairs, log_masses(g), PaperParameters())).all()


def test_merge_equals_the_twin():
    g = gaussians_of(random_splats(30, degree=2, seed=10))
    plan = MergePlan(
        np.array([[3, 7], [0, 29], [5, 6]], dtype=np.int32), np.zeros(3, np.float32), 0
    )
    result = merge(g, plan, log_masses(g))
    assert len(result) == 27
    for i, j in plan.pairs:
        at = int(np.flatnonzero(np.isin(result.sources, (i, j)))[0])
        expected, got = twins.merged(row(g, i), row(g, j)), row(result, at)
        assert result.merged[at]
        assert np.allclose(got["mean"], expected["mean"], rtol=1e-12)
        assert np.allclose(
            twins.covariance(got["scales"], got["quat"]), expected["covariance"], atol=1e-7
        )
        assert got["opacity"] == pytest.approx(expected["opacity"], rel=1e-12)
        assert np.allclose(got["features"], expected["features"], atol=1e-6)


def test_merge_leaves_other_rows_and_their_order_alone():
    g = gaussians_of(random_splats(10, seed=11))
    plan = MergePlan(np.array([[2, 8]], dtype=np.int32), np.zeros(1, np.float32), 0)
    result = merge(g, plan, log_masses(g))
    others = [0, 1, 3, 4, 5, 6, 7, 9]
    places = [0, 1, 3, 4, 5, 6, 7, 8]
    for name in ("means", "scales", "quats", "opacities", "features", "sources"):
        assert np.array_equal(getattr(result, name)[places], getattr(g, name)[others])
    assert not result.merged[places].any()
    assert result.merged[2]


def test_two_equal_splats_on_a_diagonal_become_one_long_splat():
    """Equal diagonals in the covariance: another tool gives .51 .51 .10 here."""
    g = gaussians_of(random_splats(1, seed=12).take(np.array([0, 0])))
    g.means[:] = [(0, 0, 0), (1, 1, 0)]
    g.scales[:] = 0.1
    result = merge(
        g, MergePlan(np.array([[0, 1]], np.int32), np.zeros(1, np.float32), 0), log_masses(g)
    )
    assert np.sort(result.scales[0]) == pytest.approx([0.1, 0.1, math.sqrt(0.51)], rel=1e-6)
    assert np.allclose(result.means[0], (0.5, 0.5, 0))


@pytest.mark.parametrize("k", [1, 4, 16])
def test_neighbours_are_the_nearest(k):
    means = np.random.default_rng(13).normal(size=(300, 3))
    found = nearest_neighbours(means, k, threads=2)
    distances = np.linalg.norm(means[found] - means[:, None], axis=2)
    assert np.allclose(distances, twins.neighbour_distances(means, k))
    assert not (found == np.arange(300)[:, None]).any()


@given(
    st.integers(2, 60),
    st.integers(1, 20),
    st.integers(1, 4),
    st.integers(0, 2**32 - 1),
)
def test_neighbours_are_the_nearest_among_coincident_centres(n, k, places, seed):
    """Fewer places than splats: groups of every size, larger than k and smaller."""
    rng = np.random.default_rng(seed)
    means = rng.normal(size=(places, 3))[rng.integers(0, places, n)]
    found = nearest_neighbours(means, k, threads=1)
    assert found.shape == (n, min(k, n - 1))
    distances = np.linalg.norm(means[found] - means[:, None], axis=2)
    assert np.allclose(distances, twins.neighbour_distances(means, k))
    assert not (found == np.arange(n)[:, None]).any()
    assert all(len(set(row)) == len(row) for row in found.tolist())


def test_centres_so_close_that_squares_underflow_are_not_their_own_neighbours():
    means = np.random.default_rng(17).normal(size=(60, 3)) * 1e-200
    found = nearest_neighbours(means, 4, threads=1)
    assert not (found == np.arange(60)[:, None]).any()
    assert all(len(set(row)) == 4 for row in found.tolist())


def test_coincident_groups_are_found_among_near_ones():
    means = np.repeat(np.array([[0.0, 0, 0], [0, 0, 1e-12], [5, 5, 5]]), (9, 3, 8), axis=0)
    order, bounds = coincident_groups(means)
    assert order.tolist() == list(range(20))
    assert bounds.tolist() == [0, 9, 12, 20]


def test_pairs_are_the_union_of_both_directions_once_each():
    means = np.random.default_rng(14).normal(size=(200, 3))
    pairs = neighbour_pairs(means, 6, threads=1)
    assert list(map(tuple, pairs.tolist())) == twins.pairs_of(nearest_neighbours(means, 6, 1))


def test_pairs_of_a_row_that_all_others_have_as_their_neighbour():
    """Its list of pairs is long, and most of it comes from the others."""
    neighbours = np.stack([(np.arange(400) + 1) % 400, np.full(400, 200)], axis=1).astype(np.int32)
    neighbours[199:201, 1] = [5, 7]
    one_sided, starts = np.empty((400, 2), dtype=bool), np.empty(401, dtype=np.int64)
    count_pairs(neighbours, one_sided, starts)
    pairs = np.empty((starts[-1], 2), dtype=np.int32)
    fill_pairs(neighbours, one_sided, starts, starts[:-1].copy(), pairs)
    assert list(map(tuple, pairs.tolist())) == twins.pairs_of(neighbours)


@pytest.mark.parametrize("spread", [0.0, 1e-3, 15.0])
def test_cost_keys_sort_like_costs_and_pairs(spread):
    rng = np.random.default_rng(19)
    costs = (rng.choice([-1, 1], 3000) * np.exp(spread * rng.normal(size=3000))).astype(np.float32)
    keys = np.empty(3000, dtype=np.uint64)
    assert cost_keys(costs, keys) == 3000
    other = np.empty_like(keys)
    found = other if radix_sort(keys, other) else keys
    assert (found & np.uint64(0xFFFFFFFF)).tolist() == np.argsort(costs, kind="stable").tolist()


@given(
    st.lists(
        st.sampled_from([-2.0, -1.0, -0.0, 0.0, 1.5, math.inf, math.nan]), min_size=1, max_size=40
    ),
    st.integers(1, 12),
    st.integers(0, 2**32 - 1),
)
def test_matching_is_greedy_with_ties_by_pair(costs, limit, seed):
    rng = np.random.default_rng(seed)
    every = np.array([(i, j) for i in range(12) for j in range(i + 1, 12)], dtype=np.int32)
    pairs = every[np.sort(rng.choice(len(every), len(costs), replace=False))]
    costs = np.array(costs, dtype=np.float32)
    plan = match(pairs, costs, 12, limit)
    assert list(map(tuple, plan.pairs.tolist())) == twins.greedy(pairs, costs.tolist(), limit)
    assert plan.without_cost == np.isnan(costs).sum()


def test_morton_codes_interleave_the_cells():
    means = np.random.default_rng(15).uniform(size=(100, 3))
    low, high = np.quantile(means, (0.01, 0.99), axis=0)
    width = (high - low).max()
    cells = np.clip((means - low + width) / (3 * width) * 2**21, 0, 2**21 - 1).astype(int)
    assert morton_codes(means).tolist() == [twins.morton_code(cell) for cell in cells]


def test_flyaways_do_not_put_all_others_into_one_cell():
    means = np.random.default_rng(16).uniform(size=(1000, 3))
    means[:5] *= 1e6
    assert len(np.unique(morton_codes(means))) > 950


def test_kernels_run_uncompiled_too():
    """As plain Python, where a debugger reaches them: all of this file again."""
    if os.environ.get("NUMBA_DISABLE_JIT") == "1":
        pytest.skip("this is the uncompiled run")
    result = subprocess.run(
        [
            sys.executable,
            "-m",
            "pytest",
            "-q",
            "-p",
            "no:xdist",
            "-p",
            "no:cacheprovider",
            __file__,
        ],
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stdout

"""Each kernel compared with its float64 reference implementation in `reference_kernels`."""

import dataclasses
import itertools
import math
import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import nanogs
import reference_kernels as reference
from builders import gaussians_of, random_splats, row
from nanogs.errors import ModelError
from nanogs.kernels.assign import assign_nearest, invert_covariances
from nanogs.kernels.factors import factor_rows
from nanogs.kernels.forest import (
    log_determinants,
    merge_increments,
    raise_to_children,
    root_of_each,
    subtree_sums,
)
from nanogs.kernels.grouping import group_members
from nanogs.kernels.mass import mass_fraction
from nanogs.kernels.nodes import (
    covariances_of,
    gather_moments,
    heaviest_members,
    join_pairs_of_nodes,
    principal_axes,
)
from nanogs.kernels.pairs import collect_free, count_pairs, fill_firsts, fill_seconds, tally_free
from nanogs.kernels.quaternion import rotation_matrix, unit_quaternion
from nanogs.kernels.radix import radix_sort
from nanogs.kernels.symmetric3 import covariance, eigen, log_det, mix, shortest_last
from nanogs.method import match as matching
from nanogs.method.graph import neighbour_pairs
from nanogs.method.match import MergePlan, match
from nanogs.method.order import codes_in, morton_codes
from nanogs.method.paper.cost import JITTER, log_masses, pair_costs
from nanogs.method.paper.merge import merge
from nanogs.method.paper.parameters import PaperParameters
from nanogs.neighbours import coincident_groups, nearest_neighbours
from nanogs.threads import use_threads

compiled_only = pytest.mark.skipif(
    os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="the uncompiled run shows nothing of it"
)


def random_quats(count, seed=0):
    quats = np.random.default_rng(seed).normal(size=(count, 4))
    return (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32)


def test_rotation_matrix_equals_the_quaternion_product():
    for quat in random_quats(50):
        # float32 quaternions have unit length to 1e-7 only, which affects the formulas differently.
        assert np.allclose(rotation_matrix(quat), reference.rotation_matrix(quat), atol=1e-6)


@pytest.mark.parametrize("quat", [*np.eye(4), *random_quats(50, seed=1)])
def test_unit_quaternion_inverts_rotation_matrix_on_every_branch(quat):
    quat = np.asarray(quat, dtype=np.float64)
    restored = np.array(unit_quaternion(rotation_matrix(quat)))
    assert np.linalg.norm(restored) == pytest.approx(1)
    assert restored[0] >= 0
    assert abs(restored @ quat) == pytest.approx(1, abs=1e-6)


def test_mixed_covariance_is_the_second_moment_of_the_mixture():
    g = gaussians_of(random_splats(2, seed=3))
    a, b = row(g, 0), row(g, 1)
    sigmas = [
        covariance(rotation_matrix(p["quat"]), *(p["scales"].astype(np.float64) ** 2))
        for p in (a, b)
    ]
    share = reference.fraction(a, b)
    mixed = mix(share, sigmas[0], 1 - share, sigmas[1], share * (1 - share), a["mean"] - b["mean"])
    assert np.allclose(reference.unpack(mixed), reference.moments(a, b)[1], rtol=1e-6)


@pytest.mark.parametrize("ratio", [1.0, 1e-2, 1e-4, 1e-6])
def test_eigen_is_accurate_for_thin_splats(ratio):
    for quat in random_quats(20, seed=4):
        sigma = covariance(rotation_matrix(quat), 1.0, 0.5, ratio**2)
        values, axes = eigen(sigma)
        axes = np.array(axes)
        assert np.allclose(axes @ np.diag(values) @ axes.T, reference.unpack(sigma), atol=1e-14)
        assert np.allclose(axes.T @ axes, np.eye(3), atol=1e-14)
        assert np.linalg.det(axes) == pytest.approx(1)
        assert np.allclose(np.sort(values), np.linalg.eigvalsh(reference.unpack(sigma)), atol=1e-15)


@given(st.lists(st.floats(-1e3, 1e3), min_size=6, max_size=6), st.sampled_from([1e-30, 1, 1e30]))
def test_eigen_reconstructs_any_symmetric_matrix_in_any_unit(entries, unit):
    sigma = tuple(entry * unit for entry in entries)
    values, axes = eigen(sigma)
    axes = np.array(axes)
    largest = max(map(abs, sigma))
    assert np.allclose(
        axes @ np.diag(values) @ axes.T, reference.unpack(sigma), atol=1e-13 * largest
    )


@pytest.mark.parametrize("variances", list(itertools.product((0.0, 1.0, 2.0), repeat=3)))
def test_the_shortest_axis_is_put_last_and_axes_stay_a_rotation(variances):
    values, axes = shortest_last(variances, ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
    axes = np.array(axes)
    assert values[2] == min(variances)
    assert np.array_equal(axes @ np.diag(values) @ axes.T, np.diag(variances))
    assert np.linalg.det(axes) == 1


def test_eigen_rotates_a_matrix_with_equal_diagonals_by_45_degrees():
    """An eigen-solver in which sign(0) = 0 returns this matrix unchanged."""
    values, _ = eigen((0.26, 0.25, 0.0, 0.26, 0.0, 0.01))
    assert np.sort(values) == pytest.approx([0.01, 0.01, 0.51])


def test_log_det_equals_the_determinant():
    for quat in random_quats(20, seed=5):
        sigma = covariance(rotation_matrix(quat), 1.0, 0.01, 1e-4)
        assert log_det(sigma, 1e-8) == pytest.approx(
            np.linalg.slogdet(reference.unpack(sigma))[1], abs=1e-9
        )


def test_log_det_of_a_singular_matrix_is_computed_with_the_floor():
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
def test_costs_equal_the_reference(samples, degree):
    g = gaussians_of(random_splats(40, degree=degree, seed=6))
    pairs = neighbour_pairs(g.means, 5)
    parameters = PaperParameters(samples=samples, seed=7, lambda_geo=0.7, lambda_app=1.3)
    costs = pair_costs(g, pairs, log_masses(g), parameters)
    normals = np.random.default_rng(7).standard_normal((samples, 3))
    expected = [reference.cost(row(g, i), row(g, j), normals, JITTER, 0.7, 1.3) for i, j in pairs]
    assert np.allclose(costs, expected, rtol=1e-5, atol=1e-5)


def test_merged_splats_have_the_same_costs_with_mixed_and_stored_features():
    """The first merge refers to rows of the model's features; the second stores the mixtures."""
    g = gaussians_of(random_splats(40, degree=2, seed=33))
    first = np.arange(0, 24, dtype=np.int32).reshape(-1, 2)
    pairs = merge(g, MergePlan(first, np.zeros(12, np.float32), 0), log_masses(g))
    assert pairs.features is g.features
    for index, (i, j) in zip(range(12), first, strict=True):
        expected = reference.merged(row(g, i), row(g, j))["features"]
        assert np.allclose(pairs.colours()[index], expected, atol=1e-6)
    stored = dataclasses.replace(
        pairs,
        features=pairs.colours(),
        rows=np.arange(28, dtype=np.int32),
        second_rows=np.empty(0, np.int32),
        shares=np.empty((0, 2)),
    )
    candidates = neighbour_pairs(pairs.means, 5)
    masses, parameters = log_masses(pairs), PaperParameters()
    costs = [pair_costs(x, candidates, masses, parameters) for x in (pairs, stored)]
    assert np.array_equal(*costs)
    second = np.array([[0, 3], [5, 20], [22, 27]], dtype=np.int32)
    plan = MergePlan(second, np.zeros(3, np.float32), 0)
    merged_pairs, merged_stored = (merge(x, plan, masses) for x in (pairs, stored))
    assert len(merged_pairs.features) == len(merged_pairs) == 25
    assert np.array_equal(merged_pairs.colours(), merged_stored.colours())
    assert np.array_equal(
        merged_pairs.take(np.array([4, 9])).colours(), merged_pairs.colours()[[4, 9]]
    )


def test_cost_is_near_zero_for_equal_splats_and_adds_the_colour_distance():
    g = gaussians_of(random_splats(1, degree=0, seed=8).take(np.array([0, 0])))
    g.features[1, 0] += 2
    pairs = np.array([[0, 1]], dtype=np.int32)
    normals = np.random.default_rng(0).standard_normal((1, 3))
    geometry_only = pair_costs(g, pairs, log_masses(g), PaperParameters(lambda_app=0))
    with_colour = pair_costs(g, pairs, log_masses(g), PaperParameters())
    # The KL divergence of equal normals is 0; its estimate is the sampling error of the entropy.
    assert geometry_only[0] == pytest.approx(1.5 - 0.5 * np.sum(normals**2), abs=1e-4)
    assert with_colour[0] - geometry_only[0] == pytest.approx(4, rel=1e-5)


def test_costs_of_splats_without_volume_or_opacity_are_finite():
    splats = random_splats(30, seed=9)
    splats.log_scales[:10] = -np.inf
    splats.log_scales[10:15, 0] = -np.inf
    splats.opacity_logits[12:20] = -np.inf
    splats.opacity_logits[20:25] = np.inf
    g = gaussians_of(splats)
    pairs = neighbour_pairs(g.means, 29)
    assert np.isfinite(pair_costs(g, pairs, log_masses(g), PaperParameters())).all()


def test_merge_equals_the_reference():
    g = gaussians_of(random_splats(30, degree=2, seed=10))
    plan = MergePlan(
        np.array([[3, 7], [0, 29], [5, 6]], dtype=np.int32), np.zeros(3, np.float32), 0
    )
    result = merge(g, plan, log_masses(g))
    assert len(result) == 27
    for i, j in plan.pairs:
        index = int(np.flatnonzero(np.isin(result.sources, (i, j)))[0])
        expected, found = reference.merged(row(g, i), row(g, j)), row(result, index)
        assert result.merged[index]
        assert np.allclose(found["mean"], expected["mean"], rtol=1e-12)
        assert np.allclose(
            reference.covariance(found["scales"], found["quat"]), expected["covariance"], atol=1e-7
        )
        assert found["opacity"] == pytest.approx(expected["opacity"], rel=1e-12)
        assert np.allclose(found["features"], expected["features"], atol=1e-6)


def test_merge_keeps_the_other_rows_and_their_order():
    g = gaussians_of(random_splats(10, seed=11))
    plan = MergePlan(np.array([[2, 8]], dtype=np.int32), np.zeros(1, np.float32), 0)
    result = merge(g, plan, log_masses(g))
    rows_before = [0, 1, 3, 4, 5, 6, 7, 9]
    rows_after = [0, 1, 3, 4, 5, 6, 7, 8]
    for name in ("means", "scales", "quats", "opacities", "sources"):
        assert np.array_equal(getattr(result, name)[rows_after], getattr(g, name)[rows_before])
    assert np.array_equal(result.colours()[rows_after], g.colours()[rows_before])
    assert not result.merged[rows_after].any()
    assert result.merged[2]


def test_two_equal_splats_on_a_diagonal_become_one_long_splat():
    """The covariance has equal diagonals, for which another tool gives .51 .51 .10."""
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
    found = nearest_neighbours(means, k)
    distances = np.linalg.norm(means[found] - means[:, None], axis=2)
    assert np.allclose(distances, reference.neighbour_distances(means, k))
    assert not (found == np.arange(300)[:, None]).any()


@given(
    st.integers(2, 60),
    st.integers(1, 20),
    st.integers(1, 4),
    st.integers(0, 2**32 - 1),
)
def test_neighbours_are_the_nearest_among_coincident_centres(n, k, positions, seed):
    """Fewer positions than splats: groups of coincident splats are larger or smaller than k."""
    rng = np.random.default_rng(seed)
    means = rng.normal(size=(positions, 3))[rng.integers(0, positions, n)]
    found = nearest_neighbours(means, k)
    assert found.shape == (n, min(k, n - 1))
    distances = np.linalg.norm(means[found] - means[:, None], axis=2)
    assert np.allclose(distances, reference.neighbour_distances(means, k))
    assert not (found == np.arange(n)[:, None]).any()
    assert all(len(set(row)) == len(row) for row in found.tolist())


def test_centres_so_close_that_squares_underflow_are_not_their_own_neighbours():
    means = np.random.default_rng(17).normal(size=(60, 3)) * 1e-200
    found = nearest_neighbours(means, 4)
    assert not (found == np.arange(60)[:, None]).any()
    assert all(len(set(row)) == 4 for row in found.tolist())


def test_coincident_groups_exclude_centres_that_are_only_close():
    means = np.repeat(np.array([[0.0, 0, 0], [0, 0, 1e-12], [5, 5, 5]]), (9, 3, 8), axis=0)
    order, bounds = coincident_groups(means)
    assert order.tolist() == list(range(20))
    assert bounds.tolist() == [0, 9, 12, 20]


def test_each_pair_is_listed_once_for_both_directions():
    means = np.random.default_rng(14).normal(size=(200, 3))
    pairs = neighbour_pairs(means, 6)
    assert list(map(tuple, pairs.tolist())) == reference.pairs_of(nearest_neighbours(means, 6))


def test_pairs_of_a_row_that_is_a_neighbour_of_all_others():
    """Its list of pairs is long, and most of its pairs come from the lists of the others."""
    neighbours = np.stack([(np.arange(400) + 1) % 400, np.full(400, 200)], axis=1).astype(np.int32)
    neighbours[199:201, 1] = [5, 7]
    expected, starts = reference.pairs_of(neighbours), np.empty(401, dtype=np.int64)
    count_pairs(neighbours, starts)
    firsts, seconds = np.empty((2, starts[-1]), dtype=np.int32)
    fill_seconds(neighbours, starts, starts[:-1].copy(), seconds)
    fill_firsts(starts, firsts)
    assert list(zip(firsts.tolist(), seconds.tolist(), strict=True)) == expected


@compiled_only  # uncompiled, it takes a minute
@pytest.mark.parametrize("threads", [1, 2])
def test_pairs_between_different_stretches_of_rows(threads):
    """The rows have no spatial order, so that most pairs connect two stretches of rows."""
    means = np.random.default_rng(41).normal(size=(20_000, 3))
    with use_threads(threads):
        neighbours = nearest_neighbours(means, 4)
        pairs = neighbour_pairs(means, 4)
    assert list(map(tuple, pairs.tolist())) == reference.pairs_of(neighbours)


def collect_keys(firsts, seconds, costs, taken, end, keys):
    """Collect the keys of three stretches of pairs; return the counts of keys and of NaN costs."""
    bounds = np.array([0, len(costs) // 3, len(costs) // 2, len(costs)])
    counts, without = np.zeros((2, 3), np.int64)
    none = np.empty(0, np.uint64)
    collect_free(firsts, seconds, costs, taken, bounds, end, counts, without, none)
    offsets = np.cumsum(counts) - counts
    collect_free(firsts, seconds, costs, taken, bounds, end, offsets, without, keys)
    assert offsets.tolist() == np.cumsum(counts).tolist()
    return int(counts.sum()), int(without.sum())


@pytest.mark.parametrize("spread", [0.0, 1e-3, 15.0])
def test_keys_sort_by_cost_and_then_by_pair(spread):
    rng = np.random.default_rng(19)
    costs = (rng.choice([-1, 1], 3000) * np.exp(spread * rng.normal(size=3000))).astype(np.float32)
    rows, none_taken = np.arange(6000, dtype=np.int32).reshape(2, 3000), np.zeros(6000, dtype=bool)
    counts, keys = np.zeros(1 << 16, dtype=np.int64), np.empty(3000, dtype=np.uint64)
    tally_free(*rows, costs, none_taken, counts)
    assert counts.sum() == collect_keys(*rows, costs, none_taken, 1 << 16, keys)[0] == 3000
    buffer = np.empty_like(keys)
    found = radix_sort(keys, buffer)
    assert (found & np.uint64(0xFFFFFFFF)).tolist() == np.argsort(costs, kind="stable").tolist()
    upper = found >> np.uint64(48)
    assert counts.tolist() == np.bincount(upper.astype(np.int64), minlength=1 << 16).tolist()


@pytest.mark.parametrize("count", [0, 1, 1000, 5 << 14])
@pytest.mark.parametrize("threads", [1, None])
def test_keys_are_sorted_by_their_upper_halves_for_any_number_of_threads(count, threads):
    upper = np.random.default_rng(count).integers(0, 1 << 32, count, dtype=np.uint64)
    upper[::3] = 1 << 20  # ties, which are broken by the lower halves
    keys = upper << np.uint64(32) | np.arange(count, dtype=np.uint64)
    with use_threads(threads):
        found = radix_sort(keys.copy(), np.empty_like(keys))
    assert (found == np.sort(keys)).all()


@pytest.mark.parametrize(
    ("key_bound", "bound"), [(0, -math.inf), (0x8000, 0), (0xBF80, 1), (1 << 16, math.inf)]
)
def test_only_free_pairs_below_the_cost_bound_are_collected(key_bound, bound):
    rng = np.random.default_rng(29)
    costs = rng.normal(size=500).astype(np.float32)
    costs[::7], costs[1::7] = np.nan, -0.0
    firsts, seconds = rng.integers(0, 60, (2, 500)).astype(np.int32)
    taken = rng.random(60) < 0.3
    expected = np.flatnonzero((costs < bound) & ~taken[firsts] & ~taken[seconds])
    keys = np.empty(500, dtype=np.uint64)
    count, without_cost = collect_keys(firsts, seconds, costs, taken, key_bound, keys)
    assert without_cost == np.isnan(costs).sum()
    assert (keys[:count] & np.uint64(0xFFFFFFFF)).tolist() == expected.tolist()
    counts = np.zeros(1 << 16, dtype=np.int64)
    tally_free(firsts, seconds, costs, taken, counts)
    assert counts[:key_bound].sum() == count


def test_matching_in_batches_gives_the_same_pairs(monkeypatch):
    rng = np.random.default_rng(34)
    pairs = neighbour_pairs(rng.normal(size=(400, 3)), 8)
    costs = rng.choice([*rng.normal(size=90), math.nan, 0.0, -0.0], len(pairs)).astype(np.float32)
    plans, batches, original = [], [], matching._sorted_keys
    monkeypatch.setattr(
        matching, "_sorted_keys", lambda *args: batches.append(1) or original(*args)
    )
    monkeypatch.setattr(matching, "FEW", 1.0)  # leave all pairs to the batches
    monkeypatch.setattr(matching, "BATCH", 0.0)
    for smallest in (1 << 16, 50, 1):
        monkeypatch.setattr(matching, "SMALLEST_BATCH", smallest)
        plans.append(match(pairs, costs, 400, 195))
    expected = reference.greedy(pairs, costs.tolist(), 195)
    for plan in plans:
        assert list(map(tuple, plan.pairs.tolist())) == expected
        assert plan.without_cost == np.isnan(costs).sum() > 0
    assert len(batches) > 20


@pytest.mark.parametrize("pairs_per_round", [7, 100, 1 << 16])
def test_matching_in_rounds_gives_the_same_pairs(monkeypatch, pairs_per_round):
    rng = np.random.default_rng(36)
    pairs = neighbour_pairs(rng.normal(size=(400, 3)), 8)
    costs = rng.choice([*rng.normal(size=90), math.nan, 0.0, -0.0], len(pairs)).astype(np.float32)
    unmatched = []
    original = matching._match_sorted
    monkeypatch.setattr(
        matching,
        "_match_sorted",
        lambda candidates: unmatched.append((~candidates.taken).sum()) or original(candidates),
    )
    monkeypatch.setattr(matching, "STRETCH", pairs_per_round)
    for threads in (1, 2):
        with use_threads(threads):
            plan = match(pairs, costs, 400, 195)
        assert list(map(tuple, plan.pairs.tolist())) == reference.greedy(pairs, costs.tolist(), 195)
        assert (np.diff(plan.costs) >= 0).all()
    assert max(unmatched) < 100  # most pairs are matched in rounds


def test_more_pairs_than_the_maximum_are_refused(monkeypatch):
    monkeypatch.setattr(matching, "MOST_PAIRS", 2)
    pairs = np.array([[0, 1], [0, 2], [1, 2]], np.int32)
    with pytest.raises(ModelError, match="3 pairs, but at most 2 can be matched"):
        match(pairs, np.zeros(3, np.float32), 3, 1)


def test_a_chain_of_ascending_costs_is_matched_in_one_round(monkeypatch):
    rows = np.arange(5000, dtype=np.int32)
    pairs = np.stack((rows[:-1], rows[1:]), axis=1)
    costs = rows[1:].astype(np.float32)
    rounds, original = [], matching.join_pairs
    monkeypatch.setattr(matching, "join_pairs", lambda *args: rounds.append(1) or original(*args))
    plan = match(pairs, costs, 5000, 2500)
    assert plan.pairs.tolist() == pairs[::2].tolist()
    assert len(rounds) == 1


@given(
    st.lists(
        st.sampled_from([-2.0, -1.0, -0.0, 0.0, 1.5, math.inf, math.nan]), min_size=1, max_size=40
    ),
    st.integers(1, 12),
    st.integers(0, 2**32 - 1),
)
def test_matching_is_greedy_and_breaks_ties_by_pair(costs, limit, seed):
    rng = np.random.default_rng(seed)
    all_pairs = np.array([(i, j) for i in range(12) for j in range(i + 1, 12)], dtype=np.int32)
    pairs = all_pairs[np.sort(rng.choice(len(all_pairs), len(costs), replace=False))]
    costs = np.array(costs, dtype=np.float32)
    plan = match(pairs, costs, 12, limit)
    assert list(map(tuple, plan.pairs.tolist())) == reference.greedy(pairs, costs.tolist(), limit)
    assert plan.without_cost == np.isnan(costs).sum()


def test_morton_codes_interleave_the_bits_of_the_cells():
    means = np.random.default_rng(15).uniform(size=(100, 3))
    low, high = np.quantile(means, (0.01, 0.99), axis=0)
    width = (high - low).max()
    cells = np.clip((means - low + width) / (3 * width) * 2**21, 0, 2**21 - 1).astype(int)
    assert morton_codes(means).tolist() == [reference.morton_code(cell) for cell in cells]


def test_centres_outside_the_box_are_in_its_border_cells():
    inside, outside = np.array([[0.0], [1 - 1e-9]]), np.array([[-5.0], [1.0], [7.0]])
    lowest, highest = codes_in(np.repeat(inside, 3, axis=1), np.zeros(3), 1.0)
    found = codes_in(np.repeat(outside, 3, axis=1), np.zeros(3), 1.0)
    assert found.tolist() == [lowest, highest, highest]


@pytest.mark.parametrize("depth", [0.0, 1.0])
def test_outliers_do_not_put_all_other_splats_into_one_cell(depth):
    means = np.random.default_rng(16).uniform(size=(1000, 3)) * [1, 1, depth]
    means[:5] *= 1e6
    assert len(np.unique(morton_codes(means))) > 950


# The merge forest


def random_covariances(count, seed=0):
    """(count, 6) covariances of splats that are up to about a hundred times as long as thin."""
    rng = np.random.default_rng(seed)
    scales = np.exp(rng.uniform(-4, 0.5, (count, 3)))
    quats = random_quats(count, seed)
    return np.array(
        [reference.pack(reference.covariance(s, q)) for s, q in zip(scales, quats, strict=True)]
    )


def random_moments(count, channels=12, seed=0):
    """Weights, coverages, means, covariances and features of nodes far from the origin."""
    rng = np.random.default_rng(seed)
    return (
        np.exp(rng.normal(0, 2, count)),
        np.exp(rng.normal(0, 2, count)),
        rng.normal(size=(count, 3)) + (100, -50, 3),
        random_covariances(count, seed),
        rng.normal(size=(count, channels)).astype(np.float32),
    )


def random_forest(count, seed=0):
    """(M, 2) children of a forest in which random pairs of roots are merged until two are left."""
    rng = np.random.default_rng(seed)
    roots, children = list(range(count)), []
    while len(roots) > 2:
        pair = rng.choice(len(roots), 2, replace=False)
        children.append([roots[p] for p in pair])
        roots = [r for p, r in enumerate(roots) if p not in pair] + [count + len(children) - 1]
    return np.array(children, dtype=np.int32)


@pytest.mark.parametrize(("min_ratio", "min_scale"), [(1e-3, 1e-9), (0.2, 1e-9), (1e-3, 0.15)])
def test_covariances_have_the_axes_of_the_splats_and_a_minimum_thickness(min_ratio, min_scale):
    g = gaussians_of(random_splats(50, seed=20))
    g.scales[0] = 0
    g.scales[1, 2] = 0
    out = np.empty((50, 6))
    covariances_of(g.scales, g.quats, min_ratio, min_scale, out)
    for six, scales, quat in zip(out, g.scales, g.quats, strict=True):
        expected = reference.floored_covariance(scales, quat, min_ratio, min_scale)
        assert np.allclose(reference.unpack(six), expected, rtol=1e-5, atol=1e-6 * expected.max())
        assert np.linalg.eigvalsh(reference.unpack(six))[0] >= 0.999 * min_scale**2


def test_factors_are_rotations_times_scales_for_quaternions_of_any_length():
    rng = np.random.default_rng(22)
    quats = (rng.normal(size=(60, 4)) * 10.0 ** rng.integers(-30, 30, (60, 1))).astype(np.float32)
    quats[0], quats[1, 2], quats[2, 3] = 0, np.inf, np.nan
    scales = rng.uniform(0.1, 2, (60, 3)).astype(np.float32)
    factors = np.empty((60, 3, 3), np.float32)
    with np.errstate(invalid="ignore"):  # uncompiled, infinite values give warnings
        factor_rows(quats, scales, factors)
    assert np.array_equal(factors[0], np.diag(scales[0]))
    assert np.isnan(factors[1:3]).all()
    for factor, quat, scale in zip(factors[3:], quats[3:], scales[3:], strict=True):
        unit = quat.astype(np.float64) / np.linalg.norm(quat.astype(np.float64))
        expected = reference.rotation_matrix(unit) * scale
        assert np.abs(factor - expected).max() < 1e-6 * scale.max()


def test_group_members_and_heaviest_members():
    rng = np.random.default_rng(21)
    labels = rng.permutation(np.r_[np.arange(7), rng.integers(0, 7, 40)]).astype(np.int32)
    weights = rng.integers(0, 4, 47).astype(np.float64)  # many are equal
    starts, members = np.zeros(8, np.int64), np.empty(47, np.int32)
    heaviest = np.full(7, -1, np.int64)
    group_members(labels, starts, members)
    heaviest_members(labels, weights, heaviest)
    for group in range(7):
        expected = np.flatnonzero(labels == group)
        assert members[starts[group] : starts[group + 1]].tolist() == expected.tolist()
        assert heaviest[group] == expected[np.argmax(weights[expected])]  # the first of equal ones


@pytest.mark.parametrize("count", [1, 2, 9, 500])
def test_joined_pairs_form_the_groups_given_by_their_labels(count):
    rng = np.random.default_rng(count)
    rows = rng.permutation(count)[: 2 * rng.integers(0, count // 2 + 1)]
    pairs = np.sort(rows.reshape(-1, 2), axis=1).astype(np.int32)
    ids = rng.permutation(10_000)[:count].astype(np.int32)
    children, left = np.empty_like(pairs), count - len(pairs)
    starts, members = np.empty(left + 1, np.int64), np.empty(count, np.int32)
    before, merges = ids.copy(), np.full(count, -1, np.int32)
    join_pairs_of_nodes(pairs, 20_000, ids, merges, children, starts, members)
    kept = np.ones(count, bool)
    kept[pairs[:, 1]] = False
    labels = (np.cumsum(kept) - 1).astype(np.int32)
    labels[pairs[:, 1]] = labels[pairs[:, 0]]
    expected = [np.flatnonzero(labels == group).tolist() for group in range(left)]
    assert [members[a:b].tolist() for a, b in itertools.pairwise(starts)] == expected
    assert np.array_equal(children, before[pairs])
    before[pairs[:, 0]] = 20_000 + np.arange(len(pairs))
    assert np.array_equal(ids[:left], before[kept])


@pytest.mark.parametrize("own_features", [True, False])
def test_gathered_moments_equal_the_reference(own_features):
    nodes = random_moments(40, seed=22)
    feature_arguments = (*shuffled(nodes[-1]), *UNMIXED)
    if not own_features:
        feature_arguments, features = mixed(40, 12, seed=31)
        nodes = (*nodes[:-1], features)
    labels = np.r_[np.arange(9), np.random.default_rng(22).integers(0, 9, 31)].astype(np.int32)
    starts, members = np.zeros(10, np.int64), np.empty(40, np.int32)
    group_members(labels, starts, members)
    new = (np.empty(9), np.empty(9), np.empty((9, 3)), np.empty((9, 6)), np.empty((9, 12), "f4"))
    gather_moments(starts, members, *nodes[:-1], *feature_arguments, *new)
    weights, coverages, means, covariances, features = nodes
    sigmas = np.array([reference.unpack(six) for six in covariances])
    for group in range(9):
        members_of_group = labels == group
        weight, coverage, mean, sigma, colour = reference.group_moments(
            weights[members_of_group],
            coverages[members_of_group],
            means[members_of_group],
            sigmas[members_of_group],
            features[members_of_group],
        )
        assert new[0][group] == pytest.approx(weight)
        assert new[1][group] == pytest.approx(coverage)
        assert np.allclose(new[2][group], mean, rtol=1e-13)
        assert np.allclose(reference.unpack(new[3][group]), sigma, rtol=1e-10, atol=1e-12)
        assert np.allclose(new[4][group], colour, rtol=1e-5, atol=1e-6)


def test_principal_axes_reproduce_the_covariance():
    covariances = random_covariances(40, seed=23)
    covariances[0] = (1, 0, 0, 1, 0, -1e-18)  # flat, with an eigenvalue that rounding made negative
    scales, quats = np.empty((40, 3), np.float32), np.empty((40, 4), np.float32)
    principal_axes(covariances, scales, quats)
    for six, s, q in zip(covariances, scales, quats, strict=True):
        assert np.linalg.norm(q) == pytest.approx(1, abs=1e-6)
        assert np.allclose(reference.covariance(s, q), reference.unpack(six), atol=2e-6 * six.max())


def test_log_determinants_and_inverses_equal_the_reference():
    covariances = random_covariances(40, seed=24)
    dets, inverses, second_dets = np.empty(40), np.empty((40, 6)), np.empty(40)
    log_determinants(covariances, dets)
    invert_covariances(covariances, inverses, second_dets)
    for six, inverse, det, second_det in zip(covariances, inverses, dets, second_dets, strict=True):
        sigma = reference.unpack(six)
        assert det == pytest.approx(np.linalg.slogdet(sigma)[1], abs=1e-8)
        assert second_det == pytest.approx(det, abs=1e-8)
        assert np.allclose(reference.unpack(inverse) @ sigma, np.eye(3), atol=1e-8)


def shuffled(features):
    """Return the features in a random order, and for each node the row of its features."""
    rows = np.random.default_rng(1).permutation(len(features)).astype(np.int32)
    moved = np.empty_like(features)
    moved[rows] = features
    return moved, rows


# `second_rows` and `shares` of nodes that have one row of features each.
UNMIXED = np.empty(0, np.int32), np.empty((0, 2))


def mixed(count, channels, seed):
    """Return kernel arguments that make each node's features a mean of two rows, and the means."""
    rng = np.random.default_rng(seed)
    table = rng.normal(size=(count + 5, channels)).astype(np.float32)
    rows, second_rows = rng.integers(0, count + 5, (2, count)).astype(np.int32)
    shares = rng.dirichlet((1, 1), count)
    shares[0] = (1, 0)
    features = shares[:, :1] * table[rows] + shares[:, 1:] * table[second_rows]
    return (table, rows, second_rows, shares), features.astype(np.float32)


def increments_of(pairs, weights, means, covariances, feature_arguments):
    dets, out = np.empty(len(means)), np.empty((len(pairs), 2), np.float32)
    log_determinants(covariances, dets)
    merge_increments(pairs, weights, means, covariances, dets, *feature_arguments, out)
    return out


@pytest.mark.parametrize("own_features", [True, False])
def test_merge_increments_equal_the_reference(own_features):
    weights, _, means, covariances, features = random_moments(20, seed=25)
    feature_arguments = (*shuffled(features), *UNMIXED)
    if not own_features:
        feature_arguments, features = mixed(20, 12, seed=30)
    pairs = np.array([(i, j) for i in range(20) for j in range(i + 1, 20)], dtype=np.int32)
    found = increments_of(pairs, weights, means, covariances, feature_arguments)
    sigmas = np.array([reference.unpack(six) for six in covariances])
    for pair, increment in zip(pairs, found, strict=True):
        expected = reference.merge_increment(
            weights[pair], means[pair], sigmas[pair], features[pair]
        )
        assert np.allclose(increment, expected, rtol=1e-5)


def test_increments_of_immense_weights_are_finite():
    _, _, means, covariances, features = random_moments(2, seed=25)
    pairs, arguments = np.array([[0, 1]], np.int32), (*shuffled(features), *UNMIXED)
    found = increments_of(pairs, np.array([1e60, 1e60]), means, covariances, arguments)
    assert (found == np.finfo(np.float32).max).all()


@pytest.mark.parametrize("distance", [0.0, 0.3, 1.0, 4.0])
def test_geometry_increment_is_an_upper_bound_of_the_kl_divergence(distance):
    """Runnalls' bound times the weights: above the true KL divergence, and 0 for equal nodes."""
    weights = np.array([2.0, 0.5])
    means = np.array([[0, 0, 0], [distance, 0, 0]])
    covariances = random_covariances(1, seed=26)[[0, 0]] * np.array([[1.0], [1 + distance]])
    sigmas = np.array([reference.unpack(six) for six in covariances])
    found = increments_of(
        np.array([[0, 1]], np.int32),
        weights,
        means,
        covariances,
        (*shuffled(np.zeros((2, 3), np.float32)), *UNMIXED),
    )
    divergence = reference.divergence_from_merged(weights, means, sigmas, 20_000, seed=26)
    assert found[0, 1] / weights.sum() >= divergence - 0.02
    assert found[0, 0] == 0
    assert (abs(found[0, 1]) < 1e-6) == (distance == 0)


def test_subtree_sums_and_scores_that_no_child_exceeds():
    children, rng = random_forest(30, seed=27), np.random.default_rng(27)
    increments = rng.uniform(size=len(children))
    sums, scores = np.zeros(30 + len(children)), np.full(30 + len(children), -np.inf)
    scores[30:] = increments
    subtree_sums(children, increments, sums)
    raise_to_children(children, scores)
    assert (sums[:30] == 0).all()
    for node in range(30, len(sums)):
        below = reference.merges_below(children, node, 30)
        assert sums[node] == pytest.approx(increments[below].sum())
        assert scores[node] == increments[below].max()


@pytest.mark.parametrize("merged", [0, 1, 13, 28])
def test_root_of_each_is_the_highest_node_reached_by_chosen_merges(merged):
    children = random_forest(30, seed=28)
    chosen = np.arange(len(children)) < merged  # children come first, so any prefix is a cut
    roots = np.arange(30 + len(children), dtype=np.int32)
    root_of_each(children, chosen, roots)
    expected = np.arange(30)
    for merge_number in range(merged):  # later merges overrule those below them
        expected[reference.leaves_below(children, 30 + merge_number, 30)] = 30 + merge_number
    assert roots[:30].tolist() == expected.tolist()


@pytest.mark.parametrize("lambda_app", [0.0, 0.2, 5.0])
def test_assignment_equals_the_reference(lambda_app):
    _, _, means, covariances, features = random_moments(60, channels=3, seed=29)
    rng = np.random.default_rng(29)
    clusters = rng.choice(60, 8, replace=False)
    labels = rng.integers(0, 8, 60).astype(np.int32)
    candidates = np.array([np.delete(np.arange(8), g)[:5] for g in range(8)], dtype=np.int32)
    inverses, dets = np.empty((8, 6)), np.empty(8)
    invert_covariances(covariances[clusters], inverses, dets)
    moved, least = np.empty(60, np.int32), np.empty(60)
    blurs = rng.uniform(0, 1, 60).astype(np.float32)
    assign_nearest(
        labels, candidates, means, covariances, blurs, *shuffled(features), means[clusters],
        inverses, dets, features[clusters], lambda_app, moved, least,
    )  # fmt: skip
    sigmas = np.array([reference.unpack(six) for six in covariances])
    centre_sigmas = sigmas.copy()
    sigmas += blurs[:, None, None].astype(float) ** 2 * np.eye(3)
    for i in range(60):
        allowed = [labels[i], *candidates[labels[i]]]
        misfits = []
        for c in clusters[allowed]:
            cluster = means[c], centre_sigmas[c], features[c]
            misfits.append(reference.misfit(means[i], sigmas[i], features[i], *cluster, lambda_app))
        assert moved[i] == allowed[int(np.argmin(misfits))]
        assert least[i] == pytest.approx(min(misfits), rel=1e-6, abs=1e-6)


def test_splats_keep_their_cluster_if_others_fit_equally_well():
    same = np.tile(np.array([1.0, 0, 0, 1, 0, 1]), (3, 1))
    origin, grey = np.zeros((3, 3)), np.zeros((3, 1), np.float32)
    labels, moved, least = np.array([2, 0, 1], np.int32), np.empty(3, np.int32), np.empty(3)
    others = np.array([[1, 2], [0, 2], [0, 1]], np.int32)
    own_clusters = np.arange(3, dtype=np.int32)
    assign_nearest(
        labels,
        others,
        origin,
        same,
        np.zeros(3, np.float32),
        grey,
        own_clusters,
        origin,
        same,
        np.zeros(3),
        grey,
        1.0,
        moved,
        least,
    )
    assert moved.tolist() == labels.tolist()
    assert least == pytest.approx(np.zeros(3))


@compiled_only
@pytest.mark.slow
def test_kernels_work_uncompiled():
    """Run this file again as plain Python, which a debugger can step through."""
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


COMPILE = """
from nanogs.kernels.compiling import when_compiling
from nanogs.kernels import radix

told = []
when_compiling(lambda: told.append(1))
import numpy as np
radix.radix_sort(np.arange(4, dtype=np.uint64), np.empty(4, np.uint64))
print(len(told))
"""


@compiled_only
def test_compiling_is_reported_once_and_only_if_the_cache_is_empty(tmp_path):
    def reports():
        command = [sys.executable, "-c", COMPILE]
        cache = {"NUMBA_CACHE_DIR": str(tmp_path), "NUMBA_DISABLE_JIT": "0", "NANOGS_SIMD": "0"}
        run = subprocess.run(
            command, env={**os.environ, **cache}, capture_output=True, text=True, check=True
        )
        return run.stdout.strip()

    assert [reports(), reports()] == ["1", "0"]


@compiled_only
def test_every_kernel_is_compiled_for_one_layout_of_its_arguments():
    """A second layout would cost each user seconds on the first run, for no gain."""
    code = """
import importlib, pkgutil
import nanogs, nanogs.kernels
from nanogs.datasets.synthetic import make_scene
small, _ = nanogs.simplify(make_scene(1000), ratio=0.1, steps=2, views=2, view_size=64)
for module in pkgutil.iter_modules(nanogs.kernels.__path__, "nanogs.kernels."):
    for name, value in vars(importlib.import_module(module.name)).items():
        if isinstance(value, type) or getattr(value, "targetoptions", {}).get("forceinline"):
            continue
        if len(getattr(value, "signatures", ())) > 1:
            print(name, *value.signatures, sep="\\n  ")
"""
    run = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "NUMBA_DISABLE_JIT": "0"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert run.stdout == ""


LOADED = """
import sys
import numba, numpy as np
import nanogs
from nanogs.kernels.forest import subtree_sums

rng = np.random.default_rng(1)
columns = [rng.normal(size=(300, *shape)).astype("f4") for shape in ((3,), (3,), (4,), (), (1, 3))]
splats = nanogs.Splats(*columns)
first = nanogs.simplify(splats, ratio=0.1, preset="fast")[0]
print(*{"numba.np.arraymath", "numba.typed.typedlist"} & set(sys.modules))

@numba.njit
def of_three_splats(children, increments):  # compiled now, it calls a kernel that was not
    sums = np.zeros(5)
    subtree_sums(children, increments, sums)
    return sums[3:]

print(of_three_splats(np.array([[0, 1], [3, 2]], "i4"), np.array([2.0, 0.5])).tolist())
again = nanogs.simplify(splats, ratio=0.1, preset="fast")[0]
print(all((getattr(first, n) == getattr(again, n)).all() for n in ("means", "quats", "sh")))
"""


@compiled_only
def test_cached_kernels_are_loaded_without_the_compiler_modules_of_numba():
    splats = random_splats(300, degree=0)
    nanogs.simplify(splats, ratio=0.1, preset="fast")  # the process below finds all on disk
    run = subprocess.run([sys.executable, "-c", LOADED], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert run.stdout.split("\n")[:3] == ["", "[2.0, 2.5]", "True"]

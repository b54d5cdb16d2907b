"""The stages of the merge forest: moments, growth, cut, reassignment, choice."""

import dataclasses
import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import nanogs
import reference_kernels as reference
from builders import model_bytes, random_splats, same_pixel
from nanogs.clock import StageClock
from nanogs.fit.targets import make_target
from nanogs.kernels import assign
from nanogs.kernels.assign import assign_nearest, invert_covariances
from nanogs.method import forest as growth
from nanogs.method import parameters, reassign
from nanogs.method.choose import LUMA, further_growths, quality
from nanogs.method.cut import cut, label_groups, merge_scores
from nanogs.method.forest import Forest, grow_forest
from nanogs.method.growth import blocked, effective_counts
from nanogs.method.match import MergePlan
from nanogs.method.nodes import (
    LIGHTEST,
    activate_nodes,
    footprints,
    gather,
    gather_pairs,
    member_lists,
    normalised,
    thinnest_axis,
)
from nanogs.method.order import morton_order
from nanogs.method.parameters import ForestParameters
from nanogs.method.store import MOST_OPAQUE, store_groups
from nanogs.metrics import ssim
from nanogs.pipeline.one_block import OneBlock, whole_settings
from nanogs.pipeline.options.presets import PRESETS
from nanogs.pipeline.run import build, deliver
from nanogs.pipeline.scene import Task
from nanogs.pipeline.tasks import trials
from nanogs.progress import Tracker, ignore_progress
from nanogs.raster.rendering import prepare, render
from nanogs.report import CandidateReport, PassReport, StopReason
from nanogs.sh import basis
from nanogs.views.automatic import automatic_cameras

pytestmark = pytest.mark.usefixtures("small_views")
SOME = settings(max_examples=20)


def nodes_of(splats, pixel=0.0):
    rows = morton_order(splats.means.astype(np.float64))
    return activate_nodes(splats, rows, np.zeros(3), same_pixel(pixel)), rows


def forest_of(count, seed=0, k=8):
    return grow_forest(
        nodes_of(random_splats(count, seed=seed))[0], ForestParameters(k=k), ignore_progress
    )


# Moments


@SOME
@given(st.integers(2, 60), st.integers(0, 2**31))
def test_gathering_conserves_the_weighted_moments_of_the_model(n, seed):
    nodes, _ = nodes_of(random_splats(n, seed=seed), 0.01)
    labels = np.random.default_rng(seed).permutation(np.arange(n) % (n // 2)).astype(np.int32)
    merged = gather(nodes, labels, n // 2)
    colours = [x.features[x.rows].astype(np.float64) for x in (nodes, merged)]
    for part in ([nodes.means, merged.means], colours):
        before, after = (x.weights @ y for x, y in zip((nodes, merged), part, strict=True))
        assert np.allclose(after, before, rtol=1e-4, atol=1e-5)
    assert merged.weights.sum() == pytest.approx(nodes.weights.sum())
    assert merged.coverages.sum() == pytest.approx(nodes.coverages.sum())
    total, total_of_merged = (gather(x, np.zeros(len(x), np.int32), 1) for x in (nodes, merged))
    assert np.allclose(total.covariances, total_of_merged.covariances, rtol=1e-9, atol=1e-12)


def own_features(nodes):
    """Return the same nodes with a stored row of features for each node."""
    mixed = nodes.features[nodes.rows] * nodes.shares[:, :1]
    mixed += nodes.features[nodes.second_rows] * nodes.shares[:, 1:]
    rows = np.arange(len(nodes), dtype=np.int32)
    unused = {"second_rows": np.empty(0, np.int32), "shares": np.empty((0, 2))}
    return dataclasses.replace(nodes, features=mixed.astype(np.float32), rows=rows, **unused)


@SOME
@given(st.integers(4, 60), st.integers(0, 2**31))
def test_gathered_pairs_share_the_feature_table_and_mix_its_rows(n, seed):
    nodes, _ = nodes_of(random_splats(n, seed=seed), 0.01)
    labels = np.random.default_rng(seed).permutation(np.arange(n) % (2 * n // 3)).astype(np.int32)
    groups = 2 * n // 3
    pairs, stored = (
        gather_pairs(nodes, *member_lists(labels, groups)),
        gather(nodes, labels, groups),
    )
    assert pairs.features is nodes.features
    mixed = own_features(pairs)
    for name in ("weights", "coverages", "means", "covariances"):
        assert np.array_equal(getattr(pairs, name), getattr(stored, name))
    assert np.allclose(mixed.features, stored.features, rtol=1e-6, atol=1e-6)
    halves = (np.arange(groups) // 2).astype(np.int32)
    merged_features = [gather(x, halves, int(halves[-1]) + 1).features for x in (pairs, mixed)]
    assert np.allclose(*merged_features, rtol=1e-6, atol=1e-6)


def test_growing_needs_no_coverages():
    nodes, _ = nodes_of(random_splats(50, seed=6), 0.01)
    without_coverages = dataclasses.replace(nodes, coverages=nodes.weights)
    labels = (np.arange(50) // 2).astype(np.int32)
    merged = gather_pairs(without_coverages, *member_lists(labels, 25))
    assert merged.coverages is merged.weights
    assert np.array_equal(merged.weights, gather(nodes, labels, 25).weights)
    forests = [
        grow_forest(x, ForestParameters(k=8), ignore_progress) for x in (nodes, without_coverages)
    ]
    assert np.array_equal(forests[0].children, forests[1].children)
    assert np.array_equal(forests[0].increments, forests[1].increments)


def test_shapes_are_blurred_by_half_of_the_dilation():
    splats = random_splats(40, seed=7)
    plain, rows = nodes_of(splats, 0.3)
    blurred = activate_nodes(splats, rows, np.zeros(3), same_pixel(0.3), blurred=True)
    added = plain.covariances + 0.15**2 * np.array([1, 0, 0, 1, 0, 1])
    assert blurred.covariances == pytest.approx(added, rel=1e-7)
    for name in ("weights", "coverages", "means", "features", "rows"):
        assert np.array_equal(getattr(blurred, name), getattr(plain, name))


def crossed_and_apart(pairs):
    """Return a model of two kinds of pairs: crossed needles within a pixel, and faint balls."""
    rng = np.random.default_rng(3)
    splats = random_splats(4 * pairs)
    splats.means[:] = np.repeat(rng.uniform(-1, 1, (2 * pairs, 3)), 2, axis=0)
    splats.quats[:] = [1, 0, 0, 0]
    splats.sh[:] = 0.3
    needles, balls = slice(None, 2 * pairs), slice(2 * pairs, None)
    splats.log_scales[needles] = np.log(2e-6)
    splats.log_scales[needles][::2, 0] = np.log(2e-4)
    splats.log_scales[needles][1::2, 1] = np.log(2e-4)
    splats.opacity_logits[needles] = 3.0
    splats.log_scales[balls] = np.log(2e-3)
    splats.means[balls][1::2, 0] += 2e-3
    splats.opacity_logits[balls] = -2.0
    return splats


def test_what_differs_within_a_pixel_is_merged_first():
    pairs = 60
    small, _ = nanogs.simplify(crossed_and_apart(pairs), count=3 * pairs, preset="fast")
    assert np.count_nonzero(small.opacity_logits == -2.0) == 2 * pairs


def test_weights_are_one_on_average_and_never_zero():
    weights = normalised(np.array([0.0, 1.0, 3.0]))
    assert weights == pytest.approx([1e-9, 0.75, 2.25])
    assert normalised(np.zeros(3)).tolist() == [1, 1, 1]


def test_one_immense_splat_leaves_the_weights_of_all_others_apart():
    weights = normalised(np.array([1e20, 1.0, 3.0, 0.0]))
    assert weights[2] == pytest.approx(3 * weights[1])
    assert weights[0] > 1e14 * weights[1] > 1e3 * LIGHTEST


def test_the_least_axis_does_not_follow_from_one_immense_splat():
    scales = np.full((100, 3), 0.002)
    usual = thinnest_axis(scales, np.zeros((100, 3)), 0.0)
    scales[7] = 1e5
    assert thinnest_axis(scales, np.zeros((100, 3)), 0.0) == usual == pytest.approx(2e-9)
    assert thinnest_axis(np.zeros((4, 3)), np.diag([1.0, 2, 3, 4])[:, :3], 0.0) == 3e-6
    assert thinnest_axis(scales, np.zeros((100, 3)), 0.5) == 5e-4


@SOME
@given(st.integers(4, 60), st.integers(0, 2**31), st.sampled_from([0.0, 0.05]))
def test_stored_groups_block_as_much_light_as_their_members(n, seed, pixel):
    splats = random_splats(n, seed=seed)
    nodes, _ = nodes_of(splats, pixel)
    labels = (np.arange(n) // 2).astype(np.int32)
    groups = int(labels[-1]) + 1
    merged = gather(nodes, labels, groups)
    stored = store_groups(nodes, labels, splats, np.zeros(3), same_pixel(pixel))
    small = stored.grown(1.0)
    assert len(small) == groups
    alphas = small.opacities()
    sigmas = [reference.pack(reference.covariance(s, q)) for s, q in
              zip(small.scales(), small.unit_quats(), strict=True)]  # fmt: skip
    covered = alphas * footprints(np.array(sigmas), pixel)
    by_centre = np.argsort(small.means[:, 0], kind="stable")
    counts = effective_counts(nodes, labels, merged.coverages)
    expected = blocked(merged.coverages, footprints(merged.covariances, pixel), counts)
    expected = expected[np.argsort(merged.means[:, 0].astype("f4"), kind="stable")]
    translucent = alphas[by_centre] < 0.999
    pairs = np.bincount(labels)[np.argsort(merged.means[:, 0].astype("f4"), kind="stable")] > 1
    chosen = translucent & pairs
    assert np.allclose(covered[by_centre][chosen], expected[chosen], rtol=1e-3)
    assert (covered[by_centre][pairs] <= 1.001 * expected[pairs]).all()
    assert (alphas <= 1).all()


def test_groups_that_would_need_alpha_above_one_get_the_maximum():
    splats = random_splats(1).take(np.zeros(4, np.int64))
    splats.opacity_logits[:] = 3.0
    small, _ = nanogs.simplify(splats, count=1, preset="fast")
    assert small.opacities()[0] == pytest.approx(MOST_OPAQUE, abs=1e-7)
    assert np.isfinite(small.opacity_logits).all()


def test_thin_splats_and_points_get_a_minimum_thickness():
    splats = random_splats(3)
    splats.log_scales[:] = [[0, 0, -30], [-np.inf] * 3, [0, 0, 0]]
    nodes, rows = nodes_of(splats, pixel=0.5)
    values = [np.linalg.eigvalsh(reference.unpack(six)) for six in nodes.covariances]
    least = dict(zip(rows.tolist(), (np.sqrt(v[0]) for v in values), strict=True))
    assert least == {0: pytest.approx(1e-3, rel=1e-4), 1: pytest.approx(5e-4), 2: pytest.approx(1)}


# Growth and cut


@SOME
@given(st.integers(1, 150), st.integers(1, 10), st.integers(0, 2**31))
def test_a_forest_joins_all_splats_and_merges_each_node_once(n, k, seed):
    forest = forest_of(n, seed, k)
    assert len(forest.children) == n - 1
    assert forest.fewest == 1
    assert forest.stop == StopReason.TARGET
    used = forest.children.ravel()
    assert len(np.unique(used)) == len(used)
    assert (forest.children < n + np.arange(n - 1)[:, None]).all()
    assert (np.diff(forest.levels) >= 0).all()
    assert [p.merged for p in forest.passes] == np.bincount(forest.levels)[1:].tolist()
    assert all(p.count_after == p.count_before - p.merged for p in forest.passes)
    if n > 1:
        assert sorted(reference.leaves_below(forest.children, 2 * n - 2, n)) == list(range(n))


def test_passes_report_their_highest_cost_and_the_merges_done():
    nodes, reported = nodes_of(random_splats(90, seed=2))[0], []
    forest = grow_forest(nodes, ForestParameters(), lambda *progress: reported.append(progress))
    costs = forest.increments.sum(axis=1)
    for number, one_pass in enumerate(forest.passes, 1):
        assert one_pass.highest_cost == costs[forest.levels == number].max()
    done, whole = zip(*reported, strict=True)
    assert set(whole) == {90}
    assert (done[0], done[-1]) == (0, pytest.approx(89, abs=1))
    assert all(0 <= each < 90 for each in done)


def test_increments_equal_the_reference_for_the_merged_nodes():
    nodes, _ = nodes_of(random_splats(40, seed=4), 0.01)
    forest = grow_forest(nodes, ForestParameters(k=6), ignore_progress)
    sigmas = np.array([reference.unpack(six) for six in nodes.covariances])

    def moments(node):
        leaves = reference.leaves_below(forest.children, node, 40)
        weights = nodes.weights[leaves]
        arrays = (nodes.means[leaves], sigmas[leaves], nodes.features[nodes.rows[leaves]])
        return reference.group_moments(weights, weights, *arrays)

    for pair, increment in zip(forest.children, forest.increments, strict=True):
        weights, _, means, covariances, features = (
            np.array(part) for part in zip(*map(moments, pair), strict=True)
        )
        expected = reference.merge_increment(weights, means, covariances, features)
        assert np.allclose(increment, expected, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize(("lambda_app", "index_distances"), [(0.0, {1}), (10.0, {2})])
def test_a_high_colour_weight_merges_splats_of_equal_colour(lambda_app, index_distances):
    """Four spheres in a row: neighbours differ in colour, every second one has the same colour."""
    splats = random_splats(1, degree=0).take(np.zeros(4, np.int64))
    splats.means[:] = np.array([[0.0, 0, 0], [1, 0, 0], [2.1, 0, 0], [3.1, 0, 0]])
    splats.log_scales[:] = 0
    splats.sh[:, 0] = np.array([[0.0], [5], [0], [5]])
    nodes, rows = nodes_of(splats)
    forest = grow_forest(nodes, ForestParameters(k=3, lambda_app=lambda_app), ignore_progress)
    pairs = rows[forest.children[forest.levels == 1]]
    assert set(np.abs(np.diff(pairs, axis=1)).ravel().tolist()) == index_distances
    assert forest.levels.tolist() == [1, 1, 2]


@SOME
@given(st.integers(2, 60), st.sampled_from([0.0, 0.5, 0.8, 1.0]), st.integers(0, 2**31))
def test_cuts_have_exactly_the_target_count_and_are_nested(n, balance, seed):
    forest = forest_of(n, seed)
    finer = np.arange(n)
    for target in range(n, 0, -1):
        labels = cut(forest, target, balance)
        assert labels.dtype == np.int32
        _, first = np.unique(labels, return_index=True)
        assert len(first) == target
        assert labels.max() == target - 1
        assert (np.diff(first) > 0).all()  # groups are numbered in the order of their first splats
        # All splats of a finer group are in one coarser group.
        assert len(np.unique(np.stack([finer, labels]), axis=1).T) == len(np.unique(finer))
        finer = labels


@SOME
@given(st.integers(2, 100), st.sampled_from([0.0, 0.3, 1.0]), st.integers(0, 2**31))
def test_scores_never_decrease_towards_the_root(n, balance, seed):
    forest = forest_of(n, seed)
    scores = np.r_[np.full(n, -np.inf), merge_scores(forest, balance)]
    assert np.isfinite(scores[n:]).all()
    assert (scores[n:, None] >= scores[forest.children]).all()


def small_forest(increments):
    """Return a forest of four splats: (0, 1) and (2, 3) are merged, then the two results."""
    return Forest(
        4,
        np.array([[0, 1], [2, 3], [4, 5]], np.int32),
        np.array([1, 1, 2], np.int32),
        np.array(increments, np.float32),
        (),
        StopReason.TARGET,
    )


def test_scores_have_the_values_computed_by_hand():
    """Errors of subtrees: 1, 4 and 1 + 4 + 3 = 8, from colour plus a tenth of the geometry."""
    forest = small_forest([(1, 0), (0, 40), (2, 10)])
    assert merge_scores(forest, 1.0) == pytest.approx(np.log2(np.array([1, 4, 8]) / 4))
    assert merge_scores(forest, 0.0) == pytest.approx([1, 1, 2])
    assert merge_scores(forest, 0.25) == pytest.approx([0.25, 0.75, 1.75])
    assert cut(forest, 3, 1.0).tolist() == [0, 0, 1, 2]
    assert cut(small_forest([(5, 0), (1, 0), (2, 0)]), 3, 1.0).tolist() == [0, 1, 2, 2]


def test_scores_of_several_forests_are_relative_to_the_same_error():
    """The forests of blocks are cut at one score, so they must not be divided by own medians."""
    found = [
        merge_scores(small_forest([(factor, 0), (4 * factor, 0), (0, 0)]), 0.5, 2.0)
        for factor in (1.0, 8.0)
    ]
    assert found[0] == pytest.approx(np.array([1, 1, 2]) / 2 + np.log2([1 / 2, 2, 5 / 2]) / 2)
    assert found[1] - found[0] == pytest.approx(np.full(3, 1.5))


def test_merges_of_equal_scores_are_done_in_order_so_none_without_those_below_it():
    chain = np.array([[0, 1], [4, 2], [5, 3]], np.int32)
    for target, labels in ((4, [0, 1, 2, 3]), (3, [0, 0, 1, 2]), (2, [0, 0, 0, 1]), (1, [0] * 4)):
        assert label_groups(4, chain, np.zeros(3), target).tolist() == labels


def test_scores_keep_the_order_of_errors_if_most_errors_are_zero():
    forest = small_forest([(0, 0), (0, 0), (4, 0)])
    with np.errstate(all="raise"):
        scores = merge_scores(forest, 1.0)
    assert np.isfinite(scores).all()
    assert scores[2] > scores[0] == scores[1]


def test_negative_increments_count_as_zero():
    scores = merge_scores(small_forest([(-1e-9, 0), (4, 0), (0, 0)]), 1.0)
    assert np.isfinite(scores).all()
    assert scores[0] < scores[1] == scores[2]


def test_negative_increments_do_not_lower_the_error_of_a_subtree():
    scores = merge_scores(small_forest([(-4, 0), (4, 0), (1, 0)]), 1.0)
    assert scores[2] - scores[1] == pytest.approx(np.log2(5 / 4))


@pytest.fixture
def nan_costs(monkeypatch):
    """Make all merge costs NaN."""
    original = growth._increments

    def increments(*args):
        return original(*args) * np.float32(np.nan)

    monkeypatch.setattr(growth, "_increments", increments)


@pytest.mark.parametrize("preset", ["fast", "default"])
def test_nan_costs_end_the_growth_of_the_forest(nan_costs, preset):
    splats = random_splats(20)
    small, report = nanogs.simplify(splats, count=5, preset=preset)
    assert report.stop == StopReason.NO_CANDIDATES
    assert len(small) == report.achieved_count == 20
    assert model_bytes(small) == model_bytes(splats)
    assert report.passes[0].without_cost == report.passes[0].candidates > 0


def test_a_forest_that_ends_early_gives_its_lowest_possible_count(monkeypatch):
    original, calls = growth.match, []

    def match(pairs, costs, rows, limit):
        calls.append(rows)
        if len(calls) == 3:
            return MergePlan(pairs[:0], costs[:0], 0)
        return original(pairs, costs, rows, limit)

    monkeypatch.setattr(growth, "match", match)
    small, report = nanogs.simplify(random_splats(40), count=2, preset="fast")
    assert report.stop == StopReason.NO_PROGRESS
    assert len(small) == report.achieved_count == calls[-1] > 2
    assert report.asked_count == 2
    assert report.passes[-1].merged == 0
    calls.clear()
    assert nanogs.simplify(random_splats(40), count=30, preset="fast")[1].stop == StopReason.TARGET


# Reassignment


def reassigned(leaves, labels, groups, rounds):
    """Reassign by shapes that are not blurred."""
    return reassign.reassign(leaves, labels, groups, rounds, np.zeros(len(leaves), np.float32))


def widened(leaves, blurs):
    """Return the nodes with the squares of deviations added in all directions."""
    covariances = leaves.covariances + np.outer(blurs.astype(float) ** 2, [1, 0, 0, 1, 0, 1])
    return dataclasses.replace(leaves, covariances=covariances)


def log_likelihood(leaves, labels, groups):
    """Return the weighted log likelihood of the leaves under their own groups, in nats.

    Less what each would have in a group of its own.
    """
    merged = gather(leaves, labels, groups)
    inverses, dets = np.empty((groups, 6)), np.empty(groups)
    invert_covariances(merged.covariances, inverses, dets)
    no_candidates, unused, misfits = (
        np.empty((groups, 0), np.int32),
        np.empty_like(labels),
        np.empty(len(labels)),
    )
    assign_nearest(
        labels, no_candidates, leaves.means, leaves.covariances, np.zeros(len(labels), np.float32),
        leaves.features, leaves.rows,
        merged.means, inverses, dets, merged.features, reassign.LAMBDA_APP, unused, misfits,
    )  # fmt: skip
    return -float(leaves.weights @ misfits)


@SOME
@given(st.integers(20, 200), st.integers(0, 2**31), st.booleans())
def test_reassignment_keeps_every_group_and_does_not_lower_the_likelihood(n, seed, equal):
    """As in hard EM, each round lowers the misfit, unless an empty group had to be refilled."""
    leaves, _ = nodes_of(random_splats(n, seed=seed), 0.01)
    if equal:
        leaves = dataclasses.replace(leaves, weights=np.ones(n))
    labels = cut(grow_forest(leaves, ForestParameters(k=8), ignore_progress), n // 4, 0.8)
    had_empty_groups = []
    with pytest.MonkeyPatch.context() as patch:
        original = reassign._refill

        def refill(new, misfits, groups):
            had_empty_groups.append((np.bincount(new, minlength=groups) == 0).any())
            original(new, misfits, groups)

        patch.setattr(reassign, "_refill", refill)
        patch.setattr(reassign, "MOVES", 0)  # they lower another error
        moved, rounds = reassigned(leaves, labels, n // 4, 3)
    assert rounds <= len(had_empty_groups) <= 3
    assert sorted(set(moved.tolist())) == list(range(n // 4))
    before, after = (log_likelihood(leaves, x, n // 4) for x in (labels, moved))
    assert any(had_empty_groups) or after >= before - 1e-6 * abs(before)


def test_reassignment_ends_after_the_given_rounds_or_when_nothing_moves(monkeypatch):
    monkeypatch.setattr(reassign, "MOVES", 0)
    leaves, _ = nodes_of(random_splats(60, seed=5))
    labels = cut(grow_forest(leaves, ForestParameters(k=8), ignore_progress), 12, 0.8)
    unchanged, rounds_with_moves = reassigned(leaves, labels, 12, 0)
    assert unchanged is labels
    assert rounds_with_moves == 0
    settled, rounds = reassigned(leaves, labels, 12, 100)
    assert not np.array_equal(settled, labels)
    assert 0 < rounds < 100
    settled_again, rounds_with_moves = reassigned(leaves, settled, 12, 1)
    assert np.array_equal(settled_again, settled)
    assert rounds_with_moves == 0


def error_of(leaves, labels, groups):
    """Return the error that moves of single splats lower, as the forest sums it up."""
    merged, colours = gather(leaves, labels, groups), leaves.features[leaves.rows]
    own, whole = (
        np.linalg.slogdet([reference.unpack(each) for each in nodes.covariances])[1]
        for nodes in (leaves, merged)
    )
    apart = ((colours - merged.features[labels]).astype(np.float64) ** 2).sum(axis=1)
    geometry = merged.weights @ whole - leaves.weights @ own
    return 0.5 * geometry + reassign.MOVES_APP * leaves.weights @ apart


@pytest.mark.parametrize("blurred", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_moves_lower_the_error_by_what_is_predicted(seed, blurred, monkeypatch):
    """Rounds that take a splat for infinitely light leave most groups of two as they are."""
    count, groups = 60, 25
    leaves, _ = nodes_of(random_splats(count, seed=seed), 0.01)
    labels = cut(grow_forest(leaves, ForestParameters(k=8), ignore_progress), groups, 0.8)
    monkeypatch.setattr(reassign, "MOVES", 0)
    blurs = np.random.default_rng(seed).uniform(0, 0.7, count) * blurred
    blurs = blurs.astype(np.float32)
    before, _ = reassign.reassign(leaves, labels, groups, 1, blurs)
    monkeypatch.setattr(reassign, "MOVES", 1)
    predicted = []

    def make_moves(order, targets, taken, moved):
        assert (np.diff(gains[-1][order]) <= 0).all()
        unmoved = moved.copy()
        made = assign.make_moves(order, targets, taken, moved)
        rows = np.flatnonzero(moved != unmoved)
        assert made == len(rows) > 0
        assert np.array_equal(moved[rows], targets[rows])
        changed = np.concatenate([unmoved[rows], moved[rows]])
        assert len(np.unique(changed)) == len(changed)
        predicted.append(rows)
        return made

    gains = []

    def best_moves(*arguments):
        assign.best_moves(*arguments)
        gains.append(arguments[-1])

    monkeypatch.setattr(reassign, "make_moves", make_moves)
    monkeypatch.setattr(reassign, "best_moves", best_moves)
    after, _ = reassign.reassign(leaves, labels, groups, 1, blurs)
    assert np.bincount(after, minlength=groups).min() > 0
    leaves = widened(leaves, blurs)
    fall = error_of(leaves, before, groups) - error_of(leaves, after, groups)
    assert fall == pytest.approx(gains[0][predicted[0]].sum(), rel=1e-4)


def test_moves_leave_the_labels_of_the_caller_as_they_are(monkeypatch):
    leaves, _ = nodes_of(random_splats(60, seed=1), 0.01)
    labels = cut(grow_forest(leaves, ForestParameters(k=8), ignore_progress), 25, 0.8)
    with monkeypatch.context() as patch:
        patch.setattr(reassign, "MOVES", 0)
        settled, _ = reassigned(leaves, labels, 25, 100)
    before = settled.copy()
    moved, rounds = reassigned(leaves, settled, 25, 1)
    assert rounds == 0
    assert not np.array_equal(moved, before)
    assert np.array_equal(settled, before)


@pytest.mark.parametrize("seed", range(3))
def test_blurred_shapes_are_reassigned(seed):
    count, groups = 300, 60
    leaves, _ = nodes_of(random_splats(count, seed=seed), 0.01)
    labels = cut(grow_forest(leaves, ForestParameters(k=8), ignore_progress), groups, 0.8)
    blurs = np.random.default_rng(seed).uniform(0, 0.7, count).astype(np.float32)
    found, rounds = reassign.reassign(leaves, labels, groups, 2, blurs)
    expected, rounds_expected = reassigned(widened(leaves, blurs), labels, groups, 2)
    assert np.array_equal(found, expected)
    assert rounds == rounds_expected
    assert not np.array_equal(found, reassigned(leaves, labels, groups, 2)[0])


def test_a_splat_stays_with_one_that_weighs_nothing_beside_it():
    leaves, _ = nodes_of(random_splats(6, seed=1))
    leaves = dataclasses.replace(leaves, weights=np.array([1.0, 1e-9, 1, 1, 1, 1]))
    labels = np.array([0, 0, 1, 1, 2, 2], np.int32)
    moved, _ = reassigned(leaves, labels, 3, 1)
    assert moved[0] == 0
    assert np.bincount(moved, minlength=3).min() > 0


def test_empty_groups_take_the_worst_fitting_splats_of_larger_groups():
    labels = np.array([0, 0, 0, 3, 3, 2], np.int32)
    reassign._refill(labels, np.array([1.0, 5.0, 2.0, 3.0, 4.0, 9.0]), 6)
    # Splat 5 fits worst, but is alone in its group. Next are 1, 4 (after which 3 is alone) and 2.
    assert labels.tolist() == [0, 1, 5, 3, 4, 2]


def misfits_for_refilling(leaves, labels):
    given_misfits = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            reassign, "_refill", lambda _new, misfits, _groups: given_misfits.append(misfits)
        )
        reassigned(leaves, labels, labels.max() + 1, 1)
    return given_misfits[0]


def test_misfits_for_refilling_groups_are_weighted():
    leaves, _ = nodes_of(random_splats(30, seed=10))
    labels = np.zeros(30, np.int32)
    misfits = misfits_for_refilling(leaves, labels)
    assert misfits.sum() == pytest.approx(-log_likelihood(leaves, labels, 1))
    whole, sigmas = gather(leaves, labels, 1), map(reference.unpack, leaves.covariances)
    group = whole.means[0], reference.unpack(whole.covariances[0]), whole.features[0]
    expected = [
        weight * reference.misfit(*splat, *group, reassign.LAMBDA_APP)
        for weight, *splat in zip(
            leaves.weights, leaves.means, sigmas, leaves.features[leaves.rows], strict=True
        )
    ]
    assert misfits == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("unit", [2.0**-20, 2.0**20])
def test_misfits_for_refilling_groups_have_no_unit_of_length(unit):
    """Else the sign of a logarithm decides whether a heavy splat fits badly or well."""
    leaves, _ = nodes_of(random_splats(60, seed=10))
    scaled = dataclasses.replace(
        leaves, means=leaves.means * unit, covariances=leaves.covariances * unit**2
    )
    labels = (np.arange(60) % 20).astype(np.int32)
    misfits = misfits_for_refilling(leaves, labels)
    assert misfits.min() >= 0
    assert misfits_for_refilling(scaled, labels) == pytest.approx(misfits, rel=1e-9)


def test_a_group_that_loses_all_its_splats_is_refilled():
    """Nearly coincident splats in several groups: one group gets them all."""
    splats = random_splats(1).take(np.zeros(12, np.int64))
    splats.means[:, 0] = np.r_[np.zeros(4), 1e-3 * np.ones(4), 2e-3 * np.ones(4)]
    leaves, _ = nodes_of(splats)
    for labels in (np.arange(12) % 3, np.arange(12) % 11):
        moved, _ = reassigned(leaves, labels.astype(np.int32), labels.max() + 1, 5)
        assert len(np.unique(moved)) == labels.max() + 1


# Choice


def test_similarity_is_measured_on_luma():
    """The loss of green costs most, that of blue least."""
    model = random_splats(200, degree=0)
    target = make_target(prepare(model), automatic_cameras(model, 1, width=48, height=48)[0])

    def cost(channel):
        lossy = model.take(np.arange(200))
        lossy.sh[:, :, channel] = 0
        return trials._errors(lossy, [target], None)[0][1]

    red, green, blue = map(cost, range(3))
    assert green > red > 1.5 * blue > 0


def test_errors_of_a_candidate_are_added_up_over_pixels_and_blocks():
    model = random_splats(200, degree=0)
    [camera] = automatic_cameras(model, 1, width=48, height=32)
    target, bright = make_target(prepare(model), camera), model.take(np.arange(200))
    bright.sh[:] += 3  # beyond white, as screens clip it
    image = np.clip(render(prepare(bright), camera).color, 0, 1)
    wanted = target.image[..., :3] / np.float32(255)
    squares = ((wanted - image) ** 2).mean(axis=2).sum()
    unlike = 48 * 32 * (1 - ssim(wanted @ LUMA, image @ LUMA))
    [found] = trials._errors(bright, [target], None)
    assert found == pytest.approx((squares, unlike), rel=1e-4)
    assert trials._errors(bright, [None], None) == [(0, 0)]

    def quality_of(*blocks):
        records = [SimpleNamespace(facts={"errors": [[errors]]}) for errors in blocks]
        scene = SimpleNamespace(deciding=[camera], of_blocks=lambda *_task: records)
        unknown = CandidateReport(0.5, 0, False, 1.25, 0, 0, 0, chosen=False)
        return trials._report(scene, 0, "trial", unknown)

    report = quality_of(found, (squares, unlike), (0, 0))
    assert report.psnr == pytest.approx(-10 * np.log10(2 * squares / (48 * 32)), rel=1e-4)
    assert report.ssim == pytest.approx(1 - 2 * unlike / (48 * 32), rel=1e-4)
    assert report.quality == quality(report.psnr, report.ssim)
    assert quality_of((0, 0)).psnr == trials.MOST


# The candidates: three balances; the best of them after reassignment; the best of these four grown
# by 1.5, 1.8 and 2.1, until a growth gains less than a tenth of a decibel.
@pytest.mark.parametrize(("qualities", "first", "growths", "winner"), [
    ([10, 30, 20, 25, 0], 1, [1.5], 1),
    ([10, 20, 30, 35, 30], 3, [1.5], 3),
    ([30, 30, 20, 30, 0], 0, [1.5], 0),
    ([1, 2, 3, 2.9, 0], 2, [1.5], 2),
    ([10, 30, 20, 25, 30.1], 1, [1.5], 1),
    ([10, 30, 20, 25, 30.15, 30.2], 1, [1.5, 1.8], 4),
    ([10, 20, 30, 35, 36, 37, 37], 3, [1.5, 1.8, 2.1], 5),
    ([10, 20, 30, 35, 36, 37, 38], 3, [1.5, 1.8, 2.1], 6),
])  # fmt: skip
def test_the_candidate_of_highest_quality_is_chosen_and_marked_once(
    monkeypatch, qualities, first, growths, winner
):
    """The stages get the qualities in the order in which they ask for them."""
    scene, remaining_qualities = scene_with_three_balances(), iter(qualities)
    given_qualities = {}

    def report(_scene, _level, stage, candidate, number=0):
        if (stage, number) not in given_qualities:
            given_qualities[stage, number] = next(remaining_qualities)
        return dataclasses.replace(candidate, quality=given_qualities[stage, number])

    monkeypatch.setattr(trials, "_report", report)
    trials.pick_cut(scene, Task("pick"))
    balances = [0.5, 0.8, 1.0]
    leader = int(np.argmax(qualities[:3]))
    assert scene.picked(0) == leader
    step = 0
    while trials.growth_is_promising(scene, 0, step):
        trials.candidates(scene, 0, step + 1)
        step += 1
    trials.choose(scene, Task("choose"))
    reports, count = trials.reports_of(scene, 0), len(growths)
    assert next(remaining_qualities, None) is None
    assert step == count
    assert [report.balance for report in reports] == [*balances, *[balances[leader]] * (1 + count)]
    assert [r.reassigned for r in reports] == [False] * 3 + [True] + [first == 3] * count
    assert [report.growth for report in reports] == [1.1] * 4 + growths
    assert [report.chosen for report in reports] == [index == winner for index in range(4 + count)]
    chosen = scene.chosen(0)
    assert (chosen.reassigned, chosen.growth) == (
        reports[winner].reassigned, reports[winner].growth
    )  # fmt: skip


@pytest.mark.parametrize(("best", "helped"), [(2, False), (3, True)])
def test_errors_are_corrected_again_only_if_that_helped(monkeypatch, best, helped):
    monkeypatch.setattr(trials, "best_cut", lambda *_given: best)
    scene = scene_with_three_balances()
    steps = [trials.correction_is_promising(scene, 0, step) for step in (0, 1)]
    assert steps == [True, helped]


def test_growths_above_the_usual_one_are_tried():
    assert further_growths(1.25) == [1.5, 1.8, 2.1]
    assert further_growths(1.5) == [1.8, 2.1]
    assert further_growths(2.1) == []


class ThreeBalances(OneBlock):
    """A scene for which three balances are tried, without rendering."""

    balances = (0.5, 0.8, 1.0)

    def tries(self, _level):
        return True


def scene_with_three_balances():
    splats, method = random_splats(8), parameters.ForestParameters(growth=1.1, corrections=0)
    return ThreeBalances(splats, np.arange(8), whole_settings(splats, method), 1)


def test_a_ssim_difference_of_one_fiftieth_equals_one_decibel():
    assert quality(30.0, 0.9) - quality(29.0, 0.92) == pytest.approx(0)
    assert parameters.BALANCES == (0.5, 1.0)


def test_the_usual_balance_is_only_used_where_nothing_is_compared():
    balances = [ForestParameters(**given).balances for given in ({}, {"guided": False})]
    assert balances == [(0.5, 1.0), (parameters.USUAL_BALANCE,)]
    assert ForestParameters(balance=0.5).balances == (0.5, 1.0)


def test_the_report_lists_all_candidates_and_the_requested_balance():
    _, report = nanogs.simplify(random_splats(60), count=10, balance=0.3)
    assert [c.balance for c in report.candidates[:3]] == [0.3, 0.5, 1.0]
    assert sum(c.chosen for c in report.candidates) == 1
    best = next(c for c in report.candidates if c.chosen)
    assert best.quality == pytest.approx(best.psnr + 50 * best.ssim)
    assert nanogs.simplify(random_splats(60), count=10, preset="fast")[1].candidates == ()


# The whole


def quaternion_product(a, b):
    w = a[0] * b[..., 0] - b[..., 1:] @ a[1:]
    v = (
        a[0] * b[..., 1:]
        + b[..., :1] * a[1:]
        + np.cross(np.broadcast_to(a[1:], b[..., 1:].shape), b[..., 1:])
    )
    return np.concatenate([np.asarray(w)[..., None], v], axis=-1)


def in_double_precision(splats):
    """Convert the centres to double precision: moved or turned, they keep their digits."""
    return dataclasses.replace(splats, means=splats.means.astype(np.float64))


def moved(splats, offset):
    return dataclasses.replace(splats, means=splats.means + offset)


def scaled(splats, factor):
    return dataclasses.replace(
        splats,
        means=splats.means * factor,
        log_scales=(splats.log_scales + np.log(factor)).astype(np.float32),
    )


def turned(splats, quat):
    turn = reference.rotation_matrix(quat)
    return dataclasses.replace(
        splats,
        means=splats.means @ turn.T,
        quats=quaternion_product(quat, splats.quats.astype(np.float64)).astype(np.float32),
        sh=(turned_harmonics(turn, splats.sh_degree) @ splats.sh).astype(np.float32),
    )


def turned_harmonics(turn, degree):
    """Return the (K, K) rotation of spherical harmonics, fitted to colours in 200 directions."""
    directions = np.random.default_rng(0).normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return np.linalg.lstsq(basis(directions, degree), basis(directions @ turn, degree))[0]


TURN = np.array([0.5, -0.1, 0.7, 0.5]) / np.sqrt(0.25 + 0.01 + 0.49 + 0.25)
BACK = TURN * (1, -1, -1, -1)
YAW = np.array([0.8, 0.0, 0.6, 0.0])
CHANGES = {
    "moved": (lambda s: moved(s, (50.0, -7.0, 3.0)), lambda s: moved(s, (-50.0, 7.0, -3.0))),
    "tiny": (lambda s: scaled(s, 1e-6), lambda s: scaled(s, 1e6)),
    "huge": (lambda s: scaled(s, 1e8), lambda s: scaled(s, 1e-8)),
    "turned": (lambda s: turned(s, TURN), lambda s: turned(s, BACK)),
    "turned about up": (lambda s: turned(s, YAW), lambda s: turned(s, YAW * (1, -1, -1, -1))),
}


@pytest.mark.parametrize(
    ("preset", "change"),
    [*itertools.product(["fast", "default"], CHANGES), ("best", "turned"), ("best", "tiny")],
)
def test_moved_scaled_and_turned_scenes_are_simplified_alike(preset, change):
    """The groups have the same dominant members, and the splats are equal once changed back."""
    scene = dataclasses.replace(
        in_double_precision(random_splats(600, degree=1, seed=9)), extras={"row": np.arange(600)}
    )
    change_scene, change_back = CHANGES[change]
    small, _ = nanogs.simplify(scene, ratio=0.1, preset=preset)
    small_of_changed, _ = nanogs.simplify(change_scene(scene), ratio=0.1, preset=preset)
    small_of_changed = change_back(small_of_changed)
    assert np.mean(np.isin(small.extras["row"], small_of_changed.extras["row"])) > 0.98
    # Rounding may decide near ties differently, in a few groups.
    _, matched, matched_changed = np.intersect1d(
        small.extras["row"], small_of_changed.extras["row"], return_indices=True
    )
    same = (
        np.linalg.norm(small.means[matched] - small_of_changed.means[matched_changed], axis=1)
        < 1e-4
    )
    assert same.mean() > 0.95
    matched, matched_changed = (
        small.take(matched[same]),
        small_of_changed.take(matched_changed[same]),
    )
    assert np.allclose(matched.opacities(), matched_changed.opacities(), atol=2e-3)
    assert np.allclose(matched.sh, matched_changed.sh, atol=1e-3)
    for a, b in zip(range(len(matched)), range(len(matched_changed)), strict=True):
        first, second = (reference.covariance(s.scales()[i], s.unit_quats()[i])
                         for s, i in ((matched, a), (matched_changed, b)))  # fmt: skip
        assert np.allclose(first, second, atol=2e-3 * np.abs(first).max())


def test_one_forest_gives_the_results_of_separate_runs_for_many_counts():
    splats = random_splats(200)
    clock, rows = StageClock(), np.arange(200)
    scene = OneBlock(splats, rows, whole_settings(splats, PRESETS["fast"]), 1)
    build(scene, clock, Tracker(None, []))
    for count in (1, 7, 100, 199, 200):
        outcome = deliver(scene, count, clock, Tracker(None, []))
        expected, _ = nanogs.simplify(splats, count=count, preset="fast")
        assert model_bytes(outcome.splats) == model_bytes(expected)
    assert all(isinstance(each, PassReport) for each in scene.forest.passes)

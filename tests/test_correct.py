"""Correction of the errors that cuts are guided by: against plain versions, and its promises."""

import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import nanogs
import reference_kernels as reference
from builders import random_splats
from nanogs.errors import OptionError
from nanogs.fit.targets import Target, errors_of_splats, make_target
from nanogs.kernels.blocks import ALL_BLOCKS, FIELDS
from nanogs.method.correct import (
    LIT,
    TYPICAL,
    GroupErrors,
    Ordering,
    correct_errors,
    unseen_changes,
    usual_change,
)
from nanogs.method.cut import label_groups
from nanogs.pipeline import stages
from nanogs.pipeline.tasks import corrections
from nanogs.pipeline.tasks.corrections import summed_errors
from nanogs.raster.rendering import prepare
from reference_raster import render_reference
from test_kernels import random_forest
from test_refit import make_camera, make_splats

COUNT = 30


def random_ordering(seed, count=COUNT):
    """A random forest; the scores grow towards the roots, as logarithms of sums do."""
    children, rng = random_forest(count, seed), np.random.default_rng(seed)
    increments = rng.uniform(0.1, 1, len(children))
    errors = [
        increments[reference.merges_below(children, count + m, count)].sum()
        for m in range(len(children))
    ]
    return Ordering(children, np.log2(errors), rng.uniform(0.1, 2, count))


def typical_mean(sums, weights):
    typical = np.quantile(weights[weights > 0], TYPICAL)
    return (sums + sums.sum() / weights.sum() * typical) / (weights + typical)


def corrected_reference(ordering, labels, shown):
    """Compute the scores of `correct_errors`, node by node."""
    children, weights, count = ordering.children, ordering.weights, len(labels)
    leaves = [reference.leaves_below(children, count + m, count) for m in range(len(children))]
    groups = range(labels.max() + 1)
    own = {g: np.flatnonzero(labels == g).tolist() for g in groups}
    predicted = np.array([
        sum(2 ** ordering.scores[m] for m, below in enumerate(leaves) if sorted(below) == own[g])
        for g in groups
    ])  # fmt: skip
    of_groups = np.array([weights[own[g]].sum() for g in groups])
    ratios = typical_mean(shown.squared, shown.light) / typical_mean(predicted, of_groups)
    usual = shown.squared.sum() / shown.light.sum() / (predicted.sum() / of_groups.sum())
    lights = shown.light / shown.light.sum() / (of_groups / of_groups.sum())
    ratios = np.where(lights < LIT, usual, ratios)
    scores = []
    for m, below in enumerate(leaves):
        mean = (weights[below] * ratios[labels[below]]).sum() / weights[below].sum()
        under = [scores[child - count] for child in children[m] if child >= count]
        scores.append(max(ordering.scores[m] + np.log2(mean), *under, -np.inf))
    return np.array(scores)


@pytest.mark.parametrize("groups", [2, 9, 25])
def test_scores_equal_their_reference(groups):
    ordering, rng = random_ordering(groups), np.random.default_rng(groups)
    labels = label_groups(COUNT, ordering.children, ordering.scores, groups)
    shown = GroupErrors(rng.uniform(size=groups), rng.uniform(0.1, 1, groups))
    shown.light[0] = shown.squared[0] = 0  # no view shows this group
    found = correct_errors(ordering, labels, shown).scores
    expected = corrected_reference(ordering, labels, shown)
    # Only differences matter: predicted errors may have any common factor.
    np.testing.assert_allclose(found - found[0], expected - expected[0], atol=1e-12)


@given(st.integers(0, 10**6), st.integers(2, COUNT), st.floats(1e-6, 1e6))
def test_no_score_is_below_those_under_it(seed, groups, spread):
    ordering, rng = random_ordering(seed), np.random.default_rng(seed)
    labels = label_groups(COUNT, ordering.children, ordering.scores, groups)
    shown = GroupErrors(spread ** rng.normal(size=groups), spread ** rng.normal(size=groups))
    scores = correct_errors(ordering, labels, shown).scores
    assert np.isfinite(scores).all()
    for merge, pair in enumerate(ordering.children):
        assert all(scores[child - COUNT] <= scores[merge] for child in pair if child >= COUNT)
    for target in (2, groups, COUNT):
        assert label_groups(COUNT, ordering.children, scores, target).max() + 1 == target


def test_forests_that_no_view_shows_change_as_the_others_do():
    sums = np.array([[2.0, 4.0, 3.0, 6.0], [0.0, 0.0, 0.0, 0.0], [6.0, 4.0, 1.0, 2.0]])
    assert usual_change(sums) == pytest.approx(np.log2((8 / 8) / (4 / 8)))
    assert usual_change(np.zeros((2, 4))) == 0
    twice = sums * np.array([4.0, 1.0, 1.0, 1.0])
    change = usual_change(sums)
    assert unseen_changes([sums]).tolist() == [0, change, 0]
    assert unseen_changes([sums, twice]).tolist() == [0, pytest.approx(2 * change + 2), 0]
    twice[1] = 1  # a view shows it after all
    assert not unseen_changes([sums, twice]).any()


def test_errors_as_predicted_or_not_shown_change_no_order():
    ordering, groups = random_ordering(1), 9
    labels = label_groups(COUNT, ordering.children, ordering.scores, groups)
    weights, predicted = np.bincount(labels, ordering.weights), np.zeros(groups)
    for merge, score in enumerate(ordering.scores):
        below = reference.leaves_below(ordering.children, COUNT + merge, COUNT)
        if len(set(labels[below])) == 1:
            predicted[labels[below[0]]] = 2**score
    as_predicted = correct_errors(ordering, labels, GroupErrors(7 * predicted, 3 * weights)).scores
    np.testing.assert_allclose(np.diff(as_predicted - ordering.scores), 0, atol=1e-12)
    nothing, unknown = np.zeros(groups), np.full(groups, np.nan)
    for squared, light in ((nothing, nothing), (nothing, weights), (unknown, weights)):
        shown = GroupErrors(squared, light)
        assert correct_errors(ordering, labels, shown).scores.tolist() == ordering.scores.tolist()
    alone = np.arange(COUNT, dtype=np.int32)  # no merge was done, so no error was predicted
    shown = GroupErrors(np.ones(COUNT), np.ones(COUNT))
    assert correct_errors(ordering, alone, shown).scores.tolist() == ordering.scores.tolist()


def test_groups_with_larger_errors_than_predicted_are_divided():
    """Two equal halves of a scene; the errors in one of them are ten times as large."""
    half = random_ordering(2, 64)
    children = np.concatenate([
        np.where(half.children < 64, half.children, half.children + 64),
        np.where(half.children < 64, half.children + 64, half.children + 64 + len(half.children)),
    ]).astype(np.int32)  # fmt: skip
    scores = np.concatenate([half.scores, half.scores])
    ordering = Ordering(children, scores, np.concatenate([half.weights, half.weights]))
    labels = label_groups(128, children, scores, 32)
    before = [len(set(labels[part])) for part in (slice(64), slice(64, 128))]
    assert before == [16, 16]
    factors = np.where(np.arange(32) < 16, 10.0, 1.0)
    light = np.bincount(labels, ordering.weights)
    shown = GroupErrors(factors * light * 2 ** scores.mean(), light)
    found = label_groups(128, children, correct_errors(ordering, labels, shown).scores, 32)
    after = [len(set(found[part])) for part in (slice(64), slice(64, 128))]
    assert sum(after) == 32
    assert after[0] > 20


@pytest.mark.parametrize("blocks", [ALL_BLOCKS, FIELDS[0], FIELDS[1]])
@pytest.mark.parametrize("size", [(64, 48), (37, 21), (2, 30)])
@pytest.mark.parametrize("times", [1, 2])
def test_errors_of_splats_equal_their_reference(blocks, size, times):
    """The squared error over black and over white, where each splat shows; also at half size."""
    original, camera = make_splats(20, 3), make_camera(*size)
    changed = dataclasses.replace(original, sh=original.sh + np.float32(0.2))
    whole = make_target(prepare(original), camera, depth=False)
    target = make_target(prepare(original), camera, depth=False, wanted=blocks)
    found = errors_of_splats(prepare(changed), target, halved=times == 2)
    width, height = size[0] // times, size[1] // times
    small = camera.cropped(0, 0, times * width, times * height).resized(width, height)
    wanted = whole.image[: times * height, : times * width] / 255
    wanted = wanted.reshape(height, times, width, times, 4).mean(axis=(1, 3))
    color, alpha, _, _, sure = render_reference(changed, small)
    assert sure.mean() > 0.99
    over_black = wanted[..., :3] - np.minimum(color, 1)
    over_white = over_black - (wanted[..., 3:] - alpha[..., None])
    squared = ((over_black**2 + over_white**2) / 2).sum(axis=-1)
    rows, columns = np.indices((height, width)) * times // 4 % 4
    counted = (blocks >> (4 * rows + columns)) & 1
    expected = render_reference(changed, small, probes=np.stack([squared * counted, counted]))[3]
    assert counted.mean() > 0.4
    np.testing.assert_allclose(found, expected, rtol=0.02, atol=0.01 * expected.max())


def cloud(size):
    """Return splats of a size, scene units of some 8 pixels, and a view of them."""
    splats = make_splats(300, 3)
    scales = np.full_like(splats.log_scales, np.log(size))
    return dataclasses.replace(splats, log_scales=scales), make_camera(64, 48)


def test_errors_are_summed_at_full_size_where_half_shows_other_errors_than_those_of_merging():
    """A model against itself: the errors at half size are those of drawing small splats there."""
    splats, camera = cloud(size=0.004)
    prepared = prepare(splats)
    target, seen = make_target(prepared, camera, depth=False), []
    found = summed_errors(prepared, [target, target], seen.append)
    full, half = (errors_of_splats(prepared, target, halved=each) for each in (False, True))
    assert half[:, 0].sum() > 100 * full[:, 0].sum()
    assert np.array_equal(found, full + full)
    assert seen == [0, 1]


def test_errors_are_summed_at_half_size_where_they_are_as_large():
    original, camera = cloud(size=0.5)
    changed = prepare(dataclasses.replace(original, sh=original.sh + np.float32(0.2)))
    target = make_target(prepare(original), camera, depth=False)
    half = errors_of_splats(changed, target, halved=True)
    assert np.array_equal(summed_errors(changed, [target, target], lambda _: None), half + half)


@pytest.mark.parametrize(("half", "halved"), [(1.4, True), (1.6, False)])
def test_the_mean_error_in_the_first_view_decides_the_size_at_which_errors_are_summed(
    monkeypatch, half, halved
):
    """A view at half size has a quarter of the light, so sums would differ in any case."""

    def errors(drawn, means, *, halved):
        light = 0.25 if halved else 1.0
        return np.tile([light * means[halved], light], (len(drawn), 1))

    monkeypatch.setattr(corrections, "errors_of_splats", errors)
    drawn = prepare(random_splats(3))
    found = summed_errors(drawn, [(1.0, half), (1.0, 1e6 * half)], lambda _done: None)
    sums = [(0.25 * half * (1 + 1e6), 0.5)] if halved else [(2.0, 2.0)]
    np.testing.assert_allclose(found, np.tile(sums, (3, 1)))


@pytest.mark.parametrize("block", [None, 150])
def test_groups_get_their_own_errors_and_a_correction_follows_the_one_before(
    tmp_path, monkeypatch, block
):
    """Blocks are drawn among what surrounds them, as when they are measured."""
    surrounded, seen = [], []

    def sums(drawn, *_given):
        groups = scene_groups[-1]
        own = prepare(groups.grown(1.25)).means
        assert np.array_equal(drawn.means[: len(own)], own)
        surrounded.append(len(drawn) > len(own))
        rows = np.arange(len(drawn), dtype=np.float64)
        return np.column_stack((rows + 1, 2 * rows + 1))

    def merged(*given):
        scene_groups.append(groups_of(*given))
        return scene_groups[-1]

    def correcting(ordering, labels, shown):
        rows = scene_groups[-1].labels
        assert not np.array_equal(rows, np.sort(rows)), "labels should differ from rows"
        assert np.array_equal(shown.squared[rows], np.arange(len(rows)) + 1)
        assert np.array_equal(shown.light[rows], 2 * np.arange(len(rows)) + 1)
        seen.append((ordering.scores, correct_errors(ordering, labels, shown)))
        return seen[-1][1]

    scene_groups, groups_of = [], corrections.groups_of
    monkeypatch.setattr(corrections, "groups_of", merged)
    monkeypatch.setattr(corrections, "summed_errors", sums)
    monkeypatch.setattr(corrections, "correct_errors", correcting)
    monkeypatch.setattr(stages, "correction_is_promising", lambda *_given: True)
    monkeypatch.setattr("nanogs.pipeline.tasks.trials.quality", lambda *_given: next(better))
    better = itertools.count()  # each candidate is better than those before
    nanogs.save(random_splats(400, seed=3), tmp_path / "in.ply")
    given = {"ratio": 0.3, "views": 8, "view_size": 64, "steps": 0, "corrections": 2}
    nanogs.simplify_blocks(tmp_path / "in.ply", tmp_path / "out.ply", block=block, **given)
    blocks = len(seen) // 2
    assert (blocks > 1) == (block is not None)
    assert surrounded == [blocks > 1] * 2 * blocks
    for (_, first), (scores, _) in zip(seen[:blocks], seen[blocks:], strict=True):
        np.testing.assert_allclose(scores, first.scores, rtol=1e-6)


def test_a_view_of_one_row_tells_nothing():
    prepared = prepare(make_splats(20, 3))
    target = make_target(prepared, make_camera(40, 1), depth=False)
    assert not errors_of_splats(prepared, target, halved=True).any()


@pytest.mark.filterwarnings("error")
def test_colours_beyond_any_screen_give_the_error_that_a_screen_shows():
    """Black in place of white everywhere: an error of 1 over black in each of three channels."""
    splats, camera = make_splats(20, 4), make_camera(32, 32)
    black, bright = np.zeros((32, 32, 4), np.uint8), np.full_like(splats.sh, 3e38)
    target = Target(camera, black, np.inf)
    squared, light = errors_of_splats(
        prepare(dataclasses.replace(splats, sh=bright)), target, halved=True
    ).T
    assert light.max() > 1
    assert (squared <= 3 * light * (1 + 1e-5)).all()
    assert (squared > 1.5 * light * (1 - 1e-5)).all()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("copies", [5, 400])
@pytest.mark.parametrize("blocks", [False, True])
def test_merges_of_equal_splats_cost_nothing(tmp_path, copies, blocks):
    """Errors of next to nothing are neither infinite nor larger than others when corrected."""
    splats = random_splats(400 // copies, seed=3)
    splats = splats.take(np.repeat(np.arange(len(splats)), copies))
    given = {"count": 40, "views": 8, "view_size": 64, "steps": 0, "corrections": 3}
    if blocks:
        nanogs.save(splats, tmp_path / "in.ply")
        out = tmp_path / "out.ply"
        block = 150 if copies < 150 else 500  # splats in one place cannot be divided
        report = nanogs.simplify_blocks(tmp_path / "in.ply", out, block=block, **given)
        small = nanogs.load(out)
    else:
        small, report = nanogs.simplify(splats, **given)
    assert len(small) == 40
    assert all(np.isfinite(each.quality) for each in report.candidates)
    ordering = random_ordering(4)
    free = dataclasses.replace(ordering, scores=np.full(len(ordering.scores), -1022.0))
    labels = label_groups(COUNT, ordering.children, ordering.scores, 9)
    shown = GroupErrors(np.ones(9), np.ones(9))
    assert np.isfinite(correct_errors(free, labels, shown).scores).all()


def test_nothing_is_tried_if_there_is_nothing_to_compare():
    """The only view decides."""
    given = {"ratio": 0.1, "views": 1, "view_size": 64, "steps": 0}
    _, report = nanogs.simplify(random_splats(400, seed=3), **given)
    assert {each.corrections for each in report.candidates} == {0}


@pytest.mark.parametrize("corrections", [0, 1, 2])
def test_the_report_tells_which_cuts_were_corrected(corrections):
    splats = random_splats(400, seed=3)
    given = {"ratio": 0.1, "views": 8, "view_size": 64, "steps": 0, "corrections": corrections}
    small, report = nanogs.simplify(splats, **given)
    tried = [each.corrections for each in report.candidates if not each.reassigned]
    assert len(small) == 40
    assert tried[:2] == [0, 0]
    assert set(tried[2:]) <= set(range(corrections + 1))
    assert (max(tried) > 0) == (corrections > 0)
    cuts = [each for each in report.candidates if not each.reassigned and each.growth == 1.25]
    best = max(cuts, key=lambda each: each.quality)
    judged = next(each for each in report.candidates if each.reassigned)
    assert (judged.balance, judged.corrections) == (best.balance, best.corrections)


def test_corrections_are_limited():
    with pytest.raises(OptionError, match="corrections must be from 0 to 4"):
        nanogs.simplify(random_splats(20), ratio=0.5, corrections=5)

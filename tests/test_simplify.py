"""`nanogs.simplify` with each preset: difficult inputs first, then general properties.

Promises of `simplify` are tested with all presets; tests of the published method alone say so.
"""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

import nanogs
from builders import model_bytes, random_splats
from nanogs.activations import rotations
from nanogs.errors import ModelError, OptionError
from nanogs.method import match as match_stage
from nanogs.method.activation import scene_origin
from nanogs.method.paper import passes
from nanogs.method.paper.prune import prune
from nanogs.pipeline.options.presets import PRESETS
from nanogs.pipeline.options.target import target_count
from nanogs.report import StopReason
from nanogs.splats import ExtraElement, Splats

# The quality of renders and fits is not tested here, so small views will do.
pytestmark = pytest.mark.usefixtures("small_views")

every_preset = pytest.mark.parametrize("preset", PRESETS)
# Presets of which many examples can be run: the long fit of `best` takes too much time.
not_fitted = pytest.mark.parametrize("preset", ["default", "fast", "paper"])
QUICK = settings(max_examples=8)  # for each preset


def unpruned(preset):
    """Options with which no splat is pruned for its opacity."""
    return {"tau": 0} if preset == "paper" else {}


def unfitted(preset):
    """Options with which the result is not fitted, so that no splat moves after merging."""
    return {} if preset == "paper" else {"steps": 0}


def coincident_splats(count):
    """Splats that all have the same centre."""
    splats = random_splats(count, seed=1)
    splats.means[:] = splats.means[0]
    return splats


# Counts


@not_fitted
@pytest.mark.parametrize("ratio", [1, 0.99, 0.9, 0.5, 0.1, 0.01, 0.001, 1e-9])
def test_every_ratio_is_met_exactly(preset, ratio):
    splats = random_splats(1000)
    small, report = nanogs.simplify(splats, ratio=ratio, preset=preset)
    assert len(small) == report.achieved_count == math.ceil(ratio * 1000)
    assert report.stop == StopReason.TARGET


@not_fitted
@QUICK
@given(st.integers(1, 200), st.data())
def test_every_count_is_met_exactly(preset, n, data):
    count = data.draw(st.integers(1, n))
    small, report = nanogs.simplify(random_splats(n, seed=n), count=count, preset=preset)
    assert len(small) == report.achieved_count == count


def test_ratio_is_taken_as_the_decimal_number_given():
    assert math.ceil(0.07 * 100) == 8  # binary floating point alone would give this
    assert target_count(100, 0.07, None) == 7
    assert target_count(100, np.float32(0.07), None) == 7  # 0.07000000029802322 as a double


def test_pruning_stops_at_the_count_and_is_reported():
    splats = random_splats(100)
    splats.opacity_logits[:] = np.linspace(-8, -3, 100)
    small, report = nanogs.simplify(splats, ratio=0.9, preset="paper")
    assert len(small) == 90
    assert report.prune_limited
    assert report.pruned == 10
    assert np.array_equal(small.opacity_logits, splats.opacity_logits[10:])


def test_prune_keeps_alphas_from_the_smaller_of_tau_and_median_up():
    alphas = np.array([0.1, 0.0999, 0.5, 0.9, 0.2])
    assert prune(alphas, 0.1, 1).keep.tolist() == [0, 2, 3, 4]
    assert prune(np.array([0.01, 0.02, 0.03]), 0.1, 1).keep.tolist() == [1, 2]
    assert prune(np.array([0.3, 0.3, 0.3]), 0.1, 2).keep.tolist() == [0, 1, 2]


def test_limited_pruning_keeps_the_most_opaque_and_breaks_ties_by_row():
    pruning = prune(np.array([0.1, 0.1, 0.9, 0.8]), 0.5, 3)
    assert pruning.keep.tolist() == [0, 2, 3]
    assert pruning.limited
    enough = prune(np.array([0.01, 0.02, 0.03]), 0.1, 2)
    assert (enough.keep.tolist(), enough.limited) == ([1, 2], False)


@every_preset
def test_ratio_one_returns_the_same_bytes(preset):
    splats = random_splats(50, degree=3)
    small, report = nanogs.simplify(splats, ratio=1, preset=preset)
    assert model_bytes(small) == model_bytes(splats)
    assert report.passes == ()


@not_fitted
@pytest.mark.parametrize(
    ("ratio", "count", "message"),
    [(None, None, "exactly one of `ratio`"), (0.5, 5, "exactly one of `ratio`")]
    + [(bad, None, "ratio must be above 0") for bad in (0, -1, 1.01, math.nan, math.inf)]
    + [(None, bad, "count must be at least 1") for bad in (0, -1)]
    + [(None, 11, "count 11 is above the 10 usable splats of .*; ask for at most")],
)
def test_invalid_ratios_and_counts_are_refused(preset, ratio, count, message):
    with pytest.raises(OptionError, match=message):
        nanogs.simplify(random_splats(10), ratio=ratio, count=count, preset=preset)


@pytest.mark.parametrize(
    ("name", "value"),
    [("tau", -0.1), ("tau", 1.1), ("tau", math.nan), ("k", 0), ("samples", 0), ("seed", -1)]
    + [("lambda_geo", math.inf), ("lambda_app", -1), ("merge_cap", 0), ("merge_cap", 0.6)]
    + [("threads", 0), ("threads", 10_000)],
)
def test_parameters_of_paper_out_of_range_are_refused(name, value):
    with pytest.raises(OptionError, match=rf"^{name} must be .*, not {value}\.$"):
        nanogs.simplify(random_splats(10), ratio=0.5, preset="paper", **{name: value})


@pytest.mark.parametrize(
    ("override", "message"),
    [({"preset": "papr"}, "no preset 'papr'"), ({"k": 0}, "k must be 1 or more, not 0")]
    + [({name: 1}, f"default has no parameter '{name}'") for name in ("kk", "tau", "samples")]
    + [({"job": "x"}, r"no parameter 'job' \(nanogs\.simplify_blocks takes it\)")]
    + [({"filters": []}, r"no parameter 'filters' \(nanogs\.filters\.apply filters")]
    + [({"overwrite": True}, r"no parameter 'overwrite' \(nanogs\.save writes")],
)
def test_unknown_presets_and_parameters_are_refused(override, message):
    with pytest.raises(OptionError, match=message):
        nanogs.simplify(random_splats(10), ratio=0.5, **override)


# Difficult inputs


@every_preset
def test_one_splat_and_two_splats(preset):
    one, report = nanogs.simplify(random_splats(1), ratio=0.1, preset=preset)
    assert model_bytes(one) == model_bytes(random_splats(1))
    assert report.stop == StopReason.TARGET
    small, report = nanogs.simplify(random_splats(2), count=1, preset=preset, **unpruned(preset))
    assert len(small) == 1
    assert report.passes[0].merged == 1


@every_preset
def test_k_larger_than_the_count(preset):
    assert len(nanogs.simplify(random_splats(5), count=2, k=100, preset=preset)[0]) == 2


@not_fitted
@pytest.mark.parametrize("count", [2, 10, 40, 3000])
def test_coincident_centres_merge_down_to_one(preset, count):
    small, report = nanogs.simplify(coincident_splats(count), count=1, preset=preset)
    assert len(small) == 1
    assert report.stop == StopReason.TARGET


@pytest.mark.parametrize("preset", ["fast", "paper"])
def test_a_hundred_thousand_coincident_centres_finish(preset):
    """A k-d tree cannot split them: each query would visit all."""
    splats = coincident_splats(10).take(np.arange(100_000) % 10)
    assert len(nanogs.simplify(splats, ratio=0.1, preset=preset)[0]) == 10_000


@every_preset
@pytest.mark.parametrize("unit", [1e-12, 1e12])
def test_scenes_in_tiny_and_huge_units(preset, unit):
    splats = random_splats(60, spread=unit)
    small, report = nanogs.simplify(splats, count=7, preset=preset)
    assert len(small) == 7
    assert report.stop == StopReason.TARGET
    assert small.finite().all()
    assert np.isfinite(small.log_scales).all()


@every_preset
def test_zero_scales_and_zero_quaternions(preset):
    splats = random_splats(60)
    splats.log_scales[:30] = -np.inf
    splats.quats[20:40] = 0
    small, _ = nanogs.simplify(splats, count=5, preset=preset)
    assert len(small) == 5
    assert small.finite().all()
    points = splats.take(np.arange(4))
    points.means[:] = 1
    point, _ = nanogs.simplify(points, count=1, preset=preset)
    assert np.isfinite(point.log_scales).all()


def test_a_stray_does_not_move_the_origin():
    means = np.random.default_rng(0).normal(5, 1, (100_000, 3)).astype(np.float32)
    means[0], means[50_000:, 1] = 3e38, 7
    assert scene_origin(means) == pytest.approx([5, 7, 5], abs=0.5)


@every_preset
def test_outliers_a_million_extents_away_give_finite_results(preset):
    splats = random_splats(500)
    splats.means[:5] *= 1e6
    small, _ = nanogs.simplify(splats, count=50, preset=preset)
    assert small.finite().all()


@every_preset
@pytest.mark.parametrize("opacity", [np.inf, -np.inf])
def test_infinite_opacity_logits_are_valid_data(preset, opacity):
    splats = random_splats(40)
    splats.opacity_logits[:] = opacity
    small, report = nanogs.simplify(splats, count=4, preset=preset)
    assert report.dropped_nonfinite == 0
    assert len(small) == 4
    assert not np.isnan(small.opacity_logits).any()
    assert (small.opacities() > 1e-5).all() == (opacity > 0)


@not_fitted
@pytest.mark.parametrize(
    ("column", "value"),
    [*itertools.product(["means", "log_scales", "quats", "sh"], [np.nan, np.inf])]
    + [("opacity_logits", np.nan)],  # an infinite opacity logit is valid
)
def test_nonfinite_rows_are_dropped_and_reported(preset, column, value):
    splats = random_splats(50)
    array = getattr(splats, column).reshape(50, -1)
    array[7, 0] = value
    array[31, -1] = value
    small, report = nanogs.simplify(splats, count=5, preset=preset, **unpruned(preset))
    assert report.dropped_nonfinite == 2
    clean = splats.take(np.delete(np.arange(50), [7, 31]))
    same, _ = nanogs.simplify(clean, count=5, preset=preset, **unpruned(preset))
    assert model_bytes(small) == model_bytes(same)


@pytest.mark.parametrize("more", [{}, {"steps": 2, "views": 3, "view_size": 48}])
def test_a_level_of_all_splats_has_the_usable_rows_in_their_order(more):
    splats = random_splats(60)
    splats.means[7, 1] = np.nan
    (whole, _), (half, _) = nanogs.levels(splats, [1.0, 0.5], preset="fast", **more)
    assert model_bytes(whole) == model_bytes(splats.take(splats.finite()))
    assert len(half) == 30


@every_preset
def test_nonfinite_rows_are_refused_on_request(preset):
    splats = random_splats(50)
    splats.means[7] = np.nan
    with pytest.raises(ModelError, match="row 7"):
        nanogs.simplify(splats, count=5, nan="error", preset=preset)


@every_preset
def test_a_row_whose_scale_overflows_is_dropped(preset):
    splats = random_splats(20)
    splats.log_scales[3] = 1000
    assert nanogs.simplify(splats, count=5, preset=preset)[1].dropped_nonfinite == 1


@every_preset
def test_a_model_with_only_nan_opacities_is_refused(preset):
    splats = random_splats(20)
    splats.opacity_logits[:] = np.nan
    with pytest.raises(ModelError, match="No splat is usable"):
        nanogs.simplify(splats, ratio=0.5, preset=preset)


def test_nan_costs_end_the_loop_with_the_reason_in_the_report(monkeypatch):
    monkeypatch.setattr(
        passes, "pair_costs", lambda g, pairs, *_: np.full(len(pairs), np.nan, np.float32)
    )
    small, report = nanogs.simplify(random_splats(20), count=5, tau=0, preset="paper")
    assert report.stop == StopReason.NO_CANDIDATES
    assert report.passes[0].without_cost == report.passes[0].candidates > 0
    assert len(small) == 20


def test_a_pass_that_merges_nothing_ends_the_loop(monkeypatch):
    def match_nothing(pairs, costs, rows, limit):
        return match_stage.MergePlan(pairs[:0], costs[:0], 0)

    monkeypatch.setattr(passes, "match", match_nothing)
    assert (
        nanogs.simplify(random_splats(20), count=5, preset="paper")[1].stop
        == StopReason.NO_PROGRESS
    )


def test_the_report_has_the_number_of_reassignment_rounds():
    splats = random_splats(400, seed=5)
    reports = [
        nanogs.simplify(splats, count=80, preset="fast", rounds=rounds)[1] for rounds in (0, 1, 100)
    ]
    none, one, converged = (report.reassign_rounds for report in reports)
    assert (none, one) == (None, 1)
    assert 1 < converged < 100
    _, paper = nanogs.simplify(splats, count=80, preset="paper")
    assert paper.reassign_rounds is None
    _, whole = nanogs.simplify(splats, count=400, preset="fast")
    assert whole.reassign_rounds is None


def test_merge_cap_bounds_every_pass(monkeypatch):
    match, plans = passes.match, []
    monkeypatch.setattr(passes, "match", lambda *given: plans.append(match(*given)) or plans[-1])
    _, report = nanogs.simplify(random_splats(200), count=20, tau=0, merge_cap=0.1, preset="paper")
    assert len(report.passes) > 10
    assert all(p.merged <= max(1, p.count_before // 10) for p in report.passes)
    assert [each.highest_cost for each in report.passes] == [plan.costs.max() for plan in plans]
    _, report = nanogs.simplify(random_splats(5), count=1, tau=0, merge_cap=0.1, preset="paper")
    assert [one_pass.merged for one_pass in report.passes] == [1] * 4, "one is always merged"


def test_random_neighbours_follow_the_seed():
    given = {"ratio": 0.8, "preset": "paper", "tau": 0, "graph": "random"}
    reports = [nanogs.simplify(random_splats(60), seed=seed, **given)[1] for seed in range(4)]
    assert len({report.passes[0].candidates for report in reports}) > 1


# Data that is passed through


@every_preset
def test_extra_columns_come_from_the_dominant_member(preset):
    splats = random_splats(
        2, extras={"label": np.array([7, 9], np.uint8), "id": np.array([2**53 + 1, 5])}
    )
    splats.log_scales[:] = [[-3] * 3, [-1] * 3]
    splats.opacity_logits[:] = 2
    small, _ = nanogs.simplify(splats, count=1, preset=preset)
    assert small.extras["label"].tolist() == [9]
    assert small.extras["label"].dtype == np.uint8
    assert small.extras["id"].tolist() == [5]


@every_preset
def test_render_mode_comments_and_elements_are_kept(preset):
    element = ExtraElement("camera", np.array([(1.5,)], dtype=[("fx", "f4")]))
    base = random_splats(20)
    splats = Splats(
        base.means, base.log_scales, base.quats, base.opacity_logits, base.sh,
        render_mode=nanogs.RenderMode.MIP, comments=("by me",), elements=(element,),
    )  # fmt: skip
    small, _ = nanogs.simplify(splats, count=5, preset=preset)
    assert small.render_mode == nanogs.RenderMode.MIP
    assert small.comments == ("by me",)
    assert small.elements == (element,)


@every_preset
def test_the_third_axis_of_flat_splats_stays_the_normal_of_their_plane(preset):
    """As a renderer of 2DGS takes it; here it is the x axis of the scene."""
    splats = random_splats(200, degree=0, seed=6)
    splats.means[:, 0] = 0
    splats.log_scales[:] += (0.0, 0.0, -6.0)
    splats.quats[:] = (1, 0, 1, 0)
    flat = dataclasses.replace(splats, render_mode="2dgs")
    small, _ = nanogs.simplify(flat, count=20, preset=preset)
    assert small.render_mode == "2dgs"
    normals = rotations(small.unit_quats().astype(np.float64))[:, :, 2]
    assert np.abs(normals[:, 0]).min() > 0.99


@every_preset
def test_an_element_with_a_row_for_each_splat_is_refused(preset):
    base = random_splats(20)
    element = ExtraElement("sh8", np.zeros(20, dtype=[("a", "u1")]))
    splats = Splats(
        base.means, base.log_scales, base.quats, base.opacity_logits, base.sh, elements=(element,)
    )
    with pytest.raises(ModelError, match="sh8"):
        nanogs.simplify(splats, count=5, preset=preset)
    with pytest.raises(ModelError, match="sh8"):
        nanogs.levels(splats, [1, 0.5], preset=preset)


@not_fitted
def test_rows_that_were_not_merged_keep_their_bytes_and_order(preset):
    splats = random_splats(300, extras={"row": np.arange(300)})
    options = unpruned(preset) | unfitted(preset)
    small, _ = nanogs.simplify(splats, ratio=0.9, preset=preset, **options)
    rows = small.extras["row"]
    assert (np.diff(rows) > 0).all()
    same = [model_bytes(small.take(np.array([i]))) == model_bytes(splats.take(np.array([row])))
            for i, row in enumerate(rows)]  # fmt: skip
    # 30 merges of pairs leave 240 rows unmerged; with larger groups, more are left.
    assert 240 <= sum(same) < 270
    assert preset != "paper" or sum(same) == 240


@every_preset
def test_the_input_is_not_changed(preset):
    splats = random_splats(100)
    before = model_bytes(splats)
    nanogs.simplify(splats, ratio=0.1, preset=preset)
    assert model_bytes(splats) == before


@every_preset
def test_float64_centres_keep_their_precision_far_from_the_origin(preset):
    base = random_splats(100)
    far = np.array([5e6, -3e6, 100.0])
    splats = Splats(
        base.means.astype(np.float64) + far,
        base.log_scales,
        base.quats,
        base.opacity_logits,
        base.sh,
    )
    small, _ = nanogs.simplify(splats, count=20, preset=preset)
    near, _ = nanogs.simplify(base, count=20, preset=preset)
    assert small.means.dtype == np.float64
    assert np.allclose(small.means - far, near.means, atol=1e-6)


# Properties


@not_fitted
@QUICK
@given(st.integers(2, 120), st.floats(0.01, 1), st.integers(0, 3), st.integers(0, 2**31))
def test_results_are_valid_models(preset, n, ratio, degree, seed):
    splats = random_splats(n, degree=degree, seed=seed)
    small, _ = nanogs.simplify(splats, ratio=ratio, preset=preset)
    assert small.finite().all()
    assert np.isfinite(small.log_scales).all()
    assert small.sh_degree == degree
    lengths = np.linalg.norm(small.unit_quats(), axis=1)
    assert np.allclose(lengths, 1, atol=1e-6)
    assert ((small.opacities() >= 0) & (small.opacities() <= 1)).all()


@not_fitted
@QUICK
@given(st.integers(5, 60), st.integers(0, 2**31))
def test_centres_stay_inside_the_hull_of_the_input(preset, n, seed):
    splats = random_splats(n, seed=seed)
    options = unpruned(preset) | unfitted(preset)
    small, _ = nanogs.simplify(splats, ratio=0.2, preset=preset, **options)
    planes = ConvexHull(splats.means.astype(np.float64)).equations
    assert (small.means @ planes[:, :3].T + planes[:, 3] <= 1e-5).all()


@given(st.integers(0, 2**31))
def test_means_of_centre_and_colour_weighted_by_mass_are_preserved_by_one_merge(seed):
    splats = random_splats(2, seed=seed)
    splats.log_scales[:] = np.clip(splats.log_scales, -4, 0)
    small, _ = nanogs.simplify(splats, count=1, tau=0, preset="paper")
    masses = splats.opacities() * np.prod(splats.scales().astype(np.float64), axis=1)
    shares = masses / masses.sum()
    assert np.allclose(small.means[0], shares @ splats.means, atol=1e-5)
    assert np.allclose(small.sh[0], np.tensordot(shares, splats.sh, 1), atol=1e-5)


@given(st.integers(10, 100), st.integers(0, 2**31), st.sampled_from([4.0, -64.0, 1024.0]))
def test_moving_the_scene_moves_the_result(n, seed, offset):
    splats = random_splats(n, seed=seed)
    # Multiples of 2^-10 keep every digit of these centres when moved, in single precision too.
    splats.means[:] = np.round(splats.means * 1024) / 1024
    moved = splats.take(np.arange(n))
    moved.means[:] += np.float32(offset)
    small, report = nanogs.simplify(splats, ratio=0.3, preset="paper")
    small_moved, report_moved = nanogs.simplify(moved, ratio=0.3, preset="paper")
    assert [p.merged for p in report.passes] == [p.merged for p in report_moved.passes]
    assert np.allclose(small_moved.means - np.float32(offset), small.means, atol=1e-3)
    assert np.allclose(small_moved.sh, small.sh, atol=1e-6)


@every_preset
@pytest.mark.parametrize("degree", [0, 3])
def test_the_same_bytes_for_one_and_two_threads(preset, degree):
    import numba

    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("this machine has one core")
    splats = random_splats(5000, degree=degree)
    one, two = (nanogs.simplify(splats, ratio=0.1, threads=t, preset=preset)[0] for t in (1, 2))
    assert model_bytes(one) == model_bytes(two)


@every_preset
def test_the_same_bytes_again(preset):
    splats = random_splats(2000)
    first, second = (nanogs.simplify(splats, ratio=0.1, preset=preset)[0] for _ in range(2))
    assert model_bytes(first) == model_bytes(second)


def test_the_merges_of_a_small_scene_are_pinned():
    """The rows that the first pass merges are fixed: only a change of the method changes them."""
    means = np.array([[0, 0, 0], [1, 0, 0], [10, 0, 0], [11.5, 0, 0], [30, 0, 0]])
    splats = Splats(
        means=means.astype(np.float32),
        log_scales=np.full((5, 3), -1.0, np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (5, 1)),
        opacity_logits=np.full(5, 2.0, np.float32),
        sh=np.zeros((5, 1, 3), np.float32),
        extras={"row": np.arange(5)},
    )
    small, report = nanogs.simplify(splats, count=3, k=2, samples=16, preset="paper")
    assert small.extras["row"].tolist() == [0, 2, 4]
    assert np.allclose(small.means[:, 0], [0.5, 10.75, 30])
    assert [p.merged for p in report.passes] == [2]


def test_a_result_that_the_fit_cannot_improve_is_returned_unchanged():
    """The fit can hardly make one splat look like two; one splat must be returned all the same."""
    best, report = nanogs.simplify(random_splats(2), count=1, preset="best")
    assert len(best) == 1
    unfitted, _ = nanogs.simplify(random_splats(2), count=1, preset="best", steps=0)
    assert not report.fit.improved
    assert any("was not changed" in note for note in report.fit.notes)
    assert model_bytes(best) == model_bytes(unfitted)

"""Rounding by rate and distortion: kernels, the values of formats, and files that are smaller."""

from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import nanogs
from builders import cloud_pair, random_splats
from nanogs import io
from nanogs.clock import StageClock
from nanogs.fit.descent import TYPICAL, Descent
from nanogs.fit.parameters import RefitParameters
from nanogs.fit.targets import Fitting, make_target
from nanogs.io import registry
from nanogs.io.rate_distortion import (
    FARTHEST_LOGIT,
    MOST_COLOUR,
    MOST_LOGIT,
    MOST_TURN,
    Curvatures,
    rounded,
)
from nanogs.io.rotations import minimise_rotation, rotations_between, with_w
from nanogs.kernels.rate_distortion import cheapest_levels, cheapest_rotations
from nanogs.pipeline.options.settings import SearchTarget
from nanogs.pipeline.outcome import Outcome
from nanogs.pipeline.search.coarseness import COARSEST, FINER, FINEST, fill_by_rounding
from nanogs.pipeline.search.files import HeldFiles
from nanogs.pipeline.search.in_blocks import JobFiles
from nanogs.pipeline.search.job_results import Result
from nanogs.pipeline.tasks.parts import columns_of_curvatures, read_curvatures
from nanogs.raster.rendering import prepare
from nanogs.report import StopReason
from nanogs.source import InMemory
from nanogs.splats import RenderMode
from nanogs.store.columns import columns_of, count_of
from nanogs.store.scratch import FolderScratch
from nanogs.store.tables import write_table
from nanogs.views.automatic import automatic_cameras
from reference_kernels import cheapest_level, cheapest_rotation, rotation_between

FORMATS = [("a.sog", bits) for bits in range(4, 9)] + [("a.spz", bits) for bits in range(4, 9)]

LOOKS = {"views": 2, "view_size": 48, "around": 0, "further": 2, "steps": 4, "sh_degree": 0}
LONGER = LOOKS | {"further": 18, "steps": 20}


def curvatures_of(count, seed=0):
    """Curvatures of which most are small and a few large, as those of scenes."""
    rng = np.random.default_rng(seed)

    def some(*shape):
        return np.exp(rng.normal(0, 2.5, shape)).astype(np.float32)

    values = some(count, 3), 10 * some(count, 3), some(count), some(count)
    return Curvatures(1e-3 * some(count, 3), *values)


def without_curvature(count):
    """Curvatures of splats that show nowhere."""
    given = curvatures_of(count)
    return Curvatures(**{each.name: 0 * getattr(given, each.name) for each in fields(Curvatures)})


def model_of(count=3000, seed=0):
    model = random_splats(count, degree=0, seed=seed)
    model.sh[:] *= 0.5
    model.log_scales[:] = np.clip(model.log_scales, -9, 5)
    return model


def reordered(model):
    """Quaternions of rotations that are as small as possible, and (N, 3) which axis is which."""
    axes = np.tile(np.arange(3, dtype=np.float32), (len(model), 1))
    quats, order = minimise_rotation(replace(model, log_scales=axes))
    return quats, order.astype(int)


def quantisation_of(model, path, **options):
    return registry.writable(Path(path)).quantisation(model, options)


@given(st.integers(0, 2**32 - 1), st.integers(1, 30))
def test_the_cheapest_level_is_chosen(seed, count):
    rng = np.random.default_rng(seed)
    levels = np.sort(rng.normal(size=count))
    values, curvatures = rng.normal(size=20), rng.exponential(size=20).astype(np.float32)
    lengths, price, most = rng.uniform(1, 12, count), rng.exponential(0.05), rng.exponential(0.5)
    codes = np.abs(values[:, None] - levels).argmin(axis=1).astype(np.int32)
    cheapest_levels(values, curvatures, levels, lengths, price, most, codes)
    expected = [
        cheapest_level(value, float(curvature), levels, lengths, price, most)
        for value, curvature in zip(values, curvatures, strict=True)
    ]
    assert codes.tolist() == expected


def test_the_cheapest_rotations_are_those_of_a_plain_search():
    rng = np.random.default_rng(3)
    xyz = rng.uniform(-0.38, 0.38, (200, 3))
    quats = np.column_stack([np.sqrt(1 - (xyz**2).sum(axis=1)), xyz])
    levels, curvatures = np.linspace(-0.7, 0.7, 36), rng.exponential(size=(200, 3))
    lengths = rng.uniform(1, 9, (3, 36))
    start = np.abs(xyz[:, :, None] - levels).argmin(axis=2).astype(np.int32)
    codes = start.copy()
    given_ = curvatures.astype(np.float32)
    cheapest_rotations(quats, given_, levels, lengths, 0.004, 0.25, codes)
    expected = [
        cheapest_rotation(quat, curvature.astype(float), levels, lengths, 0.004, 0.25, begun)
        for quat, curvature, begun in zip(quats, given_, start, strict=True)
    ]
    assert codes.tolist() == expected
    assert 0.2 < (codes != start).any(axis=1).mean() < 1


def test_small_rotations_between_quaternions_are_about_the_own_axes():
    rng = np.random.default_rng(0)
    first = Rotation.random(50, random_state=1)
    turns = rng.normal(0, 1e-4, (50, 3))
    second = first * Rotation.from_rotvec(turns)
    one, other = (each.as_quat()[:, [3, 0, 1, 2]] for each in (first, second))
    other *= np.sign((one * other).sum(axis=1))[:, None]
    assert rotations_between(one, other) == pytest.approx(turns, abs=1e-9)
    assert rotation_between(one[0], other[0]) == pytest.approx(turns[0], abs=1e-9)


@pytest.mark.parametrize(("path", "bits"), FORMATS)
def test_rounded_values_are_those_of_the_file(tmp_path, path, bits):
    model = model_of()
    model.opacity_logits[:3] = -np.inf, np.inf, 9.0
    curvatures = curvatures_of(len(model))
    curvatures.centres[:] = 1e9  # so that no two centres become equal
    small = rounded(model, curvatures, quantisation_of(model, path, bits=bits))
    io.save(small, tmp_path / path, format_options={"bits": bits, "spare_bits": 0})
    found = io.load(tmp_path / path)
    order = cKDTree(small.means).query(found.means)[1]  # a file's rows have another order
    assert len(set(order)) == len(order)
    small = small.take(order)
    clipped = np.clip(found.opacity_logits, -FARTHEST_LOGIT, FARTHEST_LOGIT)
    ours = np.clip(small.opacity_logits, -FARTHEST_LOGIT, FARTHEST_LOGIT)
    assert clipped == pytest.approx(ours, abs=1e-5)
    assert found.means == pytest.approx(small.means, abs=1e-3)
    assert found.sh == pytest.approx(small.sh, abs=1e-6)
    if bits < 8 or path == "a.sog":
        # Of a rotation by 45 degrees the writer may find another description, with other axes.
        kept = np.flatnonzero((np.abs(found.log_scales - small.log_scales) < 1e-5).all(axis=1))
        assert len(kept) > 0.998 * len(small)
        small, found = small.take(kept), found.take(kept)
        assert found.unit_quats() == pytest.approx(small.unit_quats(), abs=1e-6)
    else:  # the axes and the rotations of .spz with 8 bits are as in the model
        assert np.sort(found.log_scales) == pytest.approx(np.sort(small.log_scales), abs=1e-6)
        assert small.quats.tobytes() == model.take(order).quats.tobytes()


@pytest.mark.parametrize(("path", "bits"), FORMATS)
def test_files_are_smaller_and_what_shows_hardly_changes(path, bits):
    model, curvatures = model_of(), curvatures_of(3000)
    options = {"bits": bits, "spare_bits": 2}
    sizes, errors = [], []
    plain = io.encoded_bytes(model, path, options)
    for coarseness in (0.5, 1.0, 2.0):
        small = io.economical(model, curvatures, path, options, coarseness)
        sizes.append(io.encoded_bytes(small, path, options))
        change = small.sh[:, 0].astype(float) - model.sh[:, 0]
        errors.append(float((curvatures.colours[:, None] * change**2).sum()))
        weight = curvatures.colours
        least, most = weight < np.quantile(weight, 0.1), weight > np.quantile(weight, 0.9)
        assert np.abs(change[least]).mean() > 1.5 * np.abs(change[most]).mean()
    assert plain > sizes[0] > sizes[1] > sizes[2]
    assert errors[0] < errors[1] < errors[2]
    assert sizes[1] < 0.97 * plain


def test_rotations_turn_little_and_covariances_stay():
    model = model_of(500)
    small = rounded(model, curvatures_of(500), quantisation_of(model, "a.sog", bits=7))
    turns = [
        Rotation.from_quat(each.unit_quats()[:, [1, 2, 3, 0]]).as_matrix()
        for each in (model, small)
    ]
    first, second = (
        np.einsum("nij,nj,nkj->nik", turn, np.exp(2.0 * each.log_scales.astype(float)), turn)
        for turn, each in zip(turns, (model, small), strict=True)
    )
    size = np.linalg.norm(first, axis=(1, 2))
    # Of a factor exp(0.6) in a variance, and a turn by MOST_TURN.
    assert (np.linalg.norm(first - second, axis=(1, 2)) / size).max() < np.expm1(0.6) + MOST_TURN


def test_values_that_a_format_cannot_hold_do_not_make_all_others_coarse():
    """A .spz holds log-scales from -10 on; the thin axes of real models may be far below."""
    model, curvatures = model_of(), curvatures_of(3000)
    levels = quantisation_of(model, "a.spz", bits=7)
    plain = rounded(model, curvatures, levels)
    flat = replace(model, log_scales=model.log_scales.copy())
    flat.log_scales[::2, 2] = -16
    small = rounded(flat, curvatures, levels)
    assert (small.log_scales[::2] == -10).any(axis=1).all()
    changes = [np.abs(each.sh - model.sh).mean() for each in (plain, small)]
    assert changes[1] == pytest.approx(changes[0], rel=0.05)


def test_surfels_keep_their_rotations():
    model = replace(model_of(200), render_mode=RenderMode.SURFEL)
    small = rounded(model, curvatures_of(200), quantisation_of(model, "a.sog", bits=6))
    assert small.quats.tobytes() == model.quats.tobytes()
    assert (small.log_scales != model.log_scales).any()


def test_formats_without_levels_leave_models_as_they_are():
    model = model_of(50)
    assert io.economical(model, curvatures_of(50), "a.ply", {}) is model


def test_nothing_moves_where_nothing_shows():
    """Without any curvature no value is better than another, so the nearest are taken."""
    model = model_of(400)
    levels = quantisation_of(model, "a.spz", bits=7)
    small = rounded(model, without_curvature(400), levels)
    nearest = levels.colours[np.abs(model.sh[..., None] - levels.colours).argmin(axis=-1)]
    assert (small.sh == nearest).all()
    assert small.means is model.means


def test_values_that_are_not_finite_stay_and_others_are_rounded_as_without_them():
    model, curvatures = model_of(), curvatures_of(3000)
    levels = quantisation_of(model, "a.spz", bits=7)
    plain = rounded(model, curvatures, levels)
    odd = replace(model, opacity_logits=model.opacity_logits.copy(), sh=model.sh.copy())
    odd.opacity_logits[:2] = -np.inf, np.inf
    odd.sh[2, 0, 1] = np.nan
    small = rounded(odd, curvatures, levels)
    assert small.opacity_logits[:2].tolist() == [-np.inf, np.inf]
    assert np.flatnonzero(np.isnan(small.sh)).tolist() == [2 * 3 + 1]
    assert (small.opacity_logits[2:] != plain.opacity_logits[2:]).mean() < 0.05
    assert (small.sh[3:] != plain.sh[3:]).mean() < 0.05


def test_values_change_at_most_by_their_limits():
    """A curvature tells nothing of a picture far away, so that a cheap code may be too far."""
    model, curvatures = model_of(), without_curvature(3000)
    model.opacity_logits[:] = np.clip(model.opacity_logits, -5, 5)
    curvatures.log_scales[:] = 1  # so that a bit has a price
    small = rounded(model, curvatures, quantisation_of(model, "a.sog", bits=8))
    turns = rotations_between(reordered(model)[0], small.quats.astype(float))
    changes = [
        (small.opacity_logits.astype(float) - model.opacity_logits, MOST_LOGIT),
        (small.sh.astype(float) - model.sh, MOST_COLOUR),
        (np.linalg.norm(turns, axis=1), MOST_TURN + 1e-6),
    ]
    for change, most in changes:
        assert 0.9 * most < np.abs(change).max() <= most


def test_curvatures_follow_the_axes_where_these_get_another_order():
    model, curvatures = model_of(), without_curvature(3000)
    curvatures.log_scales[:, 0] = curvatures.rotations[:, 0] = 1
    small = rounded(model, curvatures, quantisation_of(model, "a.sog", bits=6))
    quats, order = reordered(model)
    changes = small.log_scales - np.take_along_axis(model.log_scales, order, axis=1)
    turns = rotations_between(quats, small.quats.astype(float))
    for change in np.abs([changes, turns]):
        assert change[order == 0].mean() < 0.5 * change[order != 0].mean()


# Centres.


@pytest.mark.parametrize("path", ["a.sog", "a.spz"])
@pytest.mark.parametrize("spare", [0, 3])
def test_centres_get_every_second_code_if_they_hardly_show(tmp_path, path, spare):
    """The file has the rounded centres, and takes fewer bytes."""
    model, options = model_of(), {"bits": 7, "spare_bits": spare}
    levels, taken = quantisation_of(model, path, **options), []
    usual, coarser = levels.centres
    away = [np.abs(each.astype(float) - model.means).max() for each in levels.centres]
    assert away[1] == pytest.approx(2 * away[0], rel=0.1)
    curvatures = curvatures_of(3000)
    # The error that the other step adds, for each coordinate.
    added = np.diff(errors_of_centres(model, curvatures, levels))[0] / model.means.size
    worth = price_of(model, curvatures, levels) / added
    for factor, expected in ((1.05, None), (0.95, coarser)):
        shown = replace(curvatures, centres=np.float32(factor * worth) * curvatures.centres)
        small = rounded(model, shown, levels)
        if expected is None:
            assert small.means is model.means
        else:
            assert np.array_equal(small.means, expected)
        io.save(small, tmp_path / path, overwrite=True, format_options=options)
        found = np.sort(io.load(tmp_path / path).means, axis=0)
        wanted = np.sort(usual if expected is None else expected, axis=0)
        assert np.abs(found - wanted).max() < 0.1 * away[0]
        taken.append((tmp_path / path).stat().st_size)
    share = 0.9 if path == "a.sog" else 0.4  # gzip packs repetitions, which zeros do not make
    assert taken[1] < taken[0] - share * 3 * len(model) / 8
    for coarseness, kept in ((1.1, False), (0.9, True)):
        shown = replace(curvatures, centres=np.float32(worth) * curvatures.centres)
        assert (rounded(model, shown, levels, coarseness).means is model.means) is kept


def errors_of_centres(model, curvatures, levels):
    """The errors of both ways of rounding centres."""
    axes = Rotation.from_quat(model.unit_quats()[:, [1, 2, 3, 0]]).as_matrix()
    errors = []
    for centres in levels.centres:
        changes = centres.astype(float) - model.means
        shifts = np.einsum("nij,ni->nj", axes, changes) / np.exp(model.log_scales.astype(float))
        errors.append((curvatures.centres * np.minimum(shifts**2, 4)).sum())
    return errors


def price_of(model, curvatures, levels):
    """The error that a bit saves, from the errors of rounding all other values to the nearest."""
    quats, order = reordered(model)
    turned = with_w(nearest_of(quats[:, 1:], levels.rotations))
    shown = np.take_along_axis(curvatures.rotations, order, axis=1)
    errors = [shown * rotations_between(quats, turned) ** 2]
    logits = np.clip(levels.logits, -FARTHEST_LOGIT, FARTHEST_LOGIT)
    for values, curvature, some in (
        (model.log_scales, curvatures.log_scales, levels.log_scales),
        (model.opacity_logits, curvatures.logits, logits),
        (model.sh[:, 0], curvatures.colours[:, None], levels.colours),
    ):
        inside = (values >= some[0]) & (values <= some[-1])
        change = np.where(inside, nearest_of(values, some) - values.astype(float), 0)
        errors.append(curvature * change**2)
    total = sum(float(each.sum()) for each in errors)
    return 2 * np.log(2) * total / sum(each.size for each in errors)


def nearest_of(values, levels):
    return levels[np.abs(values[..., None] - levels).argmin(axis=-1)]


@pytest.mark.parametrize("log_scale", [-60, -200])
def test_one_tiny_splat_does_not_keep_all_centres_fine(log_scale):
    """Its error is limited: once it is beside itself, moving on changes nothing more."""
    model, curvatures = model_of(), curvatures_of(3000)
    curvatures.centres[:] = 0
    curvatures.centres[0] = 1e-3
    model.log_scales[0] = log_scale
    levels = quantisation_of(model, "a.spz", bits=7, spare_bits=0)
    assert np.array_equal(rounded(model, curvatures, levels).means, levels.centres[1])


def test_centres_that_are_not_finite_are_left_to_the_writer():
    model = model_of(50)
    model.means[3, 1] = np.nan
    shown = curvatures_of(50)
    levels = quantisation_of(model_of(50), "a.spz", bits=7)
    coarser = np.zeros_like(model.means)
    assert rounded(model, shown, levels._replace(centres=(model.means, coarser))).means is (
        model.means
    )


def test_the_ends_of_the_grid_of_sog_stay():
    """Without them all other centres would be at other codes."""
    model = model_of(500)
    for found in quantisation_of(model, "a.sog", bits=5, spare_bits=1).centres:
        for end in (np.min, np.max):
            assert (end(found, axis=0) == end(model.means, axis=0)).all()


# The search for a coarseness.


def test_a_size_is_filled_by_rounding():
    tried = []

    def packed(coarseness):
        tried.append(coarseness)
        return coarseness, round(1000 * coarseness**-0.04)

    for size in (1020, 1000, 990, 985):
        tried.clear()
        found, size_found = fill_by_rounding(packed, size)
        assert 0.98 * size <= size_found <= size
        assert found == tried[-1]
        assert tried[0] == 1.0
        assert len(tried) <= 4
    tried.clear()
    assert fill_by_rounding(packed, 1015) == (1.0, 1000)  # full enough
    assert tried == [1.0]
    for size in (900, 1040):  # out of reach: the count has to change
        tried.clear()
        assert fill_by_rounding(packed, size) == (1.0, 1000)
        assert max(tried) <= COARSEST
        assert min(tried) >= FINER
        assert len(tried) == 2


def test_a_size_that_does_not_depend_on_rounding_ends_the_search():
    tried = []

    def packed(coarseness):
        tried.append(coarseness)
        return coarseness, 1000

    assert fill_by_rounding(packed, 995) == (1.0, 1000)
    assert len(tried) <= 3


def test_a_coarseness_follows_from_how_the_size_has_changed_before():
    """At first twice too far, because files change twice as fast as usual."""
    tried = []

    def packed(coarseness):
        tried.append(coarseness)
        return coarseness, round(1000 * coarseness**-0.1)

    found, size = fill_by_rounding(packed, 1100, FINEST)
    assert (found, size) == (tried[-1], pytest.approx(0.993 * 1100, abs=1))
    assert len(tried) == 3


@pytest.mark.parametrize(("last", "expected"), [(1090, 4), (1040, 0)])
def test_a_result_is_rounded_five_times_at_most(last, expected):
    sizes, tried = iter([1000, 1200, 960, 1150, last]), []

    def packed(coarseness):
        tried.append((coarseness, next(sizes)))
        return tried[-1]

    assert fill_by_rounding(packed, 1100, FINEST) == tried[expected]
    assert len(tried) == 5


# Curvatures of a fit.


def descent_of(count=400, steps=6, views=6):
    original, small = cloud_pair(count)
    cameras = automatic_cameras(original, views, width=64, height=64)
    targets = [make_target(prepare(original), camera) for camera in cameras]
    descent = Descent(small, Fitting(targets), RefitParameters(views=views, steps=steps))
    for step in range(steps):
        descent.step(1.0, step / steps)
    return descent


def test_curvatures_are_means_over_views_and_typical_where_nothing_is_seen():
    descent = descent_of()
    descent._seen[:2] = 0, 3
    found, diagonal = descent.curvatures(), [row * (row + 3) // 2 for row in range(10)]
    blocks = descent._hessians[:, diagonal].astype(float)
    typical = np.median(blocks[descent._seen > 0], axis=0)
    for name, columns, factor in (
        ("log_scales", slice(3, 6), 1), ("rotations", slice(6, 9), 1), ("logits", 9, 2)
    ):  # fmt: skip
        values = getattr(found, name)
        rest = TYPICAL * typical[columns]
        assert values[0] == pytest.approx(factor * rest / (6 + TYPICAL), rel=1e-5)
        seen = 3 * blocks[1, columns] + rest
        assert values[1] == pytest.approx(factor * seen / (6 + TYPICAL), rel=1e-5)
    assert not found.centres[0].any()
    assert found.centres[1] == pytest.approx(
        2 * 3 * descent._hessians[1, diagonal[:3]].astype(float) / 6, rel=1e-5
    )
    weights = descent._weights.astype(float)
    typical = np.median(weights[descent._seen > 0])
    expected = 3 * 0.28209479**2 * (3 * weights[1] + TYPICAL * typical) / (6 + TYPICAL)
    assert found.colours[1] == pytest.approx(expected, rel=1e-5)
    assert found.colours.shape == (len(weights),)


def test_a_descent_that_saw_nothing_knows_no_curvature():
    descent = descent_of(steps=1)
    descent._seen[:] = 0
    assert not descent.curvatures().log_scales.any()


# Files of a size.


def fitted_outcome():
    descent = descent_of()
    return Outcome(descent.splats, (), StopReason.TARGET, curvatures=descent.curvatures())


def files_of(outcome, path="a.sog", frame=None):
    return HeldFiles(Path(path), {}, outcome.splats, StageClock(), frame)


@pytest.mark.parametrize("frame", [None, ("rdf", "rub")])
@pytest.mark.parametrize("path", ["a.sog", "a.spz"])
def test_a_result_is_rounded_as_its_file_is(path, frame):
    outcome = fitted_outcome()
    files, options = files_of(outcome, path, frame), {"bits": 6}
    small = files.rounded(outcome, options)
    assert small.curvatures is None
    assert files.bytes_of(outcome, options) == files.bytes_of(small, options)
    plain = files.bytes_of(replace(outcome, curvatures=None), options)
    assert files.bytes_of(outcome, options) < plain
    size = files.bytes_of(outcome, options) - 10  # in reach: small files are mostly headers
    assert files.bytes_of(outcome, options) > size >= files.bytes_of(outcome, options, size)
    assert files.bytes_of(outcome, options, size) >= 0.98 * size
    filled, taken = files.filled(outcome, options, size)
    assert (
        files.bytes_of(filled, options) == files.bytes_of(outcome, options, size) == taken <= size
    )


def test_results_are_compared_with_the_nearest_values():
    outcome = fitted_outcome()
    files, options = files_of(outcome), {"bits": 5, "spare_bits": 2}
    plain = replace(outcome, curvatures=None)
    assert files.measure(outcome, 1, options) == files.measure(plain, 1, options)


def test_a_size_holds_more_splats_than_with_the_nearest_values(monkeypatch, tmp_path):
    original, _ = cloud_pair(3000)
    given_ = {"size": 9000, "format": ".sog", "sh_degree": 0, "steps": 6}
    small, report = nanogs.simplify(original, **given_)
    nanogs.save(small, tmp_path / "a.sog", format_options=report.format_options)
    assert 0.98 * 9000 <= (tmp_path / "a.sog").stat().st_size == report.achieved_size <= 9000
    found = nanogs.load(tmp_path / "a.sog")
    assert np.isin(np.unique(small.log_scales), np.unique(found.log_scales)).all()
    monkeypatch.setattr("nanogs.pipeline.rounded.economical", lambda model, *_: model)
    plain, _ = nanogs.simplify(original, **given_)
    assert len(small) > 1.03 * len(plain)


@pytest.mark.parametrize("path", ["a.sog", "a.spz"])
def test_fitted_values_of_a_known_count_are_rounded_for_its_file(tmp_path, path):
    original, _ = cloud_pair(3000, degree=0)
    given_ = {"count": 600}
    small, report = nanogs.simplify(original, format=path[1:], **given_)
    plain, _ = nanogs.simplify(original, **given_)
    nanogs.save(small, tmp_path / path)
    nanogs.save(plain, tmp_path / f"plain{path[1:]}")
    taken = (tmp_path / path).stat().st_size
    assert taken < 0.97 * (tmp_path / f"plain{path[1:]}").stat().st_size
    ours, nearest = nanogs.compare(original, tmp_path / path, tmp_path / f"plain{path[1:]}").models
    assert ours.psnr == pytest.approx(nearest.psnr, abs=0.3)
    assert len(small) == len(plain) == report.achieved_count == 600
    assert np.array_equal(small.extras["label"], plain.extras["label"])
    assert report.seconds["encode"] > 0


@pytest.mark.parametrize("given_", [{"preset": "fast"}, {"steps": 19}, {"ratio": 1.0}])
def test_values_that_no_long_fit_has_measured_are_not_rounded_by_what_shows(given_):
    original, _ = cloud_pair(600, degree=0)
    given_ = {"ratio": 0.2} | given_
    small, _ = nanogs.simplify(original, format=".sog", **given_)
    plain, _ = nanogs.simplify(original, **given_)
    for name, column in columns_of(plain).items():
        assert np.array_equal(columns_of(small)[name], column), name


@pytest.mark.parametrize("block", [None, 1100])
@pytest.mark.parametrize("path", ["a.sog", "a.spz"])
def test_levels_are_rounded_as_single_files_are(scene, tmp_path, path, block):
    given_ = LONGER | {"measured": False, "block": block, "frame": ("rdf", "rub")}
    ratios = (0.5, 0.2)
    nanogs.write_levels(scene, tmp_path / "levels", ratios, suffix=path[1:], **given_)
    for number, ratio in enumerate(ratios):
        alone = tmp_path / f"{number}{path[1:]}"
        nanogs.simplify_blocks(scene, alone, ratio=ratio, finer=1.0, **given_)
        level = tmp_path / "levels" / f"level_{number}{path[1:]}"
        assert level.read_bytes() == alone.read_bytes()


# In blocks.


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "in.ply"
    nanogs.save(random_splats(3000, degree=0), path)
    return path


@pytest.mark.parametrize("path", ["a.sog", "a.spz"])
def test_a_size_holds_more_splats_in_blocks_too(scene, tmp_path, monkeypatch, path):
    given_ = LOOKS | {"size": 9000, "block": 1100}
    report = nanogs.simplify_blocks(scene, tmp_path / path, **given_)
    assert report.blocks.blocks > 1
    assert 0.98 * 9000 <= (tmp_path / path).stat().st_size == report.achieved_size <= 9000
    again = nanogs.simplify_blocks(
        scene, tmp_path / f"again{path[1:]}", job=tmp_path / "j", **given_
    )
    assert again.size_probes == report.size_probes
    assert (tmp_path / f"again{path[1:]}").read_bytes() == (tmp_path / path).read_bytes()
    monkeypatch.setattr("nanogs.pipeline.search.job_files.economical", lambda model, *_: model)
    plain = nanogs.simplify_blocks(scene, tmp_path / f"plain{path[1:]}", **given_)
    assert report.achieved_count > 1.02 * plain.achieved_count


@pytest.mark.parametrize("path", ["a.sog", "a.spz"])
def test_files_of_a_known_count_are_smaller_in_blocks_too(scene, tmp_path, monkeypatch, path):
    given_ = LONGER | {"count": 500, "block": 1100}

    def made(name):
        report = nanogs.simplify_blocks(scene, tmp_path / f"{name}{path[1:]}", **given_)
        assert report.achieved_count == 500
        assert report.blocks.blocks > 1
        return (tmp_path / f"{name}{path[1:]}").read_bytes()

    whole = made("whole")
    monkeypatch.setattr("nanogs.pipeline.job.result_writer.economical", lambda model, *_: model)
    nearest = made("nearest")
    assert len(whole) < 0.97 * len(nearest)
    monkeypatch.undo()
    monkeypatch.setattr("nanogs.pipeline.in_blocks.held_splats", lambda *_: 499)  # no room for it
    assert made("nearest2") == nearest


class Blocks:
    """A job of one level whose blocks are tables of a scratch."""

    def __init__(self, scratch, parts, target):
        self.scratch, self._target = scratch, target
        self.records = [
            write_table(scratch, f"fit-0-{number:05d}", columns, {})
            for number, columns in enumerate(parts)
        ]

    def delivered(self, _level):
        return self.records

    def delivered_count(self, _level):
        return sum(map(count_of, self.records))

    def target(self, _level):
        return self._target


def test_curvatures_of_blocks_are_read_in_order_and_typical_where_there_was_no_fit(tmp_path):
    scratch = FolderScratch(tmp_path)
    scratch.prepare()
    parts = [random_splats(count, degree=0, seed=count) for count in (5, 3, 4)]
    found = [curvatures_of(5, seed=1), None, curvatures_of(4, seed=2)]
    columns = [
        columns_of(part) | (columns_of_curvatures(each) if each else {})
        for part, each in zip(parts, found, strict=True)
    ]
    read = read_curvatures(Blocks(scratch, columns, 12), 0)
    for name in (each.name for each in fields(Curvatures)):
        first, last = getattr(found[0], name), getattr(found[2], name)
        values = getattr(read, name)
        assert np.array_equal(values[:5], first)
        assert np.array_equal(values[8:], last)
        typical = np.median(np.concatenate([first, last]), axis=0)
        assert values[5:8] == pytest.approx(np.stack([typical] * 3))
    assert read_curvatures(Blocks(scratch, columns, 11), 0) is None  # some were merged afterwards
    assert read_curvatures(Blocks(scratch, columns[1:2], 3), 0) is None


@pytest.mark.parametrize(
    ("path", "most", "is_rounded"),
    [("a.spz", None, True), ("a.spz", 5, True), ("a.spz", 4, False), ("a.ply", 5, False)],
)
def test_only_a_result_that_is_held_whole_is_rounded(tmp_path, path, most, is_rounded):
    scratch = FolderScratch(tmp_path)
    scratch.prepare()
    model, curvatures = random_splats(5, degree=0), curvatures_of(5)
    work = Blocks(scratch, [columns_of(model) | columns_of_curvatures(curvatures)], 5)
    work.settings = SimpleNamespace(search=SearchTarget(9000, None, ".spz", "{}", most=most))
    files = JobFiles(tmp_path / path, {}, tmp_path, None, work, StageClock())
    small = files.rounded(Result(work, 0), {"bits": 5})
    assert (files.curvatures(small) is not None) == is_rounded
    source = InMemory(model)
    assert (files.prepared(small, source) is not source) == is_rounded
    assert files.prepared(Result(work, 0), source) is source, "to the nearest values"

"""Colours fitted to views of the original: what a step may change, and when it is kept."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import nanogs
from builders import cloud_pair, model_bytes, random_splats
from nanogs.kernels.harmonics import C0
from nanogs.render.rasterize import prepare, render
from nanogs.render.views import automatic_cameras
from nanogs.simplify import recolour as stage
from nanogs.simplify import visibility
from nanogs.simplify.recolour import recolour

SOME = settings(max_examples=15, deadline=None)


@pytest.fixture(autouse=True)
def smaller_views(monkeypatch):
    monkeypatch.setattr(visibility, "SIZE", 64)


def error(small, views):
    """Mean squared error of the colours, over black by 3/4 and over white by 1/4."""
    prepared, total = prepare(small), 0.0
    for view in views:
        shown = render(prepared, view.camera)
        off = view.image - np.minimum(shown.color, 1)
        veil = (view.alpha - shown.alpha)[..., None]
        total += 0.75 * np.mean(off**2) + 0.25 * np.mean((off - veil) ** 2)
    return total / len(views)


def upright_cameras(original, count=12):
    """Views so near to each other that what one shows another one shows too."""
    return automatic_cameras(original, count, width=64, height=64, up=(0, -1, 0))


def pulls(small, views):
    return stage._pulls(small, views, lambda _done, _of: None, 0)


def step(small, merged, views):
    return stage._moved(small, merged, *pulls(small, views), stage.PRIORS[0])


def tinted(splats, seed=0, size=0.3):
    wrong = splats.sh.copy()
    wrong[:, 0] += np.random.default_rng(seed).normal(0, size, wrong[:, 0].shape)
    return dataclasses.replace(splats, sh=wrong)


@SOME
@given(st.integers(0, 1000), st.integers(2, 60))
def test_a_step_never_leaves_the_views_further_away(seed, count):
    """Colours within (0, 1), so that nothing is clipped: least squares without exceptions."""
    original = random_splats(count, degree=0, seed=seed)
    original.sh[:] = np.clip(original.sh, -0.4 / C0, 0.4 / C0)
    small = tinted(original.take(np.arange(0, count, 2)), seed, 0.05)
    small.sh[:] = np.clip(small.sh, -0.4 / C0, 0.4 / C0)
    views = visibility.look(original, count=2).all
    moved = step(small, np.ones(len(small), bool), views)
    assert error(moved, views) <= error(small, views) * (1 + 1e-4)


def test_a_lone_opaque_splat_gets_the_colour_it_should_show():
    original = random_splats(1, degree=0)
    original.opacity_logits[:] = 9
    original.sh[0, 0] = np.array([0.2, 0.5, 0.7]) / C0 - 0.5 / C0
    wrong = tinted(original)
    views = visibility.look(original, count=4).all
    moved = step(wrong, np.ones(1, bool), views)
    assert np.abs(wrong.sh - original.sh).max() > 0.03 / C0
    assert np.abs(moved.sh - original.sh).max() < 0.01 / C0


def test_only_mean_colours_of_merged_splats_change():
    original, small = cloud_pair()
    merged = np.random.default_rng(1).random(len(small)) < 0.5
    views = visibility.look(original, upright_cameras(original, 6))
    found, report = recolour(small, merged, views, visibility.judge(small, views))
    assert report.kept
    assert model_bytes(found.take(np.flatnonzero(~merged))) == model_bytes(
        small.take(np.flatnonzero(~merged))
    )
    assert (found.sh[merged, 0] != small.sh[merged, 0]).any(axis=1).mean() > 0.9
    found.sh[:, 0] = small.sh[:, 0]
    assert model_bytes(found) == model_bytes(small)


def test_what_it_gains_is_measured_on_views_it_has_not_seen():
    original, small = cloud_pair()
    views = visibility.look(original, upright_cameras(original, 6))
    everything = np.ones(len(small), bool)
    before = visibility.judge(small, views)
    found, report = recolour(small, everything, views, before)
    assert (report.psnr_before, report.ssim_before) == before
    first = step(small, everything, views.other)
    assert (report.psnr_after, report.ssim_after) == visibility.judge(first, views)
    assert report.psnr_after > report.psnr_before + 0.1
    assert visibility.judge(found, views)[0] > report.psnr_after, "the second step saw these"


def test_what_does_not_help_is_not_kept():
    original, small = cloud_pair()
    views = visibility.look(original, upright_cameras(original, 6))
    perfect = (100.0, 1.0)
    found, report = recolour(small, np.ones(len(small), bool), views, perfect)
    assert found is small
    assert not report.kept


def test_where_views_differ_much_a_more_cautious_step_is_tried(monkeypatch):
    original, small = cloud_pair()
    views = visibility.look(original, upright_cameras(original, 6))
    everything = np.ones(len(small), bool)
    before = visibility.judge(small, views)
    first = pulls(small, views.other)
    cautious = stage._moved(small, everything, *first, stage.PRIORS[1])
    judged = iter([(before[0] - 1, before[1]), visibility.judge(cautious, views)])
    monkeypatch.setattr(stage, "judge", lambda *_: next(judged))
    found, report = recolour(small, everything, views, before)
    assert report.kept
    pulled, held = pulls(cautious, views.judging)
    second = stage._moved(cautious, everything, pulled, held + first[1], stage.PRIORS[1])
    assert model_bytes(found) == model_bytes(second)


def test_one_view_cannot_tell():
    original, small = cloud_pair()
    views = visibility.look(original, count=1)
    assert recolour(small, np.ones(len(small), bool), views, (20.0, 0.5)) == (small, None)


def test_simplify_reports_it_and_unmerged_splats_keep_their_bytes():
    splats = random_splats(300)
    splats = dataclasses.replace(splats, extras={"row": np.arange(300, dtype=np.int32)})
    cameras = upright_cameras(splats)
    small, report = nanogs.simplify(splats, ratio=0.9, cameras=cameras)
    assert report.recolour is not None
    untouched = [
        i
        for i, row in enumerate(small.extras["row"])
        if (small.means[i] == splats.means[row]).all()
    ]
    rows = small.extras["row"][untouched]
    assert len(rows) > 200
    assert model_bytes(small.take(np.array(untouched))) == model_bytes(splats.take(rows))
    assert nanogs.simplify(splats, ratio=0.9, preset="fast")[1].recolour is None
    plain, report = nanogs.simplify(splats, ratio=0.9, recolour=False, cameras=cameras)
    assert report.recolour is None
    assert model_bytes(plain) != model_bytes(small)

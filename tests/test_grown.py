"""`nanogs.grow`: results of any count of one forest are those that `simplify` makes."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import nanogs
from builders import cloud_pair, random_splats
from nanogs.errors import ModelError, OptionError
from strategies import assert_same

QUICK = {"views": 2, "view_size": 64, "steps": 2}


@pytest.fixture(scope="module")
def model():
    return cloud_pair(degree=2)[0]


@pytest.fixture(scope="module")
def grown(model):
    return nanogs.grow(model, **QUICK)


def test_results_are_those_of_simplify_in_any_order_and_after_drafts(model, grown):
    for count in (40, 7, 250, 40):
        grown.draft(count // 2)
        small, report = grown.simplify(count)
        expected, told = nanogs.simplify(model, count=count, **QUICK)
        assert_same(small, expected)
        assert (report.asked_count, report.achieved_count) == (count, count)
        assert report.parameters == told.parameters
        assert [each.quality for each in report.candidates] == [
            each.quality for each in told.candidates
        ]


def test_the_fast_preset_looks_at_nothing(model):
    grown = nanogs.grow(model, preset="fast")
    assert_same(grown.simplify(60)[0], nanogs.simplify(model, count=60, preset="fast")[0])
    assert "look" not in grown.seconds


@pytest.mark.parametrize("preset", ["fast", "default"])
def test_the_degree_of_harmonics_is_that_of_simplify(model, preset):
    quick = QUICK if preset == "default" else {}
    grown = nanogs.grow(model, preset=preset, sh_degree=1, **quick)
    small, _ = grown.simplify(50)
    assert small.sh_degree == 1
    assert_same(small, nanogs.simplify(model, count=50, preset=preset, sh_degree=1, **quick)[0])


@given(count=st.integers(1, 400))
@settings(max_examples=15, deadline=None)
def test_a_draft_has_the_count(grown, count):
    draft = grown.draft(count)
    assert len(draft) == count
    assert draft.finite().all()


def test_a_draft_is_one_cut_without_looking(model):
    plain = {"measure": False, "steps": 0, "rounds": 0}
    grown = nanogs.grow(model, preset="fast")
    expected, _ = nanogs.simplify(model, count=90, preset="fast", **plain)
    assert_same(grown.draft(90), expected)


def test_all_splats_are_the_model_without_those_that_are_not_finite(model):
    broken = replace(model, means=model.means.copy())
    broken.means[3, 1] = np.nan
    grown = nanogs.grow(broken, preset="fast")
    rest = broken.take(np.delete(np.arange(len(broken)), 3))
    assert grown.available == len(model) - 1
    assert_same(grown.draft(grown.available), rest)
    assert_same(grown.simplify(grown.available)[0], rest)


def test_what_is_measured_is_what_compare_says_of_the_saved_file(model, grown, tmp_path):
    small, _ = grown.simplify(80)
    for suffix in (".ply", ".spz"):
        measured = grown.measure(small, format=suffix)
        path = tmp_path / f"small{suffix}"
        nanogs.save(small, path)
        [score] = nanogs.compare(model, path).models
        assert measured.bytes == path.stat().st_size
        assert measured.judged.psnr == pytest.approx(score.psnr, abs=1e-9)
        assert measured.judged.ssim == pytest.approx(score.ssim, abs=1e-9)


def test_options_of_the_format_count(grown):
    small = random_splats(300, degree=2)
    rich = grown.measure(small, format=".spz").bytes
    poor = grown.measure(small, format=".spz", format_options={"sh_bits": 3}).bytes
    assert poor < rich


@pytest.mark.parametrize("count", [0, -1, 401])
def test_counts_that_there_are_not_are_refused(grown, count):
    with pytest.raises(OptionError):
        grown.draft(count)
    with pytest.raises(OptionError):
        grown.simplify(count)


def test_paper_and_unknown_options_are_refused(model):
    with pytest.raises(OptionError, match="paper cannot search for several counts"):
        nanogs.grow(model, preset="paper")
    with pytest.raises(OptionError, match="no parameter"):
        nanogs.grow(model, viewz=3)
    with pytest.raises(OptionError):
        nanogs.grow(model, sh_degree=7)
    with pytest.raises(ModelError, match="No splat is usable"):
        nanogs.grow(replace(random_splats(4), means=np.full((4, 3), np.nan, np.float32)))


def test_progress_ends_with_one(model):
    steps = []
    grown = nanogs.grow(model, progress=steps.append, **QUICK)
    assert steps[-1].fraction == 1
    more = []
    small, _ = grown.simplify(30, progress=more.append)
    grown.measure(small, progress=more.append)
    assert [each.fraction for each in more].count(1) == 2

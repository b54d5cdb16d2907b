"""`nanogs.grow`: for any count, one forest gives the results of `simplify`."""

import json
import math
import pickle
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import nanogs
from builders import cloud_pair, random_splats
from nanogs.errors import ModelError, OptionError
from nanogs.splats import ExtraElement
from strategies import assert_same
from viewer_bundle import require_bundle

QUICK = {"views": 2, "view_size": 64, "steps": 2}


@pytest.fixture(scope="module")
def model():
    return cloud_pair(degree=2)[0]


@pytest.fixture(scope="module")
def grown(model):
    return nanogs.grow(model, **QUICK)


def test_results_equal_those_of_simplify_in_any_order_and_after_drafts(model, grown):
    for count in (40, 7, 250, 40):
        grown.draft(count // 2)
        small, report = grown.simplify(count)
        expected, expected_report = nanogs.simplify(model, count=count, **QUICK)
        assert_same(small, expected)
        assert (report.asked_count, report.achieved_count) == (count, count)
        assert report.parameters == expected_report.parameters
        assert [candidate.quality for candidate in report.candidates] == [
            candidate.quality for candidate in expected_report.candidates
        ]


@pytest.mark.parametrize("suffix", [".sog", "meta.json", ".spz", ".ply"])
def test_results_for_a_file_equal_those_of_simplify_for_it(suffix):
    model = cloud_pair(3000, degree=0)[0]  # without harmonics, which splats of a .sog would share
    chosen, bits = {"views": 3, "view_size": 48, "around": 0}, {"bits": 6}
    options = {} if suffix == ".ply" else {"format_options": bits}
    grown = nanogs.grow(model, **chosen)
    small, report = grown.simplify(300, format=suffix, **options)
    expected, _ = nanogs.simplify(model, count=300, format=suffix, **options, **chosen)
    assert_same(small, expected)
    assert ("encode" in report.seconds) == (suffix != ".ply")
    plain, _ = grown.simplify(300)
    assert np.array_equal(small.log_scales, plain.log_scales) == (suffix == ".ply")
    with pytest.raises(OptionError, match="depth"):
        grown.simplify(300, format=suffix, format_options={"depth": 1})


def test_several_threads_get_the_results_of_one(grown):
    counts = [40, 7, 250, 90, 120, 60]
    expected = [(grown.simplify(count)[0], grown.draft(count)) for count in counts]
    with ThreadPoolExecutor(6) as pool:
        made = pool.map(lambda count: grown.simplify(count)[0], counts)
        drafts = pool.map(grown.draft, counts)
        for pair in zip(made, drafts, strict=True):
            for given, wanted in zip(pair, expected.pop(0), strict=True):
                assert_same(given, wanted)


def test_results_are_made_while_another_thread_measures(grown):
    small, draft = grown.simplify(40)[0], grown.draft(60)
    expected, measuring, made = grown.measure(small), threading.Event(), threading.Event()

    def wait(step):
        measuring.set()
        assert made.wait(20), "no result was made meanwhile"

    with ThreadPoolExecutor(2) as pool:
        measured = pool.submit(grown.measure, small, progress=wait)
        assert measuring.wait(20)
        results = pool.submit(lambda: (grown.simplify(40)[0], grown.draft(60)))
        results.add_done_callback(lambda _: made.set())
        assert measured.result() == expected
    for result, alone in zip(results.result(), (small, draft), strict=True):
        assert_same(result, alone)


def test_a_pickled_grown_model_makes_the_same_results(grown):
    again = pickle.loads(pickle.dumps(grown))
    assert_same(again.simplify(40)[0], grown.simplify(40)[0])


def test_a_count_may_be_a_numpy_number(grown):
    small, report = grown.simplify(np.int64(40))
    assert json.loads(json.dumps(report.to_dict()))["asked_count"] == len(small) == 40


class StoppedError(Exception):
    pass


def stop_in(stage, step):
    if step.stage == stage:
        raise StoppedError


@pytest.fixture(scope="module")
def stages(grown):
    """The stages of a result, in order."""
    seen = []
    grown.simplify(30, progress=lambda step: seen.append(step.stage))
    return [*dict.fromkeys(seen)]


def test_a_call_that_its_progress_ended_changes_no_later_result(grown, stages):
    expected = grown.simplify(40)[0]
    for stage in stages:
        with pytest.raises(StoppedError):
            grown.simplify(30, progress=partial(stop_in, stage))
        assert_same(grown.simplify(40)[0], expected)


def test_nothing_of_a_cancelled_result_is_kept(grown, stages):
    before = len(pickle.dumps(grown))
    for stage in stages:
        with pytest.raises(StoppedError):
            grown.simplify(30, progress=partial(stop_in, stage))
        assert len(pickle.dumps(grown)) == before


def test_nothing_of_a_draft_is_kept(model):
    grown = nanogs.grow(model, preset="fast")
    before = len(pickle.dumps(grown))
    grown.draft(300)
    assert len(pickle.dumps(grown)) < before + 100  # the seconds of its stages


def test_the_fast_preset_renders_nothing(model):
    grown = nanogs.grow(model, preset="fast")
    assert_same(grown.simplify(60)[0], nanogs.simplify(model, count=60, preset="fast")[0])
    assert "look" not in grown.seconds


@pytest.mark.parametrize("preset", ["fast", "default"])
def test_the_sh_degree_is_reduced_as_in_simplify(model, preset):
    quick = QUICK if preset == "default" else {}
    grown = nanogs.grow(model, preset=preset, sh_degree=1, **quick)
    small, _ = grown.simplify(50)
    assert small.sh_degree == 1
    assert_same(small, nanogs.simplify(model, count=50, preset=preset, sh_degree=1, **quick)[0])


@given(count=st.integers(1, 400))
@settings(max_examples=15, deadline=None)
def test_a_draft_has_exactly_the_requested_count(grown, count):
    draft = grown.draft(count)
    assert len(draft) == count
    assert draft.finite().all()


def test_a_draft_is_one_cut_without_rendering(model):
    plain = {"guided": False, "steps": 0, "rounds": 0}
    grown = nanogs.grow(model, preset="fast")
    expected, _ = nanogs.simplify(model, count=90, preset="fast", **plain)
    assert_same(grown.draft(90), expected)


def test_the_highest_count_is_the_model_without_nonfinite_splats(model):
    broken = replace(model, means=model.means.copy())
    broken.means[3, 1] = np.nan
    grown = nanogs.grow(broken, preset="fast")
    rest = broken.take(np.delete(np.arange(len(broken)), 3))
    assert grown.available == len(model) - 1
    assert_same(grown.draft(grown.available), rest)
    assert_same(grown.simplify(grown.available)[0], rest)


def test_measure_returns_the_scores_of_compare_for_the_saved_file(model, grown, tmp_path):
    small, _ = grown.simplify(80)
    for suffix in (".ply", ".spz"):
        measured = grown.measure(small, format=suffix)
        path = tmp_path / f"small{suffix}"
        nanogs.save(small, path)
        [score] = nanogs.compare(model, path).models
        assert measured.bytes == path.stat().st_size
        assert measured.judged.psnr == pytest.approx(score.psnr, abs=1e-9)
        assert measured.judged.ssim == pytest.approx(score.ssim, abs=1e-9)


def test_of_a_page_what_it_shows_is_measured(model, grown, tmp_path):
    """Not the model before it is packed: the page holds an .spz."""
    require_bundle()
    measured = {suffix: grown.measure(model, format=suffix) for suffix in (".ply", ".spz", ".html")}
    psnr = {suffix: each.judged.psnr for suffix, each in measured.items()}
    assert psnr[".ply"] == math.inf
    assert psnr[".html"] == pytest.approx(psnr[".spz"], abs=1)
    nanogs.save(model, tmp_path / "page.html")
    assert measured[".html"].bytes == (tmp_path / "page.html").stat().st_size


def test_format_options_affect_the_measured_size(grown):
    small = random_splats(300, degree=2)
    default_bytes = grown.measure(small, format=".spz").bytes
    reduced_bytes = grown.measure(small, format=".spz", format_options={"sh_bits": 3}).bytes
    assert reduced_bytes < default_bytes


@pytest.mark.parametrize(
    ("count", "message"), [(0, "at least 1"), (-1, "at least 1"), (401, "above the 400 usable")]
)
def test_counts_out_of_range_are_refused(grown, count, message):
    with pytest.raises(OptionError, match=message):
        grown.draft(count)
    with pytest.raises(OptionError, match=message):
        grown.simplify(count)


@pytest.mark.parametrize("deliver", ["draft", "simplify"])
def test_elements_with_a_row_for_each_splat_are_refused_before_anything_is_made(model, deliver):
    rows = np.zeros(len(model), [("a", "<f4")])
    grown = nanogs.grow(replace(model, elements=[ExtraElement("each", rows)]), preset="fast")
    with pytest.raises(ModelError, match="'each' has one row for each splat"):
        getattr(grown, deliver)(40)
    assert len(grown.draft(len(model))) == len(model)


def test_paper_and_unknown_options_are_refused(model):
    with pytest.raises(OptionError, match="paper cannot search for several counts"):
        nanogs.grow(model, preset="paper")
    with pytest.raises(OptionError, match="no parameter"):
        nanogs.grow(model, viewz=3)
    with pytest.raises(OptionError, match=r"SH degree .* not 7"):
        nanogs.grow(model, sh_degree=7)
    with pytest.raises(ModelError, match="No splat is usable"):
        nanogs.grow(replace(random_splats(4), means=np.full((4, 3), np.nan, np.float32)))


def test_progress_of_each_call_ends_at_one(model):
    steps = []
    grown = nanogs.grow(model, progress=steps.append, **QUICK)
    assert steps[-1].fraction == 1
    later_steps = []
    small, _ = grown.simplify(30, progress=later_steps.append)
    grown.measure(small, progress=later_steps.append)
    assert [step.fraction for step in later_steps].count(1) == 2

"""Answers without a server: drafts of newer requests, and counts found for sizes and PSNRs."""

import gc
import math
import threading
import weakref
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from builders import cloud_pair
from nanogs.activations import SH_C0
from nanogs.filters import FilterReport
from nanogs.io import encoded_bytes, save
from nanogs.pipeline.options.target import Goal
from nanogs.studio import asking, showing
from nanogs.studio.asking import QUICK, SETTLED, TRIES, UNSEEN, RequestHandler
from nanogs.studio.cache import FilteredScene, WorkerCache, grown_key
from nanogs.studio.choice import Choice, FilterChoice, choice_of
from nanogs.studio.curve import Curve, Point
from nanogs.studio.scene import StudioSettings
from nanogs.studio.worker import Cancelled
from nanogs.views.opening import opening_for


class RecordingJob:
    """A job that records the events that are sent to it."""

    page, pace = "p", None

    def __init__(self, number):
        self.id, self.said, self.shown = number, [], []
        self.kinds, self.useful = [], []

    def __call__(self, event, shown=None):
        self.said.append(event)
        if shown is not None:
            self.shown.append((event["type"], shown))

    @property
    def events(self):
        return [event["type"] for event in self.said if event["type"] != "rest"]

    def progress(self, kind):
        self.kinds.append(kind)
        return lambda step: None

    def rest(self, model, least, most):
        self.said.append({"type": "rest", "model": model, "least": least, "most": most})

    def shielded(self, useful):
        self.useful.append(useful)
        return nullcontext()


class Forest:
    """A fake forest that measures a result only once a newer request has its draft."""

    available, fewest = 400, 1

    def __init__(self, splats):
        self.splats, self.measuring, self.go_on = splats, threading.Event(), threading.Event()
        self.using, self.formats = 0, []

    def draft(self, count):
        self.using += 1
        assert self.using == 1, "two threads use the forest at once"
        drafted = self.splats.take(slice(0, max(count, self.fewest)))
        self.using -= 1
        return drafted

    def simplify(self, count, *, format, progress):  # noqa: A002
        self.formats.append(format)
        return self.draft(count), SimpleNamespace(stop="fewest", notes=("a note",))

    def measure(self, splats, *, format, progress):  # noqa: A002
        self.formats.append(format)
        self.measuring.set()
        assert self.go_on.wait(20), "no draft was made meanwhile"
        return SimpleNamespace(bytes=10, judged=SimpleNamespace(psnr=30.0, ssim=0.9))


@pytest.fixture
def forest():
    return Forest(cloud_pair()[0])


@pytest.fixture
def answers(forest):
    curve = Curve(400, 1, lambda count: 10 * count, exact=True)
    answer_state = SimpleNamespace(
        settings=SimpleNamespace(render_mode=None), here=lambda choice: forest,
        is_grown=lambda choice: True,
        roughly=lambda choice, progress: forest,
        fully=lambda choice, progress: forest, curve=lambda choice, grown: curve,
    )  # fmt: skip
    return RequestHandler(answer_state, opening_for(forest.splats))


def test_a_draft_has_the_harmonics_that_are_asked_for(answers, forest, monkeypatch):
    degrees = []

    def show(splats, *more):
        degrees.append(splats.sh_degree)
        return showing.show(splats, *more)

    monkeypatch.setattr(asking, "show", show)
    forest.go_on.set()
    forest.splats = replace(forest.splats, sh=np.zeros((len(forest.splats), 4, 3), np.float32))
    for number, more in enumerate(({}, {"sh_degree": 0}), 1):
        answers.sooner(choice_of({"wish": {"splats": 50}} | more), RecordingJob(number))
    assert degrees == [1, 0]


def test_a_newer_request_gets_its_draft_while_an_older_one_is_measured(answers, forest):
    first, second = RecordingJob(1), RecordingJob(2)
    one, two = (choice_of({"wish": {"splats": count}}) for count in (50, 60))
    thread = threading.Thread(target=answers.ask, args=(one, first))
    thread.start()
    assert forest.measuring.wait(20)
    answers.sooner(two, second)
    assert second.events == ["draft"]
    assert first.events == ["draft", "made"]
    forest.go_on.set()
    thread.join(20)
    assert first.events == ["draft", "made", "point", "measured"]
    answers.ask(two, second)
    assert second.events == ["draft", "made", "point", "measured"]  # and no second draft


def test_a_request_gets_its_draft_while_the_plot_is_filled(answers, forest):
    choice, plot, job = choice_of({"wish": {"bytes": 600}}), RecordingJob(1), RecordingJob(2)
    thread = threading.Thread(target=answers.explore, args=(choice, plot))
    thread.start()
    assert forest.measuring.wait(20)
    answers.sooner(choice, job)
    assert job.said[0]["splats"] == 60  # of 10 bytes each
    forest.go_on.set()
    thread.join(20)
    assert plot.events == ["point"] * 6
    assert set(plot.kinds) == {"curve"}


def test_an_early_draft_waits_for_the_forest_and_is_left_out_without_one(answers):
    choice, job = choice_of({"wish": {"splats": 50}}), RecordingJob(1)
    with answers._forest:
        thread = threading.Thread(target=answers.sooner, args=(choice, job))
        thread.start()
        thread.join(0.1)
        assert job.events == []
    thread.join(20)
    assert job.events == ["draft"]
    answers._cache.here = lambda choice: None
    answers.sooner(choice, job := RecordingJob(2))
    assert job.events == []


@pytest.mark.parametrize(
    ("change", "useful"),
    [
        ({"goal": Goal(count=8)}, [True, True]),
        ({"format": ".sog"}, [True, True]),
        ({"preset": "best"}, [True, False]),
        ({"filters": FilterChoice(min_opacity=0.1)}, [False, False]),
    ],
)
def test_forests_are_finished_for_newer_requests_that_they_serve(answers, forest, change, useful):
    forest.go_on.set()
    answers.ask(choice := choice_of({"wish": {"splats": 50}}), job := RecordingJob(1))
    newer = replace(choice, **change)
    assert [serves(newer) for serves in job.useful] == useful


def test_sizes_are_those_of_the_format_that_is_asked_for(answers, forest):
    forest.go_on.set()
    choice = choice_of({"wish": {"splats": 50}, "format": ".spz"})
    answers.ask(choice, RecordingJob(1))
    answers.explore(choice, RecordingJob(2))
    assert forest.formats == [".spz"] * (2 + 6)


def test_a_request_that_has_begun_gets_no_draft_after_its_result(answers, forest):
    job, choice = RecordingJob(1), choice_of({"wish": {"splats": 50}})
    thread = threading.Thread(target=answers.ask, args=(choice, job))
    thread.start()
    assert forest.measuring.wait(20)
    answers.sooner(choice, job)  # it waited for the forest until the result was measured
    forest.go_on.set()
    thread.join(20)
    assert job.events == ["draft", "made", "point", "measured"]


def test_a_result_is_sent_once_and_measured_afterwards(answers, forest, monkeypatch):
    forest.go_on.set()
    clock = SimpleNamespace(perf_counter=iter((5.0, 7.5)).__next__)
    monkeypatch.setattr(asking, "time", clock)
    answers.ask(choice_of({"wish": {"splats": 50}}), job := RecordingJob(1))
    made, measured = (shown for kind, shown in job.shown if kind != "draft")
    assert list(made.models) == [made.entry["id"]]
    assert measured.entry == made.entry
    assert measured.models == {}
    available = {"available": 400, "fewest": 1}
    figures = {"splats": 50, "bytes": 10, "psnr": 30.0, "ssim": 0.9, "stop": "fewest"}
    assert job.said[-1] == figures | available | {
        "type": "measured", "seconds": 2.5, "notes": ["a note"],
    }  # fmt: skip
    about = {"splats": 50, "bytes": 500, "psnr": None, "about": True} | available
    assert [event for event in job.said if event.get("about")] == [
        {"type": kind} | about for kind in ("draft", "made")
    ]
    assert job.kinds == ["draft", "draft", "draft", "measure"]


def test_a_draft_of_fewer_splats_than_are_possible_says_how_many_it_has(answers, forest):
    forest.go_on.set()
    forest.fewest = 60
    answers.ask(choice_of({"wish": {"splats": 50}}), job := RecordingJob(1))
    assert [event["splats"] for event in job.said if "splats" in event] == [60] * 4


def test_a_page_that_was_opened_in_a_mode_shows_the_scene_in_it(answers, forest):
    forest.go_on.set()
    answers._cache.settings.render_mode = "mip"
    stays = np.ones(len(forest.splats), bool)
    answers._cache.sifted = lambda choice: FilteredScene(forest.splats, stays, ())
    for number, (mode, sent) in enumerate((("mip", 0), ("default", 1), ("default", 0), ("mip", 1))):
        choice = choice_of({"wish": {"splats": 50}, "render_mode": mode})
        answers.ask(choice, job := RecordingJob(number + 1))
        assert job.events.count("filtered") == sent


def test_a_preview_shows_the_whole_scene_and_what_would_be_removed(answers, forest, monkeypatch):
    monkeypatch.setattr(showing, "MOST_SHOWN", 150)
    stays = np.arange(len(forest.splats)) % 4 > 0
    left, reports = forest.splats.take(np.flatnonzero(stays)), (FilterReport("box", "", 100, 300),)
    answers._cache.previewed = lambda choice: FilteredScene(left, stays, reports)
    answers._cache.whole = lambda render_mode: forest.splats
    answers.preview(choice_of({"wish": {"splats": 50}}), job := RecordingJob(1))
    took = [{"name": "box", "argument": "", "removed": 100, "left": 300}]
    assert job.said == [{"type": "filtered", "took": took, "left": 300, "preview": True}]
    [(_, shown)] = job.shown
    assert (shown.entry["splats"], shown.entry["of"]) == (134, 400)
    assert job.kinds == ["filters"]


def test_the_worker_waits_until_the_page_has_drawn(answers, forest):
    forest.go_on.set()
    job = RecordingJob(1)
    job.pace = 0.1
    answers.ask(choice_of({"wish": {"splats": 50}}), job)
    draft, made, _ = (shown.entry for _, shown in job.shown)
    rests = [(e["model"], e["least"], e["most"]) for e in job.said if e["type"] == "rest"]
    assert rests == [(draft["id"], SETTLED, UNSEEN), (made["id"], 0.0, UNSEEN + 5.0)]


def test_a_slow_page_gets_drafts_of_fewer_splats(answers, forest, monkeypatch):
    monkeypatch.setattr(asking, "FEWEST_DRAFTED", 10)
    forest.go_on.set()
    sizes = []
    for number, pace in enumerate((None, 1e-9, QUICK / 40, 1.0), 1):
        job = RecordingJob(number)
        job.pace = pace
        answers.ask(choice_of({"wish": {"splats": 50}}), job)
        drafted, made = (shown.entry for kind, shown in job.shown if kind != "measured")
        assert made["splats"] == drafted["of"] == job.said[0]["splats"] == 50
        sizes.append(drafted["splats"])
    assert sizes == [50, 50, 40, 10]


def test_a_result_that_a_browser_cannot_draw_is_shown_with_fewer_splats(
    answers, forest, monkeypatch
):
    monkeypatch.setattr(asking, "MOST_SHOWN", 30)
    forest.go_on.set()
    answers.ask(choice_of({"wish": {"splats": 50}}), job := RecordingJob(1))
    assert [(kind, shown.entry["splats"], shown.entry["of"]) for kind, shown in job.shown] == [
        ("draft", 30, 50), ("made", 30, 50), ("measured", 30, 50),
    ]  # fmt: skip
    assert job.said[-1]["splats"] == 50


def test_a_page_that_shows_another_model_gets_it_and_its_curve_points(answers, forest):
    forest.go_on.set()
    stays, splats = np.arange(len(forest.splats)) > 0, forest.splats.take(slice(1, None))
    answers._cache.sifted = lambda choice: FilteredScene(splats, stays, ())
    data = {"wish": {"splats": 50}}
    for number, job in ((1, RecordingJob(1)), (2, RecordingJob(2))):
        job.page = f"page {number}"
        answers.ask(choice_of(data | {"filters": {"min_opacity": 0.1}}), job)
        others = ["point"] * (number - 1)  # measured for the page before
        assert job.events == ["filtered", *others, "draft", "made", "point", "measured"]
        filtered = {"type": "filtered", "took": [], "left": len(splats), "preview": False}
        assert job.said[0] == filtered
        assert job.shown[0][1].entry["splats"] == len(splats)
        points = [event for event in job.said if event["type"] == "point"]
        assert [(event["splats"], event["format"]) for event in points] == [(50, ".ply")] * number
        answers.ask(choice_of(data), again := RecordingJob(number + 2))
        assert "filtered" not in again.events, "that page shows the whole scene"


def test_a_page_that_returns_to_another_curve_gets_its_points(answers, forest):
    forest.go_on.set()
    curves = {suffix: Curve(400, 1, lambda count: count, exact=True) for suffix in (".ply", ".spz")}
    answers._cache.curve = lambda choice, grown: curves[choice.format]
    for number, suffix in enumerate((".ply", ".spz", ".ply", ".ply"), 1):
        choice = choice_of({"wish": {"splats": 50}, "format": suffix})
        answers.ask(choice, job := RecordingJob(number))
        known = ["point"] if number == 3 else []
        assert job.events == [*known, "draft", "made", "point", "measured"]


def test_points_that_a_cancelled_request_has_not_sent_are_sent_by_the_next(answers, forest):
    class Interrupted(RecordingJob):
        def __call__(self, event, shown=None):
            if self.said:
                raise Cancelled
            super().__call__(event, shown)

    forest.go_on.set()
    choice, curve = choice_of({"wish": {"splats": 50}}), answers._cache.curve(None, forest)
    for count in (10, 20):
        curve.add(Point(count, 10 * count, 30.0, coarse=True))
    with pytest.raises(Cancelled):
        answers.ask(choice, Interrupted(1))
    answers.ask(choice, job := RecordingJob(2))
    assert job.events == ["point", "point", "draft", "made", "point", "measured"]


def test_the_plot_is_filled_with_plain_cuts_of_a_forest_that_is_in_memory(answers, forest):
    forest.go_on.set()
    choice = choice_of({"wish": {"splats": 50}})
    for grown, counts in ((False, []), (True, [20, 4, 80, 200, 40, 8])):
        answers._cache.is_grown = lambda choice, grown=grown: grown
        answers.explore(choice, job := RecordingJob(1))
        points = [(each["splats"], each["kind"]) for each in job.said]
        assert points == [(count, "coarse") for count in counts]


COUNTS = st.integers(1, 10_000)
POINTS = st.lists(
    st.builds(
        lambda count, coarse: Point(count, 40 * count + 900, 10 + 3 * len(bin(count)), coarse),
        COUNTS, st.booleans(),
    ),
    max_size=8,
)  # fmt: skip


@given(
    st.dictionaries(st.integers(1, 2000), st.integers(0, 50_000), min_size=1, max_size=6),
    st.integers(1, 30_000),
)
def test_estimated_sizes_never_decrease_for_any_measured_sizes(measured, size):
    curve = Curve(2000, 1, lambda n: round(10.4 * n), exact=False)
    for count, found in measured.items():
        curve.add(Point(count, found, 30.0, True))
    sizes = [curve.bytes_of(count) for count in range(1, 2001)]
    assert sizes == sorted(sizes)
    within = sum(each <= size for each in sizes)
    assert curve.count_for(Goal(size=size)) == max(within, 1)
    known = sorted(measured)
    if sorted(measured.values()) == [measured[each] for each in known]:
        assert all(curve.bytes_of(each) == max(measured[each], 1) for each in known)


def test_beyond_measured_sizes_the_nearest_one_is_scaled():
    curve = Curve(1000, 1, lambda n: 10 * n, exact=False)
    for count, size in ((100, 2000), (200, 3000)):
        curve.add(Point(count, size, 30.0, coarse=False))
    assert [curve.bytes_of(count) for count in (50, 100, 200, 400)] == [1000, 2000, 3000, 6000]


@given(points=POINTS, count=COUNTS, size=st.integers(1, 10**7), psnr=st.floats(0.1, 90))
def test_goals_lead_to_valid_counts(points, count, size, psnr):
    curve = Curve(10_000, 7, lambda n: 41 * n, exact=False)
    for point in points:
        curve.add(point)
    assert curve.count_for(Goal(count=count)) == count
    for goal in (Goal(size=size), Goal(psnr=psnr)):
        found = curve.count_for(goal)
        assert 7 <= found <= 10_000
    fits = curve.count_for(Goal(size=size))
    if 7 < fits < 10_000:
        assert curve.bytes_of(fits) <= size < curve.bytes_of(fits + 1)
    for point in points:
        if not any(each.count == point.count and each is not point for each in points):
            assert curve.bytes_of(point.count) == pytest.approx(point.bytes, abs=1)


def test_the_largest_count_that_fits_is_taken():
    curve = Curve(1000, 10, lambda n: 41 * n, exact=True)
    counts = [curve.count_for(Goal(size=size)) for size in (1, 409, 20_499, 20_500, 20_501, 10**6)]
    assert counts == [10, 10, 499, 500, 500, 1000]


def test_no_count_below_the_fewest_is_measured():
    curve, found = Curve(1000, 60, lambda n: n, exact=True), []
    while (count := curve.missing()) is not None:
        found.append(count)
        curve.add(Point(count, count, 30.0, coarse=True))
    assert found == [60, 200, 500, 100]


def test_measured_results_raise_the_curve_of_plain_cuts():
    curve = Curve(1000, 1, lambda n: n, exact=True)
    for count, mark in ((10, 20.0), (100, 30.0), (1000, 40.0)):
        curve.add(Point(count, count, mark, coarse=True))
    assert curve.psnr_of(100) == pytest.approx(30)
    assert curve.count_for(Goal(psnr=30)) == 100
    curve.add(Point(100, 100, 32.0, coarse=False))
    assert curve.psnr_of(100) == pytest.approx(32)
    assert curve.count_for(Goal(psnr=32)) == 100
    assert curve.missing() == 50
    curve.add(Point(50, 50, 28.0, coarse=False))
    assert curve.missing() == 50, "a full result is no plain cut"
    curve.add(Point(10_000, 10_000, 55.0, coarse=False))  # beyond all plain cuts
    assert curve.psnr_of(10_000) == pytest.approx(55)


def test_estimated_psnrs_never_fall_and_continue_as_at_the_nearer_end():
    curve = Curve(1000, 1, lambda n: n, exact=True)
    for count, mark in ((100, 20.0), (200, 22.0), (300, 21.0), (400, 25.0)):
        curve.add(Point(count, count, mark, coarse=True))
    assert curve.psnr_of(50) == pytest.approx(18)
    assert curve.psnr_of(300) == pytest.approx(22)
    assert curve.psnr_of(800) == pytest.approx(25 + 8 * math.log(2)), "the steepest slope"


def test_a_result_with_infinite_psnr_does_not_change_the_curve():
    curve, whole = Curve(1000, 1, lambda n: n, exact=True), Point(1000, 1000, math.inf, False)
    guessed = curve.count_for(Goal(psnr=30))
    curve.add(whole)
    assert curve.psnr_of(100) is None
    assert curve.count_for(Goal(psnr=30)) == guessed
    for count, mark in ((10, 20.0), (100, 30.0)):
        curve.add(Point(count, count, mark, coarse=True))
    assert curve.psnr_of(100) == pytest.approx(30)
    assert curve.count_for(Goal(psnr=30)) == 100
    curve.add(Point(100, 100, 32.0, coarse=False))
    assert curve.psnr_of(100) == pytest.approx(32)
    assert curve.psnr_of(300) == pytest.approx(32 + 10 * math.log10(3))


@given(
    available=st.integers(1000, 10**6), at_all=st.floats(28, 60), slope=st.floats(1.5, 6),
    share=st.floats(0.02, 0.9),
)  # fmt: skip
def test_a_psnr_is_approached_in_few_results_without_earlier_ones(available, at_all, slope, share):
    def truth(count):
        return at_all + slope * math.log(count / available)

    goal = Goal(psnr=max(truth(math.ceil(share * available)), 1.0))
    curve = Curve(available, 1, lambda n: n, exact=True)
    misses = []
    for _ in range(TRIES):
        count = curve.count_for(goal)
        misses.append(abs(truth(count) - goal.psnr))
        curve.add(Point(count, count, truth(count), coarse=False))
    assert misses[1] <= max(misses[0], 0.05)  # a splat more or less, if few are left
    assert misses[-1] <= max(0.2, 0.1 * misses[0]), "the line through two results leads there"


def test_two_close_results_are_not_extrapolated_far():
    curve = Curve(100_000, 1, lambda n: n, exact=True)
    for count, mark in ((7046, 30.7), (7100, 30.6)):
        curve.add(Point(count, count, mark, coarse=False))
    assert 3000 < curve.count_for(Goal(psnr=30.0)) < 7046
    assert 7100 < curve.count_for(Goal(psnr=31.0)) < 12_000


def test_of_several_results_the_one_that_meets_the_psnr_is_shown(answers, forest):
    forest.go_on.set()
    marks = iter([33.0, 29.0, 31.0])
    forest.measure = lambda *_, **__: SimpleNamespace(
        bytes=10, judged=SimpleNamespace(psnr=next(marks), ssim=0.9)
    )
    job = RecordingJob(1)
    answers.ask(choice_of({"wish": {"psnr": 30.0}}), job)
    assert job.events == ["draft", *["made", "point"] * 3, "measured"]
    assert job.said[-1]["psnr"] == 31.0


@pytest.mark.parametrize(
    ("marks", "results"),
    [([30.2], 1), ([31.0, 30.2], 2), ([20.0, 20.0], 2)],
    ids=["near at once", "near at last", "the whole model is worse"],
)
def test_no_more_results_are_made_than_a_psnr_needs(answers, forest, marks, results):
    forest.go_on.set()
    left = iter(marks)
    forest.measure = lambda *_, **__: SimpleNamespace(
        bytes=10, judged=SimpleNamespace(psnr=next(left), ssim=0.9)
    )
    answers.ask(choice_of({"wish": {"psnr": 30.0}}), job := RecordingJob(1))
    assert job.events == ["draft", *["made", "point"] * results, "measured"]


def test_a_model_that_is_too_large_to_be_drawn_keeps_its_harmonics(forest, monkeypatch):
    monkeypatch.setattr(showing, "MOST_SHOWN", 150)
    drawn = showing.few(forest.splats)
    assert np.array_equal(drawn.sh, forest.splats.sh[::3])
    start = opening_for(forest.splats)
    shown = showing.show(drawn, start, 400)
    assert (shown.entry["splats"], shown.entry["of"]) == (134, 400)
    assert shown.entry["note"].startswith("134 splats are drawn in place of 400, because a browser")
    assert showing.show(drawn, start, 134).entry["note"] is None


def test_splats_to_be_removed_are_magenta_in_a_reduced_model_too(forest, monkeypatch):
    monkeypatch.setattr(showing, "MOST_SHOWN", 150)
    stays = np.random.default_rng(0).random(400) < 0.5
    colours = showing.marked(forest.splats, stays).sh[:, 0] * SH_C0 + 0.5
    magenta = np.isclose(colours, (1, 0, 1), atol=1e-6).all(axis=1)
    assert magenta.tolist() == (~stays[::3]).tolist()


@pytest.mark.parametrize("suffix", [".ply", ".glb", ".npz", ".compressed.ply", ".splat"])
def test_a_curve_keeps_no_model_alive(suffix, tmp_path):
    """A studio holds up to 32 curves, and frees the scene between two saves."""
    path = tmp_path / "scene.ply"
    splats = replace(cloud_pair()[0], comments=("a line",))
    save(splats, path)
    cache = WorkerCache(SimpleNamespace(path=path), StudioSettings())
    choice = Choice(goal=Goal(count=9), format=suffix, sh_degree=0)
    held = weakref.ref(cache.sifted(choice).splats.means)
    curve = cache.curve(choice, Forest(splats))
    assert curve.exact
    cache.forget()
    gc.collect()
    assert held() is None
    smaller = splats.with_sh_degree(0).take(slice(0, 100))
    assert curve.bytes_of(100) == encoded_bytes(smaller, tmp_path / f"out{suffix}")


@pytest.fixture
def cache(tmp_path):
    save(cloud_pair()[0], tmp_path / "scene.ply")
    studio = StudioSettings(threads=2, max_memory=10**9)
    return WorkerCache(SimpleNamespace(path=tmp_path / "scene.ply"), studio)


def test_sizes_are_estimated_from_a_part_of_the_splats(cache, monkeypatch, tmp_path):
    parts = []

    def encoded(splats, path):
        parts.append(len(splats))
        return encoded_bytes(splats, path)

    monkeypatch.setattr("nanogs.studio.cache.encoded_bytes", encoded)
    monkeypatch.setattr("nanogs.studio.cache._SAMPLE", 399)
    choice = Choice(goal=Goal(count=9), format=".spz")
    splats = cache.sifted(choice).splats
    whole = encoded_bytes(splats, tmp_path / "out.spz")
    curve = cache.curve(choice, Forest(splats))
    assert 0.7 * whole < curve.bytes_of(len(splats)) < 1.4 * whole
    assert (parts, curve.exact) == ([200], False)


def test_only_the_latest_curves_are_kept(cache, monkeypatch):
    monkeypatch.setattr("nanogs.studio.cache._CURVES", 2)
    choices = [Choice(goal=Goal(count=9), format=each) for each in ("meta.json", ".sog", ".ply")]
    forest = Forest(cache.sifted(choices[0]).splats)
    folder, file = (cache.curve(choice, forest) for choice in choices[:2])
    assert folder.bytes_of(100) == file.bytes_of(100)
    assert cache.curve(choices[0], forest) is folder
    cache.curve(choices[2], forest)
    assert cache.curve(choices[1], forest) is file
    assert cache.curve(choices[0], forest) is not folder
    best = replace(choices[2], preset="best")
    assert cache.curve(best, forest) is not cache.curve(choices[2], forest)


def test_filters_and_render_mode_are_those_of_each_choice(cache):
    whole = Choice(goal=Goal(count=9))
    few = replace(whole, filters=FilterChoice(box=(0, -9, -9, 9, 9, 9)))
    mip = replace(few, render_mode="mip")
    counts = []
    for choice in (whole, few, mip, whole):
        previewed = cache.previewed(choice)
        sifted = cache.sifted(choice)
        assert cache.previewed(choice) is sifted
        for splats in (previewed.splats, sifted.splats):
            assert splats.render_mode == (choice.render_mode or "default")
            counts.append(len(splats))
    assert 0 < counts[2] < 400
    assert counts == [400, 400, *counts[2:3] * 4, 400, 400]


def test_a_forest_is_used_only_for_its_own_model(cache, monkeypatch):
    grown = []

    def grow(splats, **options):
        assert cache.grown is None, "two forests are in memory"
        grown.append((len(splats), options["preset"]))
        return Forest(splats)

    monkeypatch.setattr("nanogs.pipeline.grown.grow", grow)
    whole = Choice(goal=Goal(count=9), preset="fast")
    few = replace(whole, filters=FilterChoice(box=(0, -9, -9, 9, 9, 9)))
    best = replace(few, preset="best")
    assert cache.here(whole) is None
    for choice, drafts in ((whole, False), (few, False), (best, True)):
        assert (cache.here(choice) is not None) == drafts
        assert not cache.is_grown(choice)
        forest = cache.fully(choice, None)
        assert cache.is_grown(choice)
        assert forest is cache.fully(choice, None) is cache.here(choice)
    left = len(cache.sifted(few).splats)
    assert grown == [(400, "fast"), (left, "fast"), (left, "best")]
    assert left < 400


def test_a_forest_is_grown_as_the_choice_and_the_settings_say(cache, monkeypatch):
    given = []

    def grow(splats, **options):
        given.append(options)
        return Forest(splats)

    monkeypatch.setattr("nanogs.pipeline.grown.grow", grow)
    data = {"wish": {"splats": 9}, "up": "+z", "sh_degree": 1}
    fast, best = (choice_of(data | {"preset": preset}) for preset in ("fast", "best"))
    cache.fully(best, "steps")
    assert cache.roughly(fast, "steps") is cache.fully(best, "steps"), "any forest gives drafts"
    cache.forget()
    cache.roughly(best, "steps")
    shared = {
        "sh_degree": 1, "device": "cpu", "threads": 2, "max_memory": 10**9, "progress": "steps",
    }  # fmt: skip
    quickest = shared | {"preset": "fast", "up": None}  # it renders nothing, so needs no direction
    assert given == [shared | {"preset": "best", "up": (0.0, 0.0, 1.0)}, quickest]


@pytest.mark.parametrize(
    ("goal", "near"),
    [
        ({"psnr": 30.0}, True),
        ({"psnr": 30.1}, False),
        ({"psnr": 29.6}, False),
        ({"size": 1000}, True),
        ({"size": 1030}, True),
        ({"size": 999}, False),
        ({"size": 1040}, False),
        ({"ratio": 0.5}, True),
    ],
)
def test_a_result_is_near_if_it_meets_the_goal_and_exceeds_it_little(goal, near):
    assert asking._near(Goal(**goal), Point(50, 1000, 30.0, coarse=False)) == near


def test_of_several_results_the_nearest_that_meets_the_goal_is_shown():
    points = [Point(count, 10 * count, count / 2, coarse=False) for count in (50, 58, 62, 70)]
    for goal, count in ((Goal(psnr=30), 62), (Goal(size=605), 58), (Goal(psnr=99), 70)):
        assert min(points, key=lambda point: asking._miss(goal, point)).count == count


@pytest.mark.parametrize(
    ("change", "anew"),
    [
        ({"preset": "best"}, True),
        ({"sh_degree": 0}, True),
        ({"up": "+z"}, True),
        ({"render_mode": "mip"}, True),
        ({"filters": FilterChoice(min_opacity=0.1)}, True),
        ({"goal": Goal(count=8)}, False),
        ({"format": ".sog"}, False),
    ],
)
def test_a_forest_is_grown_anew_for_what_changes_it(change, anew):
    choice = Choice(goal=Goal(count=9), format=".ply")
    assert (grown_key(replace(choice, **change)) != grown_key(choice)) == anew

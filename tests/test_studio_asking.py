"""Answers without a server: drafts of newer requests, and counts that wishes come to."""

import threading
from contextlib import nullcontext
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.builders import cloud_pair

from nanogs.pipeline.target import Goal
from nanogs.studio.asking import Answers
from nanogs.studio.choice import choice_of
from nanogs.studio.curve import Curve, Point
from nanogs.views.opening import opening_for


class Told:
    """A job that keeps what it is told."""

    page = "p"

    def __init__(self, number):
        self.id, self.events = number, []

    def __call__(self, event, shown=None):
        self.events.append(event["type"])

    def progress(self, kind):
        return lambda step: None

    def rest(self, seconds):
        pass

    def shielded(self, useful):
        return nullcontext()


class Forest:
    """A forest whose results are measured once a newer request has its draft."""

    available, fewest = 400, 1

    def __init__(self, splats):
        self.splats, self.measuring, self.go_on = splats, threading.Event(), threading.Event()
        self.using = 0

    def draft(self, count):
        self.using += 1
        assert self.using == 1, "two threads use the forest at once"
        drafted = self.splats.take(slice(0, count))
        self.using -= 1
        return drafted

    def simplify(self, count, *, progress):
        return self.draft(count), SimpleNamespace(stop="target", notes=())

    def measure(self, splats, **options):
        self.measuring.set()
        assert self.go_on.wait(20), "no draft was made meanwhile"
        return SimpleNamespace(bytes=10, judged=SimpleNamespace(psnr=30.0, ssim=0.9))


@pytest.fixture
def forest():
    return Forest(cloud_pair()[0])


@pytest.fixture
def answers(forest):
    curve = Curve(400, 1, lambda count: 10 * count, exact=True)
    held = SimpleNamespace(
        is_shown=lambda choice: True, here=lambda choice: forest,
        roughly=lambda choice, progress: forest,
        fully=lambda choice, progress: forest, curve=lambda choice, grown: curve,
    )  # fmt: skip
    return Answers(held, opening_for(forest.splats))


def test_a_newer_request_has_its_draft_while_an_older_one_is_measured(answers, forest):
    first, second = Told(1), Told(2)
    one, two = (choice_of({"wish": {"splats": count}}) for count in (50, 60))
    asked = threading.Thread(target=answers.ask, args=(one, first))
    asked.start()
    assert forest.measuring.wait(20)
    answers.sooner(two, second)
    assert second.events == ["draft"]
    assert first.events == ["draft"]
    forest.go_on.set()
    asked.join(20)
    assert first.events == ["draft", "point", "measured"]
    answers.ask(two, second)
    assert second.events == ["draft", "point", "measured"]  # and no second draft


COUNTS = st.integers(1, 10_000)
POINTS = st.lists(
    st.builds(
        lambda count, coarse: Point(count, 40 * count + 900, 10 + 3 * len(bin(count)), coarse),
        COUNTS, st.booleans(),
    ),
    max_size=8,
)  # fmt: skip


@given(points=POINTS, count=COUNTS, size=st.integers(1, 10**7), psnr=st.floats(0.1, 90))
def test_wishes_come_to_counts_that_there_are(points, count, size, psnr):
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


def test_what_was_measured_lifts_what_plain_cuts_show():
    curve = Curve(1000, 1, lambda n: n, exact=True)
    for count, mark in ((10, 20.0), (100, 30.0), (1000, 40.0)):
        curve.add(Point(count, count, mark, coarse=True))
    assert curve.psnr_of(100) == pytest.approx(30)
    assert curve.count_for(Goal(psnr=30)) == 100
    curve.add(Point(100, 100, 32.0, coarse=False))
    assert curve.psnr_of(100) == pytest.approx(32)
    assert curve.count_for(Goal(psnr=32)) == 100
    assert curve.missing() == 50

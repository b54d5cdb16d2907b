"""The job queue of the studio: order, dropped requests, and what the worker waits for."""

import asyncio
import contextlib
import os
import threading
import time
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from builders import random_splats
from nanogs import cleanup
from nanogs.errors import NanogsError
from nanogs.io import save
from nanogs.io.temporary import name_beside
from nanogs.pipeline.job.folder import job_folder
from nanogs.progress import Step
from nanogs.studio import supervisor, worker
from nanogs.studio.choice import choice_of
from nanogs.studio.jobs import Job, Queue
from nanogs.studio.orders import SaveRequest
from nanogs.studio.process import Process
from nanogs.studio.scene import StudioSettings, scene_of
from nanogs.studio.supervisor import WorkerSupervisor
from nanogs.studio.worker import Cancelled, Inbox, WorkerChannel

OPEN_FILES = Path("/proc/self/fd")
KINDS = ("ask", "save", "curve")


def test_a_new_request_replaces_waiting_and_running_ones_of_its_kind():
    queue = Queue()
    first, second, third = (Job("ask", "a", n) for n in range(3))
    assert queue.put(first) == []
    assert queue.next() is first
    assert queue.put(second) == [first]
    assert queue.dropped
    assert queue.put(third) == [second]  # and not the first once more
    assert queue.next() is None
    queue.done()
    assert queue.next() is third
    assert not queue.dropped


def test_a_running_save_is_not_replaced():
    queue = Queue()
    save, ask = Job("save", "a"), Job("ask", "a")
    queue.put(save)
    assert queue.next() is save
    assert queue.put(ask) == []
    assert queue.put(Job("save", "a")) == []
    assert not queue.dropped


def test_pages_do_not_disturb_each_other():
    queue = Queue()
    one, other = Job("ask", "a", 1), Job("ask", "b", 1)
    queue.put(one)
    assert queue.next() is one
    assert queue.put(other) == []
    assert queue.cancel("b") == [other]
    assert not queue.dropped


def test_cancelling_drops_the_running_job_of_a_page_once():
    queue = Queue()
    running, waiting, kept = Job("ask", "a"), Job("filter", "a"), Job("save", "a")
    for job in (running, waiting, kept):
        queue.put(job)
    assert queue.next() is running
    assert queue.cancel("a", ("filter",)) == [waiting]
    assert not queue.dropped
    assert queue.cancel("a", ("ask", "filter")) == [running]
    assert queue.dropped
    assert queue.cancel("a", ("ask",)) == []
    assert list(queue) == [kept]


def test_pages_take_turns():
    queue, served = Queue(), []
    for number in range(3):
        queue.put(Job("ask", "a", number))
        queue.put(Job("save", "a", number))
    queue.put(Job("ask", "b", 0))
    queue.put(Job("open"))
    while (job := queue.next()) is not None:
        served.append((job.kind, job.page))
        queue.done()
    assert served == [("open", ""), ("ask", "a"), ("ask", "b"), ("save", "a")]
    queue.put(Job("ask", "c"))
    queue.put(Job("open"))  # of a new worker, which can do nothing before
    assert queue.next().kind == "open"


def test_the_page_that_was_served_the_longest_ago_is_next():
    queue = Queue()
    for page in "bac":
        queue.put(Job("ask", page))
        assert queue.next().page == page
        queue.done()
    for page in "cab":
        queue.put(Job("ask", page))
    served = []
    while (job := queue.next()) is not None:
        served.append(job.page)
        queue.done()
    assert served == ["b", "a", "c"]


def test_background_measurements_give_way_to_requests():
    queue = Queue()
    curve = Job("curve", "a")
    queue.put(curve)
    queue.next()
    assert queue.put(Job("save", "b")) == [curve]
    assert queue.dropped


@given(
    st.lists(
        st.tuples(st.sampled_from(["put", "next", "done", "cancel"]),
                  st.sampled_from("abc"), st.sampled_from(KINDS))
    )
)  # fmt: skip
def test_no_request_is_lost(steps):
    """Each request is either dropped or done, and at most one of a page and kind waits."""
    queue, put, dropped, done = Queue(), [], [], []
    for step, page, kind in steps:
        if step == "put":
            put.append(Job(kind, page))
            dropped += queue.put(put[-1])
        elif step == "cancel":
            dropped += queue.cancel(page, KINDS)
        elif step == "next":
            queue.next()
        elif queue.running is not None:
            if not queue.dropped:
                done.append(queue.running)
            queue.done()
        waiting = [job for job in queue if job is not queue.running]
        assert len({(job.page, job.kind) for job in waiting}) == len(waiting)
    assert len(set(dropped)) == len(dropped)
    assert {*dropped, *done, *queue} == set(put)
    assert len(dropped) + len(done) + len(list(queue)) == len(put)


@contextlib.contextmanager
def listening_inbox():
    """An inbox, and a function that sends messages to it."""
    messages, idle = SimpleQueue(), threading.Event()

    def recv():
        idle.set()
        return messages.get()

    inbox = Inbox(SimpleNamespace(recv=recv))

    def tell(*message):
        assert idle.wait(20)
        idle.clear()
        messages.put(message)
        assert idle.wait(20), "it was not heard"

    yield inbox, tell


def seconds_of(act, *arguments):
    start = time.monotonic()
    act(*arguments)
    return time.monotonic() - start


def test_a_job_waits_until_its_model_was_drawn():
    job, later = Job("ask", "a", 7), Job("ask", "a", 8)
    with listening_inbox() as (inbox, tell):
        tell("seen", ("b", "new", 1e-6))
        tell("seen", ("a", "old", None))
        assert seconds_of(inbox.rest, job, "new", 0.0, 0.2) >= 0.2, "another page, an older model"
        threading.Timer(0.1, tell, ("seen", ("a", "new", 2e-6))).start()
        assert seconds_of(inbox.rest, job, "new", 0.0, 60.0) < 30
        assert 0.1 <= seconds_of(inbox.rest, job, "new", 0.1, 60.0) < 30, "seen, but not settled"
        tell("seen", ("b", "newer", None))
        assert (inbox.pace("a"), inbox.pace("b"), inbox.pace("c")) == (2e-6, 1e-6, None)
        threading.Timer(0.1, tell, ("cancel", (later.id, None))).start()
        assert seconds_of(inbox.rest, later, "newer", 60.0, 60.0) < 30
        assert inbox.dropped(later)


def test_a_request_may_be_cancelled_while_records_of_older_ones_are_removed():
    class SlowRecords(dict):
        def __iter__(self):
            for number in super().__iter__():
                yield number
                cancelling.start()
                cancelling.join(0.2)

    with listening_inbox() as (inbox, tell):
        inbox._dropped = SlowRecords({1: None})
        cancelling = threading.Thread(target=tell, args=("cancel", (9, None)))
        inbox.begin(Job("ask", "a", 7))
        cancelling.join(20)
        assert dict(inbox._dropped.items()) == {9: None}


def test_a_job_that_was_cancelled_before_it_began_stays_cancelled():
    with listening_inbox() as (inbox, tell):
        job = Job("ask", "a")
        tell("cancel", (job.id - 1, None))
        tell("cancel", (job.id, None))
        inbox.begin(job)
        assert list(inbox._dropped) == [job.id]


def test_only_a_newer_choice_gets_its_draft_early():
    with listening_inbox() as (inbox, tell):
        newer = Job("ask", "a")
        for number, job in enumerate((Job("save", "b"), newer, None)):
            tell("cancel", (number, job))
        assert [inbox.successors.get() for _ in range(inbox.successors.qsize())] == [newer]


def test_of_several_newer_choices_the_latest_gets_a_draft_and_further_ones_follow():
    drafted, (first, second, third) = [], (Job("ask", "a") for _ in range(3))
    with listening_inbox() as (inbox, tell):

        def sooner(job, channel):
            drafted.append((job, channel.id))
            if job is third:
                raise KeyboardInterrupt  # or it would wait for another
            inbox.successors.put(third)
            raise Cancelled

        for job in (first, second):
            tell("cancel", (0, job))
        with pytest.raises(KeyboardInterrupt):
            worker._draft_sooner(SimpleNamespace(sooner=sooner), None, inbox)
    assert drafted == [(second, second.id), (third, third.id)]


def test_the_worker_ends_with_the_server(monkeypatch):
    ended = SimpleQueue()
    monkeypatch.setattr(worker, "_end", ended.put)

    def recv():
        raise EOFError

    Inbox(SimpleNamespace(recv=recv))
    assert ended.get(timeout=20) == 1


@pytest.fixture
def channel():
    """A channel of a job, the messages that it sends, and a function that cancels the job."""
    sent, job = [], Job("ask", "a", 7)
    with listening_inbox() as (inbox, tell):
        channel = WorkerChannel(SimpleNamespace(send=sent.append), inbox, job)
        yield channel, sent, lambda successor: tell("cancel", (job.id, successor))


def test_progress_is_sent_now_and_then_and_for_each_new_stage(channel, monkeypatch):
    channel, sent, _ = channel
    seconds = iter((100.0, 100.09, 100.11, 100.19, 100.2))
    monkeypatch.setattr(worker, "time", SimpleNamespace(monotonic=lambda: next(seconds)))
    on_step = channel.progress("draft")
    for fraction, stage in enumerate(("graph", "graph", "graph", "graph", "cut")):
        on_step(Step(stage, 1, 2, 0, 1, fraction))
    shared = {"type": "progress", "number": 7, "kind": "draft"}
    assert sent == [
        ("event", "a", shared | {"stage": "graph", "fraction": 0}, {}),
        ("event", "a", shared | {"stage": "graph", "fraction": 2}, {}),
        ("event", "a", shared | {"stage": "cut", "fraction": 4}, {}),
    ]


def test_a_cancelled_job_stops_at_its_next_step_and_sends_nothing_more(channel):
    channel, sent, cancel = channel
    on_step, done = channel.progress("draft"), []
    cancel(None)
    for act in (
        partial(channel, {"type": "draft"}),
        partial(on_step, Step("graph", 1, 2, 0, 1, 0.5)),
        partial(channel.rest, "model", 0.0, 60.0),
    ):
        with pytest.raises(Cancelled):
            act()
    job, handler = Job("ask", "a"), SimpleNamespace(do=lambda *_: done.append("begun"))
    assert worker._outcome(handler, job, channel) == ("cancelled", {"type": "cancelled"})
    assert sent == done == []


def test_points_of_the_plot_and_the_scene_belong_to_no_request(channel):
    channel, sent, _ = channel
    for kind in ("point", "scene", "draft"):
        channel({"type": kind})
    assert [message[2] for message in sent] == [
        {"type": "point"}, {"type": "scene"}, {"type": "draft", "number": 7},
    ]  # fmt: skip


def test_work_that_serves_a_newer_request_is_finished_first(channel):
    channel, _, cancel = channel
    choice, done = choice_of({"wish": {"splats": 5}}), []
    cancel(Job("ask", "a", 8, choice))

    def work(name, useful):
        with channel.shielded(useful):
            channel.check()
            done.append(name)

    for name, useful in (("useful", lambda newer: newer is choice), ("useless", lambda _: False)):
        with pytest.raises(Cancelled):
            work(name, useful)
    assert done == ["useful"]


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (NanogsError("It is empty."), "It is empty."),
        (MemoryError(), "Memory ran out; free some and try again."),
        (OSError(28, "The disk is full", "a.ply"), "a.ply: The disk is full."),
        (OSError("It is gone"), "The scene: It is gone."),
    ],
)
def test_an_error_of_a_job_is_reported_to_its_page(channel, error, message):
    channel, _, _ = channel

    def do(*_):
        raise error

    outcome = worker._outcome(SimpleNamespace(do=do), Job("ask", "a"), channel)
    assert outcome == ("failed", {"type": "failed", "message": message})


class SlowToEnd:
    """A worker process that takes as long to end as the test likes."""

    ended_by = "exit code 143"

    def __init__(self, on_message):
        self._on_message, self.jobs, self.others = on_message, [], []
        self.ending, self.may_end = threading.Event(), threading.Event()

    def send(self, message):
        kind, said = message
        (self.jobs if kind == "job" else self.others).append(said)

    def end(self):
        self.ending.set()
        assert self.may_end.wait(20)

    def end_by_itself(self):
        self._on_message(None)

    async def say(self, *message):
        """Send the server a message, and wait until it has been handled."""
        self._on_message(message)
        await asyncio.sleep(0)
        await asyncio.sleep(0)


@pytest.fixture
def workers(monkeypatch):
    """The workers that a supervisor starts."""
    started = []

    def start(_scene, _settings, on_message):
        started.append(SlowToEnd(on_message))
        return started[-1]

    monkeypatch.setattr(supervisor, "Process", start)
    monkeypatch.setattr(supervisor, "PATIENCE", 0.01)
    return started


async def until(holds):
    for _ in range(1000):
        if holds():
            return
        await asyncio.sleep(0.01)
    raise AssertionError("it did not happen")


def test_a_worker_that_is_being_ended_gets_no_other_job(workers):
    told, cancelled, waiting = [], Job("ask", "a", 1), Job("save", "a", 2)

    async def session():
        supervisor = WorkerSupervisor(None, None, lambda page, event, _: told.append(event))
        supervisor.put(cancelled)
        await workers[0].say("done", "done", None)
        supervisor.put(waiting)
        supervisor.cancel("a", "ask")
        await until(workers[0].ending.is_set)
        await workers[0].say("done", "cancelled", {"type": "cancelled"})  # at the last moment
        workers[0].may_end.set()
        await until(lambda: len(workers) == 2)
        await workers[1].say("done", "done", None)
        await workers[1].say("done", "done", None)

    asyncio.run(session())
    assert [job.kind for job in workers[0].jobs] == ["open", "ask"]
    assert [job.kind for job in workers[1].jobs] == ["open", "save"]
    assert [(event["type"], event["number"]) for event in told] == [("cancelled", 1)]


def test_a_worker_knows_the_newest_request_that_replaces_its_job(workers, monkeypatch):
    monkeypatch.setattr(supervisor, "PATIENCE", 60)
    first, second, third = (Job("ask", "a", number) for number in (1, 2, 3))

    async def session():
        supervisor = WorkerSupervisor(None, None, lambda page, event, models: None)
        supervisor.put(first)
        await workers[0].say("done", "done", None)
        supervisor.put(second)
        supervisor.put(Job("filter", "a"))
        supervisor.put(Job("ask", "b"))
        supervisor.cancel("b")
        supervisor.put(third)
        supervisor.cancel("a")

    asyncio.run(session())
    assert workers[0].others == [(first.id, second), (first.id, third), (first.id, None)]


def test_a_running_save_is_not_told_to_stop_for_another(workers):
    first, second = Job("save", "a", 1), Job("save", "a", 2)

    async def session():
        supervisor = WorkerSupervisor(None, None, lambda page, event, models: None)
        supervisor.put(first)
        await workers[0].say("done", "done", None)
        supervisor.seen("a", "model", 1e-6)
        supervisor.put(second)
        await workers[0].say("done", "done", None)

    asyncio.run(session())
    assert workers[0].others == [("a", "model", 1e-6)]
    assert workers[0].jobs[1:] == [first, second]


def test_cancelling_a_page_ends_its_requests_of_every_kind(workers):
    told, kinds = [], ["ask", "filter", "save"]

    async def session():
        supervisor = WorkerSupervisor(None, None, lambda *each: told.append(each[:2]))
        for kind in kinds:
            supervisor.put(Job(kind, "a"))
        supervisor.put(Job("ask", "b"))
        supervisor.cancel("a")
        await workers[0].say("done", "done", None)

    asyncio.run(session())
    assert [(page, event["kind"], event["type"]) for page, event in told] == [
        ("a", kind, "cancelled") for kind in kinds
    ]
    assert [job.page for job in workers[0].jobs] == ["", "b"]


def test_a_replaced_job_has_more_time_to_stop_than_a_cancelled_one(workers, monkeypatch):
    timers, running = [], []

    class Timer:
        def __init__(self, seconds, _end):
            self.seconds, self.runs = seconds, True
            timers.append(self)

        def cancel(self):
            self.runs = False

    def note():
        running.append([number for number, timer in enumerate(timers) if timer.runs])

    async def session():
        supervisor = WorkerSupervisor(None, None, lambda page, event, models: None)
        supervisor.put(Job("ask", "a", 1))
        await workers[0].say("done", "done", None)
        with monkeypatch.context() as patch:
            patch.setattr(asyncio.get_running_loop(), "call_later", Timer)
            supervisor.put(Job("ask", "a", 2))
            note()
            await workers[0].say("event", "a", {"type": "progress"}, {})  # it counts from here
            note()
            supervisor.cancel("a")
            note()
            await workers[0].say("event", "a", {"type": "progress"}, {})
            note()
            await workers[0].say("done", "cancelled", {"type": "cancelled"})
            note()

    asyncio.run(session())
    replaced, cancelled = supervisor.PATIENCE_REPLACED, supervisor.PATIENCE
    assert [timer.seconds for timer in timers] == [replaced, replaced, cancelled]
    assert running == [[0], [1], [2], [2], []]


def test_the_plot_is_not_filled_for_a_page_that_is_left_or_a_request_that_failed(
    workers, monkeypatch
):
    monkeypatch.setattr(supervisor, "PATIENCE", 60)
    told = []

    async def session():
        supervisor = WorkerSupervisor(None, None, lambda page, event, _: told.append(event))
        supervisor.put(Job("ask", "a", 1))
        await workers[0].say("done", "done", None)
        await workers[0].say("done", "done", None)
        supervisor.cancel("a", "ask", "filter", "curve")
        await workers[0].say("done", "cancelled", {"type": "cancelled"})
        supervisor.put(Job("ask", "a", 2))
        await workers[0].say("done", "failed", {"type": "failed"})

    asyncio.run(session())
    assert [job.kind for job in workers[0].jobs] == ["open", "ask", "curve", "ask"]
    assert [(event["type"], event["number"]) for event in told] == [("failed", 2)]


def test_filling_the_plot_goes_on_after_another_job(workers, monkeypatch):
    monkeypatch.setattr(supervisor, "PATIENCE_REPLACED", 60)

    async def session():
        supervisor = WorkerSupervisor(None, None, lambda page, event, models: None)
        supervisor.put(Job("ask", "a", 1))
        await workers[0].say("done", "done", None)
        await workers[0].say("done", "done", None)
        supervisor.put(Job("save", "b", 1))
        await workers[0].say("done", "cancelled", {"type": "cancelled"})
        supervisor.cancel("b", "ask", "filter", "curve")
        await workers[0].say("done", "done", None)

    asyncio.run(session())
    assert [job.kind for job in workers[0].jobs] == ["open", "ask", "curve", "save", "curve"]


@pytest.mark.parametrize("outcome", ["done", "failed", None], ids=["done", "failed", "killed"])
def test_the_plot_of_a_request_is_filled_once(workers, outcome):
    told = []

    async def session():
        supervisor = WorkerSupervisor(None, None, lambda *each: told.append(each[:2]))
        supervisor.put(Job("ask", "a", 1))
        await workers[0].say("done", "done", None)
        await workers[0].say("done", "done", None)
        if outcome is None:
            workers[0].may_end.set()
            workers[0].end_by_itself()
        else:
            await workers[0].say("done", outcome, {"type": outcome})
        await until(lambda: told)
        assert supervisor.queue.idle

    asyncio.run(session())
    assert told == [("a", {"type": "explored"})]
    assert [job.kind for worker in workers for job in worker.jobs] == ["open", "ask", "curve"]


def test_a_worker_that_is_cancelled_while_it_ends_by_itself_is_replaced_once(workers):
    told = []

    async def session():
        supervisor = WorkerSupervisor(None, None, lambda *each: told.append(each[:2]))
        supervisor.put(Job("ask", "a", 1))
        await workers[0].say("done", "done", None)
        supervisor.put(Job("ask", "b", 1))
        workers[0].end_by_itself()
        await until(workers[0].ending.is_set)
        supervisor.cancel("a")
        await asyncio.sleep(0.1)  # longer than the patience
        workers[0].may_end.set()
        await until(lambda: len(workers) == 2)
        await asyncio.gather(*asyncio.all_tasks() - {asyncio.current_task()})
        await workers[1].say("done", "done", None)

    asyncio.run(session())
    assert [job.kind for job in workers[1].jobs] == ["open", "ask"]
    assert [(page, event["type"]) for page, event in told] == [("a", "cancelled")]


def test_no_job_is_done_for_a_scene_that_could_not_be_opened(workers):
    told = []

    async def session():
        supervisor = WorkerSupervisor(None, None, lambda page, event, _: told.append(event))
        supervisor.put(Job("ask", "a", 1))
        workers[0].may_end.set()
        await workers[0].say("done", "failed", {"type": "failed"})
        assert workers[0].ending.is_set()

    asyncio.run(session())
    assert [(event["kind"], event["type"]) for event in told] == [
        ("open", "failed"), ("ask", "cancelled"),
    ]  # fmt: skip
    assert [job.kind for job in workers[0].jobs] == ["open"]


def test_cancelling_while_a_worker_is_being_ended_does_not_end_the_next(workers, monkeypatch):
    monkeypatch.setattr(supervisor, "PATIENCE_REPLACED", 0.02)

    async def session():
        supervisor = WorkerSupervisor(None, None, lambda page, event, models: None)
        supervisor.put(Job("ask", "a", 1))
        await workers[0].say("done", "done", None)
        supervisor.put(Job("ask", "a", 2))
        await until(workers[0].ending.is_set)
        supervisor.cancel("a")
        supervisor.put(Job("ask", "a", 3))
        workers[0].may_end.set()
        await until(lambda: len(workers) == 2)
        await asyncio.sleep(0.2)
        workers[1].may_end.set()

    monkeypatch.setattr(supervisor, "PATIENCE", 0.1)
    asyncio.run(session())
    assert not workers[1].ending.is_set()


def test_a_scene_whose_reading_ends_the_worker_is_not_read_again_unasked(workers):
    told, waiting = [], Job("ask", "a", 1)

    async def session():
        supervisor = WorkerSupervisor(None, None, lambda page, event, _: told.append(event))
        supervisor.put(waiting)
        workers[0].may_end.set()
        workers[0].end_by_itself()
        await until(lambda: told)
        await asyncio.sleep(0.05)
        assert len(workers) == 1
        assert supervisor.queue.idle
        supervisor.put(Job("ask", "a", 2))

    asyncio.run(session())
    assert [(event["kind"], event["type"]) for event in told] == [
        ("open", "failed"), ("ask", "cancelled"),
    ]  # fmt: skip
    assert [job.kind for job in workers[1].jobs] == ["open"]


@pytest.mark.skipif(os.name == "nt", reason="Windows does not lock temporary files")
@pytest.mark.parametrize("ended", ["worker", "studio"])
@pytest.mark.parametrize("begun", [False, True], ids=["new", "begun by a command"])
def test_a_save_whose_worker_ends_leaves_nothing(workers, tmp_path, ended, begun):
    save(random_splats(9), tmp_path / "scene.ply")
    scene, choice = scene_of(tmp_path / "scene.ply"), {"wish": {"splats": 5}, "levels": "1"}
    choice = choice_of(choice | {"format": "lod-meta.json"})
    order = SaveRequest(scene, StudioSettings(), choice, tmp_path / "web" / "lod-meta.json")
    job, temporary = job_folder(order.target, None), name_beside(order.target)

    async def session():
        supervisor = WorkerSupervisor(scene, None, lambda page, event, models: None)
        supervisor.put(Job("save", "a", 1, order))
        if begun:
            job.mkdir()
        await workers[0].say("done", "done", None)
        job.mkdir(exist_ok=True)
        for folder in (job, temporary):
            (folder / "part").mkdir(parents=True)
        workers[0].may_end.set()
        if ended == "studio":
            supervisor.end()
            return
        workers[0].end_by_itself()
        await until(lambda: supervisor.queue.idle)

    asyncio.run(session())
    assert {path.name for path in tmp_path.iterdir()} == {"scene.ply", *([job.name] * begun)}


@pytest.mark.skipif(not OPEN_FILES.exists(), reason="the system does not list open files")
def test_a_worker_that_has_ended_holds_nothing_open():
    def held():
        return len([*OPEN_FILES.iterdir()]), len(cleanup._pending)

    def start_and_end():
        ended = threading.Event()
        Process(None, None, lambda message: ended.set()).end()
        assert ended.wait(20)

    start_and_end()  # the first also starts Python's own helper process
    before, until = held(), time.monotonic() + 20
    start_and_end()
    while held() > before and time.monotonic() < until:
        time.sleep(0.01)
    assert held() <= before

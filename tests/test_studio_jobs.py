"""Which request is next, and which are dropped."""

from hypothesis import given
from hypothesis import strategies as st

from nanogs.studio.jobs import Job, Queue

KINDS = ("ask", "save", "curve")


def test_the_newest_of_a_kind_takes_the_place_of_what_waits_and_of_what_runs():
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


def test_no_ask_ends_a_save():
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


def test_what_is_measured_while_nobody_asks_gives_way():
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
    """Each one that was put is dropped or done, and not both; one of a page and kind waits."""
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

"""Splitting the range of a kernel, and other work, among threads."""

import os
import subprocess
import sys
import threading
import time
import weakref

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import nanogs
from builders import random_splats
from nanogs import parallel
from nanogs.kernels.policy import parallel_kernel
from nanogs.parallel import ParallelKernel, for_each
from nanogs.threads import most_threads, use_threads


def add_one(start, stop, scale, values):
    """Add to some values."""
    values[start:stop] += scale


def split(function, least=1, each=8, over="values"):
    return ParallelKernel(function, function, over, least, each)


@given(st.integers(0, 300), st.integers(1, 400), st.integers(1, 20), st.booleans())
def test_every_index_is_in_exactly_one_range(count, least, each, alone):
    values = np.zeros(count)
    with use_threads(1 if alone else None):
        split(add_one, least, each)(2.0, values)
    assert (values == 2.0).all()


def test_ranges_have_the_requested_number_and_similar_sizes():
    ranges = []
    run = split(lambda start, stop, values: ranges.append((start, stop)), 10, 3)
    with use_threads(1):
        run(range(100))
        assert ranges == [(0, 33), (33, 66), (66, 100)]
        ranges.clear()
        run(range(19))  # not worth two ranges
        assert ranges == [(0, 19)]


def timed_kernel(count, pace):
    """Return a kernel whose latest call had `count` iterations of `pace` seconds."""
    run = split(add_one)
    run._timed, run._pace = count, pace
    return run


def test_calls_that_take_less_time_use_fewer_threads():
    seconds = 1e-5, 1e-4, 1e-3, 1e-2
    assert [timed_kernel(1000, whole / 1000)._most_threads(1000, 16) for whole in seconds] == [
        1, 2, 7, 16,
    ]  # fmt: skip
    assert [timed_kernel(1000, whole / 1000)._most_threads(1000, 2) for whole in seconds] == [
        1, 2, 2, 2,
    ]  # fmt: skip
    assert split(add_one)._most_threads(1000, 16) == 16, "nothing is known yet"
    assert timed_kernel(1000, 1e-5)._most_threads(0, 16) == 16


def test_a_much_smaller_call_is_not_judged_by_one_with_shorter_iterations():
    assert timed_kernel(1000, 1e-9)._most_threads(500, 16) == 1
    assert timed_kernel(1000, 1e-9)._most_threads(499, 16) == 16


def burn(seconds):
    """Keep this processor busy."""
    start = time.thread_time()
    while time.thread_time() - start < seconds:
        pass


def test_the_time_of_a_call_is_that_of_its_parts_without_waiting():
    def work(start, stop, values):
        time.sleep(0.02)
        burn((stop - start) * values[0])

    run = split(work, each=4)
    with use_threads(1):
        run(np.full(10, 1e-3))
        assert 1e-3 <= run._pace < 2.5e-3
        run(np.zeros(10))  # an easy call only halves what is known
        assert 0.5e-3 <= run._pace < 1.25e-3
        with pytest.raises(IndexError):
            run(np.zeros(0))  # such a call leaves what is known
        assert run._timed == 10


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="one processor")
def test_exactly_the_requested_number_of_threads_takes_part():
    barrier = threading.Barrier(2, timeout=20)
    thread_ids = []

    def meet(_start, _stop, values):
        assert len(values) == 100
        thread_ids.append(threading.get_ident())
        if len(thread_ids) <= 2:
            barrier.wait()

    with use_threads(2):
        split(meet)(range(100))
    assert len(thread_ids) == 16
    assert len(set(thread_ids)) == 2


@pytest.mark.parametrize("threads", [1, numba.config.NUMBA_NUM_THREADS])
def test_an_exception_in_any_thread_reaches_the_caller(threads):
    def fail(start, _stop, values):
        if start > 0 and len(values):
            raise ZeroDivisionError

    with use_threads(threads), pytest.raises(ZeroDivisionError):
        split(fail)(range(100))


@parallel_kernel("values", least=1)
def count_calls(start, stop, sums, calls, values):
    """Add to the values of a range; calls[start]: how often a range began there."""
    calls[start] += 1
    for i in range(start, stop):
        if values[i] < 0:
            raise ValueError("below zero")
        values[i] += sums[0]


def compiled_calls(count):
    return np.ones(1), np.zeros(count + 1, np.int64), np.zeros(count)


@given(st.integers(0, 300), st.booleans())
def test_compiled_code_takes_each_part_once(count, alone):
    sums, calls, values = compiled_calls(count)
    count_calls._pace = 0.0  # short calls would use one thread only
    with use_threads(1 if alone else None) as threads:
        count_calls(sums, calls, values)
    assert (values == 1).all()
    assert calls.max() == 1
    assert calls.sum() == max(1, min(16 * threads, count))


def test_a_kernel_can_run_on_this_thread_alone():
    sums, calls, values = compiled_calls(100)
    count_calls.here(sums, calls, values)
    assert (values == 1).all()
    assert calls.tolist() == [1, *[0] * 100]


@pytest.mark.skipif(numba.config.DISABLE_JIT, reason="nothing is compiled")
def test_compiled_code_takes_no_more_parts_than_it_may():
    sums, calls, values = compiled_calls(100)
    left = parallel._Range(100, 10)
    for most in (0, 3, 1):
        count_calls._compiled(left.address, most, sums, calls, values)
    assert (values == 1).sum() == 40
    assert next(left.taken()) == (40, 50)
    count_calls._compiled(left.address, 100, sums, calls, values)
    assert (values == 1).sum() == 90, "all but the part that Python took"


@pytest.mark.skipif(numba.config.DISABLE_JIT, reason="nothing is compiled")
def test_a_thread_returns_from_compiled_code_after_a_turn():
    """Otherwise an interrupt would wait until a long call has ended."""
    sums, calls, values = compiled_calls(1000)
    turns = []

    def counted(address, most, *args):
        turns.append(most)
        count_calls._compiled(address, most, *args)

    run = ParallelKernel(count_calls._compiled.py_func, counted, "values", 1, 8)
    with use_threads(1):
        run(sums, calls, values)
        assert turns == [1] * 8, "nothing is known yet"
        turns.clear()
        run._pace = 2 * parallel._TURN / 1000  # the whole would take two turns
        run(sums, calls, values)
        assert turns == [4, 4]
    assert (values == 2).all()


def test_a_clock_that_stands_still_fails_no_call(monkeypatch):
    """The clock of threads on Windows advances every 16 ms: most calls seem to take no time."""
    sums, calls, values = compiled_calls(100)
    monkeypatch.setattr(time, "thread_time", lambda: 0.0)
    monkeypatch.setattr(count_calls, "_pace", 1e-3)
    for _ in range(1200):  # the pace, which each call halves, becomes 0
        count_calls(sums, calls, values)
    assert count_calls._pace == 0
    assert (values == 1200).all()


@pytest.mark.parametrize("threads", [1, numba.config.NUMBA_NUM_THREADS])
def test_an_exception_in_compiled_code_reaches_the_caller(threads):
    sums, calls, values = compiled_calls(1000)
    values[1] = -1
    with use_threads(threads):
        with pytest.raises(ValueError, match="below zero"):
            count_calls(sums, calls, values)
        if threads == 1:
            assert values.sum() == 0, "no part began after the one that failed"
        count_calls(sums, calls, np.zeros(1000))


def test_docstring_and_signatures_of_the_kernel_are_kept():
    run = split(add_one)
    assert run.__doc__ == "Add to some values."
    assert run.signatures == []


FORK = """
import os
import numpy as np
from nanogs.parallel import ParallelKernel, for_each

def add_one(start, stop, values):
    values[start:stop] += 1

run = ParallelKernel(add_one, add_one, "values", 1, 8)
run(np.zeros(100))  # starts threads, which the child does not have
child = os.fork()
values = np.zeros(100)
run(values)
if child:
    assert os.waitpid(child, 0)[1] == 0
assert (values == 1).all()
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="nothing forks here")
def test_a_forked_process_starts_its_own_threads():
    subprocess.run([sys.executable, "-W", "ignore", "-c", FORK], check=True, timeout=60)


LATE = """
import sys, threading
import nanogs

scene, name = nanogs.load(sys.argv[1]), sys.argv[2]

def work():
    threading.main_thread().join()  # which shuts all pools
    nanogs.save(nanogs.simplify(scene, count=40, preset="fast")[0], name)

threading.Thread(target=work).start()
"""


def test_a_thread_can_work_after_the_main_thread_has_ended(tmp_path):
    nanogs.save(random_splats(200), tmp_path / "in.ply")
    command = [sys.executable, "-c", LATE, tmp_path / "in.ply", tmp_path / "late.sog"]
    subprocess.run(command, check=True, timeout=120)
    small, _ = nanogs.simplify(tmp_path / "in.ply", count=40, preset="fast")
    nanogs.save(small, tmp_path / "usual.sog")
    assert (tmp_path / "late.sog").read_bytes() == (tmp_path / "usual.sog").read_bytes()


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="one processor")
def test_each_part_is_done_once_and_all_threads_take_part():
    barrier = threading.Barrier(2, timeout=20)
    calls = []

    def work(part):
        calls.append((part, threading.get_ident()))
        if part < 2:
            barrier.wait()

    with use_threads(2):
        for_each(range(50), work)
    assert sorted(part for part, _ in calls) == list(range(50))
    assert len({thread for _, thread in calls}) == 2


@pytest.mark.parametrize("threads", [1, numba.config.NUMBA_NUM_THREADS])
def test_an_exception_in_a_part_reaches_the_caller(threads):
    def fail(part):
        if part == 7:
            raise ZeroDivisionError

    with use_threads(threads), pytest.raises(ZeroDivisionError):
        for_each(range(20), fail)


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="one processor")
@pytest.mark.parametrize("fails", ["here", "elsewhere"])
def test_after_a_failure_no_part_begins_or_goes_on(fails):
    barrier = threading.Barrier(2, timeout=20)
    finished = []

    def work(part):
        if part < 2:
            barrier.wait()
            if (threading.current_thread() is threading.main_thread()) == (fails == "here"):
                raise ZeroDivisionError
            time.sleep(0.2)
        finished.append(part)

    with use_threads(2), pytest.raises(ZeroDivisionError):
        for_each(range(50), work)
    assert len(finished) == 1  # the one that had begun
    time.sleep(0.1)
    assert len(finished) == 1


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="one processor")
def test_an_interrupt_does_not_wait_for_parts_that_have_not_begun():
    begun_parts = []

    def work(part):
        begun_parts.append(part)
        if threading.current_thread() is threading.main_thread():
            raise KeyboardInterrupt
        time.sleep(0.05)

    started = time.perf_counter()
    with use_threads(2), pytest.raises(KeyboardInterrupt):
        for_each(range(200), work)
    assert len(begun_parts) < 100
    assert time.perf_counter() - started < 4


# Handles interrupts as at a terminal, even if this process ignores them.
SIGNALLED = """
import signal, threading, time
signal.signal(signal.SIGINT, signal.default_int_handler)
from nanogs.parallel import for_each
from nanogs.threads import use_threads

begun, sent = [], []

def work(part):
    begun.append(part)
    own = threading.current_thread() is threading.main_thread()
    if not own and not sent:
        sent.append(part)
        signal.raise_signal(signal.SIGINT)  # which the main thread answers to
    time.sleep(0.05)

with use_threads(2):
    try:
        for_each(range(200), work)
    except KeyboardInterrupt:
        print("interrupted after", len(begun))
"""


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="one processor")
def test_a_signal_does_not_wait_for_parts_that_have_not_begun():
    """In its own process, because a stray interrupt would end the one that runs other tests."""
    command = [sys.executable, "-c", SIGNALLED]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    assert int(ended.stdout.removeprefix("interrupted after ")) < 20
    assert int(ended.stdout.split()[-1]) < 100


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="one processor")
def test_an_interrupt_during_submission_leaves_no_thread_working(monkeypatch):
    pool = parallel._pool()
    started = []

    class Interrupted:
        def submit(self, *args):
            pool.submit(*args)
            time.sleep(0.1)  # time enough to begin
            raise KeyboardInterrupt

    monkeypatch.setattr(parallel, "_pool", Interrupted)
    with use_threads(2), pytest.raises(KeyboardInterrupt):
        for_each(range(20), started.append)
    time.sleep(0.1)
    assert started == []


def test_nested_work_stays_on_its_thread():
    """Otherwise all threads could wait for work that no thread is free to do: a deadlock."""

    def outer(number):
        outer_thread = threading.current_thread()

        def inner(part):
            found.append((number, part))
            on_same_thread.append(
                outer_thread is threading.main_thread()
                or threading.current_thread() is outer_thread
            )
            time.sleep(0.001)

        for_each(range(3), inner)

    found, on_same_thread = [], []
    with use_threads(None):
        for_each(range(20), outer)
    assert sorted(found) == [(a, b) for a in range(20) for b in range(3)]
    assert all(on_same_thread)


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="one processor")
def test_work_that_has_not_begun_holds_no_arrays():
    ended = threading.Event()
    busy = [parallel._pool().submit(ended.wait) for _ in range(most_threads())]
    values = np.zeros(8)
    reference = weakref.ref(values)
    try:
        with use_threads(2):
            split(add_one)(1.0, values)
        assert (values == 1).all()
        del values
        assert reference() is None
    finally:
        ended.set()
        for future in busy:
            future.result()

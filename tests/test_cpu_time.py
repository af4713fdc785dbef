"""CPU time by step."""

import threading
import time

import pytest

from clpipe.base.cpu_time import CpuTimer, CpuTimes


def work(seconds):
    """Take CPU time of this thread."""
    end = time.thread_time() + seconds
    while time.thread_time() < end:
        pass


def test_an_inner_step_is_not_counted_twice():
    with CpuTimes() as times, CpuTimer("outer"):
        work(0.02)
        with CpuTimer("inner"):
            work(0.04)
        work(0.02)
    assert times.seconds == pytest.approx({"outer": 0.04, "inner": 0.04}, abs=0.01)
    assert times.elsewhere == pytest.approx(0, abs=0.01)


def test_threads_add_up_and_waiting_costs_nothing():
    @CpuTimer("work")
    def one():
        work(0.03)
        time.sleep(0.05)

    with CpuTimes() as times:
        threads = [threading.Thread(target=one) for _ in range(3)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert times.seconds == pytest.approx({"work": 0.09}, abs=0.02)


def test_what_is_in_no_step_is_elsewhere():
    with CpuTimes() as times:
        work(0.05)
    assert not times.seconds
    assert times.elsewhere == pytest.approx(0.05, abs=0.02)


def test_a_step_that_began_before_the_counting_does_not_end_another():
    with CpuTimer("before"):
        times = CpuTimes()
        times.__enter__()
        with CpuTimer("within"):
            work(0.02)
    work(0.02)
    with CpuTimer("after"):
        work(0.02)
    times.__exit__()
    assert times.seconds == pytest.approx({"within": 0.02, "after": 0.02}, abs=0.01)


def test_an_error_ends_its_step():
    with CpuTimes() as times:
        with pytest.raises(ValueError, match="x"), CpuTimer("fails"):
            raise ValueError("x")
        work(0.02)
    assert times.seconds["fails"] < 0.01

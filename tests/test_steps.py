"""CPU time by step."""

import threading
import time

import pytest

from clpipe.base.steps import Step, StepTimes


def work(seconds):
    """Take CPU time of this thread."""
    end = time.thread_time() + seconds
    while time.thread_time() < end:
        pass


def test_an_inner_step_is_not_counted_twice():
    with StepTimes() as times, Step("outer"):
        work(0.02)
        with Step("inner"):
            work(0.04)
        work(0.02)
    assert times.seconds == pytest.approx({"outer": 0.04, "inner": 0.04}, abs=0.01)
    assert times.elsewhere == pytest.approx(0, abs=0.01)


def test_threads_add_up_and_waiting_costs_nothing():
    @Step("work")
    def one():
        work(0.03)
        time.sleep(0.05)

    with StepTimes() as times:
        threads = [threading.Thread(target=one) for _ in range(3)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert times.seconds == pytest.approx({"work": 0.09}, abs=0.02)


def test_what_is_in_no_step_is_elsewhere():
    with StepTimes() as times:
        work(0.05)
    assert not times.seconds
    assert times.elsewhere == pytest.approx(0.05, abs=0.02)


def test_a_step_that_began_before_the_counting_does_not_end_another():
    with Step("before"):
        times = StepTimes()
        times.__enter__()
        with Step("within"):
            work(0.02)
    work(0.02)
    with Step("after"):
        work(0.02)
    times.__exit__()
    assert times.seconds == pytest.approx({"within": 0.02, "after": 0.02}, abs=0.01)


def test_an_error_ends_its_step():
    with StepTimes() as times:
        with pytest.raises(ValueError, match="x"), Step("fails"):
            raise ValueError("x")
        work(0.02)
    assert times.seconds["fails"] < 0.01

"""CPU time by step."""

import threading
from collections import Counter
from types import SimpleNamespace

import pytest

from clpipe.base import cpu_time
from clpipe.base.cpu_time import CpuTimer, CpuTimes


@pytest.fixture
def work(monkeypatch):
    """A function that takes seconds of CPU time of its thread, by clocks that nothing else moves.

    There is no clock of wall time: CPU time must not depend on one.
    """
    taken = Counter()

    def work(seconds):
        taken[threading.get_ident()] += seconds

    clocks = SimpleNamespace(
        thread_time=lambda: taken[threading.get_ident()], process_time=lambda: sum(taken.values())
    )
    monkeypatch.setattr(cpu_time, "time", clocks)
    return work


def test_an_inner_step_is_not_counted_twice(work):
    with CpuTimes() as times, CpuTimer("outer"):
        work(2)
        with CpuTimer("inner"):
            work(5)
        work(1)
    assert times.seconds == {"outer": 3, "inner": 5}
    assert times.elsewhere == 0


def test_threads_add_up(work):
    both = threading.Barrier(3)

    @CpuTimer("work")
    def one():
        both.wait()
        work(3)
        both.wait()

    with CpuTimes() as times:
        threads = [threading.Thread(target=one) for _ in range(3)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        work(1)
    assert times.seconds == {"work": 9}
    assert times.elsewhere == 1


def test_what_is_in_no_step_is_elsewhere(work):
    work(7)
    with CpuTimes() as times:
        work(5)
    assert not times.seconds
    assert times.elsewhere == 5


def test_a_step_that_began_before_the_counting_does_not_end_another(work):
    with CpuTimer("before"):
        times = CpuTimes()
        times.__enter__()
        with CpuTimer("within"):
            work(2)
    work(4)
    with CpuTimer("after"):
        work(3)
    times.__exit__()
    assert times.seconds == {"within": 2, "after": 3}
    assert times.elsewhere == 4


def test_an_error_ends_its_step(work):
    with CpuTimes() as times:
        with pytest.raises(ValueError, match="x"), CpuTimer("fails"):
            raise ValueError("x")
        work(2)
    assert times.seconds == {"fails": 0}
    assert times.elsewhere == 2

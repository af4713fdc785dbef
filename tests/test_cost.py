"""Python calls and launches that a sample and an image cost: counts, so they hold on any machine.

The ceilings are what was measured when they were last lowered. Lower them with the cost.
"""

import itertools
import queue
import sys
import threading

import numpy as np
import pyopencl as cl
import pytest

import clpipe
from clpipe.batch.in_turn import InTurn
from tests.test_batch import worker_of

SLACK = 1.05  # for other versions of Python and of libraries
CAMERAS = ["sony-a7r2", "canon-5d2", "canon-6d", "nikon-d850"]


class Cost:
    """Counts Python calls, in this thread and those that begin later, and launches."""

    def __init__(self, monkeypatch):
        self._calls, self._launches, self._counting = itertools.count(), itertools.count(), False
        launch = cl.enqueue_nd_range_kernel

        def launched(*arguments, **options):
            next(self._launches)
            return launch(*arguments, **options)

        monkeypatch.setattr(cl, "enqueue_nd_range_kernel", launched)
        threading.setprofile(self._profile)
        sys.setprofile(self._profile)

    def _profile(self, frame, event, argument):
        if self._counting and event in {"call", "c_call"}:
            next(self._calls)

    def of(self, work):
        """Return the calls and launches of a function."""
        self._calls, self._launches, self._counting = itertools.count(), itertools.count(), True
        work()
        self._counting = False
        return next(self._calls), next(self._launches)


@pytest.fixture
def cost(device, monkeypatch):
    yield Cost(monkeypatch)
    threading.setprofile(None)
    sys.setprofile(None)


@pytest.fixture
def renders(write_exr, tmp_path):
    """Write small renders and return their folder."""
    rng = np.random.default_rng(0)
    for i in range(24):
        write_exr(f"in/r{i:03}.exr", rng.random((96, 96, 3)).astype(np.float32) / 2)
    return tmp_path / "in"


def test_a_training_sample(renders, cost):
    """Noisy and clean, raw and picture, with a camera and an ISO drawn for each patch."""
    drawn = {"camera": {"choice": CAMERAS}, "iso": {"log_uniform": [200, 3200]}}
    samples = clpipe.Dataset(renders, patch=64, raw="packed", **drawn)
    samples.__getitems__(range(8))
    calls, launches = cost.of(lambda: samples.__getitems__(range(8, 24)))
    assert calls / 16 <= 16_400 * SLACK
    assert launches <= 49  # for all 16


def test_a_training_sample_with_nothing_drawn(renders, cost):
    samples = clpipe.Dataset(renders, patch=64)
    samples[0], samples[1]
    calls, launches = cost.of(lambda: samples[2])
    assert calls <= 7_700 * SLACK
    assert launches <= 12


def test_a_call_of_process(cost):
    camera = clpipe.Pipeline()
    image = np.random.default_rng(0).random((64, 64, 3), np.float32)
    camera.process(image, "a")
    camera.process(image, "a", iso=1000)
    for settings, ceiling in (({}, 3_600), ({"iso": 1100}, 6_000)):
        calls, launches = cost.of(lambda s=settings: camera.process(image, "b", **s))
        assert calls <= ceiling * SLACK
        assert launches <= 7


def test_an_image_of_run(renders, device, cost, tmp_path):
    (tmp_path / "out").mkdir()
    worker, jobs = worker_of(tmp_path)

    def run(part):
        waiting = queue.SimpleQueue()
        for job in [*part, None]:
            waiting.put(job)
        outcomes = InTurn(worker, device, None, lambda: None).run(waiting)
        assert [outcome.status for outcome in outcomes] == ["done"] * len(part)

    run(jobs[:2])
    few, many = cost.of(lambda: run(jobs[2:8])), cost.of(lambda: run(jobs[8:]))
    calls, launches = ((b - a) / 10 for a, b in zip(few, many, strict=True))
    assert calls <= 4_000 * SLACK
    assert launches <= 7

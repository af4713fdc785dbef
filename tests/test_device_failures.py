"""Device failures: errors and states as drivers report them."""

import threading
from dataclasses import replace

import numpy as np
import pyopencl as cl
import pytest

from clpipe.base.errors import DeviceError, DeviceFailedError
from clpipe.batch.threads import Batch
from clpipe.chain.making import make_chain
from clpipe.chain.settings import settings_from
from clpipe.engine import programs
from clpipe.engine.device import Device
from clpipe.engine.recovery import MAX_FAILURES
from clpipe.engine.runner import Runner
from tests.conftest import fail_launches, worker_of

IMAGE = np.full((20, 30, 3), 0.5, np.float16)


class Fault:
    """Makes launches fail like NVIDIA's driver after an invalid read.

    The launch, and from then on everything in its context, raises CL_OUT_OF_RESOURCES, which
    pyopencl raises as a MemoryError. There is no GPU here, so this stands in for one.

    Args:
        launches: numbers of the launches that fail, counted over all contexts.
    """

    def __init__(self, monkeypatch, launches):
        self.launches = launches
        self.count = 0
        self.dead = {}  # contexts, held so that no other gets the same handle
        self.lock = threading.Lock()
        launch, copy = cl.enqueue_nd_range_kernel, cl.enqueue_copy

        def launched(on, *arguments, **options):
            with self.lock:
                number, self.count = self.count, self.count + 1
                if number in self.launches:
                    self.dead[on.context.int_ptr] = on.context
            self.check(on)
            return launch(on, *arguments, **options)

        def copied(on, *arguments, **options):
            self.check(on)
            return copy(on, *arguments, **options)

        monkeypatch.setattr(cl, "enqueue_nd_range_kernel", launched)
        monkeypatch.setattr(cl, "enqueue_copy", copied)

    def check(self, queue):
        if queue.context.int_ptr in self.dead:
            raise cl.MemoryError("clEnqueue failed: OUT_OF_RESOURCES")


@pytest.fixture(autouse=True)
def _contexts_of_their_own(monkeypatch):
    monkeypatch.setattr(programs, "_by_device", {})  # those of other tests stay shared


@pytest.fixture(params=["CPU", "GPU"])
def device(device, request):
    """The device, and the same device as if it had its own memory."""
    return Device(replace(device.info, type=request.param))


def runner_on(device):
    """A chain on a device of its own, ready to run."""
    chain = make_chain(settings_from({"stages": ["exposure", "gamma"]}))  # a single launch
    runner = Runner(chain, Device(device.info))
    runner.compile()
    return runner


def test_a_launch_that_fails_is_tried_again_in_a_new_context(device, monkeypatch):
    runner = runner_on(device)
    expected = runner.run(IMAGE, "k").encoded
    fault = Fault(monkeypatch, {1})  # at the second image
    assert np.array_equal(runner.run(IMAGE, "k").encoded, expected)
    assert np.array_equal(runner.run(IMAGE, "k").encoded, expected)
    assert len(fault.dead) == 1


def test_an_image_that_fails_again_fails_alone(device, monkeypatch):
    runner = runner_on(device)
    expected = runner.run(IMAGE, "k").encoded
    Fault(monkeypatch, {0, 1})
    with pytest.raises(DeviceFailedError, match="failed: clEnqueue failed: OUT_OF_RESOURCES"):
        runner.run(IMAGE, "k")
    assert np.array_equal(runner.run(IMAGE, "k").encoded, expected)


def test_a_device_that_fails_at_everything_is_given_up(device, monkeypatch):
    runner = runner_on(device)
    Fault(monkeypatch, range(1000))
    for _ in range(MAX_FAILURES - 1):
        with pytest.raises(DeviceFailedError):
            runner.run(IMAGE, "k")
    with pytest.raises(DeviceError, match="failed for 3 images in a row, so it is no longer used"):
        runner.run(IMAGE, "k")
    with pytest.raises(DeviceError, match="OUT_OF_RESOURCES"):
        Runner(runner.chain, Device(device.info)).compile()


@pytest.mark.parametrize(
    "error", [cl.MemoryError("OUT_OF_RESOURCES"), cl.RuntimeError("INVALID_OPERATION")]
)
def test_a_launch_that_fails_once_is_tried_again(device, monkeypatch, error):
    runner = runner_on(device)
    expected = runner.run(IMAGE, "k").encoded
    fail_launches(monkeypatch, error, 0)
    assert np.array_equal(runner.run(IMAGE, "k").encoded, expected)


def test_kernels_that_fail_in_a_batch_change_no_byte(device, write_exr, tmp_path, monkeypatch):
    for i in range(12):
        pixels = np.random.default_rng(i).random((20, 30, 3)).astype(np.float32)
        write_exr(f"in/{i:02}.exr", pixels)

    def made(name):
        worker, jobs = worker_of(tmp_path, name, values={"stages": ["exposure", "gamma"]})
        # Both have one context, as two on one device have: what breaks it for one does for both.
        batch = Batch(worker, [Device(device.info), Device(device.info)])
        statuses = [outcome.status for outcome in batch.run(jobs)]
        return statuses, {p.name: p.read_bytes() for p in (tmp_path / name).iterdir()}

    expected = made("whole")
    fault = Fault(monkeypatch, {3})  # the first two launches are of tiny images, to compile
    assert made("failing") == expected
    assert expected[0] == ["done"] * 12
    assert len(fault.dead) == 1

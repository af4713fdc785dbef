"""Transfers to and from a device: zero-copy, or through staging buffers."""

from dataclasses import replace
from typing import Any

import numpy as np
import pyopencl as cl
import pytest

from clpipe.base.errors import DeviceFailedError
from clpipe.chain.making import make_chain
from clpipe.chain.settings import settings_from
from clpipe.engine import programs
from clpipe.engine.buffers import crop_patches
from clpipe.engine.check import example
from clpipe.engine.device import Device
from clpipe.engine.extents import Box
from clpipe.engine.options import RunOptions, Timing
from clpipe.engine.runner import Runner
from clpipe.stage import Kind
from tests.conftest import fail_launches

IMAGES = [example(Kind.RGB, (40, 48), half=True, seed=seed) for seed in range(5)]


def planes_of(image: np.ndarray) -> np.ndarray:
    """Return the channels of an image as planes, (3, height, width)."""
    return np.ascontiguousarray(image.transpose(2, 0, 1))


@pytest.fixture
def runner(device: Device) -> Runner:
    """A single launch on its own device."""
    return Runner(make_chain(settings_from({"stages": ["exposure", "gamma"]})), Device(device.info))


@pytest.fixture
def copied(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The sizes of the host's copies of sources and results."""
    sizes: list[int] = []
    copy = np.copyto

    def counted(to: np.ndarray, *arguments: Any, **options: Any) -> None:
        sizes.append(to.size)
        copy(to, *arguments, **options)

    monkeypatch.setattr(np, "copyto", counted)
    return sizes


def test_a_cpu_uses_an_image_where_it_is(runner, copied):
    image = IMAGES[0].copy()
    image.setflags(write=False)
    into = np.zeros(image.shape, np.uint8)
    runner.compile()
    copied.clear()
    assert runner.run(image, "k", RunOptions(into=into)).encoded is into
    expected = Runner(runner.chain, None).run(image, "k").encoded
    assert np.abs(into.astype(int) - expected).max() <= 1
    assert not copied
    padded = np.zeros((60, 40, 3), np.float16)  # with rows after the image, for whole blocks
    padded[:37] = image[:37, :40]
    whole = runner.run(padded[:37].copy(), "k").encoded
    assert len(copied) == 1
    assert np.array_equal(runner.run(padded[:37], "k").encoded, whole)
    assert len(copied) == 1


@pytest.mark.parametrize(
    "changed",
    [
        pytest.param(lambda image: image[::-1].copy()[::-1], id="rows upside down"),
        pytest.param(lambda image: np.concatenate([image] * 2, axis=1)[:, :48], id="part of rows"),
        pytest.param(np.asfortranarray, id="columns first"),
        pytest.param(lambda image: planes_of(image).transpose(1, 2, 0), id="planes"),
    ],
)
@pytest.mark.parametrize("type_", ["CPU", "GPU"])
def test_an_image_may_lie_in_memory_in_any_way(runner, type_, changed):
    runner.device = Device(replace(runner.device.info, type=type_))
    expected = runner.run(IMAGES[0], "k").encoded
    assert np.array_equal(runner.run(changed(IMAGES[0]), "k").encoded, expected)


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_planes_are_read_where_they_are(runner, copied, dtype):
    image = IMAGES[0].astype(dtype)
    expected = runner.run(image, "k").encoded
    planar = planes_of(image).transpose(1, 2, 0)
    assert np.array_equal(runner.run(planar, "k").encoded, expected)
    copied.clear()
    assert np.array_equal(runner.run(planar, "k").encoded, expected)
    assert not copied
    for memory in (20_000, 9_000):  # in tiles
        runner.device.memory = memory
        assert np.array_equal(runner.run(planar, "k").encoded, expected)


@pytest.mark.parametrize("type_", ["CPU", "GPU"])
@pytest.mark.parametrize("memory", [None, 300_000])  # whole, and in tiles
def test_both_ways_give_the_same(device, type_, memory):
    chain = make_chain(settings_from({"iso": 3200, "white_balance": {"method": "gray_world"}}))
    one, two = (
        Runner(chain, Device(replace(device.info, type=kind), size), ("normalize",), final=True)
        for kind, size in (("CPU", None), (type_, memory))
    )
    for image in (example(Kind.RGB, (90, 200), half=True, seed=seed) for seed in range(3)):
        expected, found = one.run(image, "k"), two.run(image, "k")
        for name in ("final", "encoded", "kept", "estimates"):
            np.testing.assert_equal(getattr(found, name), getattr(expected, name))
        boxes = [Box(x, 2 * x, x + 20, 2 * x + 16) for x in (0, 7, 25)]
        patches = two.submit(image, "k", RunOptions(boxes=boxes))()
        np.testing.assert_equal(patches.encoded, crop_patches(expected.encoded, boxes))


def queued(device: Device, monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """Record the following enqueued operations and their queues."""
    seen = []

    def watched(name: str) -> None:
        real = getattr(cl, name)

        def call(queue: cl.CommandQueue, *arguments: Any, **options: Any) -> cl.Event:
            seen.append((name, queue.int_ptr))
            return real(queue, *arguments, **options)

        monkeypatch.setattr(cl, name, call)

    watched("enqueue_copy")
    watched("enqueue_nd_range_kernel")
    return seen


@pytest.fixture
def gpu_runner(runner: Runner) -> Runner:
    """The same on a device with memory of its own, as far as clpipe knows."""
    runner.device = Device(replace(runner.device.info, type="GPU"))
    runner.compile()
    return runner


def test_transfers_of_an_image_run_beside_the_kernels_of_its_neighbours(gpu_runner, monkeypatch):
    expected = [gpu_runner.run(image, "k").encoded for image in IMAGES]
    device, gate = gpu_runner.device, cl.UserEvent(gpu_runner.device.flow.context)
    seen = queued(device, monkeypatch)
    # Kernels are held back: the first one's, and so all that follow.
    cl._enqueue_marker_with_wait_list(device.flow.queue, [gate])
    timings: list[list[Timing]] = [[], []]
    begun = [gpu_runner.submit(IMAGES[i], "k", RunOptions(timings[i])) for i in range(2)]
    target = ["enqueue_copy", "enqueue_nd_range_kernel", "enqueue_copy"] * 2
    assert [name for name, _ in seen] == target  # and the host did not wait
    up, run, down = (queue for _, queue in seen[:3])
    assert len({up, run, down}) == 3
    assert [queue for _, queue in seen[3:]] == [up, run, down]
    gate.set_status(cl.command_execution_status.COMPLETE)
    results = [wait().encoded for wait in begun]
    assert all(np.array_equal(a, b) for a, b in zip(results, expected, strict=False))
    (sent, _, _), (sent_next, launched_next, _) = timings
    assert sent.start <= sent_next.start <= launched_next.start
    # More than can be on the way: the oldest is waited for.
    waits = [gpu_runner.submit(image, "k") for image in IMAGES]
    assert [np.array_equal(wait().encoded, e) for wait, e in zip(waits, expected, strict=True)] == [
        True
    ] * 5


@pytest.mark.slow
def test_images_that_are_only_floats_do_not_mix(gpu_runner):
    runner = Runner(gpu_runner.chain, gpu_runner.device, encode=False, final=True)
    expected = [runner.run(image, "k").final for image in IMAGES]
    waits = [runner.submit(image, "k") for image in IMAGES]
    for wait, image in zip(waits, expected, strict=True):
        assert np.array_equal(wait().final, image)


def test_a_source_that_is_there_is_not_sent_again(gpu_runner):
    image = IMAGES[0].copy()

    def sent(unchanged: bool) -> tuple[int, np.ndarray]:
        timings: list[Timing] = []
        result = gpu_runner.submit(image, "k", RunOptions(timings, unchanged=unchanged))()
        return [t.name for t in timings].count("upload"), result.encoded

    (first, pixels), (again, same) = sent(True), sent(True)
    assert (first, again) == (1, 0) and np.array_equal(pixels, same)
    image[:] = IMAGES[1]
    changed, other = sent(False)
    assert changed == 1 and np.array_equal(other, gpu_runner.run(IMAGES[1], "k").encoded)
    image = image.copy()
    assert sent(True)[0] == 1  # another array


@pytest.mark.parametrize("fails", [0, 1])
def test_an_error_of_one_image_leaves_the_others_whole(gpu_runner, monkeypatch, fails):
    monkeypatch.setattr(programs, "_by_device", {})
    expected = [gpu_runner.run(image, "k").encoded for image in IMAGES]
    # And when that image is tried again.
    fail_launches(monkeypatch, cl.RuntimeError("INVALID_OPERATION"), fails, 2)
    begun = [gpu_runner.submit(image, "k") for image in IMAGES[:2]]
    for number, wait in enumerate(begun):
        if number == fails:
            with pytest.raises(DeviceFailedError, match="INVALID_OPERATION"):
                wait()
        else:
            assert np.array_equal(wait().encoded, expected[number])
    assert np.array_equal(gpu_runner.run(IMAGES[2], "k").encoded, expected[2])

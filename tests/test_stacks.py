"""Stacks: images that share launches get the same bits as single images."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pyopencl as cl
import pytest

from clpipe.batch.threads import Batch
from clpipe.chain.making import make_chain
from clpipe.chain.settings import settings_from
from clpipe.engine import stack
from clpipe.engine.buffers import crop_patches
from clpipe.engine.check import check_stack, example
from clpipe.engine.device import Device
from clpipe.engine.extents import Box
from clpipe.engine.options import DEFAULTS, RunOptions
from clpipe.engine.runner import Result, Runner
from clpipe.engine.service import Frame, Service
from clpipe.stage import Kind
from tests.conftest import worker_of

# These chains have each kind of launch: stencils, resampling, sums, a mosaic with a period.
CHAINS = {
    "default": {"row_noise": {"sigma": 0.002}},
    "others": {
        "stages": [
            "resize",
            "exposure",
            "mosaic",
            "quantize",
            "normalize",
            "demosaic",
            "gamma",
        ],
        "resize": {"scale": 0.5},
        "exposure": {"method": "auto"},
        "mosaic": {"method": "array", "array": "x-trans"},
    },
}
SIZES = [(40, 48), (23, 61), (70, 33)]


def equal(one: Result, two: Result) -> None:
    """Fail unless two results are the same, bit for bit."""
    for name in ("final", "encoded", "kept", "estimates"):
        np.testing.assert_equal(getattr(one, name), getattr(two, name), err_msg=name)


@pytest.fixture(params=["CPU", pytest.param("GPU", marks=pytest.mark.slow)])
def on(device, request):
    """The device, and the same device as if it had its own memory."""
    return Device(replace(device.info, type=request.param))


class Asked(NamedTuple):
    """An image to submit to a runner."""

    runner: Runner
    image: np.ndarray
    noise_key: str
    options: RunOptions = DEFAULTS

    @property
    def frame(self):
        runner = self.runner
        results = runner.keep, runner.encode, runner.final
        return Frame(runner.chain, self.image, self.noise_key, *results, self.options)


def submit_batch(asked):
    """Return functions that wait for images which a service develops together."""
    service = Service([asked[0].runner.device])
    return [each.result for each in service.develop([each.frame for each in asked])]


def submissions(device, stages, sizes=SIZES):
    """An image of each size, each with an ISO, gains and curves of its own, in halves."""
    all_ = []
    for number, size in enumerate(sizes):
        own = {"iso": 400 * 2**number, "gamma": {"method": "power", "exponent": 2.0 + number / 10}}
        chain = make_chain(settings_from({**own, **stages}))
        runner = Runner(chain, device, ("normalize",), True)
        image = example(Kind.RGB, size, half=True, seed=number)
        all_.append(Asked(runner, image, f"key {number}"))
    return all_


@pytest.mark.parametrize("name", CHAINS)
def test_members_have_the_bits_that_they_have_alone(on, launches, name):
    submitted = submissions(on, CHAINS[name])
    alone = [each.runner.run(each.image, each.noise_key) for each in submitted]
    launches.clear()
    for wait, expected in zip(submit_batch(submitted), alone, strict=True):
        equal(wait(), expected)
    assert {size[2:] for size in launches} == {(3,)}
    assert len(launches) < 20


def test_patches_of_one_image_and_of_others_go_together(on, launches):
    submitted = submissions(on, CHAINS["default"])
    wholes = [each.runner.run(each.image, each.noise_key) for each in submitted]
    boxes = [Box(0, 0, 16, 20), Box(7, 3, 23, 23), Box(16, 1, 32, 21)]
    cut = [each._replace(options=RunOptions(boxes=boxes)) for each in submitted]
    launches.clear()
    for wait, whole in zip(submit_batch(cut), wholes, strict=True):
        found = wait()
        np.testing.assert_equal(found.encoded, crop_patches(whole.encoded, boxes))
        np.testing.assert_equal(
            found.kept["normalize"], crop_patches(whole.kept["normalize"], boxes)
        )
    assert {size[2:] for size in launches} == {(9,)}


@pytest.mark.slow
def test_the_check_of_a_device_tries_them(on, launches):
    result = check_stack(on)
    assert result.passed and result.difference.differing == 0 and result.cases == 7
    # Only one image is large enough to run in bands.
    assert {size[2:] for size in launches} == ({(6,), (1,)} if on.info.cpu else {(7,), (1,)})


@pytest.mark.parametrize("sizes", [[(1, 7), (1, 40), (1, 1)], [(9, 1), (2, 1), (30, 1)]])
def test_lines_of_pixels(on, sizes):
    submitted = submissions(on, {"stages": ["mosaic", "demosaic", "gamma"]}, sizes)
    runners = {each.runner for each in submitted}
    for runner in runners:
        runner.keep = ()
    alone = [each.runner.run(each.image, each.noise_key) for each in submitted]
    for wait, expected in zip(submit_batch(submitted), alone, strict=True):
        equal(wait(), expected)


def test_more_than_one_stack_where_memory_is_short(on, launches, monkeypatch):
    submitted = submissions(on, CHAINS["default"])
    alone = [each.runner.run(each.image, each.noise_key) for each in submitted]
    monkeypatch.setattr(stack, "MIN_MEMBERS", 2)

    def depths():
        """Submit the images and return how many of them each launch covers."""
        launches.clear()
        for wait, expected in zip(submit_batch(submitted), alone, strict=True):
            equal(wait(), expected)
        return {size[2:] for size in launches}

    # The bytes of a member depend on the device's lanes, so find the largest limit that splits.
    limit = 2**21
    assert depths() == {(3,)}
    while (found := depths()) == {(3,)}:
        limit = limit * 4 // 5
        monkeypatch.setattr(stack, "MAX_STACK_BYTES", dict.fromkeys((True, False), limit))
    assert found == {(2,), (1,)}
    on.memory = limit // 3  # less than one member takes
    assert depths() == {(1,)}


def test_what_takes_other_kernels_goes_by_itself(on, launches):
    submitted = submissions(on, CHAINS["default"])
    chain = make_chain(settings_from({"stages": ["exposure", "gamma"]}))
    other = submitted[0]._replace(runner=Runner(chain, on))
    alone = [each.runner.run(each.image, each.noise_key) for each in (*submitted, other)]
    launches.clear()
    waits = submit_batch([submitted[0], other, *submitted[1:]])
    found = [wait() for wait in waits]
    for result, expected in zip([found[0], *found[2:], found[1]], alone, strict=True):
        equal(result, expected)
    assert {size[2:] for size in launches} == {(3,), (1,)}


@pytest.mark.parametrize("error", [cl.RuntimeError("INVALID_OPERATION"), cl.MemoryError("full")])
def test_a_stack_that_fails_is_done_image_by_image(on, monkeypatch, error):
    submitted = submissions(on, CHAINS["default"])
    alone = [each.runner.run(each.image, each.noise_key) for each in submitted]
    before = submit_batch(submitted)
    launch = cl.enqueue_nd_range_kernel

    def launched(queue, kernel, size, *rest, **options):
        if size[2] > 1:
            raise error
        return launch(queue, kernel, size, *rest, **options)

    monkeypatch.setattr(cl, "enqueue_nd_range_kernel", launched)
    for wait, expected in zip([*before, *submit_batch(submitted)], alone * 2, strict=True):
        equal(wait(), expected)


WAYS = {
    "in turn": lambda worker, device: Batch(worker, [device], 1, in_flight=1),
    "threads": lambda worker, device: Batch(worker, [device], 2),
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("what", ["pictures", "a burst and its truth", "patches"])
def test_small_images_of_a_run_share_launches(
    device, write_exr, tmp_path, monkeypatch, launches, way, what
):
    rng = np.random.default_rng(0)
    for number in range(7):
        size = (24, 32) if number % 3 else (17, 40)
        pixels = rng.random((*size, 3)).astype(np.float32) / 2
        write_exr(tmp_path / f"in/r{number}.exr", pixels)
    submitted = {"a burst and its truth": {"frames": 3, "truth": ("clean",)}}
    submitted["patches"] = {"patch": 16, "patches_per_image": 2}

    def made(name):
        worker, jobs = worker_of(tmp_path, name, values={"iso": 3200}, **submitted.get(what, {}))
        outcomes = list(WAYS[way](worker, device).run(jobs))
        assert [outcome.status for outcome in outcomes] == ["done"] * 7
        files = (tmp_path / name).rglob("*.png")
        return {file.name: file.read_bytes() for file in files}

    launches.clear()
    together = made("together")
    most = max(size[2] for size in launches)
    monkeypatch.setattr(stack, "MIN_MEMBERS", 1000)
    launches.clear()
    alone = made("alone")
    assert max(size[2] for size in launches) == 1
    assert together == alone and len(alone) == {"pictures": 7, "patches": 14}.get(what, 35)
    if (what, way) != ("pictures", "threads"):  # threads decide which pictures meet
        assert most > 1


def test_a_small_image_that_fails_fails_alone(device, write_exr, tmp_path, monkeypatch):
    for number in range(6):
        grey = 0.5 if number == 2 else 0.2
        write_exr(tmp_path / f"in/r{number}.exr", np.full((16, 16, 3), grey, np.float32))
    worker, jobs = worker_of(tmp_path)
    work = Runner.work

    def planted(runner, image, *given):
        if image.mean() > 0.4:
            raise ValueError("a mistake")
        return work(runner, image, *given)

    monkeypatch.setattr(Runner, "work", planted)
    outcomes = list(Batch(worker, [device], in_flight=1).run(jobs))
    assert [outcome.status for outcome in outcomes] == ["done"] * 2 + ["failed"] + ["done"] * 3
    assert outcomes[2].error.endswith("r2.exr: unexpected ValueError: a mistake")

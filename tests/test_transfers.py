"""Pixels on their way to a device and back: where they lie, or through staging buffers."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from clpipe.chain.chain import make_chain
from clpipe.chain.settings import settings_from
from clpipe.engine.check import example
from clpipe.engine.device import Device
from clpipe.engine.runner import Runner
from clpipe.stage import Kind

IMAGES = [example(Kind.RGB, (40, 48), half=True, seed=seed) for seed in range(5)]


def planes_of(image: np.ndarray) -> np.ndarray:
    """The channels of an image one behind the other, (3, height, width)."""
    return np.ascontiguousarray(image.transpose(2, 0, 1))


@pytest.fixture
def runner(device: Device) -> Runner:
    """A single launch, on a device of its own."""
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
    assert runner.run(image, "k", into=into).encoded is into
    expected = Runner(runner.chain, None).run(image, "k").encoded
    assert np.abs(into.astype(int) - expected).max() <= 1
    assert not copied
    room = np.zeros((40, 40, 3), np.float16)  # three rows behind the image
    room[:37] = image[:37, :40]
    whole = runner.run(room[:37].copy(), "k").encoded
    assert len(copied) == 1
    assert np.array_equal(runner.run(room[:37], "k").encoded, whole)
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
@pytest.mark.parametrize("memory", [None, 110_000])  # whole, and in tiles
def test_both_ways_give_the_same(device, type_, memory):
    chain = make_chain(settings_from({"iso": 3200, "white_balance": {"method": "gray_world"}}))
    one, two = (
        Runner(chain, Device(replace(device.info, type=kind), size), ("normalize",), final=True)
        for kind, size in (("CPU", None), (type_, memory))
    )
    for image in IMAGES[:3]:
        expected, found = one.run(image, "k"), two.run(image, "k")
        for name in ("final", "encoded", "kept", "estimates"):
            np.testing.assert_equal(getattr(found, name), getattr(expected, name))

"""Launches that are skipped because their results are on the device: same bits."""

from dataclasses import replace

import numpy as np
import pyopencl as cl
import pytest

from clpipe.chain.making import make_chain
from clpipe.chain.settings import settings_from
from clpipe.engine.check import example
from clpipe.engine.device import Device
from clpipe.engine.extents import Box
from clpipe.engine.options import RunOptions
from clpipe.engine.plan import make_plan
from clpipe.engine.runner import Runner
from clpipe.stage import Kind
from tests.conftest import fail_launches
from tests.test_tiles import same

GRAY_WORLD = {"white_balance": {"method": "gray_world"}}
MEAN = {"denoise": {"method": "mean"}}


def chain_of(**settings):
    return make_chain(settings_from({"iso": 800, **settings}))


class Developer:
    """Develops images again and again on one device that holds what is between launches."""

    def __init__(self, info):
        self.device = Device(info)
        self.runners = {}

    def runner(self, chain, keep=(), final=False):
        first = Runner(chain, self.device, keep, final=final, incremental=True)
        return self.runners.setdefault((keep, final), first).for_chain(chain)

    def launches(self, image, key="k", unchanged=True, **settings):
        """The launches that ran, by the last word of their names."""
        timings = []
        runner = self.runner(chain_of(**settings))
        runner.submit(image, key, RunOptions(timings, unchanged=unchanged))()
        return [t.name.split(".")[-1] for t in timings if not t.transfer]


LINES, LOAD, NOISE = "lines", "inverse_color_matrix", "demosaic"
AFTER = ["bounded_green", "denoise", "sharpen", "gamma"]


def test_only_launches_that_a_change_touches_run_again(device):
    developer, image = Developer(device.info), example(Kind.RGB, (50, 70), half=True)
    ran = developer.launches
    assert ran(image) == [LINES, LOAD, NOISE, *AFTER]
    assert ran(image) == ["gamma"]
    assert ran(image, gamma={"exponent": 2.0, "method": "power"}) == ["gamma"]
    assert ran(image) == ["gamma"]
    assert ran(image, sharpen={"amount": 0.9}) == ["gamma"]
    assert ran(image, denoise={"luma_strength": 3}) == AFTER[1:]
    assert ran(image) == AFTER[1:]
    assert ran(image, exposure={"ev": 1}) == [NOISE, *AFTER]
    assert ran(image, "another") == [LINES, NOISE, *AFTER]
    assert ran(image, seed=1) == [LINES, NOISE, *AFTER]
    assert ran(image, iso=3200) == [LINES, NOISE, *AFTER]
    assert ran(image, iso=3200, gamma={"exponent": 2.0, "method": "power"}) == ["gamma"]
    assert ran(image, iso=3200, unchanged=False) == [LOAD, NOISE, *AFTER]
    assert ran(image.copy(), iso=3200) == [LOAD, NOISE, *AFTER]
    assert ran(image[:, :69].copy(), iso=3200) == [LINES, LOAD, NOISE, *AFTER]


def test_what_is_estimated_from_the_image_is_estimated_again_when_it_changes(device):
    developer, image = Developer(device.info), example(Kind.RGB, (50, 70), half=True)

    def ran(**settings):
        return developer.launches(image, **settings, **GRAY_WORLD)

    sums = ["normalize", "add_up", "gray_world"]
    every = ran()
    assert [name for name in every if name in sums] == sums
    assert ran(denoise={"luma_strength": 3}) == AFTER[1:]
    assert ran(iso=3200) == [LINES, *every[2:]]


@pytest.mark.slow
def test_launches_before_a_method_that_is_switched_are_left_out(device):
    developer, image = Developer(device.info), example(Kind.RGB, (50, 70), half=True)
    for settings in ({}, MEAN):
        developer.launches(image, **settings)  # compiles
    developer.launches(image)
    assert developer.launches(image, **MEAN)[0] == "denoise"
    assert developer.launches(image) == AFTER[1:]


def test_nothing_is_left_out_after_an_image_that_was_interrupted(device, monkeypatch):
    developer, image = Developer(device.info), example(Kind.RGB, (50, 70), half=True)
    every = developer.launches(image)
    fail_launches(monkeypatch, KeyboardInterrupt(), 3)
    with pytest.raises(KeyboardInterrupt):
        developer.launches(image, "another")
    assert developer.launches(image) == every


def test_planes_lie_alike_where_stencils_differ_a_little():
    borders = {
        make_plan(chain_of(**settings), incremental=True).border
        for settings in ({}, {"skip": ["sharpen"]}, {"demosaic": {"method": "bilinear"}})
    }
    assert borders == {4}


class Walk:
    """Changes at random, each followed by a comparison with a runner that holds nothing."""

    def __init__(self, info, device, monkeypatch):
        self.random = np.random.default_rng(0)
        self.developer, self.plain = Developer(info), device
        self.patch = monkeypatch
        sizes = ((50, 70), (33, 130), (1, 40), (60, 1))
        self.images = [example(Kind.RGB, size, half=True) for size in sizes]
        self.image, self.key, self.settings, self.results = self.images[0], "k", {}, ((), False)
        self.expected = {}

    def choice(self, *options):
        return options[self.random.integers(len(options))]

    def change(self):
        pick = self.choice
        match pick("value", "value", "value", "method", "image", "results", "pixels", "other"):
            case "value":
                name, value = pick(
                    ("iso", pick(800, 3200)),
                    ("seed", pick(0, 1)),
                    ("exposure", {"ev": pick(0, 0.5)}),
                    ("gamma", pick({}, {"method": "power", "exponent": 2.0})),
                    ("denoise", pick({}, {"luma_strength": 3}, {"chroma_strength": 0.5})),
                    ("sharpen", {"amount": pick(0.3, 0.6)}),
                    ("optical_blur", {"sigma": pick(0.4, 0.38)}),
                )
                self.settings = {**self.settings, name: value}
                self.key = pick("k", "k", "l")
            case "method":
                self.settings = {**self.settings, **pick(MEAN, GRAY_WORLD)}
                for name in pick(("denoise",), ("white_balance",), ()):
                    self.settings.pop(name, None)
            case "image":
                self.image = pick(self.images[0], *self.images)
            case "results":
                self.results = pick(((), False), ((), True), (("normalize",), False))
            case "pixels":
                self.image += np.float16(0.01)
                return False
            case "other":
                self.interrupt()
        return True

    def interrupt(self):
        """Use the same buffers for something else, or lose them."""
        device = self.developer.device
        plain = Runner(chain_of(**self.settings), device)
        match self.choice("plain", "patches", "tiles", "failure"):
            case "plain":
                plain.run(self.images[0], "k")
            case "patches":
                boxes = [Box(0, 0, 20, 20), Box(20, 10, 40, 30)]
                runner = self.developer.runner(plain.chain)
                runner.submit(self.images[0], "k", RunOptions(boxes=boxes))()
            case "tiles":
                device.memory, memory = 500_000, device.memory
                image = example(Kind.RGB, (100, 150), half=True)
                expected = Runner(plain.chain, self.plain).run(image, "k")
                same(self.developer.runner(plain.chain).run(image, "k"), expected)
                device.memory = memory
            case "failure":
                runner = self.developer.runner(plain.chain)
                with self.patch.context() as patch:
                    fail_launches(patch, cl.RuntimeError("the driver died"), self.choice(0, 2))
                    runner.submit(self.image, "other", RunOptions(unchanged=True))()

    def compare(self, unchanged):
        chain, (keep, final) = chain_of(**self.settings), self.results
        runner = self.developer.runner(chain, keep, final)
        timings = []
        found = runner.submit(self.image, self.key, RunOptions(timings, unchanged=unchanged))
        again = runner.submit(self.image, self.key, RunOptions(unchanged=True))
        expected = Runner(chain, self.plain, keep, final=final).run(self.image, self.key)
        same(found(), expected)
        same(again(), expected)
        ran = sum(not timing.transfer for timing in timings)
        return len(runner.plan(True, min(self.image.shape[:2]) > 1).launches) - ran


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["CPU", "GPU"])
def test_the_same_bits_after_any_changes(device, kind, monkeypatch):
    walk = Walk(replace(device.info, type=kind), device, monkeypatch)
    left_out = 0
    for _ in range(60):
        left_out += walk.compare(unchanged=walk.change())
    assert left_out > 100

"""An image has the same bits however the engine cuts it: tiles, patches, bands and stacks."""

from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl
import pytest

import clpipe
from clpipe.base.errors import ImageError
from clpipe.chain.chain import Chain
from clpipe.chain.layers import layer_of_array, with_layers
from clpipe.chain.making import make_chain
from clpipe.chain.settings import settings_from
from clpipe.engine.bindings import step_buffer
from clpipe.engine.check import (
    chain_for,
    check_stack,
    example,
    mosaic_parameters,
    sensor_parameters,
    stages_to_raw,
)
from clpipe.engine.device import Device
from clpipe.engine.extents import Box, whole_image
from clpipe.engine.ir import Histogram, Launch, Lines, Plan
from clpipe.engine.options import DEFAULTS, RunOptions
from clpipe.engine.runner import Result, Runner
from clpipe.engine.service import Frame, Service
from clpipe.engine.state import State
from clpipe.engine.tiles import LARGEST_TILE, buffer_sizes, halos_of, tiling_of
from clpipe.stage import Kind, StageRole
from clpipe.stages import DEFAULT_CHAIN
from tests import methods

GRAY_WORLD = {"white_balance": {"method": "gray_world"}}
WITH_STATE = [*DEFAULT_CHAIN]
WITH_STATE.insert(WITH_STATE.index("denoise"), "temporal_denoise")
TO_DEMOSAIC = ["mosaic", "inverse_white_balance", "white_balance", "demosaic"]
TO_REMOSAIC = [*TO_DEMOSAIC[:3], "remosaic", "demosaic"]
SIZE = (151, 203)


@dataclass
class Case:
    """A chain, as nested settings, and what is developed with it.

    Args:
        settings: with an ISO of 3200 if they have none.
        kind: of the image.
        size: height and width.
        tile: the columns and rows of a tile, without its halo; () is three fifths of the memory,
            and None stands for a chain that allows no tiles.
        frames: of a sequence; the result is that of the last.
        later: the number of later exposures.
        has_flow: whether temporal_denoise has a layer of flow.
        keep: stages whose images are kept.
        bands: whether some of its launches run in bands on a CPU.
        whole: whether samples are whole numbers.
        held: layers, which chains do not hold.
    """

    settings: dict[str, Any]
    kind: Kind = Kind.RGB
    size: tuple[int, int] = SIZE
    tile: tuple[int, ...] | None = (64, 48)
    frames: int = 1
    later: int = 0
    has_flow: bool = False
    keep: tuple[str, ...] = ()
    bands: bool = True
    whole: bool = False
    held: list[Any] = field(default_factory=list)

    def made(self, **changes: Any) -> Chain:
        """Make the chain with changed settings."""
        chain = make_chain(settings_from({"iso": 3200, **self.settings, **changes}), self.kind)
        if not self.has_flow:
            return chain
        flow = np.random.default_rng(0).normal(0, 4, (*self.size, 2)).astype(np.float32)
        layer = layer_of_array(chain, "temporal_denoise", flow, *self.size[::-1])
        self.held.append(layer)
        return with_layers(chain, {"temporal_denoise": layer})

    def images(self) -> list[np.ndarray]:
        """The frames, and the later exposures."""
        seeds = range(max(self.frames, 1 + self.later))
        images = [example(self.kind, self.size, half=not self.whole, seed=n) for n in seeds]
        return [image.astype(np.uint16) for image in images] if self.whole else images

    def develop(self, runner: Runner, boxes: tuple[Box, ...] = ()) -> Result:
        """Return the result of the last frame, or patches of it."""
        images = self.images()
        if self.frames == 1:
            options = RunOptions(boxes=boxes, later_exposures=images[1:])
            return runner.run(images[0], "k", options)
        state = State()
        return [runner.run(x, "k", RunOptions(boxes=boxes, state=state)) for x in images][-1]


LENS = {"method": "brown_conrady", "fx": 200.0, "k1": -0.1}
TWICE = {"stages": ["resize", "mosaic", "row_noise", "demosaic", "resize"]}
TWICE |= {"row_noise": {"sigma": 0.01}, "demosaic": {"method": "bilinear"}}
LATER = {"shutter": {"subframes": 3}, "sensor_noise": {"method": "staggered", "count": 3}}


def on(array: str, stages: list[str], **settings: Any) -> dict[str, Any]:
    """Settings of a chain on a filter array."""
    return {"mosaic": mosaic_parameters(array), "stages": stages, **settings}


CASES = {
    "default": Case({}, size=(61, 203)),
    "sums": Case(GRAY_WORLD, size=(150, 203)),
    "strip": Case(GRAY_WORLD, size=(901, 9)),
    # Two functions of one file read the mosaic, whose gains are recomputed at their taps.
    "edge_directed": Case({**GRAY_WORLD, "demosaic": {"method": "edge_directed"}}),
    "GBRG": Case({"mosaic": {"pattern": "GBRG"}, "white_balance": {"method": "white_patch"}}),
    "histogram": Case({"exposure": {"method": "auto"}}),
    "resampled": Case({"distortion": LENS, "resize": {"scale": 0.6}}, tile=()),
    "paper": Case(
        {"demosaic": {"method": "edge_directed_median"}, "denoise": {"method": "bilateral"}}
    ),
    "means": Case({"demosaic": {"method": "menon2007"}, "denoise": {"method": "mean"}}),
    "blocks": Case({"denoise": {"method": "non_local_means"}}),
    "quad": Case({"mosaic": mosaic_parameters("quad-RGGB"), "demosaic": {"method": "linear_mmse"}}),
    "resized twice": Case(
        TWICE | {"resize": {"scale": 0.9, "method": "lanczos3"}, "resize_2": {"scale": 0.7}},
        tile=(),
        keep=("resize", "row_noise"),
        bands=False,
    ),
    "sequence": Case({"stages": WITH_STATE}, tile=None, frames=3, keep=("temporal_denoise",)),
    "flow": Case(
        {"stages": WITH_STATE, "temporal_denoise": {"method": "flow", "threshold": 100.0}},
        tile=None,
        frames=2,
        has_flow=True,
    ),
    "later exposures": Case(
        {"stages": ["shutter", "mosaic", "sensor_noise"], **LATER}, later=2, bands=False, tile=None
    ),
    "DN": Case({"stages": ["normalize"]}, kind=Kind.RAW, bands=False, whole=True),
    "row": Case(
        {"stages": ["mosaic", "demosaic", "gamma"]}, size=(1, 900), tile=(24, 4), bands=False
    ),
    "column": Case(
        {"stages": ["mosaic", "demosaic", "gamma"]}, size=(900, 1), tile=(24, 4), bands=False
    ),
}
SLOW = {
    "percentile": Case({"exposure": {"method": "auto", "rule": "percentile"}}),
    **{
        f"every source of noise on {array}": Case(
            on(array, [*stages_to_raw()], **sensor_parameters())
        )
        for array in ("GRBG", "x-trans", "RGBW")
    },
    "estimated twice": Case(
        {
            "stages": ["mosaic", "white_balance", "demosaic", "mosaic", "white_balance"],
            "demosaic": {"method": "bilinear"},
            "white_balance_2": {"method": "white_patch"},
            **GRAY_WORLD,
        },
        keep=("mosaic", "white_balance", "mosaic_2"),
        bands=False,
    ),
    "period of 3": Case(
        on("RGB/GBR/BRG", TO_DEMOSAIC, demosaic={"method": "linear_mmse"}), bands=False
    ),
    "x-trans": Case(on("x-trans", TO_DEMOSAIC, demosaic={"method": "directional_mmse"})),
    **{
        f"{array}, {method}": Case(
            on(array, TO_REMOSAIC, remosaic={"method": method}, demosaic={"method": "bilinear"}),
            size=(203, 310),
            tile=(96, 64),
        )
        for array, method in (
            ("quad-RGGB", "binning"),
            ("nona-RGGB", "binning"),
            ("x-trans", "linear_mmse"),
        )
    },
}
CASES |= SLOW


def same(one: Result, two: Result) -> None:
    """Fail unless two results are the same, bit for bit."""
    for name in ("final", "encoded", "kept", "estimates"):
        np.testing.assert_equal(getattr(one, name), getattr(two, name), err_msg=name)


def memory_for(plan: Plan, columns: int, rows: int, lanes: int) -> int:
    """Return the memory of a tile with so many pixels, without its halo."""
    halo = 2 * halos_of(plan)[0] + lanes
    whole = whole_image(plan, columns + halo, rows + halo, lanes)
    return sum(buffer_sizes(plan, whole).values()) + 4 * 1024


@contextmanager
def memory_of(device: Device, memory: int):
    """Limit a device's memory, and check that it holds no more."""
    before, device.memory = device.memory, memory
    try:
        yield
        assert device.bytes_held <= memory
    finally:
        device.memory = before


def in_tiles(runner: Runner, image: np.ndarray, columns: int, rows: int) -> tuple[Result, int]:
    """The result of an image, which is the same in tiles of about that size, and their number.

    So are patches of it, made alone.
    """
    device = runner.device
    plan = runner.plan(image.dtype == np.float16, fold=min(image.shape[:2]) > 1)
    memory = memory_for(plan, columns, rows, device.info.lanes)
    tiling = tiling_of(plan, *image.shape[1::-1], device.info.lanes, memory, memory)
    whole = runner.run(image, "k")
    with memory_of(device, memory):
        same(whole, runner.run(image, "k"))
    for box in boxes_in(whole):
        same(whole.cropped([box]), runner.run(image, "k", RunOptions(boxes=[box])))
    return whole, len(tiling.tiles)


def in_less_memory(runner: Runner, image: np.ndarray, half: bool = False) -> None:
    """Check an image in three fifths of the memory, and the memory of each tile."""
    whole, device = runner.run(image, "k"), runner.device
    plan, size = runner.plan(half), (*image.shape[1::-1], device.info.lanes)
    memory = sum(buffer_sizes(plan, whole_image(plan, *size)).values()) * 6 // 10
    tiling = tiling_of(plan, *size, memory, memory)
    assert len(tiling.tiles) > 1
    for extents in tiling.tiles:
        sizes = buffer_sizes(plan, extents)
        assert all(each <= tiling.sizes[name] for name, each in sizes.items())
    with memory_of(device, memory):
        same(whole, runner.run(image, "k"))


def boxes_in(whole: Result) -> list[Box]:
    """Two patches of one size: one at an odd place, and one that ends with the image."""
    images = [x for x in (whole.final, whole.encoded, *whole.kept.values()) if x is not None]
    height, width = images[0].shape[:2]
    high, wide = min(height, 31), min(width, 37)
    places = ((width - wide) // 2 | 1, (height - high) // 2 | 1), (width - wide, height - high)
    left_top = [(min(x, width - wide), min(y, height - high)) for x, y in places]
    return [Box(x, y, x + wide, y + high) for x, y in left_top]


def narrow(device: Device, monkeypatch: pytest.MonkeyPatch) -> Device:
    """Return the device with bands in strips as narrow as can be."""
    monkeypatch.setattr("clpipe.engine.bands.SMALLEST", 256)
    monkeypatch.setattr("clpipe.engine.bands.SMALLEST_CACHE", 1)
    monkeypatch.setattr("clpipe.engine.discovery.private_cache", lambda: 1)
    return Device(replace(device.info, compute_units=3))


def banded(plan: Plan) -> list[Launch]:
    return [x for x in plan.launches if isinstance(x, Launch) and x.bands]


Way = Callable[[Case, Result, Device, pytest.FixtureRequest], None]


def tiles(case: Case, whole: Result, device: Device, request: pytest.FixtureRequest) -> None:
    runner = Runner(case.made(), device, case.keep, final=True)
    if case.tile:
        result, count = in_tiles(runner, case.images()[0], *case.tile)
        same(result, whole)
        assert count >= 3
    elif case.tile is not None:
        in_less_memory(runner, case.images()[0], half=True)


def patches(case: Case, whole: Result, device: Device, request: pytest.FixtureRequest) -> None:
    runner = Runner(case.made(), device, final=True)
    boxes = boxes_in(replace(whole, kept={}))
    same(replace(whole, kept={}).cropped(boxes), case.develop(runner, boxes))


def bands(case: Case, whole: Result, device: Device, request: pytest.FixtureRequest) -> None:
    device = narrow(device, request.getfixturevalue("monkeypatch"))
    runner = Runner(case.made(), device, case.keep, final=True)
    assert bool(banded(runner.plan_for(case.images()[0]))) is case.bands
    same(whole, case.develop(runner))
    patches(case, whole, device, request)


def own_memory(case: Case, whole: Result, device: Device, request: pytest.FixtureRequest) -> None:
    other = Device(replace(device.info, type="GPU"))
    same(whole, case.develop(Runner(case.made(), other, case.keep, final=True)))


def numpy(case: Case, whole: Result, device: Device, request: pytest.FixtureRequest) -> None:
    """NumPy computes the same, but for rounding."""
    expected = case.develop(Runner(case.made(), None, case.keep, final=True))
    for name, image in {"final": expected.final, **expected.kept}.items():
        found = whole.final if name == "final" else whole.kept[name]
        np.testing.assert_allclose(found, image, atol=1e-3, err_msg=name)
    if expected.encoded is not None:
        assert np.abs(whole.encoded.astype(int) - expected.encoded).max() <= 1
    for step, values in expected.estimates.items():
        assert whole.estimates[step] == pytest.approx(values, rel=1e-6)


def kept(case: Case, whole: Result, device: Device, request: pytest.FixtureRequest) -> None:
    names = [step.name for step in case.made().steps]
    for keep in (names, names[1::3]):
        found = case.develop(Runner(case.made(), device, keep, final=True))
        assert list(found.kept) == keep
        same(replace(whole, kept={}), replace(found, kept={}))
        for name in {*case.keep} & {*keep}:
            np.testing.assert_array_equal(found.kept[name], whole.kept[name])
        if names[-1] in keep:
            np.testing.assert_array_equal(found.kept[names[-1]], found.final)


def submit_batch(submitted: list[Any]) -> list[Callable[[], Result]]:
    """Return functions that wait for images which a service develops together."""
    frames = [
        Frame(r.chain, image, key, r.keep, r.encode, r.final, options)
        for r, image, key, options in submitted
    ]
    return [each.result for each in Service([submitted[0][0].device]).develop(frames)]


def stack(case: Case, whole: Result, device: Device, request: pytest.FixtureRequest) -> None:
    """Images of other sizes and numbers share its launches, and so do their patches."""
    if case.frames > 1 or case.later:
        return
    for on in (device, Device(replace(device.info, type="GPU"))):
        first, submitted = Runner(case.made(), on, case.keep, final=True), []
        for number in range(3):
            (image,), shift = case.images(), 9 * number
            image = image[shift * (len(image) > 9) :, shift * (image.shape[1] > 9) :]
            runner = Runner(case.made(iso=3200 + number), on, case.keep, final=True)
            runner = runner if number else first
            submitted.append((runner, np.ascontiguousarray(image), "k", DEFAULTS))
        alone = [runner.run(*rest) for runner, *rest in submitted]
        same(alone[0], whole)
        launches = request.getfixturevalue("launches")
        launches.clear()
        for wait, expected in zip(submit_batch(submitted), alone, strict=True):
            same(wait(), expected)
        if not any(isinstance(launch, Histogram) for launch in first.plan().launches):
            assert max(size[2] for size in launches) == 3
        if not case.keep:
            boxes = RunOptions(boxes=boxes_in(alone[-1]))
            cut = submit_batch([(*each[:3], boxes) for each in submitted])
            for wait, expected in zip(cut, alone, strict=True):
                same(wait(), expected.cropped(boxes.boxes))


WAYS: dict[str, Way] = {
    each.__name__: each for each in (tiles, patches, bands, own_memory, numpy, stack)
}


@pytest.mark.parametrize("way", [*WAYS, pytest.param("kept", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.slow] * (n in SLOW)) for n in CASES]
)
def test_an_image_has_the_same_bits_however_it_is_cut(device, request, name, way):
    case = CASES[name]
    whole = case.develop(Runner(case.made(), device, case.keep, final=True, bands=False))
    {**WAYS, "kept": kept}[way](case, whole, device, request)


def lane_of(stage, method):
    """Return a chain of one method, and an image of which red and blue differ."""
    chain = chain_for(stage, method, {}, "GRBG")
    image = example(chain.source, (150, 203), bands=chain.bands)
    image[::2] *= 0.5
    return chain, image


@pytest.mark.parametrize("lanes", ["many", pytest.param("one", marks=pytest.mark.slow)])
@pytest.mark.parametrize(("stage", "method"), methods.ALL)
def test_every_stage(device, scalar_device, stage, method, lanes):
    chain, image = lane_of(stage, method)
    on = device if lanes == "many" else scalar_device
    result, count = in_tiles(Runner(chain, on, encode=False, final=True), image, 70, 56)
    # A wide lens's picture is as large of the smallest image, by which memory is measured out.
    assert count >= (3 if stage.role is StageRole.VIEW else 6)
    if method.method in ("gray_world", "white_patch"):
        assert result.estimates["white_balance"]["red_gain"] != 1


@pytest.mark.slow
def test_sizes_at_which_tiles_are_narrow_or_end_with_the_image(device):
    runner = Runner(make_chain(settings_from({"iso": 3200, **GRAY_WORLD})), device)
    random, counts = np.random.default_rng(0), set()
    for _ in range(25):
        height, width, rows, columns = map(int, random.integers((40, 40, 4, 8), (200, 200, 60, 60)))
        image = example(Kind.RGB, (height, width), half=True)
        counts.add(in_tiles(runner, image, columns, rows)[1])
    assert len(counts) > 6


@pytest.mark.parametrize("pattern", ["RGGB", "BGGR", "GRBG", "GBRG"])
def test_bands_of_all_patterns(device, monkeypatch, pattern):
    device = narrow(device, monkeypatch)
    chain = make_chain(settings_from({"iso": 3200, "mosaic": {"pattern": pattern}}))
    runners = [Runner(chain, device, bands=on) for on in (True, False)]
    for height in range(48, 52):
        image = example(Kind.RGB, (height, 131))
        same(*(runner.run(image, "k") for runner in runners))


@pytest.mark.parametrize("size", [(1, 40), (40, 1), (3, 3), (5, 5), (6, 200), (11, 11)])
def test_images_hardly_larger_than_a_border_run_launch_by_launch(device, size):
    runner = Runner(make_chain(settings_from({})), device)
    image = example(Kind.RGB, size)
    plan = runner.plan_for(image)
    assert plan.border == 2
    assert bool(banded(plan)) == (min(size) > 5)
    same(Runner(runner.chain, device, bands=False).run(image, "k"), runner.run(image, "k"))


@pytest.fixture(params=["CPU", pytest.param("GPU", marks=pytest.mark.slow)])
def stacked(device, request):
    """Three images of two structures, submitted to a device or one with its own memory, alone."""
    on = Device(replace(device.info, type=request.param))
    first = Runner(make_chain(settings_from({"iso": 3200})), on)
    other = Runner(make_chain(settings_from({"stages": ["exposure", "gamma"]})), on)
    sizes = {(40, 48): first, (33, 35): other, (23, 61): first, (70, 33): first}
    submitted = [(r, example(Kind.RGB, size), "k", DEFAULTS) for size, r in sizes.items()]
    return submitted, [runner.run(*rest) for runner, *rest in submitted]


def test_what_takes_other_kernels_goes_by_itself_as_do_images_that_fill_the_memory(
    stacked, launches
):
    submitted, alone = stacked
    on = submitted[0][0].device
    for memory, depths in ((on.memory, {(3,), (1,)}), (600_000, {(1,)})):
        launches.clear()
        with memory_of(on, memory):
            for wait, expected in zip(submit_batch(submitted), alone, strict=True):
                same(wait(), expected)
        assert {size[2:] for size in launches} == depths


@pytest.mark.parametrize("error", [cl.RuntimeError("INVALID_OPERATION"), cl.MemoryError("full")])
def test_a_stack_that_fails_is_done_image_by_image(stacked, monkeypatch, error):
    submitted, alone = stacked
    before, launch = submit_batch(submitted), cl.enqueue_nd_range_kernel

    def launched(queue, kernel, size, *rest, **options):
        if size[2] > 1:
            raise error
        return launch(queue, kernel, size, *rest, **options)

    monkeypatch.setattr(cl, "enqueue_nd_range_kernel", launched)
    for wait, expected in zip([*before, *submit_batch(submitted)], alone * 2, strict=True):
        same(wait(), expected)


@pytest.mark.slow
def test_the_check_of_a_device_tries_stacks(device, launches):
    result = check_stack(device)
    assert result.passed and result.difference.differing == 0 and result.cases == 7
    assert max(size[2] for size in launches) >= 6


LANCZOS = {"scale": 0.4, "method": "lanczos3"}


@pytest.mark.parametrize("part", [1, 2, 5, 8])
@pytest.mark.parametrize("lanes", [1, 8, 16])
@pytest.mark.parametrize(
    "settings",
    [
        GRAY_WORLD,
        {**TWICE, "resize": LANCZOS, "resize_2": {"scale": 0.6}},
        {**TWICE, "resize": {**LANCZOS, "scale": 0.97}, "resize_2": {"scale": 0.6}},
        {**TWICE, "resize": {**LANCZOS, "scale": 0.125}, "resize_2": {"scale": 0.6}},
    ],
)
def test_tiles_cover_each_size_once_and_fit(part, lanes, settings):
    plan = plan_of(**settings)
    width, height = 1403, 999
    full = sum(buffer_sizes(plan, whole_image(plan, width, height, lanes)).values())
    memory = full // part
    tiling = tiling_of(plan, width, height, lanes, memory, memory // 2)
    assert tiling.bytes <= memory and (part == 1 or len(tiling.tiles) > 1)
    covered = [np.zeros((e.height, e.width), int) for e in tiling.tiles[0]]
    for extents in tiling.tiles:
        for image, extent, halo in zip(covered, extents, halos_of(plan), strict=True):
            core, stored = extent.core, extent.stored
            image[core.top : core.bottom, core.left : core.right] += 1
            if extent.is_empty:
                continue
            assert stored.left % lanes == stored.top % 4 == 0
            assert stored.left <= max(core.left - halo, 0) and stored.top <= max(core.top - halo, 0)
            assert stored.right >= min(core.right + halo, extent.width)
            assert stored.bottom >= min(core.bottom + halo, extent.height)
        sizes = buffer_sizes(plan, extents)
        assert all(size <= tiling.sizes[name] for name, size in sizes.items())
        assert max(sizes.values()) <= memory // 2
    assert all((image == 1).all() for image in covered)


def plan_of(**settings) -> Plan:
    return Runner(make_chain(settings_from(settings)), None).plan()


@pytest.mark.parametrize("lanes", [1, 8, 16])
def test_tables_of_lines_are_as_long_as_the_image_that_has_them(lanes):
    wide = {"projection": {"method": "kannala_brandt", "fx": 200.0, "source": "map"}}
    chain = make_chain(settings_from({"iso": 3200, **wide}))
    plan = Runner(chain, None).plan()
    sizes = buffer_sizes(plan, extents := whole_image(plan, 120, 60, lanes))
    lines = [launch for launch in plan.launches if isinstance(launch, Lines)]
    assert lines
    for launch in lines:
        extent = extents[launch.level]
        assert extent.width > 400  # of a render of 120
        vectors = -(-max(extent.width, extent.height) // lanes)
        for op in launch.ops:
            assert sizes[step_buffer(op.pass_.writes, op.step)] >= 4 * vectors * lanes


def test_full_rows_come_before_narrow_tiles():
    plan = plan_of()
    for memory, columns in ((2**34, {30000}), (2**26, {2736, 2640})):
        tiling = tiling_of(plan, 30000, 20000, 8, memory, memory)
        assert {extent.core.width for (extent,) in tiling.tiles} == columns
        assert tiling.bytes < LARGEST_TILE


def test_memory_that_is_too_small_for_any_tile(device, monkeypatch):
    runner = Runner(make_chain(settings_from({})), device)
    monkeypatch.setattr(device, "memory", 1000)
    with pytest.raises(
        ImageError,
        match=r"64x64 pixels need .* KiB of device memory, or .* KiB in the smallest tiles, "
        r"with a buffer of .* KiB. The limit is 1.0 KiB",
    ):
        runner.run(np.zeros((64, 64, 3), np.float32), "k")


@pytest.mark.parametrize("call", ["enqueue_map_buffer", "enqueue_nd_range_kernel"])
def test_memory_that_is_not_there_all_the_same(device, monkeypatch, call):
    runner = Runner(make_chain(settings_from({"iso": 3200, **GRAY_WORLD})), device)
    image = example(Kind.RGB, (150, 203), half=True)
    whole = runner.run(image, "k")
    runner.run(example(Kind.RGB, (333, 403), half=True), "k")
    plan, real, failures = runner.plan(), getattr(cl, call), []

    @contextmanager
    def left(size):
        """Another program has filled most of the device's memory."""

        def scarce(*arguments, **options):
            if device.bytes_held > size:
                failures.append(call)
                raise cl.MemoryError("CL_OUT_OF_RESOURCES")
            return real(*arguments, **options)

        failures.clear()
        with monkeypatch.context() as patch:
            patch.setattr(cl, call, scarce)
            yield

    # The memory suffices for the image, but not together with the larger image's buffers.
    enough = sum(buffer_sizes(plan, whole_image(plan, 203, 150, 8)).values())
    for size, tries in ((enough, 1), (enough // 2, 3), (enough // 3, 5)):
        with left(size):
            same(whole, runner.run(image, "k"))
        assert 1 <= len(failures) <= tries
    with left(100), pytest.raises(ImageError, match=r"203x150 pixels: .* is out of memory, even"):
        runner.run(image, "k")
    same(whole, runner.run(image, "k"))


def test_buffers_that_cannot_be_made(device, monkeypatch):
    runner = Runner(make_chain(settings_from({"iso": 3200, **GRAY_WORLD})), Device(device.info))
    image = example(Kind.RGB, (150, 203), half=True)
    whole, allocate, sizes = runner.run(image, "k"), cl.Buffer, []

    def scarce(context, flags, size=0, hostbuf=None):
        sizes.append(size if hostbuf is None else hostbuf.nbytes)
        if sizes[-1] > 120_000:
            raise cl.MemoryError("CL_MEM_OBJECT_ALLOCATION_FAILURE")
        return allocate(context, flags, size, hostbuf)

    runner.device.limit_memory(runner.device.memory)  # release all buffers
    with monkeypatch.context() as patch:
        patch.setattr(cl, "Buffer", scarce)
        same(whole, runner.run(image, "k"))
    assert max(sizes) > 120_000


SHARED = {
    "pictures": ({}, 7),
    "a burst and its truth": ({"frames": 3, "truth": "clean"}, 35),
    "patches": ({"patch": clpipe.Patches(16, per_image=2)}, 14),
}


@pytest.mark.parametrize("jobs", [1, 2])
@pytest.mark.parametrize("what", SHARED)
def test_small_images_of_a_run_share_launches(renders, launches, what, jobs):
    options, count = SHARED[what]
    renders(7)

    def made(out, *inputs):
        run = clpipe.run(inputs, out, format="png", iso=3200, jobs=jobs, **options)
        assert {outcome.status for outcome in run} == {"done"}
        return {path.name: path.read_bytes() for path in Path(out).glob("*.png")}

    together = made("together", "in")
    assert what == "pictures" or max(size[2] for size in launches) > 1
    for path in Path("in").iterdir():
        alone = made("alone", path)
    assert together == alone and len(alone) == count


def test_a_small_image_that_fails_fails_alone(renders, monkeypatch):
    renders(6)
    work = Runner.work

    def planted(runner, image, key, *given):
        if key.startswith("r002"):
            raise ValueError("a mistake")
        return work(runner, image, key, *given)

    monkeypatch.setattr(Runner, "work", planted)
    outcomes = {outcome.job.key: outcome for outcome in clpipe.run("in", "out", jobs=1)}
    failed = [key for key, outcome in outcomes.items() if outcome.status != "done"]
    assert failed == ["r002.exr"] and len(outcomes) == 6
    assert outcomes["r002.exr"].error.endswith("r002.exr: unexpected ValueError: a mistake")

"""Tiled images: the same bits as whole images, in any amount of memory."""

from contextlib import contextmanager

import numpy as np
import pyopencl as cl
import pytest

from clpipe.base.errors import ImageError
from clpipe.chain.making import make_chain
from clpipe.chain.registry import all_stages, load_stage_file
from clpipe.chain.settings import Settings, settings_from
from clpipe.engine.bindings import step_buffer
from clpipe.engine.buffers import crop_patches
from clpipe.engine.check import chain_for, example, sensor_parameters
from clpipe.engine.device import Device
from clpipe.engine.extents import Box, whole_image
from clpipe.engine.ir import Lines, Plan
from clpipe.engine.options import RunOptions
from clpipe.engine.runner import Result, Runner
from clpipe.engine.tiles import (
    LARGEST_TILE,
    buffer_sizes,
    halos_of,
    tiling_of,
)
from clpipe.stage import Kind, StageRole
from tests import methods
from tests.test_contributing import block

GRAY_WORLD = {"white_balance": {"method": "gray_world"}}


def plan_of(**settings) -> Plan:
    return Runner(make_chain(settings_from(settings)), None).plan()


def memory_for(plan: Plan, columns: int, rows: int, lanes: int) -> int:
    """Return the memory of a tile with so many pixels, without its halo."""
    halo = 2 * halos_of(plan)[0] + lanes
    whole = whole_image(plan, columns + halo, rows + halo, lanes)
    return sum(buffer_sizes(plan, whole).values()) + 4 * 1024


def same(one: Result, two: Result) -> None:
    """Fail unless two results are the same, bit for bit."""
    for a, b in ((one.final, two.final), (one.encoded, two.encoded)):
        assert (a is None) == (b is None)
        assert a is None or a.tobytes() == b.tobytes()
    assert one.kept.keys() == two.kept.keys()
    for name, image in one.kept.items():
        assert image.tobytes() == two.kept[name].tobytes(), name
    assert one.estimates == two.estimates


def in_tiles(
    runner: Runner, image: np.ndarray, columns: int, rows: int, monkeypatch: pytest.MonkeyPatch
) -> tuple[Result, int]:
    """The result of an image, which is the same in tiles of about that size, and their number.

    So are patches of it, made alone.
    """
    device = runner.device
    plan = runner.plan(image.dtype == np.float16, fold=min(image.shape[:2]) > 1)
    memory = memory_for(plan, columns, rows, device.info.lanes)
    tiling = tiling_of(plan, *image.shape[1::-1], device.info.lanes, memory, memory)
    whole = runner.run(image, "k")
    with monkeypatch.context() as patch:
        patch.setattr(device, "memory", memory)
        parts = runner.run(image, "k")
        assert device.bytes_held <= memory
    same(whole, parts)
    for box in patches_in(whole):  # together they would have kernels of their own: test_stacks.py
        same(cut(whole, [box]), runner.submit(image, "k", RunOptions(boxes=[box]))())
    return whole, len(tiling.tiles)


def in_less_memory(
    runner: Runner, image: np.ndarray, monkeypatch: pytest.MonkeyPatch, half: bool = False
) -> None:
    """Check an image in three fifths of the memory, and the memory of each tile."""
    whole, device = runner.run(image, "k"), runner.device
    plan, size = runner.plan(half), (*image.shape[1::-1], device.info.lanes)
    memory = sum(buffer_sizes(plan, whole_image(plan, *size)).values()) * 6 // 10
    tiling = tiling_of(plan, *size, memory, memory)
    assert len(tiling.tiles) > 1
    for extents in tiling.tiles:
        sizes = buffer_sizes(plan, extents)
        assert all(each <= tiling.sizes[name] for name, each in sizes.items())
    with monkeypatch.context() as patch:
        patch.setattr(device, "memory", memory)
        same(whole, runner.run(image, "k"))


def patches_in(whole: Result) -> list[Box]:
    """Two patches of one size: one at an odd place, and one that ends with the image."""
    images = [x for x in (whole.final, whole.encoded, *whole.kept.values()) if x is not None]
    height, width = images[0].shape[:2]
    high, wide = min(height, 31), min(width, 37)
    places = ((width - wide) // 2 | 1, (height - high) // 2 | 1), (width - wide, height - high)
    left_top = [(min(x, width - wide), min(y, height - high)) for x, y in places]
    return [Box(x, y, x + wide, y + high) for x, y in left_top]


def cut(whole: Result, boxes: list[Box]) -> Result:
    """Return the result with parts of its images, one after another."""
    final, encoded = (
        None if image is None else crop_patches(image, boxes)
        for image in (whole.final, whole.encoded)
    )
    kept = {name: crop_patches(image, boxes) for name, image in whole.kept.items()}
    return Result(final, encoded, kept, whole.estimates)


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


@pytest.mark.parametrize(("stage", "method"), methods.ALL)
def test_every_stage(device, monkeypatch, stage, method):
    check_stage(device, monkeypatch, stage, method)


@pytest.mark.slow
@pytest.mark.parametrize(("stage", "method"), methods.ONE_OF_EACH_WAY)
def test_stages_on_one_lane(scalar_device, monkeypatch, stage, method):
    check_stage(scalar_device, monkeypatch, stage, method)


def check_stage(device, monkeypatch, stage, method):
    """Check that a method gives the same bits in tiles and as a whole."""
    chain = chain_for(stage, method, {}, "GRBG")
    runner = Runner(chain, device, encode=False, final=True)
    image = example(chain.source, (150, 203))
    image[::2] *= 0.5  # so that red and blue differ
    result, count = in_tiles(runner, image, 70, 56, monkeypatch)
    # A wide lens's picture is as large of the smallest image, by which memory is measured out.
    assert count >= (3 if stage.role is StageRole.VIEW else 6)
    if method.method in ("gray_world", "white_patch"):
        assert result.estimates["white_balance"]["red_gain"] != 1


@pytest.mark.slow
def test_auto_exposure_by_a_percentile(scalar_device, monkeypatch):
    stage = all_stages()["exposure"]
    chain = chain_for(stage, stage.by_name["auto"], {"rule": "percentile"}, "GRBG")
    runner = Runner(chain, scalar_device, encode=False, final=True)
    result, count = in_tiles(runner, example(Kind.RGB, (150, 203)), 70, 56, monkeypatch)
    assert count >= 6
    assert result.estimates["exposure"]["metered_ev"] != 0


@pytest.mark.parametrize(
    ("pattern", "balance"),
    [
        ("RGGB", "gray_world"),
        ("GBRG", "white_patch"),
        pytest.param("GRBG", "white_patch", marks=pytest.mark.slow),
    ],
)
def test_the_default_chain(device, monkeypatch, pattern, balance):
    settings = {"mosaic": {"pattern": pattern}, "white_balance": {"method": balance}}
    chain = make_chain(settings_from({"iso": 3200, **settings}))
    runner = Runner(chain, device)
    for size in ((150, 203), (901, 9)) if pattern == "RGGB" else ((149, 202),):
        image = example(Kind.RGB, size, half=True)
        _, count = in_tiles(runner, image, 64, 48, monkeypatch)
        assert count >= 3


@pytest.mark.slow
def test_sizes_at_which_tiles_are_narrow_or_end_with_the_image(device, monkeypatch):
    runner = Runner(make_chain(settings_from({"iso": 3200, **GRAY_WORLD})), device)
    random = np.random.default_rng(0)
    counts = set()
    for _ in range(25):
        height, width, rows, columns = (
            int(n) for n in random.integers((40, 40, 4, 8), (200, 200, 60, 60))
        )
        image = example(Kind.RGB, (height, width), half=True)
        counts.add(in_tiles(runner, image, columns, rows, monkeypatch)[1])
    assert len(counts) > 6


@pytest.mark.slow
def test_numbers_found_twice_and_kept_images(device, monkeypatch):
    settings = {
        "stages": ["mosaic", "white_balance", "demosaic", "mosaic", "white_balance"],
        "demosaic": {"method": "bilinear"},
        **GRAY_WORLD,
        "white_balance_2": {"method": "white_patch"},
    }
    chain = make_chain(settings_from(settings))
    image = example(Kind.RGB, (157, 211))
    keep = [step.name for step in chain.steps]
    kept, count = in_tiles(Runner(chain, device, keep), image, 64, 48, monkeypatch)
    assert count >= 6
    assert list(kept.kept) == keep
    assert set(kept.estimates) == {"white_balance", "white_balance_2"}
    fused, _ = in_tiles(Runner(chain, device, final=True), image, 64, 48, monkeypatch)
    assert fused.estimates == kept.estimates
    assert fused.final.tobytes() == kept.final.tobytes()


@pytest.mark.slow
def test_every_source_of_noise(device, monkeypatch):
    names = list(all_stages())
    chain = tuple(names[: names.index("quantize") + 1])
    settings = Settings(iso=3200, stages=chain, parameters=sensor_parameters())
    runner = Runner(make_chain(settings, Kind.RGB), device, encode=False, final=True)
    _, count = in_tiles(runner, example(Kind.RGB, (150, 203)), 64, 48, monkeypatch)
    assert count >= 6


@pytest.mark.slow
def test_a_stage_of_somebody_else_reads_places_in_the_image(device, tmp_path, monkeypatch):
    monkeypatch.setattr("clpipe.chain.registry._from_files", {})
    (tmp_path / "vignette.cl").write_text(block("c"))
    (tmp_path / "vignette.py").write_text(block("python"))
    stage = load_stage_file(tmp_path / "vignette.py")
    chain = make_chain(Settings(iso=3200, stages=(stage.name,)), Kind.RGB)
    image = example(Kind.RGB, (150, 203))
    result, count = in_tiles(Runner(chain, device, final=True), image, 64, 48, monkeypatch)
    assert count >= 6
    assert np.abs(result.final - Runner(chain, None, final=True).run(image, "k").final).max() < 1e-6


@pytest.mark.parametrize("size", [(1, 900), (900, 1)])
def test_one_pixel_wide_or_high(device, monkeypatch, size):
    settings = Settings(iso=3200, stages=("mosaic", "demosaic"))
    runner = Runner(make_chain(settings, Kind.RGB), device, encode=True, final=True)
    assert in_tiles(runner, example(Kind.RGB, size), 24, 4, monkeypatch)[1] >= 4


def test_whole_numbers_become_floats_tile_by_tile(device, monkeypatch):
    chain = make_chain(Settings(iso=3200, stages=("normalize",)), Kind.RAW)
    runner = Runner(chain, device, final=True)
    image = np.random.default_rng(0).integers(0, 16384, (150, 203)).astype(np.uint16)
    in_tiles(runner, image, 64, 48, monkeypatch)


@pytest.mark.parametrize("memory", [2**17 + 2**14, 2**18, 2**20, 2**22, 2**26])
@pytest.mark.parametrize("lanes", [1, 8, 16])
def test_tiles_cover_an_image_once_and_fit(memory, lanes):
    plan = plan_of(**GRAY_WORLD)
    width, height, halo = 403, 333, halos_of(plan)[0]
    tiling = tiling_of(plan, width, height, lanes, memory, memory // 4)
    covered = np.zeros((height, width), int)
    assert tiling.bytes <= memory
    for (extent,) in tiling.tiles:
        core, stored = extent.core, extent.stored
        covered[core.top : core.bottom, core.left : core.right] += 1
        assert stored.left % lanes == stored.top % 4 == core.left % 2 == core.left % lanes == 0
        assert stored.left <= max(core.left - halo, 0) and stored.top <= max(core.top - halo, 0)
        assert stored.right == min(core.right + halo, width)
        assert stored.bottom == min(core.bottom + halo, height)
        sizes = buffer_sizes(plan, (extent,))
        assert all(size <= tiling.sizes[name] for name, size in sizes.items())
        assert max(sizes.values()) <= memory // 4
    assert (covered == 1).all()
    assert (len(tiling.tiles) == 1) == (memory == 2**26)


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

"""Launches in bands: the same bits as over whole images, in a few rows of memory."""

from hypothesis import given, settings
from hypothesis import strategies as st

from clpipe.chain.making import make_chain
from clpipe.chain.settings import settings_from
from clpipe.engine.bands import BAND, ring_bytes, schedule_of, strip_of, strips_of
from clpipe.engine.extents import Extent, whole_image
from clpipe.engine.hardware import USUAL_CACHE, private_cache
from clpipe.engine.ir import Cpu, Plan
from clpipe.engine.plan import make_plan
from clpipe.engine.tiles import buffer_sizes
from tests.test_cuts import banded

CPU = Cpu(cores=2, cache=1 << 19)


def plan_of(cpu: Cpu | None = CPU, **chain) -> Plan:
    return make_plan(make_chain(settings_from({"iso": 3200, **chain})), cpu=cpu)


def test_what_ends_a_run_of_bands():
    names = [[part.name for part in launch.bands.parts] for launch in banded(plan_of())]
    assert [len(each) for each in names] == [6]
    sums = plan_of(white_balance={"method": "gray_world"})
    assert [len(launch.bands.parts) for launch in banded(sums)] == [2, 5]
    assert banded(sums)[0].bands.parts[-1].sums
    kept = make_plan(make_chain(settings_from({})), keep=["normalize"], cpu=CPU)
    assert all(kept.slots[image.number] for _, image in kept.kept)
    assert not banded(plan_of(cpu=None))


def test_only_the_source_and_the_result_are_stored_whole():
    plan = plan_of()
    sizes = buffer_sizes(plan, whole_image(plan, 6000, 4000, 8))
    assert sum(sizes.values()) < 0.25e9  # 33 bytes a pixel without bands, 0.8 GB
    assert sum(sizes.values()) - sizes["rings"] < 9.1 * 24e6


@given(st.integers(1, 9000), st.integers(1, 9000), st.sampled_from([8, 16]), st.integers(1, 64))
@settings(max_examples=200, deadline=None)
def test_strips_cover_the_image_and_fit_into_the_cache(width, height, lanes, cores):
    (launch,) = banded(plan_of(Cpu(cores, 1 << 20)))
    extent = Extent.whole(width, height, lanes, 3)
    columns, rows = strip_of(launch.bands, extent)
    across, down = strips_of(launch.bands, extent)
    assert (across - 1) * columns < width <= across * columns
    assert (down - 1) * rows < height <= down * rows
    assert columns % (2 * lanes) == 0 and rows % BAND == 0
    assert ring_bytes(launch.bands, extent) <= across * down << 20


def test_rings_hold_what_readers_need():
    (launch,) = banded(plan_of())
    schedule, parts = schedule_of(launch.bands), launch.bands.parts
    assert schedule.leads[-1] == schedule.overlaps[-1] == 0
    for number, part in enumerate(parts[:-1]):
        ring = schedule.rings[part.writes.number]
        for reader, other in enumerate(parts):
            if any(read.image == part.writes for read in other.reads):
                ahead = schedule.leads[number] - schedule.leads[reader]
                assert ahead >= other.radius and ring.border >= other.radius
                assert ring.rows >= BAND + ahead + other.radius + 2 * ring.border
                assert schedule.overlaps[number] >= schedule.overlaps[reader] + other.radius


def test_the_cache_of_a_core_is_read_from_linux(tmp_path):
    assert private_cache(tmp_path) == USUAL_CACHE
    for number, (level, size) in enumerate([("1", "32K"), ("2", "1280K"), ("3", "20480K")]):
        (tmp_path / f"index{number}").mkdir()
        (tmp_path / f"index{number}" / "level").write_text(level + "\n")
        (tmp_path / f"index{number}" / "size").write_text(size + "\n")
    private_cache.cache_clear()
    assert private_cache(tmp_path) == 1280 << 10
    private_cache.cache_clear()


def test_plans_that_differ_in_a_lens_share_their_kernels():
    lens = {"method": "brown_conrady", "fx": 200.0}
    one, two = (plan_of(distortion=lens | {"k1": k1}) for k1 in (-0.1, -0.05))
    first = banded(one)[-1].bands.parts[0]
    assert first.opener and not first.stencil  # the resampling
    assert one != two and one.unscaled == two.unscaled

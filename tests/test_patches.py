"""Training patches: the bits of whole pictures at any position and rotation."""

import itertools
from pathlib import Path

import numpy as np
import pytest

import clpipe as api
from clpipe.base.errors import ImageError, RequestError
from clpipe.chain.making import make_chain
from clpipe.chain.settings import settings_from
from clpipe.dataset.arrays import packed
from clpipe.engine.device import Device
from clpipe.engine.extents import Box
from clpipe.engine.options import RunOptions
from clpipe.engine.runner import Runner
from clpipe.images.tags import FLIPS, upright
from clpipe.outputs.patches import PatchLayout, first_aligned_position
from clpipe.reference.cfa import PATTERNS
from tests.conftest import same_samples as same

ISO = 3200  # a chain that other tests compile too


@pytest.fixture
def renders(write_exr, tmp_path, monkeypatch):
    """Three renders of two sizes, one of them odd."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    for i in range(3):
        size = (41, 57) if i % 2 else (48, 64)
        write_exr(f"in/r{i}.exr", rng.random((*size, 3)).astype(np.float32) * 0.6)
    return Path("in")


def arrays(sample):
    """The images of a sample."""
    return {name: v for name, v in sample.items() if np.ndim(v) > 1 and np.shape(v) != (3, 3)}


def check_against_whole(whole, patches):
    """Fail unless patches are parts of a whole sample, turned, and of the same camera."""
    turns = set()
    for patch in patches:
        (left, top), turn = patch["place"], patch["turn"]
        images = arrays(patch)
        for name, image in images.items():
            size = image.shape[0]
            part = whole[name][top : top + size, left : left + size]
            assert np.array_equal(image, upright(part, turn)), name
            assert image.flags.c_contiguous and image.flags.writeable
            assert np.shares_memory(np.from_dlpack(image), image)
        assert images.keys() == arrays(whole).keys()
        shift = first_aligned_position(whole["cfa"], turn, size)
        assert (left % 2, top % 2) == shift
        turns.add(turn)
    return turns


def test_all_that_a_sample_has_is_that_of_the_whole_picture(renders):
    given = {"iso": ISO, "truth": "clean", "raw": "mosaic"}
    for number, key in ((0, "r0.exr"), (1, "r1.exr")):
        (whole,) = api.Dataset(f"in/{key}", **given)
        patches = api.Dataset(
            renders, **given, patch=api.Patches(24, 60, augment=True)
        ).__getitems__(range(60 * number, 60 * number + 60))
        assert {patch["key"] for patch in patches} == {key}
        assert check_against_whole(whole, patches) == set(FLIPS)
        assert {"image", "truth", "raw", "truth.raw"} <= patches[0].keys()


@pytest.mark.parametrize("pattern", PATTERNS)
def test_each_pattern_and_the_variance(renders, pattern):
    given = {
        "device": "numpy",
        "iso": ISO,
        "raw": "mosaic",
        "variance": True,
        "until": "normalize",
        "truth": "clean",
        "stages": ["mosaic", "sensor_noise", "inverse_white_balance", "quantize", "normalize"],
        "mosaic": {"pattern": pattern},
    }
    (whole,) = api.Dataset("in/r1.exr", **given)
    assert whole["cfa"] == pattern and whole["variance"].dtype == np.float32
    patches = api.Dataset("in/r1.exr", patch=api.Patches(17, 60, augment=True), **given)
    assert len(check_against_whole(whole, patches)) == 8


@pytest.mark.parametrize("size", [6, 7])
def test_turned_patches_have_the_pattern(size):
    for pattern, turn in itertools.product(PATTERNS, FLIPS):
        cell = np.array(list(pattern)).reshape(2, 2)
        x, y = first_aligned_position(pattern, turn, size)
        turned = upright(np.tile(cell, (6, 6))[y : y + size, x : x + size], turn)
        assert (turned == np.tile(cell, (6, 6))[:size, :size]).all()


def test_packed_planes():
    # By the colours' letters, the second green in lower case where it is in blue's rows.
    for pattern, cell in (("RGGB", "RGgB"), ("BGGR", "BgGR"), ("GRBG", "GRBg"), ("GBRG", "gBRG")):
        mosaic = np.tile(np.array(list(cell)).reshape(2, 2), (3, 4))
        planes = packed(mosaic, pattern)
        assert planes.shape == (4, 3, 4)
        assert ["".join(np.unique(plane)) for plane in planes] == ["R", "G", "g", "B"]


def test_places_are_everywhere_and_fit():
    layout = PatchLayout(api.Patches(8, augment=True), 21, 16, "RGGB", 0)
    patches = layout.patches_for(range(400), "key")
    assert {p.left for p in patches} == set(range(14)) and {p.top for p in patches} == set(range(9))
    assert layout.patches_for([7], "key") == patches[7:8] != layout.patches_for([7], "other")
    for edge in (layout, PatchLayout(api.Patches(16, augment=True), 16, 16, "RGGB", 0)):
        for patch in edge.patches_for(range(50), "key"):
            assert patch.left + patch.size <= edge.width and patch.top + patch.size <= edge.height
    plain = PatchLayout(api.Patches(8), 21, 16, "RGGB", 0).patches_for(range(50), "key")
    assert {(p.left % 2, p.top % 2, p.orientation) for p in plain} == {(0, 0, 1)}


def test_each_patch_has_draws_of_its_own(renders):
    few = {"device": "numpy", "until": "mosaic"}
    options = {"iso": {"log_uniform": [200, 6400]}, "patch": api.Patches(16, per_image=6)}
    isos = {}
    for draws in (None, "patch", "image"):
        dataset = api.Dataset(renders, draws=draws, epochs=2, **few, **options)
        isos[draws] = [(s["key"], s["epoch"], s["iso"]) for s in dataset]
        by_number = [dataset[i] for i in (0, 7, 1)]
        assert [(s["key"], s["epoch"], s["iso"]) for s in by_number] == [
            isos[draws][i] for i in (0, 7, 1)
        ]
    assert isos[None] == isos["patch"] and len({*isos["patch"]}) == len(isos["patch"])
    images = {sample[:2] for sample in isos["image"]}
    assert len({*isos["image"]}) == len(images)
    grid = {**options, "patch": api.Patches(16, per_image="grid")}
    assert len({s["iso"] for s in api.Dataset(renders, **few, **grid)}) == len(images) / 2


def test_a_patch_with_draws_of_its_own_is_of_the_picture_with_these(renders):
    options = {"iso": {"choice": [400, 3200]}, "patch": api.Patches(16, per_image=4)}
    wholes = {
        (s["key"], s["iso"]): s["quantize"]
        for iso in (400, 3200)
        for s in api.Dataset(renders, device="numpy", keep="quantize", iso=iso)
    }
    for sample in api.Dataset(renders, device="numpy", keep="quantize", **options):
        left, top = sample["place"]
        whole = wholes[sample["key"], sample["iso"]]
        assert np.array_equal(sample["quantize"], whole[top : top + 16, left : left + 16])


@pytest.mark.parametrize("augment", [False, True])
def test_a_grid_covers_the_picture(augment):
    layout = PatchLayout(api.Patches(8, "grid", augment), 37, 24, "RGGB", 0)
    covered = np.zeros((24, 37), int)
    for patch in layout.patches_for(range(layout.count), "key"):
        position = first_aligned_position("RGGB", patch.orientation, 8)
        assert (patch.left % 2, patch.top % 2) == position
        covered[patch.top : patch.top + 8, patch.left : patch.left + 8] += 1
    assert layout.count == 15
    assert augment or (covered[:, :36].all() and not covered[:, 36].any())


def test_a_grid_over_images_of_several_sizes(renders):
    grid = api.Dataset(renders, device="numpy", patch=api.Patches(16, "grid"), until="mosaic")
    assert len(grid) == 12 + 3 * 4 + 12
    positions = [(s["key"], *s["place"]) for s in grid]
    assert len(set(positions)) == len(grid)
    assert positions[23] == ("r1.exr", 40, 24)  # where 57x41 ends, at an even place


def test_positions_belong_to_the_image_the_epoch_and_the_seed(renders):
    made = api.Dataset(renders, iso=ISO, patch=api.Patches(16, 3), epochs=2)
    assert len(made) == 18
    listed = list(made)
    for i in (17, 4, -18):
        same(made[i], listed[i])
    later = api.Dataset(renders, iso=ISO, patch=api.Patches(16, 3), epoch=1)
    for one, two in zip(later, listed[9:], strict=True):
        same(one, two)
    positions = [tuple(s["place"]) for s in listed]
    assert len(set(positions)) > 12 and positions[:9] != positions[9:]
    other = api.Dataset(renders, iso=ISO, patch=api.Patches(16, 3), seed=1)
    assert [tuple(s["place"]) for s in other] != positions[:9]


@pytest.mark.parametrize("patches", [0, 2, 5])
def test_images_that_need_larger_buffers_than_those_in_flight(device, patches):
    """A device that works in the host's memory must not write to buffers that were freed."""
    runner = Runner(make_chain(settings_from({"iso": ISO})), Device(device.info), bands=False)
    submitted = []
    for side in (16, 1800, 1900):  # large enough that freed memory cannot be written to
        boxes = [Box(i, i, i + side // 2, i + side // 2) for i in range(patches)]
        image = np.random.default_rng(side).random((side, side, 3)).astype(np.float16)
        submitted.append((image, "k", RunOptions(boxes=boxes)))
    alone = [runner.run(*each).encoded for each in submitted]
    runner.device.limit_memory(runner.device.memory)  # release all buffers
    waits = [runner.device.submit([runner.work(*each)])[0] for each in submitted]
    for wait, expected in zip(waits, alone, strict=True):
        assert np.array_equal(wait().encoded, expected)


def test_training_goes_on_where_it_was(renders):
    def dataset(**changes):
        given = {"device": "numpy", "until": "mosaic", "patch": api.Patches(16, 4)}
        return api.Dataset(renders, epochs=2, **{**given, **changes})

    whole = list(dataset())
    first = dataset()
    begun = [sample for _, sample in zip(range(7), first, strict=False)]
    state = first.state_dict()
    second = dataset()
    second.load_state_dict(state)
    assert second.state_dict() == state
    rest = list(second)
    for one, two in zip([*begun, *rest], whole, strict=True):
        same(one, two)
    assert len(list(second)) == len(whole)  # another iteration begins at the start
    third = dataset()
    third.load_state_dict(second.state_dict())
    assert list(third) == []  # nothing is left of that one
    third.set_epoch(1)
    same(next(iter(third)), whole[12])
    for other in (
        dataset(patch=api.Patches(8, 4)),
        dataset(patch=api.Patches(16, 5)),
        first.shard(0, 2),
    ):
        with pytest.raises(RequestError, match="other images or patches"):
            other.load_state_dict(state)


def test_decoded_renders_are_kept_while_they_fit(renders, write_exr, monkeypatch):
    from clpipe.inputs.loader import ImageLoader

    read, real = [], ImageLoader.read
    monkeypatch.setattr(ImageLoader, "read", lambda s, job: read.append(job.key) or real(s, job))

    def names_read(cache):
        read.clear()
        made = api.Dataset(
            renders, device="numpy", until="mosaic", patch=8, epochs=2, threads=1, cache=cache
        )
        order = [i * 16 for i in (0, 1, 0, 1, 2, 3, 4)]
        made.__getitems__(order[:2])
        for i in order[2:]:
            made[i]
        return "".join(name[1] for name in read)

    one = 48 * 64 * 6  # bytes, half
    assert names_read("1M") == "012"
    assert names_read(2 * one) == "012"
    assert names_read(one) == "01121"
    assert names_read(0) == "0101201"
    made = api.Dataset("in/r0.exr", device="numpy", until="mosaic", patch=8)
    before = made[0]["image"]
    write_exr("in/r0.exr", np.ones((48, 64, 3), np.float32))
    assert not np.array_equal(made[0]["image"], before)  # the file has changed


def test_types_and_orders(renders):
    def first(**changes):
        return api.Dataset("in/r0.exr", iso=ISO, patch=16, raw="mosaic", **changes)[0]

    plain = first(keep=["normalize"])
    assert (plain["image"].dtype, plain["raw"].dtype) == (np.uint8, np.uint16)
    real = first(dtype=np.float32, channels_first=True, keep=["normalize"])
    assert real["image"].shape == (3, 16, 16) and real["image"].dtype == np.float32
    assert np.array_equal(np.rint(real["image"] * 255).transpose(1, 2, 0), plain["image"])
    for prefix in ("", "truth."):
        assert np.array_equal(real[prefix + "raw"], plain[prefix + "normalize"])
        dn = plain[prefix + "raw"].astype(float) - plain["black_level"]
        signal = dn / (plain["white_level"] - plain["black_level"])
        assert np.abs(real[prefix + "raw"] - signal).max() < 1e-6
    half = first(dtype="float16")
    assert np.array_equal(half["raw"], real["raw"].astype(np.float16))
    whole = first(dtype="uint16")
    assert np.array_equal(whole["raw"], plain["raw"])
    pixels = real["truth"].transpose(1, 2, 0)
    assert np.array_equal(whole["truth"], np.rint(pixels * np.float32(65535)))


def test_facts_of_a_sample(renders):
    sample = api.Dataset(renders, iso=ISO, patch=16, raw="packed", seed=3)[5]
    camera = api.load_camera("sony-a7r2")
    assert (sample["camera"], sample["iso"], sample["seed"]) == (camera.name, ISO, 3)
    assert sample["a"] == camera.noise(ISO).a
    assert (sample["black_level"], sample["white_level"]) == (512, 16383)
    assert np.allclose(sample["gains"][::2], camera.white_balance_gains)
    assert sample["raw"].shape == sample["truth.raw"].shape == (4, 8, 8)
    assert sample["truth"].shape == (16, 16, 3)  # without asking


def test_the_variance_is_that_of_the_noise(write_exr, tmp_path):
    write_exr("flat.exr", np.full((200, 200, 3), 0.3, np.float32))
    made = api.Dataset(
        tmp_path / "flat.exr",
        device="numpy",
        iso=ISO,
        until="normalize",
        raw="packed",
        variance=True,
        dtype="float32",
        patch=api.Patches(180, per_image=1),
        skip=["row_noise"],
    )
    (sample,) = made
    error = sample["raw"] - sample["truth.raw"]
    assert sample["variance"].shape == error.shape == (4, 90, 90)
    for plane, variance in zip(error, sample["variance"], strict=True):
        assert plane.var() == pytest.approx(variance.mean(), rel=0.06)


def test_layers_go_along(write_exr, tmp_path):
    rng = np.random.default_rng(0)
    pixels = rng.random((40, 48, 4)).astype(np.float32)
    write_exr("a.exr", pixels, "R,G,B,Z", half=False)
    given = {"device": "numpy", "until": "mosaic", "carry": "Z:depth"}
    (whole,) = api.Dataset(tmp_path / "a.exr", **given)
    for s in api.Dataset(tmp_path / "a.exr", patch=api.Patches(16, augment=True), **given):
        left, top = s["place"]
        part = whole["carried.Z"][top : top + 16, left : left + 16]
        assert np.array_equal(s["carried.Z"], upright(part, s["turn"]))
        assert s["carried.valid"].shape == (16, 16)
    given["carry"] = "Z:normal"
    write_exr("a.exr", rng.random((40, 48, 6)), "R,G,B,Z.X,Z.Y,Z.Z", half=False)
    with pytest.raises(
        ImageError, match=r"a\.exr: .*Z: augment flips and rotates patches, but cannot rotate"
    ):
        api.Dataset(tmp_path / "a.exr", patch=api.Patches(16, augment=True), **given)[0]


@pytest.mark.parametrize("device", [None, "numpy"])
def test_images_of_two_sizes_cannot_both_be_cut(renders, device):
    stages = ["exposure", "mosaic", "sensor_noise", "quantize", "normalize", "demosaic", "resize"]
    small = {"stages": stages, "demosaic": {"method": "bilinear"}, "resize": {"scale": 0.5}}
    made = api.Dataset(renders, device=device, iso=ISO, patch=8, raw="mosaic", **small)
    with pytest.raises(ImageError, match=r"r0\.exr: the image after quantize has 64x48 .* 32x24"):
        made[0]


def test_a_chain_without_noise_has_no_truth_by_itself(renders):
    made = api.Dataset(renders, device="numpy", patch=8, until="mosaic")
    assert "truth" not in made[0] and made[0]["image"].shape == (8, 8)

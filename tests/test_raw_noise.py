"""RawNoise: the chain's bits for mosaics, planes and batches, and reproducibility."""

import pickle

import numpy as np
import pytest

import clpipe as api
from clpipe.dataset.arrays import packed
from clpipe.reference.cfa import PATTERNS

CAMERA, ISO = "sony-a7r2", 3200


def noise(iso=ISO, **settings):
    return api.RawNoise(CAMERA, iso, device="numpy", **settings)


@pytest.fixture(scope="module")
def raw():
    """A clean mosaic, some of it near white."""
    return np.random.default_rng(0).random((20, 30), np.float32)


def test_a_mosaic_gets_the_bits_that_it_gets_in_the_chain(raw):
    given = {"seed": 5, "noise_key": "pair", "row_noise": {"sigma": 0.01}}
    keep, render = ["inverse_white_balance"], np.repeat(raw[..., None], 3, 2)
    shot = api.Pipeline(
        camera=CAMERA, iso=ISO, device="numpy", until="normalize", keep=keep, **given
    ).process(render, "a")
    clean = shot.kept["inverse_white_balance"]
    noisy = noise(**given)(clean)
    assert np.array_equal(noisy, shot.image) and not np.array_equal(noisy, clean)


def test_as_much_noise_as_the_profile_says():
    flat = np.full((400, 400), 0.5, np.float32)
    model = api.load_camera(CAMERA).noise(ISO)
    noisy = noise(skip=["row_noise"])(flat, "a")
    assert np.var(noisy) == pytest.approx(model.a * 0.5 + model.b, rel=0.02)
    assert np.mean(noisy) == pytest.approx(0.5, rel=1e-3)


@pytest.mark.parametrize("pattern", PATTERNS)
def test_planes_get_the_noise_of_their_mosaic(raw, pattern):
    add = noise(noise_key="k", mosaic={"pattern": pattern})
    assert np.array_equal(add(packed(raw, pattern)), packed(add(raw), pattern))


def test_shape_and_type_stay(raw):
    add, planes = noise(), packed(raw, "RGGB")
    assert np.array_equal(add(raw[None], "a")[0], add(raw, "a"))
    for dtype in ("float16", "float32", "float64"):
        for clean in (raw, raw[None], planes, planes[None], raw[None, None]):
            noisy = add(clean.astype(dtype))
            assert noisy.shape == clean.shape and noisy.dtype == dtype
            assert noisy.flags.c_contiguous and noisy.flags.writeable


def test_each_of_a_batch_has_noise_of_its_own_that_a_key_brings_back(raw):
    batch = np.stack([packed(raw, "RGGB")] * 3)
    first, second, third = one = noise()(batch, "a")
    assert not (np.array_equal(first, second) or np.array_equal(second, third))
    assert np.array_equal(noise()(batch, "a"), one)
    assert not np.array_equal(noise()(batch, "b"), one)
    assert not np.array_equal(noise(seed=1)(batch, "a"), one)


def test_calls_without_a_key_repeat_themselves_with_a_seed_alone(raw):
    def calls(add, *generator):
        return [add(raw, *generator).tobytes() for _ in range(3)]

    free, seeded, given = noise(), noise(seed=1), noise()
    calls_of_seeded = calls(seeded)
    assert len({*calls(free), *calls(free), *calls_of_seeded}) == 9
    assert calls(noise(seed=1)) == calls_of_seeded != calls(seeded)
    again = pickle.loads(pickle.dumps(seeded))
    assert calls(again) == calls_of_seeded  # it begins anew in another process
    assert calls(pickle.loads(pickle.dumps(free))) != calls(free)
    generators = [np.random.default_rng(7) for _ in range(2)]
    assert calls(given, generators[0]) == calls(given, generators[1])


def test_an_iso_is_drawn_for_each_raw():
    flat = np.full((64, 64), 0.5, np.float32)
    add = noise({"choice": [100, 25600]})
    levels = {round(float(add(flat, f"{i}").std()), 2) for i in range(8)}
    assert len(levels) == 2
    assert repr(add) == "RawNoise('sony-a7r2', {'choice': [100, 25600]})"


@pytest.mark.parametrize(
    ("found", "text"),
    [
        (np.zeros((3, 4, 4), np.float32), r"shape \(3, 4, 4\); expected a mosaic"),
        (np.zeros((0, 4), np.float32), r"shape \(0, 4\)"),
        (np.zeros(4, np.float32), r"shape \(4,\)"),
        (np.zeros((4, 4), np.uint16), "found uint16; .* Subtract the black level from DN"),
        ([[0.5, 0.5]], "mosaic is a list, but an array is expected. Pass numpy.asarray"),
        (np.full((4, 4), np.nan), "NaN"),
    ],
)
def test_arrays_that_are_no_raws(found, text):
    with pytest.raises(api.ImageError, match=text):
        noise()(found)


def test_values_that_are_not_allowed(raw):
    with pytest.raises(api.RequestError, match="found key 3; expected a text"):
        noise()(raw, key=3)
    with pytest.raises(
        api.RequestError, match="found until, but it always runs from crosstalk to normalize"
    ):
        noise(until="quantize")
    with pytest.raises(api.RequestError, match="most similar: sony-a7r2"):
        api.RawNoise("sony-a7r22", ISO)
    with pytest.raises(api.RequestError, match="goes from 100 to 25600"):
        noise(50)
    with pytest.raises(api.RequestError, match=r"found iso \(100, 200\)"):
        noise((100, 200))

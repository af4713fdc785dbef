"""clpipe.torch: NumPy's bits with a key, the same distribution without; gradients."""

import numpy as np
import pytest

import clpipe as api
from clpipe.reference.cfa import PATTERNS

torch = pytest.importorskip("torch", reason="needs PyTorch, in the extra train")

from clpipe.dataset.arrays import packed  # noqa: E402  behind the import that may skip
from clpipe.torch import RawNoise  # noqa: E402

ALL = {
    "crosstalk": {"share": 0.02},
    "prnu": {"sigma": 0.02},
    "defect_pixels": {"hot_share": 0.05, "hot_level": 0.3, "dead_share": 0.05},
    "blooming": {"method": "column", "full_signal": 0.4},
    "dark_current": {"exposure_time": 30.0, "current": 3.0, "spread": 0.4},
    "random_telegraph": {"share": 0.05, "amplitude": 0.05},
    "dsnu": {"sigma": 0.01},
    "dark_shading": {"slope": 1e-5, "offset": 0.01, "length": 7.3},
    "row_noise": {"sigma": 0.01},
    "column_noise": {"sigma": 0.01},
    "banding": {"amplitude": 0.01, "period": 9.7},
    "black_level_error": {"sigma": 0.01, "bias": [0.004, -0.002, 0.001, 0.003]},
}
TAILS = {"tukey_lambda": -0.2, "full_well": 900.0}
CASES = {
    "default": {},
    "all stages": ALL,
    "gaussian": {"sensor_noise": {"method": "gaussian"}},
    "gaussian tails": {"sensor_noise": {"method": "gaussian", **TAILS}},
    "skewed tails": {"sensor_noise": TAILS},
    "photons": {"sensor_noise": {"method": "poisson"}},
    "few photons": {"sensor_noise": {"method": "poisson", "a": 0.05, "b": 1e-4}},
    "photons tails": {"sensor_noise": {"method": "poisson", **TAILS}},
    "none": {"sensor_noise": {"method": "none", "full_signal": 0.5}},
}
SIZES = [(37, 21), (1, 16), (16, 1)]


def mosaics(*shape):
    return np.random.default_rng(0).uniform(-0.02, 1.1, shape).astype(np.float32)


def of_chain(mosaic, camera, iso, key, **settings):
    ends = {"start_at": "crosstalk", "until": "normalize", "device": "numpy"}
    pipeline = api.Pipeline(**ends, camera=camera, iso=iso, noise_key=key, **settings)
    return pipeline.process(mosaic, key).image


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("shape", SIZES, ids="{0[0]}x{0[1]}".format)
def test_a_key_brings_the_chains_bits(case, shape):
    raw, camera = mosaics(3, *shape), "sony-a7s2"
    add = RawNoise(camera, 6400, seed=3, **CASES[case])
    noisy = add(torch.from_numpy(raw)[:, None], ["a", "b", "c"]).numpy()[:, 0]
    for mosaic, found, key in zip(raw, noisy, "abc", strict=True):
        expected = of_chain(mosaic, camera, 6400, key, seed=3, **CASES[case])
        assert np.array_equal(found, expected), key
        assert not np.array_equal(found, mosaic)


def test_every_camera_has_its_bits():
    raw = mosaics(16, 12)
    for camera in api.built_in_cameras():
        iso = api.load_camera(camera).iso_range[1]
        found = RawNoise(camera, iso)(torch.from_numpy(raw)[None], "k").numpy()[0]
        assert np.array_equal(found, of_chain(raw, camera, iso, "k")), camera


def test_neighbours_of_a_larger_array_have_its_bits():
    raw, effects = mosaics(2, 16, 13), {name: ALL[name] for name in ("crosstalk", "blooming")}
    for camera in ("fujifilm-x-t3", "sony-a7r2", "sony-imx686-quad"):
        iso = api.load_camera(camera).iso_range[1]
        found = RawNoise(camera, iso, **effects)(torch.from_numpy(raw)[:, None], ["k", "l"])
        for mosaic, noisy, key in zip(raw, found.numpy()[:, 0], "kl", strict=True):
            assert np.array_equal(noisy, of_chain(mosaic, camera, iso, key, **effects)), camera


@pytest.mark.parametrize("pattern", PATTERNS)
def test_planes_are_their_mosaic(pattern):
    raw = mosaics(12, 8)
    add = RawNoise("sony-a7r2", 3200, mosaic={"pattern": pattern}, **ALL)
    planes = add(torch.from_numpy(packed(raw, pattern)), "k")
    assert np.array_equal(
        planes.numpy(), packed(add(torch.from_numpy(raw)[None], "k")[0].numpy(), pattern)
    )


def test_draws_by_sample_and_by_key():
    cameras = {"choice": ["sony-a7s2", "canon-6d"]}
    raw, iso = torch.full((40, 4, 16, 16), 0.2), {"log_uniform": [800, 6400]}
    add = RawNoise(cameras, iso, seed=1)
    noisy = add(raw)
    levels = noisy.std((1, 2, 3))
    assert levels.max() > 2 * levels.min()
    assert not torch.equal(noisy, add(raw))
    assert torch.equal(noisy, RawNoise(cameras, iso, seed=1)(raw))
    names = [f"s{i}" for i in range(6)]
    keyed = add(raw[:6, :1], names)
    assert torch.equal(keyed[2:4], add(raw[2:4, :1], names[2:4]))
    for name, found in zip(names, keyed.numpy(), strict=True):
        expected = of_chain(np.full((16, 16), 0.2, np.float32), cameras, iso, name, seed=1)
        assert np.array_equal(found[0], expected)


def test_as_much_noise_as_the_profile_says_from_new_keys():
    model = api.load_camera("sony-a7r2").noise(3200)
    noisy = RawNoise("sony-a7r2", 3200, seed=2, skip=["row_noise"])(
        torch.full((8, 1, 128, 128), 0.5)
    )
    assert noisy.var().item() == pytest.approx(model.a * 0.5 + model.b, rel=0.02)
    assert noisy.mean().item() == pytest.approx(0.5, rel=1e-3)


def test_samples_lie_anywhere_on_one_sensor():
    add = RawNoise("canon-6d", 100, seed=1, skip=["sensor_noise"], prnu={"sigma": 0.1})
    noisy = add(torch.full((4, 1, 32, 32), 0.5)).numpy()[:, 0]
    assert len({one.tobytes() for one in noisy}) == 4
    assert np.array_equal(*(add(torch.full((1, 1, 8, 8), 0.5), [key]).numpy() for key in "ab"))


@pytest.mark.parametrize("method", ["skewed_gaussian", "gaussian", "poisson"])
def test_gradients_are_those_of_differences(method):
    settings = {"sensor_noise": {"method": method, "full_well": 1e6}, "quantize": {"bits": 16}}
    if method == "poisson":  # whole numbers: the gradient is that of their mean
        add, clean = RawNoise("canon-6d", 1600, **settings), torch.full((1, 1, 64, 64), 0.3)
        clean.requires_grad_()
        add(clean, ["k"]).mean().backward()
        assert clean.grad.mean().item() * clean.numel() == pytest.approx(1, rel=1e-5)
        return
    add = RawNoise("canon-6d", 1600, **settings)
    clean = torch.full((1, 1, 64, 64), 0.3, requires_grad=True)
    add(clean, ["k"]).sum().backward()
    step = 1e-2
    with torch.no_grad():
        above, below = (add(clean + d, ["k"]) for d in (step, -step))
    expected = (above - below) / (2 * step)
    assert torch.allclose(clean.grad, expected, atol=2e-3)


def test_clipping_stops_a_gradient_and_rounding_does_not():
    clean = torch.tensor([[[0.5, 2.0], [-3.0, 0.2]]], requires_grad=True)
    RawNoise("canon-6d", 100, skip=["sensor_noise"])(clean, "k").sum().backward()
    assert clean.grad[0].tolist() == [
        [pytest.approx(1, rel=1e-4), 0],
        [0, pytest.approx(1, rel=1e-4)],
    ]


def test_messages_name_what_is_wrong():
    add = RawNoise("sony-a7r2", 3200)
    with pytest.raises(api.ImageError, match=r"shape \(3, 8, 8\)"):
        add(torch.zeros(3, 8, 8))
    with pytest.raises(api.ImageError, match=r"torch.int32; expected floats"):
        add(torch.zeros(1, 8, 8, dtype=torch.int32))
    with pytest.raises(api.RequestError, match="2, one for each mosaic"):
        add(torch.zeros(2, 1, 8, 8), ["a"])
    with pytest.raises(api.RequestError, match="sony-a7r9"):
        RawNoise("sony-a7r9", 3200)

"""Noise: exact random words, exact normals, and the required statistics."""

from math import sqrt

import numpy as np
import pytest
from scipy.stats import norm

from clpipe.reference.math import exponential, exponential_minus_1, negative_log, square_root
from clpipe.reference.random import Stream, normal_at, normal_of, normals_of, philox, stream_of
from clpipe.stage import Kind

A, B = 2e-4, 3e-6
LEVELS = np.linspace(0.0, 0.9, 16)


def words(*counters: int, key: tuple[int, int]) -> list[int]:
    arrays = [np.array([c], np.uint32) for c in counters]
    return [int(w[0]) for w in philox(*arrays, Stream(*key, 0))]


def test_philox_known_answers():
    # Random123 (Salmon et al. 2011), kat_vectors, philox4x32 10.
    f = 0xFFFFFFFF
    assert words(0, 0, 0, 0, key=(0, 0)) == [0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8]
    assert words(f, f, f, f, key=(f, f)) == [0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD]
    assert words(0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344, key=(0xA4093822, 0x299F31D0)) == [
        0xD16CFE09,
        0x94FDCCEB,
        0x5001E420,
        0x24126EA1,
    ]


def test_normals_invert_the_normal_distribution():
    steps = np.unique(np.geomspace(1, 2**31 - 1, 20000).astype(np.uint32))
    p = (steps + 0.5) / 2**32
    z = normal_of(steps).astype(np.float64)
    assert np.all(np.abs(z - norm.isf(p)) < np.maximum(8e-5 * z, 1e-7))
    # A relative error e of z moves the tail probability by about z^2 * e.
    near = z < 5
    allowed = (4e-5 * np.maximum(z[near], 1) ** 2 + 3e-7) * 1.5
    assert np.all(np.abs(norm.sf(z[near]) / p[near] - 1) < np.maximum(allowed, 3e-4))
    assert np.all(np.diff(z) <= 1e-6)
    assert 6.1 < z[0] < 6.2
    assert 6.3 < normal_of(np.uint32([0])).item() < 6.4
    assert np.array_equal(normal_of(steps | np.uint32(0x80000000)), -normal_of(steps))


def test_pairs_of_normals_are_on_circles():
    steps = np.unique(np.geomspace(1, 2**31 - 1, 20000).astype(np.uint32))
    direction = np.arange(steps.size, dtype=np.uint32) * np.uint32(2654435769)
    one, other = (z.astype(np.float64) for z in normals_of(steps, direction))
    exact = np.sqrt(-2 * np.log((steps + 0.5) / 2**31))
    assert np.all(np.abs(np.hypot(one, other) - exact) < 2e-5 * exact + 1e-3 * (exact < 1e-3))
    angle = (direction << np.uint32(2)).view(np.int32) * (np.pi / 4 / 2**31)
    sine = np.where(direction >> 31, one, other)
    assert np.all(np.abs(sine - exact * np.sin(angle)) < 2e-5 * exact + 1e-3 * (exact < 1e-3))
    # All eight ways to exchange them and to change their signs are as frequent.
    octant = (one < 0) * 4 + (other < 0) * 2 + (np.abs(one) < np.abs(other))
    assert np.abs(np.bincount(octant, minlength=8) / steps.size - 1 / 8).max() < 0.01
    least = np.uint32([0]), np.uint32([0])
    assert 6.6 < normals_of(*least)[0].item() < 6.7


def test_logarithm_root_and_exponential_have_the_errors_that_they_state():
    t = np.geomspace(1e-9, 10, 100001).astype(np.float32)
    exact = -np.log(t.astype(np.float64))
    assert np.all(np.abs(negative_log(t) - exact) < 4e-7 * np.maximum(np.abs(exact), 1))
    x = np.geomspace(1e-30, 1e10, 100001).astype(np.float32)
    assert np.abs(square_root(x) / np.sqrt(x.astype(np.float64)) - 1).max() < 5e-6
    x = np.linspace(-87, 87, 100002).astype(np.float32)
    allowed = np.where(np.abs(x) < 20, 1e-6, 4e-6)
    assert np.all(np.abs(exponential(x) / np.exp(x.astype(np.float64)) - 1) < allowed)
    assert np.all(np.abs(exponential_minus_1(x) / np.expm1(x.astype(np.float64)) - 1) < allowed)


def test_distribution_out_to_the_tails():
    z = normal_at((2000, 2000), 0, stream_of("tails", "s")).astype(np.float64).ravel()
    n = z.size
    assert abs(z.mean()) < 4 / sqrt(n)
    assert abs(z.var() - 1) < 4 * sqrt(2 / n)
    assert abs((z**3).mean()) < 4 * sqrt(15 / n)
    assert abs((z**4).mean() - 3) < 4 * sqrt(96 / n)
    for sigma in (1, 2, 3, 4, 4.5):
        expected = n * norm.sf(sigma)
        for count in (np.count_nonzero(z > sigma), np.count_nonzero(z < -sigma)):
            assert abs(count - expected) < 4 * sqrt(expected) + 1


def noisy_flats(develop, key="flat", seed=0, method="gaussian", numpy=True):
    """The noise of flat fields of all levels side by side, through mosaic and sensor noise."""
    flat = np.repeat(LEVELS, 128).astype(np.float32)[None, :, None] * np.ones(
        (512, 1, 3), np.float32
    )
    result = develop(
        flat,
        key,
        numpy,
        stages=["mosaic", "sensor_noise"],
        seed=seed,
        sensor_noise={"a": A, "b": B, "method": method},
    )
    return result.final.astype(np.float64) - flat[..., 0]


@pytest.mark.parametrize("method", ["skewed_gaussian", "gaussian", "poisson"])
def test_flat_fields_have_variance_a_y_plus_b(develop, method):
    noise = noisy_flats(develop, method=method).reshape(512, len(LEVELS), 128)
    n = 512 * 128
    for i, level in enumerate(LEVELS):
        variance = A * level + B
        block = noise[:, i]
        assert abs(block.mean()) < 4 * sqrt(variance / n)
        assert abs(block.var() / variance - 1) < 4 * sqrt(2 / n)


def correlation(x: np.ndarray, y: np.ndarray) -> float:
    return float(np.corrcoef(x.ravel(), y.ravel())[0, 1] * sqrt(x.size))


@pytest.mark.parametrize("method", ["gaussian", "poisson"])
def test_noise_is_independent_of_everything_else(develop, method):
    scale = np.sqrt(A * np.repeat(LEVELS, 128) + B)[None, :]
    noise = noisy_flats(develop, method=method) / scale
    for dy, dx in ((0, 1), (1, 0), (1, 1), (0, 2), (2, 0), (4, 0), (0, 8), (0, 16)):
        assert abs(correlation(noise[dy:, dx:], noise[: 512 - dy, : noise.shape[1] - dx])) < 4
    sites = [noise[y::2, x::2] for y in (0, 1) for x in (0, 1)]
    for i, one in enumerate(sites):
        for two in sites[:i]:
            assert abs(correlation(one, two)) < 4
    assert abs(correlation(noise, noisy_flats(develop, "other", method=method) / scale)) < 4
    assert abs(correlation(noise, noisy_flats(develop, seed=1, method=method) / scale)) < 4


def test_noise_belongs_to_the_image_not_to_the_run(develop):
    one, _, again = (noisy_flats(develop, key, numpy=False) for key in "aba")
    assert np.array_equal(one, again)


def lines(develop, stage, key="k", seed=0, iso=3200):
    grey = np.zeros((400, 600), np.float32)
    return develop(
        grey,
        key,
        source=Kind.MOSAIC,
        stages=[stage],
        seed=seed,
        iso=iso,
        **{stage: {"sigma": 0.01}},
    ).final


def test_row_noise_is_one_offset_a_row_new_in_each_image(develop):
    image = lines(develop, "row_noise")
    assert np.all(image == image[:, :1])
    assert abs(image[:, 0].std() / 0.01 - 1) < 4 / sqrt(2 * 400)
    assert not np.array_equal(image, lines(develop, "row_noise", key="other"))


def test_column_noise_is_one_offset_a_column_fixed_to_the_camera(develop):
    image = lines(develop, "column_noise")
    assert np.all(image == image[:1])
    assert abs(image[0].std() / 0.01 - 1) < 4 / sqrt(2 * 600)
    for other in ({"key": "other"}, {"seed": 5}, {"iso": 100}):
        assert np.array_equal(image, lines(develop, "column_noise", **other))


@pytest.mark.slow
def test_repeated_stages_draw_different_noise(develop):
    grey = np.full((64, 64), 0.5, np.float32)
    settings = {"sensor_noise": {"a": 0, "b": 1e-4}, "sensor_noise_2": {"a": 0, "b": 1e-4}}
    result = develop(
        grey,
        source=Kind.MOSAIC,
        stages=["sensor_noise", "sensor_noise"],
        keep=("sensor_noise",),
        **settings,
    )
    first = result.kept["sensor_noise"] - 0.5
    assert abs(correlation(first, result.final - 0.5 - first)) < 4


@pytest.mark.parametrize("iso", [100, 500, 640, 3200])
def test_camera_noise_is_the_measured_one(iso):
    from clpipe.camera.profile import load_camera

    # gain and read noise in DN: W. Claff, photonstophotos.net, Sony A7RM2, 2015-08-29
    gain, read = {
        100: (0.315, 1.413),
        500: (1.587, 4.918),
        640: (2.0002, 2.418),
        3200: (10.0774, 10.31),
    }[iso]
    model = load_camera("sony-a7r2").noise(iso)
    a, b = model.a, model.b
    assert a == pytest.approx(gain / 15871, rel=1e-6)
    assert b == pytest.approx((read / 15871) ** 2, rel=1e-6)


def test_read_noise_is_never_interpolated_across_gain_stages():
    from clpipe.camera.profile import load_camera

    noise = load_camera("sony-a7r2").noise
    assert noise(639).b > noise(500).b > 4 * noise(640).b

"""Photo-electrons, read noise and fixed patterns: distributions, parameters, bounds."""

from math import sqrt

import numpy as np
import pytest
from scipy.stats import chi2, kurtosis, poisson, tukeylambda

from clpipe.base.errors import RequestError
from clpipe.camera.profile import built_in_cameras, load_camera
from clpipe.chain.making import make_chain
from clpipe.chain.settings import settings_from
from clpipe.engine.plan import make_plan
from clpipe.engine.runner import Runner
from clpipe.reference.poisson import poisson_of
from clpipe.reference.tukey_lambda import shape_and_scale, tukey_lambda_of
from clpipe.stage import Kind

MEANS = (0.1, 1, 5, 9.9, 10.1, 50, 1000, 1e5)


def words_of(j):
    """The random words whose uniform number is (j + 1/2) / 2^32."""
    upper = j >= 1 << 31
    return np.where(upper, (1 << 32) - 1 - j, j | 1 << 31).astype(np.uint32)


def draw(develop, level, count=1_000_000, **parameters):
    """Return only sensor noise on a flat mosaic."""
    flat = np.full((count // 2000, 2000), level, np.float32)
    stages = {"stages": ["sensor_noise"], "sensor_noise": parameters}
    return develop(flat, source=Kind.MOSAIC, **stages).final.astype(np.float64)


@pytest.mark.parametrize("mean", MEANS)
def test_poisson_numbers_pass_a_chi_square_test_of_a_million(develop, mean):
    n, a = 1_000_000, 1e-5
    # A gain of 1e-5 DN and no read noise: the whole numbers can be read off again.
    signal = draw(develop, np.float32(mean * a), n, method="poisson", a=a, b=0.0).ravel()
    numbers = np.rint(signal / a).astype(np.int64)
    mean = float(np.float32(mean * a) * np.float32(1 / a))
    least, most = int(poisson.ppf(1e-6, mean)), int(poisson.isf(1e-6, mean))
    inner = np.arange(least + 1, most + 1)
    expected = n * np.r_[poisson.cdf(least, mean), poisson.pmf(inner, mean), poisson.sf(most, mean)]
    observed = np.bincount(np.clip(numbers, least, most + 1) - least, minlength=len(expected))
    # Cells with few in them are joined, as the test asks for.
    cell = np.searchsorted(np.arange(1, int(n / 10) + 1) * 10, np.cumsum(expected) - 1e-9)
    e, o = (np.bincount(cell, v)[np.unique(cell)] for v in (expected, observed))
    p = chi2.sf(np.sum((o - e) ** 2 / e), len(e) - 1)
    assert p > 0.001
    assert abs(numbers.mean() - mean) < 4 * sqrt(mean / n)
    assert abs(numbers.var() - mean) < 4 * sqrt((mean + 2 * mean**2) / n)
    beyond = np.count_nonzero(numbers > most)
    assert poisson.cdf(beyond, expected[-1]) > 1e-4 and poisson.sf(beyond - 1, expected[-1]) > 1e-4


@pytest.mark.parametrize("mean", [*MEANS, 0.001, 3, 9.999, 10, 20, 200])
def test_poisson_tails_are_exact_to_one_in_a_million(mean):
    mean = np.float32(mean)
    exact = poisson(float(mean))
    k = np.unique(np.linspace(exact.ppf(1e-6), exact.isf(1e-6), 300).astype(np.int64))
    # The share of all words that give at most k, by bisection: the numbers rise with the words.
    low, high = np.zeros(len(k), np.int64), np.full(len(k), 1 << 32)
    while np.any(high - low > 1):
        middle = (low + high) // 2
        within = poisson_of(np.full(len(k), mean), words_of(middle)) <= k
        low, high = np.where(within, middle, low), np.where(within, high, middle)
    found = high / 2**32
    below, above = np.abs(found / exact.cdf(k) - 1), np.abs((1 - found) / exact.sf(k) - 1)
    smaller = np.where(exact.cdf(k) < 0.5, below, above)
    assert smaller[np.minimum(exact.cdf(k), exact.sf(k)) > 1e-6].max() < 0.01
    assert np.abs(found - exact.cdf(k)).max() < 2e-5


def test_poisson_numbers_are_whole_bounded_and_never_of_darkness():
    words = np.uint32([0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF])
    for mean in np.float32([0, 1e-30, 1e-3, 9.99, 10, 4e6, 4.3e6, 1e9]):
        numbers = poisson_of(np.full(5, mean, np.float32), words)
        assert np.all(np.isfinite(numbers)) and np.all(numbers >= 0)
        if mean < 1 << 22:
            assert np.all(numbers == np.rint(numbers))
    assert np.all(poisson_of(np.zeros(5, np.float32), words) == 0)


@pytest.mark.parametrize("shape", [-0.3, -0.1, 0.0, 0.14, 1.0])
def test_tukey_lambda_is_that_of_scipy(shape):
    j = np.unique(np.geomspace(4, 2**31, 2000).astype(np.int64))
    z = tukey_lambda_of(words_of(j), *shape_and_scale(shape))
    exact = tukeylambda.ppf((j + 0.5) / 2**32, shape) / tukeylambda.std(shape)
    assert np.abs(z / exact - 1)[np.abs(exact) > 0.01].max() < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("method", ["skewed_gaussian", "gaussian", "poisson"])
@pytest.mark.parametrize("more", [{}, {"tukey_lambda": -0.15}])
def test_mean_and_variance_are_those_asked_for(develop, method, more):
    a, b, n = 2e-3, 5e-6, 1_000_000
    for level in (0.0, 0.003, 0.02, 0.6):
        noisy = draw(develop, level, n, method=method, a=a, b=b, **more)
        variance = a * level + b
        heavy = 3 if more else 1
        assert abs(noisy.mean() - level) < 4 * sqrt(variance / n)
        assert abs(noisy.var() / variance - 1) < 4 * sqrt(2 * heavy / n)
    dark = draw(develop, 0.0, n, method=method, a=a, b=b, **more).ravel()
    # The fourth moment of this lambda is far out: a tenth is what a million show of it.
    excess = tukeylambda.stats(-0.15, moments="k") if more else 0.0
    assert kurtosis(dark) == pytest.approx(float(excess), rel=0.25, abs=0.02)


@pytest.mark.parametrize("read_noise", [0.0, 2.0])
@pytest.mark.parametrize("electrons", [1, 4, 40, 1000])
def test_the_skew_is_that_of_shot_noise(develop, electrons, read_noise):
    n, a = 1_000_000, 1e-3
    b, level = (a * read_noise) ** 2, a * electrons
    noise = (draw(develop, level, n, method="skewed_gaussian", a=a, b=b) - level) / a
    variance = electrons + read_noise**2
    skewness = electrons / variance**1.5
    found = float((noise.astype(np.float64) ** 3).mean() / noise.var(dtype=np.float64) ** 1.5)
    # The error of a skewness of n normals is sqrt(6 / n); what is not modelled is c's cube.
    assert abs(found - skewness) < 4 * sqrt(6 / n) + 0.04 * skewness
    assert abs(noise.var(dtype=np.float64) / variance - 1) < 4 * sqrt(2 / n) + 0.01 / electrons
    gaussian = draw(develop, level, n, method="gaussian", a=a, b=b) - level
    assert abs((gaussian.astype(np.float64) ** 3).mean()) < 0.1 * a**3 * variance**1.5


@pytest.mark.parametrize("read_noise", [0.0, 0.01, 0.1])
@pytest.mark.parametrize("electrons", [0.2, 0.03, 1e-3, 1e-8, 1e-24])
def test_the_noise_of_little_light_is_little(develop, electrons, read_noise):
    a = 1e-3
    variance = a**2 * (electrons + read_noise**2)
    given = {"method": "skewed_gaussian", "a": a, "b": (a * read_noise) ** 2}
    noise = draw(develop, a * electrons, 300_000, **given) - np.float32(a * electrons)
    assert noise.var(dtype=np.float64) == pytest.approx(variance, rel=0.04, abs=0)
    assert abs(noise.mean(dtype=np.float64)) < 0.02 * sqrt(variance)


def test_a_full_well_holds_no_more(develop):
    given = {"a": 1e-3, "full_well": 500.0, "b": 0.0}
    for method in ("skewed_gaussian", "gaussian", "poisson"):
        bright = draw(develop, 0.9, 10_000, method=method, **given)
        assert bright.max() == np.float32(0.5) == bright.min()
        assert draw(develop, 0.3, 10_000, method=method, **given).max() < 0.5


def model(**sensor_noise):
    settings = settings_from({"iso": 800, "sensor_noise": sensor_noise})
    return make_chain(settings).noise


def test_three_ways_to_say_the_same():
    unit = 16383 - 512
    camera = load_camera("sony-a7r2").noise(800)
    emva, paper = camera.emva(), camera.paper()
    assert model() == camera
    same = [
        model(a=camera.a, b=camera.b),
        model(system_gain=emva.system_gain, read_noise=emva.read_noise, adc_noise=emva.adc_noise),
        model(read_noise=emva.read_noise, adc_noise=emva.adc_noise),
        model(chi=paper.chi, theta=paper.theta, b_before=paper.b_before, b_after=paper.b_after),
    ]
    for other in same:
        assert (other.a, other.b) == pytest.approx((camera.a, camera.b), rel=1e-9)
    assert same[1].paper().b_after == pytest.approx(paper.b_after)
    assert same[3].emva().adc_noise == pytest.approx(emva.adc_noise)
    # a = K / range; b = (K r / range)^2 + (q / range)^2
    assert model(system_gain=4.0, read_noise=3.0, adc_noise=5.0).a == pytest.approx(4 / unit)
    found = model(system_gain=4.0, read_noise=3.0, adc_noise=5.0).b
    assert found == pytest.approx((12**2 + 5**2) / unit**2)
    # a = theta/chi, b = theta^2 b' + b'' - theta^2 p0/chi
    found = model(chi=1e4, theta=2.0, b_before=3e-6, b_after=1e-6, p0=0.01)
    assert (found.a, found.b) == pytest.approx((2e-4, 12e-6 + 1e-6 - 4e-6))


def test_what_is_left_out_is_the_cameras():
    camera = load_camera("sony-a7r2").noise(800)
    emva, paper, unit = camera.emva(), camera.paper(), camera.signal_range
    found = model(adc_noise=5.0)
    assert found.a == pytest.approx(camera.a)
    assert found.b * unit**2 == pytest.approx((2.521 * emva.read_noise) ** 2 + 25)
    assert model(read_noise=4.0).emva().adc_noise == pytest.approx(emva.adc_noise)
    found = model(chi=1e4, theta=2.0)
    assert found.b == pytest.approx(4 * paper.b_before + paper.b_after)


def test_a_full_well_stays_in_the_truth(develop):
    given = {
        "sensor_noise": {"a": 1e-3, "full_well": 500.0},
        "stages": ["sensor_noise", "quantize"],
    }
    chain = make_chain(settings_from(given), Kind.MOSAIC)
    bright = np.full((8, 8), 0.9, np.float32)
    truth = Runner(chain.without_noise(), None, encode=False, final=True).run(bright, "k").final
    assert np.all(truth == np.rint(np.float32(0.5) * 15871 + 512))
    assert chain.without_noise().noise is None
    # Without a gain an electron is worth nothing, and a full well says nothing.
    dim = draw(develop, 0.1, 10_000, a=0.0, b=0.0, full_well=4e4)
    assert np.all(dim == np.float32(0.1))


def test_hot_pixels_can_be_seen_where_the_camera_does_not_say_how_hot(develop):
    image = fixed(develop, defect_pixels={"hot_share": 0.01}).final
    assert (image >= 0.1).mean() == pytest.approx(0.01, rel=0.2)


def fixed(develop, key="k", seed=0, iso=3200, level=0.0, **stages):
    flat = np.full((400, 600), level, np.float32)
    return develop(flat, key, source=Kind.MOSAIC, stages=list(stages), seed=seed, iso=iso, **stages)


@pytest.mark.slow
def test_what_is_fixed_to_a_camera_is_the_same_in_every_frame(develop, tmp_path):
    stages = {
        "prnu": {"sigma": 0.01},
        "defect_pixels": {"hot_share": 0.01, "hot_level": 0.2, "dead_share": 0.01},
        "dsnu": {"sigma": 0.01},
    }
    own = tmp_path / "mine.toml"
    text = built_in_cameras()["sony-a7r2"].read_text()
    own.write_text(text.replace('name = "sony-a7r2"', 'name = "mine"'))
    for stage, given in stages.items():
        one = fixed(develop, level=0.5, **{stage: given}).final
        for other in ({"key": "other"}, {"seed": 3}, {"iso": 100}):
            same = fixed(develop, level=0.5, **other, **{stage: given}).final
            assert np.array_equal(one, same), (stage, other)
        other = develop(
            np.full((400, 600), 0.5, np.float32),
            source=Kind.MOSAIC,
            stages=[stage],
            camera=str(own),
            **{stage: given},
        ).final
        assert not np.array_equal(one, other)


def test_prnu_scales_and_dsnu_adds(develop):
    n = 400 * 600
    for level in (0.1, 0.8):
        uneven = fixed(develop, level=level, prnu={"sigma": 0.02}).final
        assert abs(uneven.std() / (0.02 * level) - 1) < 4 / sqrt(2 * n)
        assert abs(uneven.mean() / level - 1) < 4 * 0.02 / sqrt(n)
        uneven = fixed(develop, level=level, dsnu={"sigma": 0.02}).final - level
        assert abs(uneven.std() / 0.02 - 1) < 4 / sqrt(2 * n)


def test_hot_and_dead_pixels(develop):
    given = {"hot_share": 0.02, "hot_level": 0.1, "dead_share": 0.01}
    image = fixed(develop, level=0.3, defect_pixels=given).final.astype(np.float64)
    n = image.size
    hot, dead = image > 0.3001, image == 0
    assert abs(hot.sum() - 0.02 * n) < 4 * sqrt(0.02 * n)
    assert abs(dead.sum() - 0.01 * n) < 4 * sqrt(0.01 * n)
    assert np.all(image[~hot & ~dead] == np.float32(0.3))
    extra = (image[hot] - 0.3) / 0.1
    assert extra.min() > 0.999
    assert abs(extra.mean() - 2) < 4 / sqrt(hot.sum())
    assert abs(np.mean(extra > 3) - np.exp(-2)) < 4 * sqrt(np.exp(-2) / hot.sum())


def test_a_profile_says_what_is_fixed_in_electrons(tmp_path):
    own = tmp_path / "mine.toml"
    more = (
        "dsnu = 2.0\nhot_pixel_share = 1e-4\nhot_pixel_level = 100\nprnu = 0.004\nfull_well = 5e4"
    )
    text = built_in_cameras()["sony-a7r2"].read_text()
    own.write_text(text.replace("row_noise_ratio = 0.12", more))
    for iso in (100, 3200):
        chain = make_chain(settings_from({"camera": str(own), "iso": iso}))
        methods = {step.name: step.method for step in chain.steps}
        a = chain.noise.a
        assert methods["dsnu"].sigma == pytest.approx(2 * a)
        assert methods["defect_pixels"].hot_level == pytest.approx(100 * a)
        assert methods["prnu"].sigma == 0.004
        assert methods["sensor_noise"].full_well == 5e4


def test_what_does_nothing_costs_nothing(develop):
    quiet = make_plan(make_chain(settings_from({"row_noise": {"sigma": 0.0}})))
    names = [op.step for launch in quiet.launches for op in getattr(launch, "ops", ())]
    assert not {"prnu", "defect_pixels", "dsnu", "row_noise", "column_noise"} & set(names)


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_bit_depths(develop, bits):
    ramp = np.linspace(-0.1, 1.2, 5000, dtype=np.float32)[None]
    ramp[0, 7] = 0
    dn = develop(ramp, source=Kind.MOSAIC, stages=["quantize"], quantize={"bits": bits}).final
    scale = (2**bits - 1) / 16383
    assert dn.max() == round(16383 * scale)
    assert dn[0, 7] == round(512 * scale)
    assert len(np.unique(dn)) <= 2**bits
    there = ["quantize", "normalize"]
    back = develop(ramp, source=Kind.MOSAIC, stages=there, quantize={"bits": bits}).final
    inside = (ramp > -0.03) & (ramp < 1)
    assert np.abs(back - ramp)[inside].max() < 0.6 / (2**bits * 0.96)


def test_bit_depths_that_do_not_fit_their_levels():
    with pytest.raises(
        RequestError, match="white_level must be below 4096, because the raw image has 12 bits"
    ):
        make_chain(settings_from({"quantize": {"bits": 12, "white_level": 5000.0}}))

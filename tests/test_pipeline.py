"""Whole chains: the same bits for any kept images, fusion or history."""

from types import MappingProxyType

import numpy as np
import pytest

import clpipe as package
from clpipe.camera.lights import TOLERANCE, light_in_srgb, plausible_gains
from clpipe.camera.profile import load_camera
from clpipe.chain.files import load_config
from clpipe.chain.making import make_chain
from clpipe.chain.registry import all_stages
from clpipe.chain.settings import settings_from
from clpipe.engine.runner import Runner
from clpipe.images.read import read_image
from clpipe.reference.cfa import red_site
from clpipe.stages import DEFAULT_CHAIN
from tests.conftest import STILL_LIFE


@pytest.fixture(scope="module")
def still_life():
    return read_image(STILL_LIFE).pixels


def runner(settings, device, **options):
    return Runner(make_chain(settings_from(settings)), device, **options)


def test_images_of_all_sizes_one_after_the_other(device, still_life):
    many = runner({"iso": 3200}, device)
    for size in ((50, 70), (640, 960), (50, 70), (33, 8), (64, 64)):
        image = np.ascontiguousarray(still_life[: size[0], : size[1]])
        fresh = runner({"iso": 3200}, device).run(image, "k").encoded
        assert np.array_equal(many.run(image, "k").encoded, fresh)


def test_half_and_float_sources_agree(device, still_life):
    image = np.ascontiguousarray(still_life[:64, :64])
    one = runner({}, device).run(image, "k").encoded
    assert np.array_equal(one, runner({}, device).run(image.astype(np.float32), "k").encoded)


def test_a_render_keeps_its_colours(develop, still_life):
    crop = np.ascontiguousarray(still_life[120:240, 120:360])
    quiet = ["sensor_noise", "row_noise", "denoise", "sharpen", "gamma"]
    result = develop(crop, numpy=True, skip=quiet, tone_curve={"method": "linear"})
    clean = crop.astype(np.float64)
    assert np.abs(result.final.mean((0, 1)) - clean.mean((0, 1))).max() < 2e-3


def test_burnt_out_highlights_are_white(develop):
    bright = np.full((32, 32, 3), 40, np.float32)
    encoded = develop(bright, encode=True).encoded
    assert encoded.min() == 255


GRAY = {"method": "gray_world", "limit": False}


def test_gray_world_makes_means_equal(develop):
    random = np.random.default_rng(0)
    image = (random.random((64, 64, 3)) * [0.5, 0.3, 0.1]).astype(np.float32)
    chain = ["mosaic", "white_balance"]
    result = develop(image, numpy=True, stages=chain, white_balance=GRAY)
    sites = [result.final[y::2, x::2].mean() for y in (0, 1) for x in (0, 1)]
    green = (sites[1] + sites[2]) / 2
    assert sites[0] == pytest.approx(green, rel=1e-5)
    assert sites[3] == pytest.approx(green, rel=1e-5)
    gains = result.estimates["white_balance"]
    assert gains["red_gain"] == pytest.approx(0.6, rel=0.05)
    assert gains["blue_gain"] == pytest.approx(3.0, rel=0.05)


@pytest.mark.parametrize("numpy", [False, True])
@pytest.mark.parametrize("method", ["gray_world", "white_patch"])
def test_gains_stay_near_those_of_lights(develop, numpy, method):
    leaves = np.random.default_rng(2).uniform(0.5, 1.0, (64, 64, 1)) * [0.12, 0.3, 0.06]
    camera = load_camera("canon-5d3")

    def gains(light, **settings):
        values = {"method": method, **settings}
        image = (leaves * light).astype(np.float32)
        result = develop(image, numpy=numpy, camera="canon-5d3", white_balance=values)
        return np.array(list(result.estimates["white_balance"].values()))

    daylight, tungsten = np.ones(3), light_in_srgb(2856)
    assert gains(daylight, limit=False).min() / max(camera.white_balance_gains) > 1  # magenta
    near = gains(daylight)
    lights = plausible_gains(camera, camera.white_balance_gains)
    assert abs(near / lights - 1).max(1).min() <= TOLERANCE + 1e-5
    assert (
        0.8 < min(near / camera.white_balance_gains) < max(near / camera.white_balance_gains) < 1.5
    )
    # Under a lamp, gains are those of lamps, and grey stays grey.
    warm = plausible_gains(camera, camera.white_balance_gains)[:12]
    assert abs(gains(tungsten) / warm - 1).max(1).min() <= TOLERANCE + 1e-5


WHITE = {"stages": ["mosaic", "white_balance"]}


@pytest.mark.parametrize(("pattern", "numpy"), [("RGGB", False), ("RGGB", True), ("GBRG", True)])
def test_white_patch_makes_the_brightest_samples_equal(develop, numpy, pattern):
    random = np.random.default_rng(1)
    image = (random.random((61, 90, 3)) * [0.2, 0.4, 0.1]).astype(np.float32)
    image[10:20, 10:20] = [0.3, 0.6, 0.15]  # a white wall in warm light: 1.6 % of the picture
    image[30:34, 30:60] = [0.9, 1.0, 0.2]  # a lamp that clips in green
    settings = {"method": "white_patch", "percentile": 99.5, "limit": False}
    mosaic = {"pattern": pattern}
    result = develop(image, numpy=numpy, white_balance=settings, mosaic=mosaic, **WHITE)
    gains = result.estimates["white_balance"]
    assert gains["red_gain"] == pytest.approx(2.0, rel=0.005)
    assert gains["blue_gain"] == pytest.approx(4.0, rel=0.005)


@pytest.mark.parametrize("numpy", [False, True])
@pytest.mark.parametrize(
    ("method", "level"), [("gray_world", 0.0), ("white_patch", 0.0), ("white_patch", 1.0)]
)
def test_darkness_or_nothing_but_clipping_changes_no_white(develop, numpy, method, level):
    image = np.full((9, 7, 3), level, np.float32)
    result = develop(image, numpy=numpy, white_balance={"method": method}, **WHITE)
    assert result.estimates["white_balance"] == {"red_gain": 1.0, "blue_gain": 1.0}


def test_white_patch_counts_a_large_picture_exactly(device):
    image = np.random.default_rng(0).random((700, 1100, 3), np.float32)
    settings = {**WHITE, "white_balance": {"method": "white_patch", "percentile": 37.123}}
    one, two = (
        runner(settings, d, encode=False, final=True).run(image, "k") for d in (device, None)
    )
    assert one.estimates["white_balance"] == pytest.approx(two.estimates["white_balance"], rel=1e-6)


def test_fixed_gains_and_none(develop):
    image = np.full((4, 4, 3), 0.1, np.float32)
    none = develop(image, white_balance={"method": "none"}, **WHITE)
    assert np.array_equal(none.final, image[..., 0])
    gains = {"method": "gains", "red_gain": 2, "blue_gain": 3}
    sites = develop(image, white_balance=gains, **WHITE).final[:2, :2].ravel()
    assert sites == pytest.approx([0.2, 0.1, 0.1, 0.3])
    camera = make_chain(settings_from({"white_balance": {"method": "gains"}}))
    assert camera.step_named("white_balance").method.red_gain == 2.77


def test_the_camera_matrix_and_its_inverse_undo_each_other(develop):
    image = np.random.default_rng(0).random((9, 13, 3), np.float32)
    chain = {"stages": ["inverse_color_matrix", "color_matrix"], "keep": ("inverse_color_matrix",)}
    for method in ("camera", "as_shot"):
        result = develop(image, color_matrix={"method": method}, **chain)
        assert np.abs(result.final - image).max() < 1e-5
        assert np.abs(result.kept["inverse_color_matrix"] - image).max() > 0.1
    grey = np.full((1, 1, 3), 0.3, np.float32)
    kept = develop(grey, **chain).kept["inverse_color_matrix"]
    assert kept == pytest.approx(grey, abs=1e-6)
    alone = develop(image, stages=["color_matrix"])  # nothing is to be undone
    assert np.array_equal(alone.final, image)


def test_a_given_matrix_mixes_colours(develop):
    image = np.float32([[[0.1, 0.2, 0.4]]])
    matrix = [[0, 1, 0], [0, 0, 1], [1, 1, 0]]
    given = {"method": "given", "matrix": matrix}
    result = develop(image, stages=["color_matrix"], color_matrix=given)
    assert result.final.ravel() == pytest.approx([0.2, 0.4, 0.3])


def test_srgb_gamma(develop):
    image = np.float32([[[0.001, 0.5, 1]]])
    result = develop(image, stages=["gamma"], gamma={"method": "srgb"}, encode=True)
    assert result.final.ravel() == pytest.approx([0.01292, 0.73536, 1], abs=1e-4)
    assert result.encoded.ravel().tolist() == [3, 188, 255]


def test_denoising_follows_the_iso_and_is_stronger_on_chroma():
    def amounts(iso):
        return make_chain(settings_from({"iso": iso})).step_named("denoise").method.amounts

    low, high = amounts(100), amounts(3200)
    assert high[0] > 4 * low[0]
    assert high[1] > 2 * high[0]


def test_the_law_is_explained_with_the_numbers_it_gives():
    step = make_chain(settings_from({"iso": 3200})).step_named("denoise")
    text = step.stage.explain(step.context)
    assert "ISO 3200" in text and "sony-a7r2" in text
    formula = "luma_noise = sqrt(sum of (0.299, 0.587, 0.114)^2 * sigma^2)"
    assert f"{formula} = {step.method.luma_noise:.3g}" in text
    assert f"{step.method.chroma_noise:.3g}" in text
    luma, chroma = 1.2 * step.method.luma_noise, 2.4 * step.method.chroma_noise
    assert f"range sigma = 1.2 * strength * noise: luma {luma:.3g}, chroma {chroma:.3g}" in text
    assert max(map(len, text.splitlines())) <= 100


@pytest.mark.parametrize(("method", "left"), [("biweight", 0.8), ("bilateral", 0.6)])
def test_denoising_takes_noise_away_and_leaves_edges(develop, method, left):
    image = np.full((128, 128, 3), 0.1, np.float32)
    image[:, 64:] = 0.6
    linear = {"exposure": {"headroom": 0}, "skip": ["inverse_color_matrix", "color_matrix"]}
    linear["skip"] += ["sharpen", "tone_curve", "gamma"]
    denoise = {"denoise": {"method": method}, "keep": ("demosaic",)}
    result = develop(image, numpy=True, iso=3200, **linear, **denoise)
    before, after = result.kept["demosaic"], result.final
    flat = (slice(8, -8), slice(8, 50))
    assert after[flat].std() < left * before[flat].std()
    step = after[8:-8, 66].mean() - after[8:-8, 61].mean()
    assert step > 0.48


@pytest.mark.parametrize("method", sorted({*all_stages()["demosaic"].by_name} - {"gray"}))
@pytest.mark.parametrize("pattern", ["GRBG", "GBRG"])
def test_demosaicing_keeps_samples_and_leaves_flat_areas_flat(develop, method, pattern):
    random = np.random.default_rng(1)
    chain = {"stages": ["mosaic", "demosaic"], "keep": ("mosaic",), "mosaic": {"pattern": pattern}}
    colours = random.random((24, 31, 3)).astype(np.float32)
    # In NumPy, with which test_kernels.py compares the kernels.
    result = develop(colours, numpy=True, demosaic={"method": method}, **chain)
    red_x, red_y = red_site(pattern)
    # On roots of the signal, samples come back rounded; and as means whose weights add up to 1.
    error = {"bounded": 1e-5, "directional_mmse": 1e-6}.get(method, 0)
    for channel, x, y in ((0, red_x, red_y), (1, 1 - red_x, red_y), (2, 1 - red_x, 1 - red_y)):
        own, sample = result.final[y::2, x::2, channel], result.kept["mosaic"][y::2, x::2]
        assert np.allclose(own, sample, rtol=error, atol=error / 10), channel
    flat = np.full((24, 31, 3), 0.25, np.float32)
    again = develop(flat, numpy=True, demosaic={"method": method}, **chain).final
    rounding = 1e-6 if method == "linear_mmse" else error  # of 49 weights and their sum
    assert np.allclose(again, flat, rtol=rounding, atol=0)


def psnr(one, two, peak):
    return 10 * np.log10(peak**2 / np.mean((one.astype(np.float64) - two) ** 2))


NOISE = ["sensor_noise", "row_noise", "column_noise"]


@pytest.fixture(scope="module")
def judged(device, still_life):
    """PSNR of a picture against the same chain without noise and denoising: linear RGB, 8 bit."""
    image = np.ascontiguousarray(still_life[160:480, 240:720])

    def judge(iso, base=MappingProxyType({}), on=device, **settings):
        def pictures(skip=(), **more):
            skip = ["sharpen", "tone_curve", "gamma", *skip]
            values = base | {"iso": iso, **more, "skip": skip}
            linear = runner(values, on, encode=False, final=True).run(image, "k").final
            curves = make_chain(settings_from(base | {"iso": iso}), start_at="tone_curve")
            return linear, Runner(curves, None).run(linear, "k").encoded

        clean = pictures([*NOISE, "denoise"])
        ours = pictures(**settings)
        return psnr(ours[0], clean[0], 1), psnr(ours[1], clean[1], 255)

    return judge


@pytest.mark.slow
@pytest.mark.parametrize("iso", [1600, 12800])
def test_non_local_means_is_the_best_denoiser(judged, iso):
    noisy = judged(iso, skip=["denoise"])
    others = {name: judged(iso, denoise={"method": name}) for name in ("mean", "median")}
    default = judged(iso)
    best = judged(iso, denoise={"method": "non_local_means"})
    for i in (0, 1):
        assert best[i] > default[i] + 1
        assert best[i] > max(value[i] for value in others.values()) + 1
        assert default[i] > noisy[i] + 0.4


@pytest.mark.slow
@pytest.mark.parametrize("iso", [1600, 12800])
def test_the_papers_denoising_makes_a_better_picture(judged, iso):
    paper = load_config("paper").values
    noisy, ours = judged(iso, paper, None, skip=["denoise"]), judged(iso, paper, None)
    for i in (0, 1):
        assert ours[i] > noisy[i] + 0.4


def with_mosaic_denoise(after):
    chain = list(DEFAULT_CHAIN)
    chain.insert(chain.index(after) + 1, "mosaic_denoise")
    return chain


UP_TO_MOSAIC_DENOISE = [*DEFAULT_CHAIN[: DEFAULT_CHAIN.index("normalize") + 1], "mosaic_denoise"]


@pytest.mark.slow
@pytest.mark.parametrize("after", ["normalize", "white_balance"])
def test_denoising_the_mosaic_makes_a_better_picture(judged, after):
    noisy = judged(3200, skip=["denoise"])
    ours = judged(3200, skip=["denoise"], stages=with_mosaic_denoise(after))
    assert ours[0] > noisy[0] + 2
    assert ours[1] > noisy[1] + 2


@pytest.mark.slow
def test_denoising_the_mosaic_takes_noise_away_and_leaves_edges(develop):
    image = np.full((96, 128, 3), 0.1, np.float32)
    image[:, 64:] = 0.6
    sharp = {"skip": ["optical_blur"], "iso": 3200, "stages": UP_TO_MOSAIC_DENOISE}
    result = develop(image, keep=("normalize",), **sharp)
    before, after = result.kept["normalize"], result.final
    for y, x in ((0, 0), (0, 1), (1, 0), (1, 1)):
        flat = (slice(8 + y, -8, 2), slice(8 + x, 54, 2))
        assert after[flat].var() < before[flat].var() / 3
        assert after[flat].mean() == pytest.approx(before[flat].mean(), rel=0.02)
        left, right = after[8 + y : -8 : 2, 62 + x], after[8 + y : -8 : 2, 64 + x]
        assert right.mean() / left.mean() == pytest.approx(6, rel=0.05)


def test_denoising_the_mosaic_keeps_what_is_below_black(develop):
    black = np.zeros((64, 64, 3), np.float32)
    stages = {"stages": UP_TO_MOSAIC_DENOISE, "keep": ("normalize",)}
    result = develop(black, numpy=True, iso=12800, **stages)
    before, after = result.kept["normalize"], result.final
    assert before.min() < 0 and after.min() < 0
    assert abs(after.mean() - before.mean()) < before.std() / 20


@pytest.mark.filterwarnings("ignore:.* clipped")
def test_white_is_one_and_the_sensor_saturates_at_two():
    """The docstring of process says so."""
    camera = package.Pipeline(skip=["noise"], keep="normalize", device="numpy")
    for value, signal in ((1.0, 0.5), (1.9, 0.95), (2.0, 1.0), (3.0, 1.0)):
        shot = camera(np.full((8, 8, 3), value, np.float32))
        assert shot.kept["normalize"][::2, 1::2] == pytest.approx(signal, abs=1e-3)

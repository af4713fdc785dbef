"""clpipe quality: its measures against known answers, and real charts that it finds."""

import json
import math
import re

import numpy as np
import pytest
from PIL import Image, ImageDraw

from clpipe.analysis.matching.charts import as_toned, read_charts
from clpipe.analysis.quality import measure, texture
from clpipe.analysis.quality.charts import (
    CHECKER,
    GREY,
    checker,
    dead_leaves,
    disc,
    dots,
    grey,
    grey_steps,
    patch_image,
    slanted_edge,
)
from clpipe.analysis.quality.checker import find_checker
from clpipe.analysis.quality.colour import checker_errors, delta_e_2000
from clpipe.analysis.quality.greys import LUMINANCE, GreyPatches
from clpipe.analysis.quality.report import FIGURES
from clpipe.analysis.quality.simulation import ChartCamera
from clpipe.analysis.quality.visual_noise import (
    PIXELS_PER_DEGREE,
    acutance,
    sensitivity,
    visual_noise,
)
from clpipe.analysis.sharpness import FREQUENCIES, edge_of, frequency_at
from clpipe.base.errors import RequestError
from clpipe.chain.settings import settings_from
from clpipe.engine.service import Service
from clpipe.reference.transfer import inverse_srgb_curve, srgb_curve
from tests.conftest import run_cli
from tests.photographs import photographs

ANGLES = (5.0, 20.0, 70.0, 85.0)
# Pairs of CIELAB colours and their CIEDE2000: Sharma, Wu and Dalal, "The CIEDE2000 color-difference
# formula", Color Research and Application 30 (2005), table 1.
SHARMA = (
    (50, 2.6772, -79.7751, 50, 0, -82.7485, 2.0425),
    (50, 2.8361, -74.02, 50, 0, -82.7485, 3.4412),
    (50, 0, 0, 50, -1, 2, 2.3669),
    (50, 2.49, -0.001, 50, -2.49, 0.0010, 7.1792),
    (50, 2.49, -0.001, 50, -2.49, 0.0011, 7.2195),
    (50, -0.001, 2.49, 50, 0.0009, -2.49, 4.8045),
    (50, 2.5, 0, 50, 0, -2.5, 4.3065),
    (50, 2.5, 0, 73, 25, -18, 27.1492),
    (50, 2.5, 0, 61, -5, 29, 22.8977),
    (60.2574, -34.0099, 36.2677, 60.4626, -34.1751, 39.4387, 1.2644),
    (22.7233, 20.0904, -46.694, 23.0331, 14.973, -42.5619, 2.0373),
    (90.8027, -2.0831, 1.441, 91.1528, -1.6435, 0.0447, 1.4441),
    (2.0776, 0.0795, -1.135, 0.9033, -0.0636, -0.5514, 0.9082),
)


@pytest.fixture(scope="module")
def camera(device):
    service = Service([device])
    return lambda **values: ChartCamera(settings_from(values), service)


def _normal(sigmas):
    return 0.5 * (1 + math.erf(sigmas / 2**0.5))


def levels_of(light):
    return 255 * srgb_curve(light)


def save(path, levels):
    Image.fromarray(np.uint8(np.rint(levels))).save(path, quality=97)


def pixel_mtf(angle, sigma=0.0):
    """The MTF of a square pixel across an edge, and of a Gaussian."""
    along, across = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    square = np.sinc(FREQUENCIES * along) * np.sinc(FREQUENCIES * across)
    return square * np.exp(-2 * (np.pi * sigma * FREQUENCIES) ** 2)


@pytest.mark.parametrize("angle", [0.0, 3.0, *ANGLES, 90.0, 137.0])
def test_the_chart_of_an_edge_is_the_mean_over_square_pixels(angle):
    samples, size = 64, 12
    at = (np.arange(size * samples) + 0.5) / samples - size / 2
    normal = np.radians(angle)
    bright = at * np.cos(normal) + at[:, None] * np.sin(normal) > 0
    share = bright.reshape(size, samples, size, samples).mean((1, 3))
    chart = (slanted_edge(4, angle, size)[..., 0] - GREY / 2) / (GREY * 1.5)
    assert np.abs(chart - share).max() < 0.02


@pytest.mark.parametrize("radius", [0.3, 0.6, 2.0, 7.3])
def test_discs_are_exact(radius):
    samples, random = 64, np.random.default_rng(10)
    y, x = random.uniform(9, 10, 2)
    at, fine = np.arange(20.0), (np.arange(20 * samples) + 0.5) / samples - 0.5
    inside = np.hypot(fine - x, fine[:, None] - y) < radius
    share = inside.reshape(20, samples, 20, samples).mean((1, 3))
    found = disc(radius, at - y, at - x)
    assert np.abs(found - share).max() < 0.01
    assert found.sum() == pytest.approx(np.pi * radius**2, rel=1e-12)


@pytest.mark.parametrize("width", [480, 481])
def test_a_dot_is_in_the_middle(width):
    dark = 0.5 - dots(width, 400)[200 - 20 : 200 + 20, width // 2 - 20 : (width + 1) // 2 + 20, 0]
    for part in (dark, dark[::-1], dark[:, ::-1]):
        assert part == pytest.approx(dark, abs=1e-6)
    assert dark.sum() / 0.48 == pytest.approx(np.pi * 64, rel=1e-5)


@pytest.mark.parametrize("angle", [3.0, *ANGLES, 110.0, 200.0])
def test_a_pinhole_with_a_square_pixel_has_the_mtf_of_sinc(angle, camera):
    [picture] = camera(stages=["gamma"]).frames(slanted_edge(4, angle, 160), "edge")
    edge, true = edge_of(measure.light_of(picture)), pixel_mtf(angle)
    assert edge.mtf50 == pytest.approx(frequency_at(0.5, true), rel=0.01)
    assert edge.mtf10 == pytest.approx(frequency_at(0.1, true), rel=0.02)
    assert np.abs(edge.mtf[0] - true)[:129].max() < 0.01
    assert max(edge.overshoot, edge.undershoot) < 0.01
    assert edge.contrast == pytest.approx(1.5 * GREY, rel=0.01)


@pytest.mark.parametrize("sigma", [0.5, 0.8, 1.5])
@pytest.mark.parametrize("bend", [0.0, 2e-4])
def test_the_mtf_of_a_blurred_and_curved_edge_with_noise(sigma, bend):
    random = np.random.default_rng(0)
    y, x = np.mgrid[-80:80, -60:60] + 0.5
    distance = (x - 0.1 * y - bend * y**2) * np.cos(math.atan(0.1))
    samples = [distance + at for at in (np.arange(16) - 7.5) / 16]  # along rows: nearly a box
    erf = np.vectorize(math.erf)
    step = np.mean([erf(each / sigma / 2**0.5) for each in samples], axis=0)
    light = np.repeat((0.3 + 0.15 * step)[..., None], 3, 2)
    mtf50 = [edge_of(light + 0.005 * random.normal(size=light.shape)).mtf50 for _ in range(8)]
    true = np.sinc(FREQUENCIES) * np.exp(-2 * (np.pi * sigma * FREQUENCIES) ** 2)
    assert np.mean(mtf50) == pytest.approx(frequency_at(0.5, true), rel=0.01)


def test_lateral_colour_at_an_edge_is_that_of_its_channels():
    near = [slanted_edge(4, 5.0, 160), slanted_edge(4, 5.0, 164)]
    light = near[0].astype(float)
    light[..., 0] = near[1][2:162, 3:163, 0]  # the middle moves by 1 px along rows
    edge = edge_of(light)
    assert edge.red == pytest.approx(-np.cos(np.radians(5)), abs=0.02)
    assert edge.blue == pytest.approx(0, abs=0.01)


@pytest.mark.parametrize("sigma", [3.0, 6.0])
def test_a_wide_blur_is_not_cut_off(sigma):
    edge = edge_of(gaussian_edge(sigma, 5.0, 200))
    assert edge.mtf50 == pytest.approx(frequency_at(0.5, pixel_mtf(5.0, sigma)), rel=0.015)


def gaussian_edge(sigma, angle, size):
    """An edge that a Gaussian blurs, without the pixel's square."""
    at, normal = np.arange(size) - (size - 1) / 2, np.radians(angle)
    distance = at * np.cos(normal) + at[:, None] * np.sin(normal)
    return np.vectorize(lambda d: 0.1 + 0.2 * _normal(d / sigma))(distance)[..., None].repeat(3, 2)


@pytest.mark.parametrize("angle", [0.0, 45.0, np.degrees(np.arctan(0.5)), 90.0])
def test_an_edge_along_a_regular_slope_is_rejected(angle):
    assert edge_of(gaussian_edge(0.5, angle, 160)) is None


def test_noise_is_no_overshoot():
    random = np.random.default_rng(9)
    light = gaussian_edge(0.8, 5.0, 160)
    edges = [edge_of(light + random.normal(0, 0.03, (160, 160, 1))) for _ in range(8)]
    assert np.median([edge.overshoot for edge in edges]) < 0.01
    assert np.median([edge.undershoot for edge in edges]) < 0.01


def test_a_dark_edge_is_measured():
    light = slanted_edge(4, 5.0, 160).astype(float)
    assert edge_of(light / 30).mtf50 == pytest.approx(edge_of(light).mtf50, rel=1e-6)


def test_a_picture_without_an_edge_has_none():
    assert edge_of(np.full((100, 100, 3), 0.2)) is None
    assert edge_of(np.random.default_rng(0).random((100, 100, 3))) is None


def test_the_information_capacity_of_white_noise():
    sigma, random = 0.02, np.random.default_rng(1)
    light = slanted_edge(4, 5.0, 160).astype(float)
    white = np.repeat(random.normal(0, sigma, (12, 160, 160, 1)), 3, -1)
    found = np.median([edge_of(light + noise).capacity for noise in white])
    at = (np.arange(4000) + 0.5) / 8000
    signal = (1.5 * GREY * np.interp(at, FREQUENCIES, pixel_mtf(5.0))) ** 2 / 12
    true = 2 * np.pi * (np.log2(1 + signal / sigma**2) * at).mean() / 2
    assert found == pytest.approx(true, rel=0.05)


def test_texture_is_that_of_the_blur(camera):
    from scipy.ndimage import gaussian_filter

    chart = dead_leaves().astype(float)
    blurred = gaussian_filter(chart, (0.8, 0.8, 0), mode="wrap")
    half = FREQUENCIES[:129]
    found = texture.texture_mtf(blurred, chart)
    angles = np.linspace(0, np.pi / 2, 91)[:, None]
    pixel = (np.sinc(half * np.cos(angles)) * np.sinc(half * np.sin(angles))).mean(0)
    true = pixel * np.exp(-2 * (np.pi * 0.8 * half) ** 2)
    assert np.abs(found - true)[8:].max() < 0.03
    noise = np.random.default_rng(2).normal(0, 0.02, (512, 512, 1))
    assert np.abs(texture.texture_mtf(blurred + noise, chart) - found).max() < 0.05
    # A printed chart has only a known spectrum. Noise counts, unless it is known.
    printed = texture.printed_texture_mtf(blurred)
    assert np.abs(printed - true)[16:].max() < 0.12
    noisy = texture.printed_texture_mtf(blurred + noise)
    assert noisy[100] > printed[100] + 0.1
    cleaned = texture.printed_texture_mtf(
        blurred + noise, np.full((200, 200, 3), GREY) + noise[:200, :200]
    )
    assert abs(cleaned[100] - printed[100]) < 0.6 * (noisy[100] - printed[100])


def test_acutance_weighs_with_the_eye():
    at = FREQUENCIES[:129]
    weights = sensitivity(at * PIXELS_PER_DEGREE)
    assert acutance(np.where(at < 0.1, 1.0, 0.0), at) == pytest.approx(
        weights[at < 0.1].sum() / weights.sum()
    )


def test_colour_differences_are_those_of_sharma():
    table = np.array(SHARMA)
    assert delta_e_2000(table[:, :3], table[:, 3:6]) == pytest.approx(table[:, 6], abs=1e-4)
    assert delta_e_2000(table[:, 3:6], table[:, :3]) == pytest.approx(table[:, 6], abs=1e-4)


def test_visual_noise_of_a_grating_is_that_of_its_contrast_seen_by_the_eye():
    for cycles in (2, 6, 12):
        at = np.arange(96)
        share = 1e-3 * np.sin(2 * np.pi * cycles * at / 96)
        light = np.tile(0.2 * (1 + share), (96, 1))[None, ..., None].repeat(3, -1)
        seen = 1e-3 * sensitivity(np.array(cycles / 96 * PIXELS_PER_DEGREE)) / 2**0.5
        lightness = 116 / 3 * 0.2 ** (1 / 3) * seen  # the slope of L* times Y
        assert visual_noise(levels_of(light)) == pytest.approx(lightness, rel=0.01)
    random = np.random.default_rng(3).normal(0, 2, (2, 64, 64, 3))
    coarse = random[:, ::2, ::2].repeat(2, 1).repeat(2, 2)
    assert visual_noise(110 + coarse) > 1.3 * visual_noise(110 + random)


def test_greys_of_a_known_sensor():
    random = np.random.default_rng(4)
    light = grey_steps()[1:]
    sigma = 0.002  # of the light; the file has as many codes as floats
    noisy = light[:, None, None, None, None] + random.normal(0, sigma, (65, 4, 64, 64, 3))
    greys = GreyPatches(light, 255 * np.clip(noisy, -1, 1))
    # Independent channels: the variances of Y, R-Y and B-Y in ISO 15739.
    y = (LUMINANCE**2).sum()
    parts = [y + (1 - 2 * LUMINANCE[c]) for c in (0, 2)]
    total = sigma * math.sqrt(y + 0.279 * parts[0] + 0.088 * parts[1])
    middle = np.s_[8:44]
    assert greys.snr[middle] == pytest.approx(20 * np.log10(light[middle] / total), abs=0.6)
    assert greys.saturation == pytest.approx(1, rel=0.05)
    assert greys.dynamic_range == pytest.approx(np.log2(1 / total), abs=0.3)
    assert greys.gamma[10:40] == pytest.approx(1, abs=0.02)
    recovered = greys.light_at(greys.means[5:20])
    assert recovered[:, 0] == pytest.approx(light[5:20], rel=0.01)


@pytest.mark.parametrize("noise", [0.01, 0.05, 0.2])
def test_contrast_detection_is_the_share_of_pairs_near_the_contrast(noise):
    random = np.random.default_rng(5)
    light = 0.01 * 2.0 ** np.arange(8)
    relative = random.normal(1, noise, (8, 1, 150, 150, 1)).repeat(3, -1)
    greys = GreyPatches(light, 255 * light[:, None, None, None, None] * relative)
    at, found = greys.detection()
    assert at == pytest.approx(np.sqrt(light[:-1] * light[1:]))
    # A Michelson contrast of 1/3 within 50 %: the ratio of both pixels is from 7/5 to 3. The ratio
    # of normal numbers is below r if their difference two - r one is below 0.
    below = [_normal((r - 2) / (noise * math.hypot(2, r))) for r in (7 / 5, 3)]
    assert found[2:5] == pytest.approx(below[1] - below[0], abs=0.01)
    assert not len(GreyPatches(light[::2], greys.levels[::2]).detection()[0])


def test_light_a_is_that_of_a_lamp():
    white = checker(under_a=True)[18] / checker()[18]
    x, y, z = (white * 0.89) @ np.linalg.inv(_xyz_to_rgb()).T
    assert (x / (x + y + z), y / (x + y + z)) == pytest.approx((0.4476, 0.4074), abs=0.002)


def _xyz_to_rgb():
    return np.array(
        [
            [3.2406, -1.5372, -0.4986],
            [-0.9689, 1.8758, 0.0415],
            [0.0557, -0.2040, 1.0570],
        ]
    )


def turned_checker(size, angle, squeeze):
    """A ColorChecker with a black frame on a table, turned and seen at an angle."""
    chart = np.uint8(np.rint(levels_of(patch_image(checker()).astype(float))))
    framed = np.pad(chart, ((40, 40), (40, 40), (0, 0)), constant_values=25)
    picture = Image.fromarray(framed).resize((size, round(size * squeeze)), Image.Resampling.BOX)
    picture = picture.rotate(angle, expand=True, resample=2, fillcolor=(140, 100, 60))
    width, height = picture.size
    corners = (0, 0, 0, height, width, height * 0.95, width * 0.97, 0)
    tilted = picture.transform((width, height), Image.Transform.QUAD, corners, 2)
    return np.asarray(tilted)


@pytest.mark.parametrize("angle", [0, 4, 30, 90, 175, 268])
@pytest.mark.parametrize(("size", "squeeze"), [(400, 0.69), (1700, 0.6)])
def test_a_turned_color_checker_is_found(angle, size, squeeze):
    picture = turned_checker(size, angle, squeeze)
    noise = np.random.default_rng(6).normal(0, 3, picture.shape)
    patches = find_checker(np.uint8(np.clip(picture + noise, 0, 255)))
    assert patches is not None
    errors = checker_errors(patches.mean((1, 2)), np.array(CHECKER))
    assert errors.delta_e < 1.5
    assert errors.hue < 2


def in_a_photograph(number):
    """A ColorChecker in the middle of a photograph: turned, tilted, tinted, blurred, with noise."""
    from scipy.ndimage import gaussian_filter

    random, photograph = np.random.default_rng(number), photographs()[number % 4]
    width, height = 900, 900
    chart = turned_checker(700, 0, 0.68)
    tall, wide = chart.shape[:2]
    scale, angle = random.uniform(0.55, 0.95), random.uniform(0, 2 * np.pi)
    corners = np.array([(-wide, -tall), (wide, -tall), (wide, tall), (-wide, tall)]) / 2 * scale
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    seen = corners @ turn.T * random.uniform(0.94, 1.06, (4, 1)) + (width / 2, height / 2)
    rows = []
    for (u, v), (x, y) in zip([(0, 0), (wide, 0), (wide, tall), (0, tall)], seen, strict=True):
        rows.append([x, y, 1, 0, 0, 0, -u * x, -u * y, u])
        rows.append([0, 0, 0, x, y, 1, -v * x, -v * y, v])
    table = np.array(rows)
    coefficients = np.linalg.solve(table[:, :8], table[:, 8])
    picture, mask = (
        np.asarray(
            Image.fromarray(each).transform(
                (width, height), Image.Transform.PERSPECTIVE, coefficients, 2
            )
        )
        for each in (chart, np.full(chart.shape, 255, np.uint8))
    )
    tint = random.uniform((0.7, 1, 0.7), (1.3, 1, 1.3)) * random.uniform(0.5, 1.1)
    lit = levels_of(np.clip(inverse_srgb_curve(picture / 255) * tint, 0, 1))
    behind = np.asarray(Image.fromarray(photograph).resize((width, height)))
    whole = np.where(mask > 128, lit, behind)
    blurred = gaussian_filter(whole, (*[random.uniform(0, 1.5)] * 2, 0))
    return np.uint8(np.clip(blurred + random.normal(0, random.uniform(0, 6), whole.shape), 0, 255))


def test_color_checkers_in_photographs_are_found():
    found = [find_checker(in_a_photograph(number)) for number in range(12)]
    hues = [checker_errors(p.mean((1, 2)), np.array(CHECKER)).hue for p in found if p is not None]
    assert len(hues) >= 11
    assert max(hues) < 20  # of tinted light


def test_a_color_checker_under_a_lamp_is_found(camera):
    [picture] = camera(iso=100).frames(patch_image(checker(under_a=True)), "lamp")
    patches = find_checker(np.uint8(np.rint(picture)))
    assert checker_errors(patches.mean((1, 2)), np.array(CHECKER)).white_balance > 30


def test_photographs_and_grids_have_no_color_checker():
    for picture in photographs():
        assert find_checker(picture) is None
    greys = np.tile(np.kron(np.eye(12), np.ones((40, 40)))[..., None] * 160 + 40, (1, 1, 3))
    assert find_checker(np.uint8(greys)) is None


def test_errors_of_white_balance_and_of_the_grey_axis_are_apart():
    true = np.array(CHECKER, float)
    warm = checker_errors(true * (1.1, 1, 0.9), true)
    assert warm.white_balance > 9 > 6 > warm.grey_axis
    assert warm.lightness == pytest.approx(0, abs=1.5)
    crooked = true.copy()
    crooked[22] += (12, 0, -12)
    assert checker_errors(crooked, true).grey_axis > 5


def test_the_lens_of_a_picture_is_that_of_its_chain(camera, device):
    k1, kr = 0.05, 1.002
    whole = {
        "stages": ["distortion", "vignetting", "glare", "gamma"],
        "distortion": {"method": "brown_conrady", "fx": 900, "k1": k1, "kr": kr},
        "vignetting": {"method": "pa", "k1": -0.4},
        "glare": {"method": "veil", "share": 0.05},
    }
    own = camera(**whole)
    greys = measure.developed_greys(own)
    found = measure.lens_figures(own, greys, 960, 640)
    radius = math.hypot(9 * 48, 6 * 48) / 900
    assert found["distortion"] == pytest.approx(100 * k1 * radius**2, rel=0.05)
    assert found["lateral_red"] == pytest.approx((kr - 1) * radius * 900 * 0.92, rel=0.1)
    assert found["lateral_blue"] == pytest.approx(0, abs=0.05)
    field = 1 - 0.4 * _radius(640, 960) ** 2
    lifted = 0.95 * field + 0.05 * field.mean()  # by glare
    middle = lifted[280:360, 440:520].mean()
    assert found["shading"] == pytest.approx(100 * lifted[:80, :80].mean() / middle, abs=0.3)
    assert found["darkest_corner"] == pytest.approx(found["shading"], abs=0.3)
    assert found["color_shading"] < 0.5
    white = 0.95 * field[320, :240].mean() + 0.05 * field.mean()
    assert found["glare"] == pytest.approx(100 * 0.05 * field.mean() / white, rel=0.05)


def _radius(height, width):
    y, x = (np.arange(n) - (n - 1) / 2 for n in (height, width))
    return np.hypot(x, y[:, None]) / math.hypot(height / 2, width / 2)


@pytest.mark.parametrize("scale", [0.3, 0.5, 0.75, 1.0])
def test_corners_of_a_smaller_picture_are_its_corners(scale, camera):
    blur = {"sigma": 0.5, "corner": 1.2}
    stages = ["optical_blur", "gamma", "resize"]
    own = camera(stages=stages, optical_blur=blur, resize={"scale": scale})
    found = measure.lens_figures(own, measure.developed_greys(own), 1440, 960)
    assert 40 < found["corners"] < 92


@pytest.mark.parametrize("clips", [0.74, 1.23, 2.74, 3.15])
@pytest.mark.parametrize("gain", [1e-4, 0.003, 0.01])
def test_clipping_between_the_patches_and_in_noise(clips, gain):
    light, full = grey_steps()[1:], GREY * 2**clips
    random = np.random.default_rng(8).normal(size=(65, 2, 48, 48, 3))
    share = (light / full)[:, None, None, None, None]
    noisy = share + np.sqrt(gain * share) * random
    greys = GreyPatches(light, levels_of(np.clip(noisy, 0, 1)))
    assert np.log2(greys.saturation / GREY) == pytest.approx(clips, abs=0.07)


def test_without_noise_there_is_no_dynamic_range(camera):
    greys = measure.developed_greys(camera(skip=["noise"]))
    assert math.isnan(greys.dynamic_range)
    assert np.isnan(greys.snr).all()


@pytest.mark.parametrize("values", [{}, {"exposure": {"method": "auto"}}])
def test_a_metered_exposure_is_that_of_a_grey_card(values, camera):
    figures, _ = measure.grey_figures(measure.developed_greys(camera(iso=100, **values)))
    assert figures["grey_level"] == pytest.approx(115, abs=2)
    assert figures["clipping"] == pytest.approx(3.46, abs=0.1)


def test_a_monochrome_camera_has_no_colour(camera):
    own = camera(mosaic={"method": "array", "array": "mono"}, demosaic={"method": "gray"})
    assert measure._colours(own) == ({}, {})
    assert math.isnan(measure._chroma_edge(own))


def test_figures_of_a_camera(camera, device):
    [low, high] = (
        measure.chain_quality(f"{iso}", settings_from({"iso": iso}), Service([device]), 480, 480)
        for iso in (100, 6400)
    )
    assert set(FIGURES) == set(low.figures)
    assert not any(map(math.isnan, low.figures.values()))
    for name in (
        "mtf50",
        "mtf50_at_1.5",
        "texture_mtf50",
        "acutance",
        "snr",
        "dynamic_range",
        "capacity",
    ):
        assert low.figures[name] > high.figures[name], name
    for name in ("visual_noise", "detection", "delta_c"):
        assert low.figures[name] < high.figures[name], name
    assert low.figures["clipping"] == pytest.approx(math.log2(2 / GREY), abs=0.05)
    assert low.figures["grey_level"] == pytest.approx(116, abs=4)
    assert low.figures["hue"] < 1 < low.figures["delta_e"] < 5
    assert low.figures["white_balance"] < 1 < 20 < low.figures["white_balance_a"]
    json.dumps(low.record(), allow_nan=False)


def test_gray_world_balances_a_lamp(camera):
    figures, _ = measure._colours(camera(white_balance={"method": "gray_world"}, iso=100))
    assert figures["white_balance_a"] < 12  # the chart itself is not grey


def test_a_smaller_picture_has_no_texture(device):
    stages = ["mosaic", "demosaic", "resize", "gamma"]
    settings = settings_from({"stages": stages, "resize": {"scale": 0.5}})
    found = measure.chain_quality("half", settings, Service([device]), 960, 640)
    assert math.isnan(found.figures["acutance"])
    assert found.figures["mtf50"] > 0.4
    assert found.figures["delta_e"] < 2


def test_a_chain_without_a_finished_picture_is_rejected(camera):
    with pytest.raises(RequestError, match="end it with gamma"):
        camera(stages=["exposure", "mosaic", "demosaic"])


def page_of_text():
    page = Image.new("RGB", (600, 400), "white")
    for line in range(10):
        ImageDraw.Draw(page).text(
            (10, 35 * line), "Every pixel tells a story: 0123456789" * 2, "black"
        )
    return np.asarray(page)


@pytest.fixture
def pictures(tmp_path, camera):
    """Pictures of charts as files, by name."""
    own = camera(iso=100)
    spot = np.full((300, 300, 3), 200, np.uint8)
    spot[100:200, 100:200] = 20
    charts = {
        "edge": own.frames(slanted_edge(4, 5.0, 160), "edge")[0],
        "checker": own.frames(patch_image(checker()), "checker")[0],
        "dots": own.frames(dots(960, 640), "dots")[0],
        "flat": own.frames(grey(np.full((480, 640), GREY)), "flat")[0],
        "spot": spot,
        "leaves": own.frames(dead_leaves(), "leaves")[0],
        "tiny": np.full((30, 60, 3), 90, np.uint8),
        "squares": np.kron(np.indices((40, 40)).sum(0) % 2, np.ones((9, 9)))[..., None].repeat(3, 2)
        * 200.0,
        "text": page_of_text(),
        "noise": np.random.default_rng(7).integers(0, 255, (200, 200, 3)).astype(np.uint8),
    }
    for name, pixels in charts.items():
        save(tmp_path / f"{name}.png", pixels)
    return {name: tmp_path / f"{name}.png" for name in charts}


def quality_of(*arguments, status=0):
    printed = run_cli("quality", *arguments, "--json", status=status).stdout
    return json.loads(printed)["quality"]


def test_charts_are_found_in_pictures(pictures):
    names = ("checker", "dots", "flat")
    reports = quality_of(*(pictures[name] for name in names))
    assert [each["found"] for each in reports] == [["ColorChecker"], ["dots"], ["flat field"]]
    assert reports[0]["colour"]["delta_c"] < 1.5
    assert reports[0]["tone"]["grey_level"] == pytest.approx(115, abs=2)
    assert "detection" not in reports  # no two greys have a contrast of 2:1
    assert reports[0]["noise"]["dynamic_range"] is None  # the chart is not dark enough
    assert abs(reports[1]["lens"]["distortion"]) < 0.2
    assert reports[2]["lens"]["shading"] == pytest.approx(100, abs=1)


def test_a_picture_of_one_edge_needs_no_area(pictures):
    [whole] = quality_of(pictures["edge"])
    [area] = quality_of(pictures["edge"], "--roi", "0,0,160x160")
    assert whole["found"] == ["edge"]
    assert whole["sharpness"] == area["sharpness"]
    assert all(edge_of(measure.light_of(each), strict=True) is None for each in photographs())


def test_areas_of_pictures_are_measured(pictures):
    [edge] = quality_of(pictures["edge"], "--roi", "10,10,140x140")
    assert edge["sharpness"]["mtf50"] == pytest.approx(0.35, abs=0.02)
    assert set(edge["sharpness"]) >= {"mtf50", "mtf10", "nyquist", "overshoot", "mtf50_blue"}
    areas = ("--roi", "black=120,120,60x60", "--roi", "white=0,0,90x300")
    [spot] = quality_of(pictures["spot"], *areas)
    black, white = inverse_srgb_curve(np.array([20, 200]) / 255)
    assert spot["lens"]["glare"] == pytest.approx(100 * black / white, rel=1e-3)
    [leaves] = quality_of(pictures["leaves"], "--roi", "texture=0,0,512x512")
    assert 0.2 < leaves["sharpness"]["texture_mtf50"] < 0.45


def test_rejected_pictures_and_areas(pictures, tmp_path):
    def error(*arguments, status=2):
        return run_cli("quality", *arguments, status=status).stderr

    for name in ("noise", "text", "squares"):
        assert "no chart was found" in error(pictures[name], status=1)
    assert "this area has no edge" in error(pictures["noise"], "--roi", "0,0,100x100", status=1)
    for area in ("0,0,900x100", "0,0,20x20", "texture=0,0,100x100", "grey=0,0,30x30"):
        assert "outside the picture or too small" in error(
            pictures["edge"], "--roi", area, status=1
        )
    for area in ("flat", "textur=0,0,90x90", "1,2,3"):
        assert "--roi: found" in error(pictures["edge"], "--roi", area)
    assert "belongs to a texture" in error(pictures["edge"], "--roi", "grey=0,0,90x90")
    swapped = ("--roi", "white=120,120,60x60", "--roi", "black=0,0,90x300")
    assert "exchange them" in error(pictures["spot"], *swapped, status=1)
    twice = ("--roi", "0,0,768x512", "--roi", "1,1,766x510")
    assert "two areas have a ColorChecker" in error(pictures["checker"], *twice, status=1)
    assert "at least 40 px" in error(pictures["tiny"], status=1)
    assert "name a PICTURE" in error("--roi", "0,0,10x10")
    assert "needs two areas" in error(pictures["spot"], "--roi", "black=0,0,50x50")
    assert "--size" in error("--size", "100x100")
    assert "--size" in error("--size", "big")
    assert ".html" in error("-o", tmp_path / "page.pdf")
    (tmp_path / "broken.jpg").write_bytes(b"no picture")
    # The other pictures are measured all the same.
    result = run_cli("quality", tmp_path / "broken.jpg", pictures["flat"], "--json", status=1)
    assert "broken.jpg" in result.stderr
    assert len(json.loads(result.stdout)["quality"]) == 1
    words = (pictures["edge"], pictures["flat"], "--roi", "200,200,160x160", "--json")
    result = run_cli("quality", *words, status=1)  # the area is outside the first picture
    assert json.loads(result.stdout)["quality"][0]["found"] == ["flat field"]
    assert "edge.png: --roi 200,200,160x160: this area is outside" in result.stderr


def test_a_page_of_a_picture_and_a_camera(pictures, tmp_path):
    page = tmp_path / "page.html"
    chain = ("--camera", "nikon-d800", "--iso", "100,3200", "--set", "sharpen.amount=0.3")
    printed = run_cli("quality", pictures["checker"], *chain, "-o", page).stdout
    text = page.read_text("utf-8")
    for name in ("checker", "nikon-d800, ISO 100", "nikon-d800, ISO 3200", "MTF50, cycles/px"):
        assert name in printed and name in text
    assert text.count("<svg") >= 5
    assert not re.findall(r"(?:src|href)=.http", text)


def test_match_takes_tone_and_sharpness_of_charts(camera, device, tmp_path):
    tone = {"toe": 0.4, "shoulder": 0.5}
    theirs = camera(iso=400, tone_curve=tone, exposure={"ev": 0.3})
    for name, render in (("checker", patch_image(checker())), ("edge", slanted_edge(4, 5.0, 160))):
        save(tmp_path / f"{name}.jpg", theirs.frames(render, name)[0])
    charts = read_charts([tmp_path / "checker.jpg", tmp_path / "edge.jpg"])
    assert charts.edge.mtf50 == pytest.approx(0.345, abs=0.02)
    settings, found = as_toned(settings_from({"iso": 400}), charts.greys, device)
    assert settings.parameters["tone_curve"] == pytest.approx(
        {"method": "standard", **tone}, abs=0.15
    )
    assert np.abs(np.subtract(found.ours, found.theirs)).max() < 1.5
    assert "exposure" not in settings.parameters


def test_compare_shows_sharpness_and_level(tmp_path):
    from scipy.ndimage import gaussian_filter

    sharp = np.tile(slanted_edge(4, 20.0), (2, 3, 1)).astype(float)
    pictures = {"sharp": sharp, "blunt": gaussian_filter(sharp, (1, 1, 0))}
    for name, light in pictures.items():
        save(tmp_path / f"{name}.png", levels_of(light))
    names = [tmp_path / f"{name}.png" for name in ("sharp", "blunt")]
    words = ("compare", *names, "-o", tmp_path / "figure.png", "--crop", "0,0,64x48")
    found = json.loads(run_cli(*words, "--json").stdout)["looks"]
    for look, sigma, light in zip(found, (0, 1), pictures.values(), strict=True):
        assert look["mtf50"] == pytest.approx(frequency_at(0.5, pixel_mtf(20.0, sigma)), rel=0.05)
        assert look["level"] == pytest.approx(np.median(levels_of(light)), abs=0.6)
    printed = run_cli(*words).stdout
    assert "MTF50  overshoot  level" in printed

"""The default development: as bright as the render, true in hue, without dots; and the paper's.

These tests use NumPy; test_kernels.py and test_pipeline.py compare the kernels with it.
"""

import numpy as np
import pytest
from scipy.ndimage import maximum_filter, minimum_filter

from clpipe.analysis.matching.columns import signature
from clpipe.analysis.quality.charts import CHECKER, checker, patch_image, patches_of
from clpipe.analysis.quality.colour import checker_errors
from clpipe.camera.profile import DEFAULT_CAMERA, load_camera
from clpipe.chain.files import load_settings
from clpipe.chain.making import make_chain
from clpipe.chain.settings import overlay, settings_from
from clpipe.engine.runner import Runner
from clpipe.reference.cfa import PATTERNS, red_site
from clpipe.reference.colour import rgb_to_ycbcr
from clpipe.reference.curve import curve_index, to_8_bit
from clpipe.reference.roots import root_of
from clpipe.stage import Context, ReferenceContext, run_reference
from clpipe.stages.demosaic.bounded import Bounded
from clpipe.stages.demosaic.median import EdgeDirectedMedian
from clpipe.stages.denoise.bilateral import Bilateral
from clpipe.stages.sharpen import Unsharp
from clpipe.stages.tone_curve import CameraRaw
from tools.compare.fidelity import dots

QUIET = ("sensor_noise", "row_noise")


def finished(image, **settings):
    """The eight bits of a picture, without noise unless ``skip`` says otherwise."""
    chain = make_chain(settings_from({"skip": QUIET, **settings}))
    return Runner(chain, None).run(image, "k").encoded


def grey(level, **settings):
    """Return the level of a developed flat grey; it may lie between two levels."""
    levels = finished(np.full((24, 26, 3), level, np.float32), **settings)
    assert np.ptp(levels) <= 1
    return int(np.median(levels))


def errors_of(picture):
    return checker_errors(patches_of(picture[None]).mean((1, 2, 3)), np.array(CHECKER))


def saturated_patches():
    """Six hues, (24, 3) linear: two bright levels, and two dark ones of the weakest channel.

    Noise that leaks through colour differences is most visible in a channel that is nearly black.
    """
    hues = np.array([(1, 0, 0), (1, 0.4, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1)])
    return np.concatenate([d + (b - d) * hues for b in (0.7, 0.2) for d in (0.03, 0.004)])


def patch_places(shape):
    y, x = np.indices(shape[:2]) % 128
    return (abs(y - 63.5) < 32) & (abs(x - 63.5) < 32)


def test_a_picture_is_as_bright_as_the_render():
    assert 110 <= grey(0.18) <= 134  # 118 in sRGB
    assert 220 <= grey(1) < 250  # white paper, and brighter things beyond it
    assert grey(0) == 0
    assert grey(2) == grey(5) == 255
    levels = [grey(level) for level in np.geomspace(0.01, 1.9, 12)]
    assert np.diff(levels).min() >= 4
    for level in (0.05, 0.18, 0.5):
        assert grey(level, exposure={"ev": 1.0}) == grey(2 * level) > grey(level) + 20


def test_colours_are_those_of_the_render():
    errors = errors_of(finished(patch_image(checker())))
    assert errors.hue <= 1 and errors.most_hue <= 3
    assert 0.95 <= errors.chroma <= 1.15
    assert abs(errors.lightness) < 3
    # So a curve on each channel does not keep them.
    each = finished(patch_image(checker()), tone_curve={"method": "camera_raw"})
    assert errors_of(each).most_hue > 6


@pytest.mark.slow
def test_saturated_colours_have_no_dots():
    image = patch_image(saturated_patches())
    places = patch_places(image.shape)

    def noise(**settings):
        noisy, clean = (finished(image, iso=1600, skip=s, **settings) for s in ((), QUIET))
        found = signature(noisy, clean, places)
        return found["kurtosis"], found["rms"], dots(noisy, clean)

    kurtosis, rms, spots = noise()
    assert 2.5 < kurtosis <= 4.5
    assert 2 < rms < 8  # levels; there is noise
    assert spots < 0.5  # in 10,000
    old = {
        "demosaic": {"method": "edge_directed_median"},
        "denoise": {"method": "bilateral", "guide": "image"},
    }
    assert noise(**old)[0] > 6


@pytest.mark.parametrize("pattern", PATTERNS)
def test_bounded_invents_no_extremes(pattern):
    random = np.random.default_rng(PATTERNS.index(pattern))
    noise = random.random((31, 42)) ** 3 * 1.3 - 0.01
    edges = np.where(random.random((31, 42)) < 0.5, 1.0, 0.001)
    ramp = np.add.outer(np.arange(31), np.arange(42)) / 80 + random.normal(0, 0.002, (31, 42))
    red_x, red_y = red_site(pattern)
    y, x = np.indices((31, 42))
    red, blue = ((y % 2 == red_y) & (x % 2 == red_x)), ((y % 2 != red_y) & (x % 2 != red_x))
    for values in (noise, edges, ramp, noise * np.where(red, 1, 0.05)):
        mosaic = values.astype(np.float32)
        full = run_reference(Bounded(noise=0.0, offset=0.03), mosaic, pattern=pattern)
        roots = root_of(full, np.float32(0.03))
        green = roots[..., 1]
        for channel, sites in enumerate((red, ~red & ~blue, blue)):
            own = roots[..., channel]
            low, high = range_around(own, sites)
            if channel != 1:  # as far beyond as green is beyond what it is there, for fine lines
                green_low, green_high = range_around(green, sites)
                low += np.minimum(green - green_low, 0)
                high += np.maximum(green - green_high, 0)
            assert np.all(own >= low - 2e-6)
            assert np.all(own <= high + 2e-6)
            moved = own[sites] - root_of(mosaic[sites], np.float32(0.03))
            assert abs(moved).max() <= 2**-21 + 2e-6  # half a step


def range_around(values, sites):
    """Return the minimum and maximum at sites of the 3x3 around each pixel."""
    return (
        minimum_filter(np.where(sites, values, np.inf), 3, mode="mirror"),
        maximum_filter(np.where(sites, values, -np.inf), 3, mode="mirror"),
    )


OFFSET = 0.005
STEP = np.full((21, 60, 3), (0.1, 0.2, 0.05), np.float32)
STEP[:, 30:] *= 3


def sharp(image, **values):
    return run_reference(
        Unsharp(**{"amount": 1.0, "limit": 1.0, "offset": OFFSET, **values}), image
    )


def root(image):
    return np.sqrt(rgb_to_ycbcr(image)[..., 0] + np.float32(OFFSET))


def test_sharpening_leaves_what_is_flat():
    result, reach = sharp(STEP, radius=2.2), 4
    for flat in (np.s_[:, : 30 - reach], np.s_[:, 30 + reach :]):
        assert np.abs(result[flat] - STEP[flat]).max() < 1e-6
    change = result[10, :, 1] - STEP[10, :, 1]
    assert change[29] < -0.02 and change[30] > 0.05


@pytest.mark.parametrize("limit", [0.0, 0.004, 0.02])
def test_a_halo_is_at_most_the_limit(limit):
    change = root(sharp(STEP, limit=limit)) - root(STEP)
    assert np.abs(change).max() == pytest.approx(limit, abs=1e-6)


def test_sharpening_by_nothing_is_off():
    random = np.random.default_rng(0).random((20, 30, 3), np.float32)
    assert not Unsharp(amount=0.0).passes()
    assert sharp(random, amount=0.0).tobytes() == random.tobytes()


def test_faint_detail_is_not_sharpened():
    faint = np.full((30, 30, 3), 0.25, np.float32)
    faint[::3, ::2] += 0.01  # 0.01 in roots
    assert np.abs(sharp(faint, threshold=0.02) - faint).max() < 1e-6
    assert np.abs(sharp(faint, threshold=0.002) - faint).max() > 0.002
    assert np.abs(sharp(STEP, threshold=0.02) - STEP).max() > 0.02


def test_sharpening_keeps_hues():
    image = np.random.default_rng(1).random((30, 40, 3), np.float32)
    result = sharp(image)
    scale = (result + OFFSET) / (image + OFFSET)
    assert np.ptp(scale[..., 1]) > 0.2
    assert np.abs(scale - scale[..., 1:2]).max() < 1e-4


def test_noise_is_sharpened_less():
    camera = load_camera(DEFAULT_CAMERA)
    amounts = [Unsharp().resolve(Context(camera, iso)).amount for iso in (100, 1600, 25600)]
    assert 1 > amounts[0] > amounts[1] > amounts[2] > 0.1


def test_the_configuration_paper_is_the_papers_pipeline():
    image = np.random.default_rng(0).random((40, 52, 3), np.float32) ** 2
    chain = make_chain(overlay(load_settings("paper"), {"iso": 800}))
    result = Runner(chain, None, [step.name for step in chain.steps]).run(image, "k")
    kept = result.kept
    assert kept["exposure"].tobytes() == image.tobytes()  # no headroom
    mosaic, (red_x, red_y) = kept["normalize"], red_site("RGGB")
    gains = np.ones_like(mosaic)
    green = (mosaic[::2, 1::2].mean(dtype=float) + mosaic[1::2, ::2].mean(dtype=float)) / 2
    for x, y in ((red_x, red_y), (1 - red_x, 1 - red_y)):
        gains[y::2, x::2] = green / mosaic[y::2, x::2].mean(dtype=float)
    balanced = np.minimum(mosaic * gains, 1)  # no colour is brighter than white
    assert np.allclose(kept["white_balance"], balanced, rtol=0, atol=1e-5)

    def reference(method, name, before):
        context = chain.step_named(name).context
        return method.resolve(context).reference(kept[before], ReferenceContext(context, {}, {}))

    full = reference(EdgeDirectedMedian(), "demosaic", "white_balance")
    assert np.array_equal(kept["demosaic"], full)
    assert np.array_equal(
        kept["denoise"], reference(Bilateral(guide="image"), "denoise", "demosaic")
    )
    curved = CameraRaw().table()[curve_index(kept["denoise"])]
    assert np.array_equal(kept["tone_curve"], curved)
    assert np.abs(kept["gamma"] - np.clip(curved, 0, 1) ** (1 / 2.2)).max() < 2e-3
    assert np.array_equal(result.encoded, to_8_bit(kept["gamma"]))
    assert "sharpen" not in kept

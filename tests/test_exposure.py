"""Exposure: by metering, against the formulas and percentiles that it stands for; by physics."""

import math

import numpy as np
import pytest

from clpipe.base.errors import RequestError
from clpipe.chain.chain import make_chain
from clpipe.chain.settings import settings_from
from clpipe.engine.runner import Runner
from clpipe.stage import run_reference
from clpipe.stages.exposure import Auto, Photometric

BT_709 = (0.2126, 0.7152, 0.0722)


@pytest.fixture(scope="module")
def scene():
    return (np.random.default_rng(0).random((101, 151, 3)) ** 3).astype(np.float32)


def metered(image, **values):
    """What metering finds, in EV."""
    settings = settings_from({"stages": ["exposure"], "exposure": {"method": "auto", **values}})
    result = Runner(make_chain(settings), None, encode=False, final=True).run(image, "k")
    found = result.estimates["exposure"]
    gain = 2 ** (found["metered_ev"] + values.get("ev", 0.0) - values.get("headroom", 1.0))
    assert found["gain"] == pytest.approx(gain, rel=2e-6)
    np.testing.assert_allclose(result.final, image * np.float32(found["gain"]), rtol=1e-6)
    return found["metered_ev"]


@pytest.mark.parametrize("scale", [1, 3e-3, 2000])
def test_log_average_is_that_of_reinhard_2002(scene, scale):
    image = scene * np.float32(scale)
    average = math.exp(np.log(1e-3 + image @ BT_709).mean())
    assert metered(image, delta=1e-3) == pytest.approx(math.log2(0.18 / average), abs=1e-3)
    assert metered(image, delta=1e-3, target=0.09, ev=2.0, headroom=0.0) == pytest.approx(
        math.log2(0.09 / average), abs=1e-3
    )


@pytest.mark.parametrize("percentile", [50.0, 99.0, 100.0])
def test_a_percentile_comes_to_the_target(scene, percentile):
    level = np.percentile(scene @ BT_709, percentile, method="inverted_cdf")
    found = metered(scene, rule="percentile", percentile=percentile, target=0.5)
    assert found == pytest.approx(math.log2(0.5 / level), abs=1.5 / 256)


@pytest.mark.parametrize("rule", ["log_average", "percentile"])
def test_metering_weighs_places(rule):
    # A bright disc, as large as the circle of centre_weighted.
    y, x = np.indices((200, 300))
    disc = np.hypot(x - 149.5, y - 99.5) <= 50
    image = np.where(disc, 0.5, 0.02)[..., None].repeat(3, 2).astype(np.float32)
    own = {"rule": rule, "percentile": 70.0, "target": 0.18}
    bright, dark = math.log2(0.18 / 0.5), math.log2(0.18 / 0.02)
    average, centre, spot = (
        metered(image, metering=each, **own) for each in ("average", "centre_weighted", "spot")
    )
    assert spot == pytest.approx(bright, abs=0.01)
    if rule == "percentile":
        assert average == pytest.approx(dark, abs=0.01)
        assert centre == pytest.approx(bright, abs=0.01)
    else:
        share = disc.mean()
        assert average == pytest.approx(share * bright + (1 - share) * dark, abs=0.01)
        assert centre == pytest.approx(0.75 * bright + 0.25 * dark, abs=0.02)


@pytest.mark.parametrize("rule", ["log_average", "percentile"])
@pytest.mark.parametrize("metering", ["average", "centre_weighted", "spot"])
def test_without_light_the_image_stays(rule, metering):
    for level in (0.0, -0.5):
        for shape in ((1, 1, 3), (1, 8, 3), (5, 4, 3)):
            image = np.full(shape, level, np.float32)
            assert metered(image, rule=rule, metering=metering) == 0


def test_limits_and_negative_pixels():
    image = np.full((4, 4, 3), 1e-3, np.float32)
    assert metered(image, max_ev=2.0) == 2
    assert metered(image * 1e6, min_ev=-1.0) == -1
    image[0] = -1  # counts as black
    expected = math.log2(0.18) - (0.75 * math.log2(1.1e-3) + 0.25 * math.log2(1e-4))
    assert metered(image) == pytest.approx(expected, abs=1e-3)
    with pytest.raises(RequestError, match="max_ev must not be below min_ev; found 1 and 2"):
        settings_from({"exposure": {"method": "auto", "min_ev": 2.0, "max_ev": 1.0}})


def test_rule_and_metering_of_auto_do_not_make_other_plans():
    # All but the rule are values at run time.
    one, two = Auto(metering="spot", target=0.5), Auto(delta=1e-3)
    assert one.passes() == two.passes() != Auto(rule="percentile").passes()


@pytest.mark.parametrize("iso", [100.0, 1600.0])
def test_a_grey_card_at_the_metered_exposure(iso):
    # 18 % under 5000 lx; a meter says N^2 / t = L S / K, with K = 12.5 (ISO 2720).
    luminance = 0.18 * 5000 / math.pi
    f_number = 5.6
    time = f_number**2 * 12.5 / (luminance * iso)
    card = np.full((2, 2, 3), luminance, np.float32)
    camera = Photometric(exposure_time=time, f_number=f_number)
    level = run_reference(camera, card, iso)
    # H = q K / S = 8.125 lx s / S, of the 78 lx s / S that fill the sensor (ISO 12232).
    assert level == pytest.approx(0.65 * 12.5 / 78, rel=1e-5)
    # At H = 10 / S, the standard's own, the card lies at 12.8 % of full scale.
    right = Photometric(exposure_time=time * 10 / 8.125, f_number=f_number)
    assert run_reference(right, card, iso) == pytest.approx(10 / 78, rel=1e-5)
    radiance = Photometric(exposure_time=time, f_number=f_number, scale=683.0, ev=1.0)
    assert run_reference(radiance, card / 683, iso) == pytest.approx(2 * 8.125 / 78, rel=1e-5)


@pytest.mark.parametrize("headroom", [0.0, 1.0])
def test_headroom_of_a_photometric_exposure_is_given_back(headroom):
    # Exposed with H = 10 lx s / S, an 18 % grey comes out at 0.18, as ISO 12232's sRGB 118 says.
    values = {"method": "photometric", "f_number": 4.0, "headroom": headroom}
    settings = {"stages": ["exposure", "tone_curve"], "tone_curve": {"method": "linear"}}
    chain = make_chain(settings_from({**settings, "iso": 200, "exposure": values}))
    grey = np.full((1, 1, 3), 10 / 200 * 16 / (0.65 * 0.01), np.float32)
    result = Runner(chain, None, ("exposure",), encode=False, final=True).run(grey, "k")
    assert result.kept["exposure"] == pytest.approx(10 / 78 / 2**headroom, rel=1e-5)
    assert result.final == pytest.approx(0.18, rel=1e-5)

"""Exposure by metering and by physics, against formulas and percentiles."""

import json
import math

import numpy as np
import OpenImageIO as oiio
import pytest

from clpipe.base.errors import RequestError
from clpipe.chain.making import make_chain
from clpipe.chain.settings import settings_from
from clpipe.engine.runner import Runner
from clpipe.inputs.manifest import read_manifest
from clpipe.stage import run_reference
from clpipe.stages.exposure.auto import Auto
from clpipe.stages.exposure.photometric import Photometric
from tests.conftest import written

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


def exposure_of(path):
    stages = json.loads(path.read_text())["stages"]
    return next(stage for stage in stages if stage["name"] == "exposure")


NUMPY = ("--device", "numpy", "--format", "exr", "--until", "quantize", "--iso", 1600)


def raw_of(path):
    return oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT)


def test_a_bracket_has_an_exposure_for_each_ev(clpipe, write_exr, tmp_path, scene):
    write_exr("view.exr", scene[:16, :24])
    bracket = ("--bracket", "-2,0,+0.5", "--set", "exposure.ev=1")
    options = ("--device", "numpy", "--format", "exr", "--until", "normalize", "--iso", 1600)
    command = ("run", "view.exr", "-o", "out", *options, *bracket, "--truth", "mosaic")
    clpipe(*command)
    names = [
        f"view.ev{ev}{truth}" for ev in ("-2", "+0", "+0.5") for truth in ("", ".truth_mosaic")
    ]
    expected = [f"{name}.{ending}" for name in names for ending in ("exr", "json")]
    assert written(tmp_path / "out") == sorted(expected)
    evs = [
        exposure_of(tmp_path / f"out/view.ev{ev}.json")["parameters"]["ev"]
        for ev in ("-2", "+0", "+0.5")
    ]
    assert evs == [-1, 1, 1.5]
    dark, middle = (raw_of(tmp_path / f"out/view.ev{ev}.truth_mosaic.exr") for ev in ("-2", "+0"))
    np.testing.assert_allclose(4 * dark, middle, atol=2e-3)
    assert "it was there already" in clpipe(*command).output


def test_exposures_of_a_bracket_have_noise_of_their_own(clpipe, write_exr, tmp_path):
    write_exr("black.exr", np.zeros((16, 24, 3)))
    clpipe("run", "black.exr", "-o", "out", *NUMPY, "--bracket", "-1,0,1")
    noise = [raw_of(tmp_path / f"out/black.ev{ev}.exr").ravel() for ev in ("-1", "+0", "+1")]
    assert np.abs(np.corrcoef(noise) - np.eye(3)).max() < 0.2
    # Whatever else is in the bracket; and the exposure at 0 is the picture without a bracket.
    clpipe("run", "black.exr", "-o", "less", *NUMPY, "--bracket", "1")
    assert np.array_equal(raw_of(tmp_path / "less/black.ev+1.exr").ravel(), noise[2])
    clpipe("run", "black.exr", "-o", "plain", *NUMPY)
    assert np.array_equal(raw_of(tmp_path / "plain/black.exr").ravel(), noise[1])
    shared = ("--noise-key", "mine", "--frames", 2)
    clpipe("run", "black.exr", "-o", "own", *NUMPY, "--bracket", "0,1", *shared)
    names = [f"own/black.ev{ev}.frame{n}.exr" for ev in ("+0", "+1") for n in (0, 1)]
    burst = [raw_of(tmp_path / name).ravel() for name in names]
    assert np.abs(np.corrcoef(burst) - np.eye(4)).max() < 0.2


def test_an_exposure_of_a_bracket_is_replayed(clpipe, write_exr, tmp_path, scene):
    write_exr("view.exr", scene[:9, :14])
    more = ("--bracket", "-1,0.333333333", "--frames", 2, "--set", "exposure.method=auto")
    clpipe("run", "view.exr", "-o", "out", *NUMPY, *more)
    for name in ("view.ev+0.333333.frame1", "view.ev-1.truth"):
        clpipe("replay", f"out/{name}.json", "-o", "again", "--device", "numpy")
        one, two = (tmp_path / folder / f"{name}.exr" for folder in ("out", "again"))
        assert one.read_bytes() == two.read_bytes()


@pytest.fixture
def sequence(write_exr, scene):
    for folder, gains in {"day": (1, 1, 8, 8), "night": (0.01, 0.01)}.items():
        for number, gain in enumerate(gains):
            write_exr(f"frames/{folder}/{number}.exr", scene[:20, :30] * gain)


def control(**values):
    """The options for control loops without delay, hysteresis and limit, and other values."""
    values = {"delay": 0, "hysteresis": 0, "speed": 0, "smoothing": 0} | values
    return [word for k, v in values.items() for word in ("--set", f"control.{k}={v}")]


METERED = (*NUMPY, "--sequence", "--set", "exposure.method=auto")


def test_each_sequence_is_smoothed_by_itself(clpipe, sequence, tmp_path):
    clpipe("run", "frames", "-o", "single", *NUMPY, "--set", "exposure.method=auto")
    clpipe("run", "frames", "-o", "out", *METERED, *control(smoothing=2))
    names = [*(f"day/{n}" for n in range(4)), *(f"night/{n}" for n in range(2))]
    single = [exposure_of(tmp_path / f"single/{name}.json")["estimates"] for name in names]
    found = [estimates["metered_ev"] for estimates in single]
    assert found[2] == pytest.approx(found[0] - 3, abs=0.01)
    share = 1 - math.exp(-1 / 2)
    third = found[1] + share * (found[2] - found[1])
    fourth = third + share * (found[3] - third)
    expected = [found[0], found[0], third, fourth, found[4], found[4]]
    set_ = [exposure_of(tmp_path / f"out/{name}.json")["parameters"]["ev"] for name in names]
    assert set_ == pytest.approx(expected, abs=1e-4)


def test_a_run_takes_the_exposures_that_a_sequence_writes(clpipe, sequence, tmp_path):
    clpipe("run", "frames", "-o", "film", *METERED, *control(), "--set", "exposure.headroom=0.5")
    clpipe("run", "film/run.csv", "-o", "out", *NUMPY, "-c", "paper")
    clpipe("run", "frames", "-o", "auto", *NUMPY, "--set", "exposure.method=auto")
    for name in ("day/0", "day/3", "night/1"):
        mine = exposure_of(tmp_path / f"out/{name}.json")["parameters"]
        theirs = exposure_of(tmp_path / f"auto/{name}.json")["estimates"]
        assert mine["ev"] == pytest.approx(theirs["metered_ev"], abs=1e-4)
        assert mine["headroom"] == 0.5
    # The manifest of a manifest keeps what it says of other things.
    rows = "path,iso,frames,mosaic.pattern\nframes/day/2.exr,200,3,GRBG\n"
    (tmp_path / "rows.csv").write_text(rows)
    clpipe("run", "rows.csv", "-o", "metered", *METERED)
    (row,) = read_manifest(tmp_path / "metered/run.csv")
    assert (row.key, row.frames) == ("frames/day/2.exr", 3)
    own = row.values["exposure"]
    assert row.values == {"iso": 200, "mosaic": {"pattern": "GRBG"}, "exposure": own}
    assert own["method"] == "gain" and own["ev"] < 4


def test_sub_frames_are_metered_as_one_exposure(clpipe, sequence, tmp_path):
    two = ("--set", "shutter.subframes=2")
    clpipe("run", "frames", "-o", "film", *METERED, *control(), *two)
    clpipe("run", "frames", "-o", "auto", *NUMPY, "--set", "exposure.method=auto", *two)
    for name in ("day/0", "day/2", "night/0"):
        mine = exposure_of(tmp_path / f"film/{name}.json")["parameters"]
        theirs = exposure_of(tmp_path / f"auto/{name}.json")["estimates"]
        assert mine["ev"] == pytest.approx(theirs["metered_ev"], abs=1e-4)

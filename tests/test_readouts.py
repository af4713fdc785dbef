"""Several readouts and companding: noise against formulas, transitions, round trips."""

import json
import re
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import clpipe as package
from clpipe.base.errors import RequestError
from clpipe.chain.making import make_chain
from clpipe.chain.settings import settings_from
from clpipe.dataset import Dataset
from clpipe.engine.runner import Runner
from clpipe.images.read import read_image
from clpipe.reference.companding import apply_pieces, default_knots, pieces_of
from tests.conftest import STILL_LIFE

METHODS = {
    "dual_gain": {},
    "split_pixel": {"ratio": 32.0, "later_noise": 2.0},
    "staggered": {"count": 3, "ratio": 8.0},
    "split_dual_gain": {"ratio": 4.0, "light_ratio": 50.0, "later_noise": 1.5},
}
RAW = ["mosaic", "sensor_noise", "quantize", "normalize"]


def chain_of(method, stages=RAW, **settings):
    own = {"method": method, **METHODS[method], **settings.pop("sensor_noise", {})}
    return make_chain(
        settings_from({"iso": 400, "stages": stages, "sensor_noise": own, **settings})
    )


@pytest.fixture
def part(write_exr):
    """A part of the still life of 240x160 pixels."""
    return write_exr("part.exr", read_image(STILL_LIFE).pixels[200:360, 300:540])


def decibels(signal, sigma):
    return 20 * np.log10(signal / sigma)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_the_signal_to_noise_ratio_is_that_of_the_formulas(method):
    chain = chain_of(method)
    step = chain.step_named("sensor_noise").method
    runner = Runner(chain, None, encode=False, final=True)
    every = step.readouts
    lit = {0: (0.05, 0.8), 1: (1.2,), len(every) - 1: (0.8 * step.full_scale,)}
    for which, light in ((which, light) for which, lights in lit.items() for light in lights):
        found = runner.run(np.full((300, 300, 3), light, np.float32), "snr").final
        read = step.b * (step.later_noise**2 if which else 1)
        expected = step.a * light / every[which].share + read / every[which].sensitivity ** 2
        assert found.mean() == pytest.approx(light, rel=0.004)
        ratios = [decibels(light, sigma) for sigma in (found.std(), expected**0.5)]
        assert ratios[0] == pytest.approx(ratios[1], abs=0.15)
        assert step.added_variance(np.float32([light])) == pytest.approx(expected, rel=0.04)


def test_the_ratio_dips_where_a_readout_takes_over():
    runner = Runner(chain_of("split_pixel"), None, encode=False, final=True)
    below, beyond = (
        decibels(x, runner.run(np.full((300, 300, 3), x, np.float32), "dip").final.std())
        for x in (0.83, 0.97)
    )
    # A photodiode that sees a 32nd has a 32nd of the electrons.
    assert below - beyond == pytest.approx(10 * np.log10(32), abs=1)


def test_each_part_is_there_alone(develop):
    light = np.random.default_rng(0).random((60, 70, 3)).astype(np.float32) * 20
    options = {"stages": ["mosaic", "sensor_noise"], "iso": 400}

    def made(**own):
        noise = {"method": "dual_gain", **own}
        return develop(light, numpy=True, sensor_noise=noise, **options).final

    merged, first, second = made(), made(part=0), made(part=1)
    assert first.max() == 1
    assert 14 < second.max() <= 16
    assert np.array_equal(merged[first < 0.85], first[first < 0.85])
    assert np.array_equal(merged[first >= 0.95], second[first >= 0.95])
    with pytest.raises(
        RequestError, match=r"sensor_noise\.part: readout 2 does not exist; choose 0 to 1"
    ):
        made(part=2)


def test_white_is_the_last_readouts_and_one_the_first_ones(develop):
    chain = chain_of("dual_gain")
    quantize, normalize = (chain.step_named(name).method for name in ("quantize", "normalize"))
    assert quantize.bits == 14 + 4
    whole = quantize.white_level - quantize.black_level
    assert normalize.white_level - normalize.black_level == pytest.approx(whole / 16)
    light = np.full((8, 8, 3), 40, np.float32)
    options = {"stages": RAW, "iso": 400, "sensor_noise": {"method": "dual_gain"}}
    assert develop(light, numpy=True, **options).final.max() == pytest.approx(16, rel=1e-5)


@pytest.mark.slow
def test_a_picture_of_the_first_range_is_as_ever(clpipe, part):
    run = ("run", part, "--iso", "400", "--format", "png", "--device", "numpy")
    clpipe(*run, "-o", "usual", "--set", "sensor_noise.method=gaussian")
    clpipe(*run, "-o", "dual", "--set", "sensor_noise.method=dual_gain", "--truth", "clean")
    one, two = (np.asarray(Image.open(f"{f}/part.png"), int) for f in ("usual", "dual"))
    assert np.abs(one - two).mean() < 2
    clean = np.asarray(Image.open("dual/part.truth_clean.png"), int)
    assert np.abs(two - clean).mean() < 4


@pytest.mark.parametrize(("white", "bits"), [(2**20 - 1, 12), (2**24 - 1, 16), (16383, 10)])
def test_a_curve_of_pieces_goes_there_and_back(white, bits):
    knots = default_knots(white, 2**bits - 1)
    there, back = pieces_of(knots), pieces_of(knots, inverse=True)
    dn = np.unique(np.geomspace(1, white, 20_000).round()).astype(np.float32)
    few = np.rint(apply_pieces(dn, there))
    assert (np.diff(few) >= 0).all()
    assert few.max() == 2**bits - 1
    again = apply_pieces(few, back)
    slope = np.interp(dn, there[:, 0], there[:, 2])  # of the piece, or steeper
    steepest = np.array([there[there[:, 0] <= x][-1, 2] for x in dn[::97]])
    error = np.abs(again - dn)[::97]
    assert slope.min() > 0
    assert (error <= 0.5 / steepest + dn[::97] * 1e-6 + 0.01).all()
    # Near a square root: the step grows as shot noise does.
    assert (0.5 / steepest <= 2 * dn[::97] ** 0.5 * (white / (2**bits - 1) ** 2) ** 0.5 + 1).all()


@pytest.mark.slow
def test_a_companded_raw(clpipe, part):
    noise = ("--device", "numpy", "--iso", "400", "--set", "sensor_noise.method=dual_gain")
    knots = "[[0,0],[16384,2048],[262143,4095]]"
    few = ("--set", "quantize.method=pwl", "--set", f"quantize.knots={knots}")
    keep = ("--keep", "quantize", "--keep", "normalize", "--format", "npy", "--format", "png")
    for folder, options in (("whole", ()), ("few", few)):
        clpipe("run", part, "-o", folder, *noise, *keep, *options)
    whole, less = (np.load(f"{f}/part.quantize.npy") for f in ("whole", "few"))
    assert (whole.dtype, less.dtype) == (np.uint32, np.uint16)
    assert np.array_equal(less, np.rint(np.interp(whole, *zip(*json.loads(knots), strict=True))))
    light, again = (np.load(f"{f}/part.normalize.npy") for f in ("whole", "few"))
    assert np.abs(light - again).max() <= 0.5 * (262143 - 16384) / 2047 / (262143 / 16) * 1.1
    clpipe("run", part, "-o", "kept", *noise, *few, "--keep", "quantize")
    enter = ("--start-at", "normalize", "--device", "numpy")
    clpipe("run", "kept/part.quantize.exr", "-o", "on", *enter)
    pictures = ("kept/part.jpg", "on/part.quantize.jpg")
    assert np.array_equal(*(np.asarray(Image.open(path)) for path in pictures))
    kept = "kept/part.quantize.exr"
    result = clpipe("measure", kept, "--truth", kept, status=1)
    assert "a curve has compressed its DN" in result.stderr


KNOTS = "[[0,0],[4096,1024],[16383,4095]]"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("quantize.method=pwl", "quantize.knots=[[0,0]]"), "knots: found .*expected pairs"),
        (("quantize.method=pwl", "quantize.knots=[[0,0],[9,9],[5,10]]"), "increase in both"),
        (("quantize.method=pwl", "quantize.knots=[[0,0],[16383,5000]]"), "does not fit in 12 bits"),
        (
            ("quantize.method=pwl", "quantize.knots=[[0,0],[99,50]]"),
            "must be the white level, 16383",
        ),
        (("normalize.method=pwl",), "no knots are known"),
        (
            ("normalize.method=pwl", f"normalize.knots={KNOTS}"),
            "but quantize.method=linear applies no curve",
        ),
        (
            ("quantize.method=pwl", "normalize.method=linear"),
            "does not undo the curve of quantize.method=pwl; set normalize.method=pwl, or",
        ),
        (("quantize.method=pwl", "normalize.white_level=9000"), "set normalize.method=pwl"),
        (
            ("quantize.method=pwl", "normalize.method=pwl", f"normalize.knots={KNOTS}"),
            "differ from those of quantize, .*remove normalize.knots",
        ),
        (
            ("sensor_noise.method=dual_gain",),
            "found a white level of 262143, but a DNG holds at most",
        ),
        (("quantize.method=pwl",), "a curve compresses"),
    ],
)
def test_what_is_refused(clpipe, options, message):
    sets = [part for option in options for part in ("--set", option)]
    result = clpipe("run", STILL_LIFE, "-o", "out", "--format", "dng", *sets, status=2)
    assert re.search(message, result.stderr.replace("\n", " "))
    assert not Path("out").exists()


def test_a_dng_of_two_readouts_that_fit(clpipe, part):
    options = ("--set", "sensor_noise.method=dual_gain", "--set", "sensor_noise.ratio=4")
    options += ("--set", "exposure.ev=1.5", "--device", "numpy")
    clpipe("run", part, "-o", "out", "--format", "dng", "--keep", "quantize", *options)
    kept = read_image(Path("out/part.quantize.exr"), mosaic=True).pixels
    assert kept.max() > 16383
    assert Path("out/part.dng").stat().st_size > kept.size * 2


@pytest.mark.slow
def test_a_sample_of_more_than_16_bits(part):
    given = {"raw": "mosaic", "sensor_noise": {"method": "dual_gain"}, "device": "numpy"}
    with pytest.raises(RequestError, match="raw has values to 262143 DN, more than uint16 holds"):
        Dataset(part, **given)
    sample = Dataset(part, dtype="float32", **given)[0]
    assert sample["raw"].dtype == np.float32


@pytest.mark.slow
def test_the_ratio_as_a_table(clpipe, write_exr):
    ramp = np.geomspace(1e-3, 30, 256, dtype=np.float32)
    path = write_exr("ramp.exr", np.tile(ramp[None, :, None], (64, 1, 3)), half=False)
    options = ("--set", "sensor_noise.method=split_pixel", "--set", "exposure.headroom=0")
    clpipe("run", path, "-o", "out", *options, "--until", "normalize", "--truth", "clean")
    pair = ("out/ramp.exr", "--truth", "out/ramp.truth_clean.exr")
    steps = json.loads(clpipe("measure", *pair, "--snr", "--json").stdout)["snr"]
    assert len(steps) > 20
    assert all(a["intensity"] < b["intensity"] for a, b in pairwise(steps))
    falls = [b["decibels"] < a["decibels"] - 2 for a, b in pairwise(steps)]
    assert any(falls)  # at the hand-over
    assert "stops below" in clpipe("measure", *pair, "--snr").stdout


LEAKY = {"split_pixel": {"ratio": 32.0}, "split_dual_gain": {"ratio": 4.0, "light_ratio": 32.0}}


@pytest.mark.slow
@pytest.mark.parametrize("method", LEAKY)
def test_light_leaks_into_the_small_photodiode(method):
    small = {"method": method, "crosstalk": 0.01, **LEAKY[method]}
    every = len(chain_of(method, sensor_noise=small).step_named("sensor_noise").method.readouts)
    large_ends = 4 if every == 4 else 1  # the signal at which the large one is white

    def made(light, **own):
        chain = chain_of(method, sensor_noise={**small, **own})
        runner = Runner(chain, None, encode=False, final=True)
        image = np.full((200, 200, 3), light, np.float32)
        truth = Runner(chain.without_noise(), None, encode=False, final=True).run(image, "")
        return runner.run(image, "leak").final, truth.final, chain.step_named("sensor_noise").method

    # It has a 32nd and a 100th of the large one's charge, and is multiplied by 32.
    seen, truth, step = made(light := 0.5, part=every // 2)
    assert seen.mean() == pytest.approx(light * 1.32, rel=0.002)
    assert truth == pytest.approx(np.full_like(truth, light * 1.32), rel=2e-3)  # whole DN
    shot = step.a * light * (1 / 32 + 0.01) * 32**2
    assert seen.var() == pytest.approx(shot + step.b * (step.later_noise * 32) ** 2, rel=0.03)
    assert step.added_variance(np.float32([light])) == pytest.approx(seen.var(), rel=0.03)
    # The merged signal steps up where the large one ends.
    for light, expected in ((0.8, 0.8), (1.1, 1.32 * 1.1)):
        seen, truth, step = made(light * large_ends)
        assert seen.mean() == pytest.approx(expected * large_ends, rel=0.002)
        assert truth.mean() == pytest.approx(expected * large_ends, rel=0.001)
        variance = step.added_variance(np.float32([light * large_ends]))
        assert variance == pytest.approx(seen.var(), rel=0.04)


def test_a_profile_says_what_leaks(tmp_path):
    profile = Path(package.__file__).parent / "camera/profiles/omnivision-hdr-2019.toml"
    text = profile.read_text().replace("\n[[", "\nphotodiode_crosstalk = 0.002\n[[", 1)
    (tmp_path / "leaky.toml").write_text(text)
    own = {"camera": str(tmp_path / "leaky.toml"), "iso": 100}
    step = chain_of("split_pixel", **own).step_named("sensor_noise").method
    assert step.crosstalk == 0.002


@pytest.mark.slow
def test_the_variance_beyond_the_first_white(clpipe, write_exr):
    light = np.repeat(np.float32([0.5, 4, 12, 40]), 4).reshape(1, 16, 1).repeat(4, 0).repeat(3, 2)
    path = write_exr("light.exr", light, half=False)
    options = ("--iso", "400", "--set", "sensor_noise.method=dual_gain", "--stages", ",".join(RAW))
    options += ("--device", "numpy")
    clpipe("run", path, "-o", "out", *options, "--truth", "variance", "--format", "npy")
    found = np.load("out/light.truth_variance.npy")[0, ::4]
    step = chain_of("dual_gain").step_named("sensor_noise").method
    expected = step.added_variance(np.float32([0.5, 4, 12, 16]))  # white is at 16
    assert found == pytest.approx(expected, rel=0.02)

"""clpipe match: its figures, known developments that it recovers, rejected pictures."""

import io
import json
import math
import os
import re
import signal
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from rich.console import Console
from scipy.ndimage import gaussian_filter

from clpipe.analysis.colours import saturated_of
from clpipe.analysis.matching import match, search
from clpipe.analysis.matching.ambiguity import Ambiguity, ambiguities
from clpipe.analysis.matching.columns import (
    COLUMNS,
    LEVELS,
    SKEWS,
    TAILS,
    WEAK,
    Noise,
    ValidPixels,
    errors_of,
    figures_of,
    noise_of_frames,
    signature,
)
from clpipe.analysis.matching.edges import as_sharp, edge_in
from clpipe.analysis.matching.result import ended_by
from clpipe.analysis.matching.scenes import Scene, Scenes, expand, load_scenes, with_holdout
from clpipe.analysis.matching.simulation import Simulator
from clpipe.analysis.matching.space import (
    Choice,
    Dimension,
    Space,
    dimensions_of,
    smaller,
    space_for,
    variants_of,
)
from clpipe.analysis.quality.charts import checker, slanted_edge
from clpipe.analysis.signature import DARK, flat_mask
from clpipe.chain.files import load_config, load_settings
from clpipe.chain.making import make_chain
from clpipe.chain.settings import Settings, overlay
from clpipe.commands.match import SearchProgress
from clpipe.images.jpeg import JpegEncoding, jpeg_encoding, jpeg_round_trip
from clpipe.pipeline import Pipeline
from clpipe.reference.colour import luma
from clpipe.reference.transfer import srgb_curve
from tests.conftest import ROOT, run_cli

SIZE, FRAMES = 128, 6
KNOWN = {
    "iso": 3200.0,
    "demosaic": {"method": "bilinear"},
    "denoise": {"method": "mean", "luma_strength": 4.0, "chroma_strength": 6.0},
    "sharpen": {"method": "none"},
}
# The methods are known here; the search finds them among others in tools and by hand.
SMALL = Space(
    {"known": (Choice("known", {k: KNOWN[k] for k in ("demosaic", "denoise", "sharpen")}),)},
    Dimension("iso", 100, 25600, 1600, logarithmic=True),
)


def scene():
    """A smooth scene in linear light with some edges, (SIZE, SIZE, 3)."""
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    light = np.stack([0.1 + 0.2 * x, 0.15 + 0.1 * y, 0.25 - 0.1 * x], axis=-1)
    light[:, 60:66] *= 0.3
    return light.astype(np.float32)


@pytest.fixture(scope="module")
def burst():
    """Six frames of a known development, uint8."""
    camera = Pipeline(device="numpy", **KNOWN)
    return [camera.process(scene(), f"frame {k}").image for k in range(FRAMES)]


@pytest.fixture(scope="module")
def grey():
    """A grey picture, and the same with independent noise of 5 levels, uint8."""
    generator = np.random.default_rng(3)
    noisy = 128 + generator.normal(0, 5, (160, 160, 3))
    return np.full((160, 160, 3), 128, np.uint8), noisy.round().clip(0, 255).astype(np.uint8)


def saved(folder, **pictures):
    """Pictures as PNGs in a folder; their paths."""
    for name, pixels in pictures.items():
        Image.fromarray(pixels).save(folder / f"{name}.png")
    return [str(folder / f"{name}.png") for name in pictures]


def test_independent_noise(grey):
    clean, noisy = (picture.astype(np.float64) for picture in grey)
    noise = noise_of_frames([noisy], clean)
    places = ValidPixels(np.ones(clean.shape[:2], bool), noise.level)
    found = figures_of(noise, places)
    for name in ("right", "two_below", "chroma_right", "red_green", "green_blue"):
        assert abs(found[name]) < 0.03, name
    # The shares of the plane of frequencies in rings of 1/8 cycle per pixel, up to its corners.
    rings = [np.pi * (k / 8) ** 2 for k in (1, 2, 3)]
    shares = [rings[0], rings[1] - rings[0], rings[2] - rings[1], 1 - rings[2]]
    assert [found[f"band_{k}"] for k in (1, 2, 3, 4)] == pytest.approx(shares, abs=0.03)
    assert found["sigma_128"] == pytest.approx(found["rms"])
    assert np.isnan(found["sigma_12"])
    # The relative standard error of the rms of n independent samples is 1 / sqrt(2 n).
    error = errors_of(noise, places)["rms"] / found["rms"]
    assert 0.3 < error * np.sqrt(2 * 160 * 160) < 3


LEVEL = np.tile(np.linspace(12, 225.9, 600), (300, 1))  # luma of a ramp


def figures_on_the_ramp(rgb):
    """The columns of noise, (300, 600, 3), on the ramp."""
    return figures_of(Noise(rgb[None], LEVEL), ValidPixels(np.ones(LEVEL.shape, bool), LEVEL))


@pytest.mark.parametrize(("low", "high"), [(24, 48), (80, 112), (112, 160), (160, 220)])
def test_skew_is_that_of_its_range_of_luma(low, high):
    """Gamma noise of shape 4 has a skew of 1, and the other luma has Gaussian noise."""
    random, name = np.random.default_rng(1), f"skew_{low}"
    skewed = random.gamma(4, 1, LEVEL.shape) - 4
    inside = np.digitize(LEVEL, (low, high)) == 1
    own = np.where(inside, skewed, random.normal(0, 2, LEVEL.shape))
    found = figures_on_the_ramp(own[..., None].repeat(3, -1))
    assert found[name] == pytest.approx(1, abs=0.1)
    others = [found[other] for other in SKEWS if other != name]
    assert others == pytest.approx([0] * 3, abs=0.1)
    wider = np.digitize(LEVEL, (low - 8, high + 8)) == 1
    around = np.where(wider & ~inside, 9 * skewed, random.normal(0, 2, LEVEL.shape))
    assert abs(figures_on_the_ramp(around[..., None].repeat(3, -1))[name]) < 0.1


def test_chroma_noise_by_luma_is_cb_and_cr_together():
    red, blue = 2.0, 3.0
    strength = 1 + np.digitize(LEVEL, LEVELS)[..., None]
    normals = np.random.default_rng(2).normal(size=(*LEVEL.shape, 3))
    found = figures_on_the_ramp(normals * strength * (red, 0, blue))
    cb = 0.564 * np.hypot(0.299 * red, 0.886 * blue)
    cr = 0.713 * np.hypot(0.701 * red, 0.114 * blue)
    expected = [(2 + k) * np.hypot(cb, cr) / 2**0.5 for k in range(len(LEVELS) - 1)]
    names = [f"chroma_sigma_{low}" for low in LEVELS[:-1]]
    assert [found[name] for name in names] == pytest.approx(expected, rel=0.03)
    assert found["sigma_12"] == pytest.approx(2 * np.hypot(0.299 * red, 0.114 * blue), rel=0.03)


# Two saturated colours in which green is weakest, one that is too grey, and one that is too dark.
PATCHES = ((200, 40, 60), (90, 5, 8), (200, 120, 130), (0, 0, 61))


def saturated():
    """Patches of 100 px, and the same with noise, in levels."""
    clean = np.repeat(np.array(PATCHES, float), 100, 0)[None].repeat(100, 0)
    sigma = np.repeat([(3, 2, 1), (3, 2, 1), (1, 7, 1), (1, 7, 1)], 100, 0)
    return clean, clean + np.random.default_rng(3).normal(size=clean.shape) * sigma


def test_the_weak_channel_of_saturated_colours_over_the_strong_one():
    clean, noisy = saturated()
    assert signature(noisy, clean)[WEAK] == pytest.approx(2 / 3, rel=0.03)
    whole = saturated_of(clean, luma(clean) >= DARK)
    number = np.cumsum(whole.mask).reshape(whole.mask.shape)
    noise = (noisy - clean)[None]
    assert math.isnan(whole.within(number <= 499).ratio(noise))
    assert whole.within(number <= 500).ratio(noise) == pytest.approx(2 / 3, rel=0.15)


def test_the_search_weighs_skew_chroma_by_luma_and_saturated_colours():
    clean, noisy = saturated()
    everywhere = np.ones(clean.shape[:2], bool)
    one = Scene("a", (noisy,), clean, False, everywhere, flat_mask(clean, DARK), ~everywhere)
    target = search.target_of(one)
    assert not target.residuals(target.figures).any()
    for name in (WEAK, "skew_80", "chroma_sigma_64"):
        other = target.figures | {name: 1.5 * target.figures[name] + 0.1}
        assert np.abs(target.residuals(other)).sum() > 1, name


def test_noise_against_the_mean_of_a_burst_is_that_of_a_frame(burst):
    frames = [frame.astype(np.float32) for frame in burst]
    mean = np.mean(burst, axis=0)
    places = ValidPixels(flat_mask(mean), luma(mean))
    clean = Pipeline(device="numpy", **KNOWN, skip=["sensor_noise", "row_noise", "column_noise"])
    truth = clean.process(scene(), "").image.astype(np.float64)
    against_truth = figures_of(noise_of_frames(frames, truth), places)
    against_mean = figures_of(noise_of_frames(frames[:4], None), places)
    for name, column in COLUMNS.items():
        # A frame minus the mean of few frames is less skewed, so skew is excluded.
        if name not in TAILS and "skew" not in name and not np.isnan(against_truth[name]):
            assert abs(column.residual(against_mean[name], against_truth[name])) < 0.06, name


def matched(frames, folder, *options):
    """What clpipe match finds for frames: its JSON. Its files are in the folder."""
    saved(folder, **{f"frame{k}": frame for k, frame in enumerate(frames)})
    files = ("-o", folder / "look.toml", "--plot", folder / "look.png")
    words = (folder / "frame?.png", *files, *options, "--device", "numpy", "--json")
    result = run_cli("match", *words)
    return json.loads(result.stdout)


@pytest.fixture(scope="module")
def found(burst, tmp_path_factory):
    """What a search of some steps finds for the burst, and the configuration that it writes."""
    folder = tmp_path_factory.mktemp("match")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(match, "space_for", lambda *_: SMALL)
        patch.setattr(search, "FINAL_STEPS", 4)
        return matched(burst, folder), load_settings(str(folder / "look.toml"))


def slope_at_grey(style):
    """The contrast of a tone curve at 18 % grey, in stops per stop."""
    low, high = style.curve(np.float32([0.089, 0.091])).astype(float)
    return np.log(high / low) / np.log(0.091 / 0.089)


@pytest.mark.slow
def test_a_known_development_comes_back(found):
    report, settings = found
    for name, column in report["columns"].items():
        row = column["searched"]
        if name != "beyond_4_sigma" and row["residual"] is not None:
            assert abs(row["residual"]) < 0.03 + 2 * row["error"], (name, row)
            assert row["error"] < 0.3, name
    # A steeper tone curve makes as much noise of a lower ISO, so only their product is well known.
    iso, known = report["searched"]["iso"], KNOWN["iso"]
    assert iso == settings.iso == pytest.approx(known, rel=0.2)
    steepness, default = (slope_at_grey(s.method("tone_curve")) for s in (settings, Settings()))
    assert iso * steepness**2 == pytest.approx(known * default**2, rel=0.1)
    strength = report["searched"]["denoise.luma_strength"]
    assert strength == pytest.approx(KNOWN["denoise"]["luma_strength"], rel=0.2)


@pytest.mark.slow
def test_crops_that_were_not_searched_prove_it(found):
    report, _ = found
    for name in ("right", "below", "diagonal", "half", "red_green", "rms"):
        row = report["columns"][name]["not_searched"]
        assert abs(row["residual"]) < 0.03 + 2 * row["error"], (name, row)


@pytest.mark.usefixtures("quick", "ambiguous")
def test_charts_set_sharpness_and_tone(burst, tmp_path):
    greys = np.full((512, 768, 3), 46.0)
    levels = (245, 205, 160, 110, 70, 35)  # of a steep curve
    chart = 255 * srgb_curve(checker())
    chart[18:] = np.array(levels)[:, None]
    for number, colour in enumerate(chart):
        y, x = (128 * index for index in divmod(number, 6))
        greys[y + 8 : y + 120, x + 8 : x + 120] = colour
    blunt = gaussian_filter(slanted_edge(4, 5.0, 160).astype(float), (1.4, 1.4, 0))
    pictures = {"checker": greys, "edge": 255 * srgb_curve(blunt)}
    (tmp_path / "charts").mkdir()
    eight_bits = {name: np.uint8(np.rint(each)) for name, each in pictures.items()}
    files = saved(tmp_path / "charts", **eight_bits)
    charts = [word for file in files for word in ("--chart", file)]
    report = matched(burst[:3], tmp_path, "--iso", 3200, *charts)
    assert np.abs(np.subtract(report["tone"]["ours"], report["tone"]["theirs"])).max() < 8
    assert np.round(report["tone"]["theirs"]).tolist() == list(levels)
    theirs, ours = (report["sharpness"][of]["mtf50"] for of in ("theirs", "ours"))
    assert ours == pytest.approx(theirs, abs=0.01)
    assert theirs < 0.2
    assert not any(name.startswith("tone_curve") for name in report["searched"])
    table = load_settings(str(tmp_path / "look.toml")).parameters
    assert table["tone_curve"]["toe"] > 0.8 or table["tone_curve"]["shoulder"] > 0.75
    assert table["optical_blur"]["sigma"] > 1


@pytest.mark.usefixtures("quick", "ambiguous")
def test_the_configuration_develops_what_was_measured(burst, tmp_path):
    report = matched(burst[:3], tmp_path, "--iso", 3200)
    assert report["ambiguities"] == [{"names": ["iso"], "correlation": None}]
    assert report["ended_by_range"] == "iso stopped"
    settings = load_settings(str(tmp_path / "look.toml"))
    assert (
        settings.parameters["denoise"]["luma_strength"]
        == (report["searched"]["denoise.luma_strength"])
    )
    assert settings.iso == 3200
    assert settings.output.jpeg_subsampling == "4:4:4"
    picture = Pipeline(tmp_path / "look.toml", device="numpy").process(scene(), "a").image
    assert picture.shape == (SIZE, SIZE, 3)
    assert (tmp_path / "look.png").read_bytes().startswith(b"\x89PNG")


@pytest.fixture
def ambiguous(monkeypatch):
    """Searches find that nothing tells the ISO, and that it stopped."""
    result = "clpipe.analysis.matching.result"
    monkeypatch.setattr(f"{result}.ambiguities", lambda *_: (Ambiguity(("iso",)),))
    monkeypatch.setattr(f"{result}.ended_by", lambda *_: "iso stopped")


@pytest.mark.slow
@pytest.mark.usefixtures("quick", "ambiguous")
def test_the_table(burst, clpipe, monkeypatch, tmp_path):
    monkeypatch.setattr("clpipe.commands.match.LINE_INTERVAL", 0.0)
    frames = saved(tmp_path, **{f"{k}": frame for k, frame in enumerate(burst[:3])})
    words = [*frames, "-o", tmp_path / "a.toml", "--iso", 3200, "--device", "numpy"]
    result = clpipe("match", *words)
    assert "warning: iso is poorly constrained: a factor of 2" in result.stdout
    assert "warning: iso stopped\n" in result.stdout
    text = (tmp_path / "a.toml").read_text()
    assert "\n# iso is poorly constrained: a factor of 2" in text
    assert "\n# iso stopped.\n" in text
    assert "note: 3 frames without a mean: kurtosis and tails are not compared" in result.stdout
    rows = {line[:22].strip(): line[22:].split() for line in result.stdout.splitlines()}
    assert rows["kurtosis"][-1] == "-"
    assert rows["luma, 1 right"][-2] == "±"
    assert "largest residual of a correlation in held-out areas" in result.stdout
    assert "5%; residuals of" in result.stderr
    assert " left\n" in result.stderr


@pytest.mark.parametrize(
    ("numbers", "reason"),
    [
        ({"iso": 6390.0}, "iso stopped at 6400, .* may have more noise"),
        ({"iso": 100.0}, "iso stopped at 100, .* may have less noise"),
        ({"iso": 5000.0}, "$"),
        ({"denoise.luma_strength": 1.0}, "$"),
    ],
)
def test_an_iso_that_stops_where_the_profile_ends_is_told_of(numbers, reason):
    assert re.match(reason, ended_by(Settings(camera="nikon-d800", iso=6400), numbers))


def test_numbers_that_make_up_for_each_other_are_told_of():
    chroma = Dimension("denoise.chroma_strength", 0.1, 10, 1, logarithmic=True)
    luma, grain = replace(chroma, name="denoise.luma_strength"), replace(chroma, name="iso")

    def residuals(settings, targets):
        table = settings.parameters["denoise"]
        logs = [math.log(table[name]) for name in ("luma_strength", "chroma_strength")]
        return np.array([5 * sum(logs), 0.3 * logs[0], 0.1 * math.log(settings.iso / 100)])

    stub = SimpleNamespace(
        dimensions=lambda settings: [luma, chroma, grain], residuals=residuals, targets=[None]
    )
    numbers = {luma.name: 1.0, chroma.name: 2.0, "iso": 2.0}
    settings = overlay(Settings(), {"denoise": {"luma_strength": 1.0, "chroma_strength": 2.0}})
    best = search.Candidate({}, replace(settings, iso=2.0), numbers, 1.0, 1.0)
    weak, pair = ambiguities(stub, best)
    assert weak.names == ("iso",)
    assert "a factor of 2 changes no residual" in str(weak)
    assert pair.names == (luma.name, chroma.name)
    assert pair.correlation == pytest.approx(-1, abs=0.01)
    assert "cannot be distinguished" in str(pair)


def test_scenes_of_one_name_in_two_folders_stay_apart(burst, tmp_path):
    scenes = load_scenes(saved(tmp_path, a=burst[0], b=burst[1]), [])
    one = scenes.each[0]
    darker = replace(one, mean=one.mean / 2)
    simulator, settings = Simulator(None), overlay(Settings(), KNOWN)
    noises = [simulator.noise(settings, each, "a").rgb for each in (one, darker)]
    assert not np.array_equal(*noises)


def candidate(cost):
    return search.Candidate({}, overlay(Settings(), KNOWN), {"iso": 3200.0}, cost, cost)


def test_a_terminal_has_a_bar_with_the_share_and_the_time_left(burst, tmp_path):
    scenes = load_scenes(saved(tmp_path, a=burst[0], b=burst[1]), [])
    terminal = io.StringIO()
    with SearchProgress(
        tmp_path / "a.toml", Console(file=terminal, force_terminal=True)
    ) as follower:
        follower.advanced(0.0, candidate(2.0), scenes)
        follower.advanced(0.25, best := candidate(1.5), scenes)
        first = (tmp_path / "a.toml").stat().st_ino
        follower.advanced(0.5, best, scenes)
    assert (tmp_path / "a.toml").stat().st_ino == first  # the best is the same
    assert "50%; residuals of 1.5; about" in terminal.getvalue()
    assert "the best result after 25% of the search" in (tmp_path / "a.toml").read_text()
    found = load_config(str(tmp_path / "a.toml"))
    assert found.settings.parameters["denoise"]["method"] == "mean"
    assert "stages" in found.values  # it is a whole chain, and so a look over another


@pytest.fixture
def quick(monkeypatch):
    """A search of one step in the small space."""

    def space(settings, _):
        return replace(SMALL, strength=None, is_toned=space_for(settings, True).is_toned)

    monkeypatch.setattr(match, "space_for", space)
    monkeypatch.setattr(search, "TRIAL_STEPS", 1)
    monkeypatch.setattr(search, "FINAL_STEPS", 1)


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
def test_stopped_it_ends_with_the_best_so_far(clpipe, burst, tmp_path, monkeypatch):
    frames = saved(tmp_path, **{f"{k}": frame for k, frame in enumerate(burst[:3])})
    words = ["match", *frames, "-o", tmp_path / "a.toml", "--iso", 3200, "--device", "numpy"]
    advanced = SearchProgress.advanced

    def stopped(self, *state):
        advanced(self, *state)
        os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(SearchProgress, "advanced", stopped)
    result = clpipe(*words, status=130)
    assert (
        f"stopped: wrote {tmp_path / 'a.toml'}, the best result after 0% of the search"
        in result.stderr
    )
    assert load_settings(str(tmp_path / "a.toml")).parameters["denoise"]["method"] == "mean"
    (tmp_path / "a.toml").unlink()
    monkeypatch.setattr(SearchProgress, "is_stopping", True)
    assert (
        "the search has no result yet, so nothing was written" in clpipe(*words, status=130).stderr
    )
    assert not (tmp_path / "a.toml").exists()


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
def test_without_matplotlib_it_only_cannot_draw(clpipe, burst, tmp_path, monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == "matplotlib"]:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    frames = saved(tmp_path, **{f"{k}": frame for k, frame in enumerate(burst[:3])})
    words = [*frames, "-o", tmp_path / "a.toml", "--iso", 3200, "--device", "numpy"]
    assert "matplotlib" in clpipe("match", *words, "--plot", "a.png", status=(1, 2)).stderr
    clpipe("match", *words)
    assert (tmp_path / "a.toml").exists()


def test_jpegs_say_their_quality_and_subsampling(burst, tmp_path):
    frame = tmp_path / "a.jpg"
    for encoding in (JpegEncoding(92, "4:2:2"), JpegEncoding(60, "4:2:0")):
        Image.fromarray(burst[0]).save(
            frame, quality=encoding.quality, subsampling=encoding.subsampling
        )
        assert jpeg_encoding(frame) == encoding
        assert np.array_equal(jpeg_round_trip(burst[0], encoding), np.asarray(Image.open(frame)))
    (png,) = saved(tmp_path, b=burst[0])
    assert jpeg_encoding(png) is None


def test_what_is_developed_goes_through_the_same_jpeg(burst, tmp_path):
    for k, picture in enumerate(burst[:4]):
        Image.fromarray(picture).save(tmp_path / f"{k}.jpg", quality=50, subsampling="4:2:0")
    scenes = load_scenes([str(tmp_path / "?.jpg")], [])
    assert scenes.jpeg == JpegEncoding(50, "4:2:0")
    settings = overlay(Settings(), KNOWN)
    one, simulator = scenes.each[0], Simulator(None)
    places = ValidPixels(one.mask, one.noise.level)
    ours = figures_of(simulator.noise(settings, one, "a"), places)
    without = figures_of(simulator.noise(settings, replace(one, jpeg=None), "a"), places)
    theirs = figures_of(one.noise, places)
    assert abs(ours["chroma_right"] - theirs["chroma_right"]) < 0.05
    assert abs(without["chroma_right"] - theirs["chroma_right"]) > 0.05


def test_every_number_of_the_development_is_searched():
    names = {d.name for d in dimensions_of(make_chain(Settings()))}
    assert {"denoise.luma_strength", "denoise.grain", "sharpen.amount"} <= names
    assert {"tone_curve.toe", "tone_curve.shoulder"} <= names
    assert not {"sharpen.limit", "tone_curve.saturation"} & names  # which noise does not tell
    assert not {"denoise.luma_noise", "sharpen.threshold"} & names  # in units of the signal
    space = space_for(Settings(), iso_is_given=False)
    assert space.strength is not None
    methods = {choice.text for choice in space.choices["demosaic"]}
    assert {"demosaic bilinear", "demosaic menon2007"} <= methods
    assert "demosaic gray" not in methods  # which is for sensors of one channel
    assert not any("file" in choice.text for choice in space.choices["tone_curve"])
    chain = make_chain(space.choices["chroma"][-1].over(Settings()))
    assert [s.method.method for s in chain.steps if "matrix" in s.name] == ["none", "as_shot"]
    chroma = {choice.text: choice for choice in space.choices["chroma"]}
    ways = {"smoother": {"chroma_strength", "spatial_sigma"}, "coarser": {"chroma_strength"}}
    for way, numbers in ways.items():
        chain = make_chain(chroma[f"colours of the camera, {way}"].over(Settings()))
        again = {d.name for d in dimensions_of(chain) if d.name.startswith("denoise_2.")}
        assert again == {f"denoise_2.{name}" for name in numbers}
    scales = {choice.text for choice in variants_of(Settings(), "denoise")}
    assert {"denoise.chroma_scale 1", "denoise.chroma_scale 4"} <= scales
    radii = {choice.text for choice in variants_of(Settings(), "sharpen")}
    assert {"sharpen.radius 0.84", "sharpen.radius 1.68"} <= radii


def test_a_smaller_picture_is_sharpened_before_or_after():
    before, after = list(smaller(Settings()))[:2]
    for choice, order in ((before, ["sharpen", "resize"]), (after, ["resize", "sharpen"])):
        names = choice.over(Settings()).stages
        assert [name for name in names if name in order] == order
        assert names[-3:] == ("tone_curve", "gamma", "picture_noise")


def test_a_name_with_brackets_is_no_glob_where_it_exists(tmp_path):
    for name in ("a[1].jpg", "a1.jpg"):
        (tmp_path / name).touch()
    assert expand([str(tmp_path / "a[1].jpg")]) == [tmp_path / "a[1].jpg"]
    (tmp_path / "a[1].jpg").unlink()
    assert expand([str(tmp_path / "a[1].jpg")]) == [tmp_path / "a1.jpg"]


def test_a_third_is_kept_out_of_the_search(burst, tmp_path):
    names = saved(tmp_path, **{f"{k}": frame for k, frame in enumerate(burst)})
    (one,) = load_scenes(names, []).each
    holdout = one.flat & one.holdout
    assert not (one.mask & holdout).any()
    assert holdout.sum() / one.flat.sum() == pytest.approx(1 / 3, abs=0.12)
    whole = replace(one, holdout=np.zeros_like(one.flat))
    kept = with_holdout([whole] * 6)
    assert [s.mask.any() for s in kept] == [True, True, False] * 2
    parts = with_holdout([whole] * 5)
    assert [s.mask.any() and (s.flat & s.holdout).any() for s in parts] == [True] * 5
    assert isinstance(Scenes(kept, None, ()), Scenes)


def refusal(clpipe, folder, *words):
    result = clpipe("match", *words, "-o", folder / "a.toml", status=(1, 2))
    assert not (folder / "a.toml").exists()
    return result.stderr


def test_pictures_that_do_not_belong_together_are_refused(clpipe, burst, grey, tmp_path):
    one, *others = burst
    moved = [np.roll(burst[k], k, 1) for k in range(4)]
    other = burst[1].copy()
    other[:, : SIZE // 2] //= 2
    paths = dict(
        zip(
            ("one", "two", "small", "other", "wall", "m0", "m1", "m2", "m3", "mean", "noisy"),
            saved(
                tmp_path,
                one=one,
                two=others[0],
                small=one[:120],
                other=other,
                wall=grey[1],
                **{f"m{k}": picture for k, picture in enumerate(moved)},
                mean=np.mean(burst, axis=0).round().astype(np.uint8),
                noisy=grey[0],
            ),
            strict=True,
        )
    )
    tried = {
        ("one",): "one frame alone cannot separate noise from the scene",
        ("one", "small"): "small.png is 128x120, but",
        ("one", "two", "other"): "does not show the same scene as",
        ("m0", "m1", "m2", "m3"): "px to the right",
        (
            "one",
            "one",
        ): "one.png has the same pixels as the mean of the frames, so no noise can be measured",
        ("one", "one", "one"): "has the same pixels as the mean of the frames",
        ("one", "--mean", "one"): "has the same pixels as",
        ("one", "two", "--mean", "mean", "--mean", "mean", "--mean", "mean"): "found 3 for 2",
        ("mean", "--mean", "one"): "check that frame and mean are not swapped",
    }
    for words, message in tried.items():
        given = [paths.get(word, word) for word in words]
        assert message in refusal(clpipe, tmp_path, *given), words


def test_clipped_pictures_are_refused(clpipe, burst, tmp_path):
    bright = [(frame * 2.5).clip(0, 255).astype(np.uint8) for frame in burst]
    names = saved(tmp_path, **{f"{k}": frame for k, frame in enumerate(bright)})
    assert "clipped, dark or nearly white" in refusal(clpipe, tmp_path, *names)


def test_wrong_names_and_files_are_refused(clpipe, burst, tmp_path):
    (name,) = saved(tmp_path, a=burst[0])
    render = ROOT / "tests" / "data" / "still_life.exr"
    assert "not a finished picture" in refusal(clpipe, tmp_path, name, render)
    assert "no file matches" in refusal(clpipe, tmp_path, str(tmp_path / "x*.png"))
    wrong = clpipe("match", name, "-o", tmp_path / "a.txt", status=2).stderr
    assert "expected a name that ends in .toml" in wrong
    Image.fromarray(burst[0]).save(tmp_path / "b.jpg", quality=80)
    assert "give pictures taken with the same camera" in refusal(
        clpipe, tmp_path, name, tmp_path / "b.jpg"
    )


PAIRS = {"canon-5d3-jpeg": "5dmark3_iso3200", "nikon-d800-jpeg": "d800_iso1600"}
SIZES = ("rms", "sigma_24", "sigma_40", "sigma_64", "sigma_96")
WITHIN = ("right", "below", "diagonal", "two_right", "half", "chroma_right", "red_green")
WITHIN += ("right_3", "right_6", "chroma_two_right", "chroma_right_4", "chroma_right_6")


@pytest.mark.slow
@pytest.mark.parametrize("look", PAIRS)
def test_looks_are_like_the_cameras(look, device, shared_data):
    pictures = f"{shared_data}/real_noise/{PAIRS[look]}"
    simulator, residuals, sizes, skews = Simulator(device), [], [], []
    for one in load_scenes([f"{pictures}_?_real.png"], [f"{pictures}_?_mean.png"]).each:
        places = one.places()
        ours = figures_of(simulator.noise(load_settings(look), one, "test"), places)
        theirs = figures_of(one.noise, places)
        residuals.append([ours[name] - theirs[name] for name in WITHIN])
        by_intensity = (*SIZES, "sigma_12", "sigma_128")
        sizes.append([ours[name] / theirs[name] for name in by_intensity])
        skews.append(ours["skew_24"] - theirs["skew_24"])
    assert np.nanmean(sizes, axis=0) == pytest.approx(1, abs=0.25)
    assert abs(np.nanmean(skews)) < 0.15
    # The chroma of the 5D Mark III is coarser than that of any development within reach.
    coarse = 0.23 if look == "canon-5d3-jpeg" else 0.1
    limits = [coarse if "chroma" in name or name == "red_green" else 0.1 for name in WITHIN]
    assert (np.abs(np.mean(residuals, axis=0)) < limits).all()


@pytest.mark.slow
@pytest.mark.parametrize("look", PAIRS)
def test_edges_of_looks_are_like_the_cameras(look, device, shared_data):
    pictures = f"{shared_data}/real_noise/{PAIRS[look]}"
    scenes = load_scenes([f"{pictures}_?_real.png"], [f"{pictures}_?_mean.png"]).each
    own = load_settings(look)
    settings, sharpness = as_sharp(own, edge_in(scenes), device)
    assert sharpness is not None
    assert sharpness.ours.mtf50 == pytest.approx(sharpness.theirs.mtf50, abs=0.03)
    found, set_to = (s.parameters["optical_blur"]["sigma"] for s in (settings, own))
    assert found == pytest.approx(set_to, abs=0.05)
